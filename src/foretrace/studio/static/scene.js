"use strict";
// Three dimensions on a canvas (WebGL 2): meshes and lines with a pose and a colour, and a camera that circles a point.

const Matrix = {
  // 4 x 4, by columns, as WebGL takes them.
  multiply: (a, b) => Array.from({ length: 16 }, (_, k) =>
    [0, 1, 2, 3].reduce((sum, i) => sum + a[4 * i + (k % 4)] * b[4 * Math.floor(k / 4) + i], 0)),
  identity: () => [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
  /** From three axes and an origin. */
  of: (x, y, z, o) => [...x, 0, ...y, 0, ...z, 0, ...o, 1],
  apply: (m, [x, y, z]) => [0, 1, 2, 3].map((k) => m[k] * x + m[4 + k] * y + m[8 + k] * z + m[12 + k]),
  /** Turned by a rotation vector [rad] (Rodrigues): three axes. */
  turned([x, y, z]) {
    const angle = Math.hypot(x, y, z);
    if (angle < 1e-12) return [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    const [u, v, w] = [x / angle, y / angle, z / angle], c = Math.cos(angle), s = Math.sin(angle), d = 1 - c;
    return [
      [c + u * u * d, v * u * d + w * s, w * u * d - v * s],
      [u * v * d - w * s, c + v * v * d, w * v * d + u * s],
      [u * w * d + v * s, v * w * d - u * s, c + w * w * d],
    ];
  },
};

const Vector = {
  add: (a, b, by = 1) => a.map((value, k) => value + by * b[k]),
  dot: (a, b) => a.reduce((sum, value, k) => sum + value * b[k], 0),
  cross: (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
  unit(a) {
    const length = Math.max(Math.hypot(...a), 1e-12);
    return a.map((value) => value / length);
  },
};

class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
    if (!this.gl) throw new Error("this browser shows no WebGL 2: take a newer one, or switch hardware acceleration on");
    this.things = new Map();
    this.camera = { target: [0, 0, 0.02], turn: -1.14, rise: 0.58, distance: 0.46 };
    this.program = this.compile(
      `#version 300 es
      uniform mat4 view, pose; in vec3 place; out vec3 at;
      void main() { vec4 world = pose * vec4(place, 1.0); at = world.xyz; gl_Position = view * world; }`,
      `#version 300 es
      precision highp float; uniform vec4 colour; uniform float flat_light; in vec3 at; out vec4 shown;
      void main() {
        vec3 normal = normalize(cross(dFdx(at), dFdy(at)));
        float light = 0.62 + 0.3 * abs(dot(normal, normalize(vec3(0.3, -0.45, 0.85)))) + 0.1 * abs(normal.x);
        shown = vec4(flat_light > 0.5 ? colour.rgb : colour.rgb * light, colour.a);
      }`,
    );
  }

  compile(...sources) {
    const { gl } = this, program = gl.createProgram();
    sources.forEach((source, k) => {
      const shader = gl.createShader(k ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    });
    gl.bindAttribLocation(program, 0, "place");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error("this browser cannot draw in three dimensions");
    const uniform = (name) => gl.getUniformLocation(program, name);
    return { program, view: uniform("view"), pose: uniform("pose"), colour: uniform("colour"), flat: uniform("flat_light") };
  }

  /** Add or replace a thing: `corners` are triangles, or ends of lines. */
  put(name, corners, { colour, opacity = 1, lines = false, flat = lines, pose = Matrix.identity() }) {
    this.remove(name);
    const { gl } = this, array = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(corners.flat()), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    this.things.set(name, { array, buffer, count: corners.length, colour: [...colour, opacity], lines, flat, pose, visible: true });
  }

  remove(name) {
    const thing = this.things.get(name);
    if (!thing) return;
    this.gl.deleteVertexArray(thing.array);
    this.gl.deleteBuffer(thing.buffer);
    this.things.delete(name);
  }

  get eye() {
    const { target, turn, rise, distance } = this.camera, flat = distance * Math.cos(rise);
    return Vector.add(target, [flat * Math.cos(turn), flat * Math.sin(turn), distance * Math.sin(rise)]);
  }

  get view() {
    const eye = this.eye, { target, turn } = this.camera, near = 0.005, far = 5;
    const back = Vector.unit(Vector.add(eye, target, -1)), right = [-Math.sin(turn), Math.cos(turn), 0];
    const up = Vector.cross(back, right);
    const look = Matrix.of(
      ...[0, 1, 2].map((k) => [right[k], up[k], back[k]]), [right, up, back].map((axis) => -Vector.dot(axis, eye)));
    const wide = 1.9, tall = (wide * this.canvas.width) / this.canvas.height;
    const lens = [wide, 0, 0, 0, 0, tall, 0, 0, 0, 0, (near + far) / (near - far), -1, 0, 0, (2 * near * far) / (near - far), 0];
    return Matrix.multiply(lens, look);
  }

  /** Where a point is on the canvas, in CSS pixels. */
  project(point) {
    const [x, y, , w] = Matrix.apply(this.view, point), { clientWidth, clientHeight } = this.canvas;
    return [((x / w + 1) / 2) * clientWidth, ((1 - y / w) / 2) * clientHeight];
  }

  /** Where on the table a CSS pixel of the canvas is; null: nowhere. */
  onTable([left, top]) {
    const { clientWidth, clientHeight } = this.canvas, eye = this.eye, { target, turn } = this.camera;
    const back = Vector.unit(Vector.add(eye, target, -1)), right = [-Math.sin(turn), Math.cos(turn), 0];
    const up = Vector.cross(back, right), wide = 1.9, tall = (wide * clientWidth) / clientHeight;
    let ray = Vector.add([0, 0, 0], back, -1);
    ray = Vector.add(ray, right, ((2 * left) / clientWidth - 1) / wide);
    ray = Vector.add(ray, up, (1 - (2 * top) / clientHeight) / tall);
    if (ray[2] > -1e-3) return null;
    return Vector.add(eye, ray, -eye[2] / ray[2]).slice(0, 2);
  }

  draw(background) {
    const { gl, canvas, program } = this, ratio = window.devicePixelRatio || 1;
    const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(program.program);
    gl.uniformMatrix4fv(program.view, false, this.view);
    const shown = [...this.things.values()].filter((thing) => thing.visible);
    for (const clear of [false, true]) {
      gl.depthMask(!clear); // what is translucent hides nothing
      for (const thing of shown) {
        if (clear !== thing.colour[3] < 1) continue;
        gl.uniformMatrix4fv(program.pose, false, thing.pose);
        gl.uniform4fv(program.colour, thing.colour);
        gl.uniform1f(program.flat, thing.flat ? 1 : 0);
        gl.bindVertexArray(thing.array);
        gl.drawArrays(thing.lines ? gl.LINES : gl.TRIANGLES, 0, thing.count);
      }
    }
    gl.depthMask(true);
  }
}
