"use strict";
// Table, object, screwdriver, futures and regions in a scene; all in the object's frame.

class Stage {
  constructor(scene, labels) {
    this.scene = scene;
    this.labels = labels;
    this.moving = [];
    this.shown = null;
    scene.put("table", Shapes.box([0, 0, -0.006], [0.45, 0.45, 0.006]), { colour: FACTS.colours.table, flat: true });
    scene.put("grid", Shapes.grid(0.45, 0.05).map(([x, y]) => [x, y, 2e-4]), { colour: FACTS.colours.grid, lines: true });
    for (const part of FACTS.tool) {
      const corners = part.shape === "box" ? Shapes.box(part.start, part.end) : Shapes.tube([part.start, part.end], [part.radius, part.radius]);
      scene.put(`tool ${part.name}`, corners, { colour: part.colour });
    }
  }

  showObject(object) {
    const { vertices, faces, lines } = Prism.mesh(object), { scene } = this, colours = FACTS.colours;
    scene.put("object", Shapes.triangles({ vertices, faces }), { colour: colours.object });
    scene.put("edges", lines.flat().map((k) => vertices[k]), { colour: colours.edge, lines: true });
    const rest = Geometry.edges(object.corners).flat().map(([x, y]) => [x, y, 8e-4]);
    scene.put("rest", rest, { colour: colours.edge, lines: true });
    const middle = [0, 1, 2].map((k) => vertices.reduce((sum, vertex) => sum + vertex[k], 0) / vertices.length);
    // A little smaller, so that ghosts are hidden in the object where they do not differ from it.
    const small = vertices.map((vertex) => Vector.add(middle, Vector.add(vertex, middle, -1), 0.985));
    this.ghost = Shapes.triangles({ vertices: small, faces });
    const box = [0, 1].map((k) => (Math.min(...object.corners.map((c) => c[k])) + Math.max(...object.corners.map((c) => c[k]))) / 2);
    scene.camera.target = [...box, 0.02];
  }

  /** What is imagined; null: nothing. */
  showFutures(imagined, tubes) {
    const { scene } = this;
    for (const name of [...scene.things.keys()]) if (/^(ghost|tube|path)/.test(name)) scene.remove(name);
    this.labels.replaceChildren();
    this.moving = [];
    this.shown = imagined;
    if (!imagined) return;
    const { action, com } = imagined, { leave } = View.frames(action), [c, s] = action.direction;
    const out = ([x, y, z]) => [...leave([x, y]), z];
    const enter = Matrix.of([c, -s, 0], [s, c, 0], [0, 0, 1], [...View.frames(action).enter([0, 0]), 0]);
    const back = Matrix.of([c, s, 0], [-s, c, 0], [0, 0, 1], [...action.contact, 0]);
    const motions = imagined.motions.slice(0, FACTS.mostFutures).filter((each, k) => !k || each.probability >= FACTS.leastShown);
    motions.forEach((motion, k) => {
      const colour = FACTS.outcomeColours[motion.outcome];
      const path = motion.com.map(out);
      if (k) scene.put(`ghost ${k}`, this.ghost, { colour, opacity: 0.22 });
      scene.put(`path ${k}`, Shapes.tube(path, path.map(() => 7e-4), 8), { colour, flat: true });
      const wide = motion.radius && Math.max(...motion.radius);
      if (tubes && motion.radius && !(k && wide > FACTS.wide)) {
        const radius = motion.radius.map((value) => Math.min(value, 0.2));
        const table = Math.min(0, ...path.map((point) => point[2]));
        scene.put(`tube ${k}`, Shapes.tube(path, radius, 14, table), { colour, opacity: !k && wide < FACTS.wide ? 0.3 : 0.13 });
      }
      const poses = motion.com.map((at, t) => {
        const turn = Matrix.turned(motion.turn[t]);
        const shift = [0, 1, 2].map((i) => at[i] - turn.reduce((sum, axis, j) => sum + axis[i] * com[j], 0));
        return Matrix.multiply(back, Matrix.multiply(Matrix.of(...turn, shift), enter));
      });
      this.moving.push({ names: k ? [`ghost ${k}`] : ["object", "edges"], poses });
      if (motions.length > 1) this.label(`${motion.outcome} ${Futures.percentage(motion.probability)}`, path[path.length - 1]);
    });
  }

  label(text, place) {
    const element = document.createElement("span");
    element.textContent = text;
    element.place = place;
    this.labels.append(element);
  }

  /** The grip behind the contact. */
  showGrip(action) {
    this.grip = [...Vector.add(action.contact, action.direction, -FACTS.gripBehind), FACTS.gripRadius];
    this.scene.put("grip", Shapes.ball(this.grip, FACTS.gripRadius), { colour: FACTS.colours.grip });
  }

  /** Corners of an outline that is being drawn; null: none is. */
  showDrawing(points) {
    for (const name of ["drawing", "drawn lines"]) this.scene.remove(name);
    for (const [name, thing] of this.scene.things) if (!/^(table|grid|drawing|drawn)/.test(name)) thing.visible = points === null;
    if (!points || !points.length) return;
    const colour = FACTS.colours.drawing, raised = points.map(([x, y]) => [x, y, 0.002]);
    this.scene.put("drawing", raised.flatMap((point) => Shapes.ball(point, 0.003)), { colour });
    if (points.length > 1) this.scene.put("drawn lines", Geometry.edges(raised).flat(), { colour, lines: true });
  }

  /** Everything as it is at a time [s]. */
  showTime(time) {
    if (!this.shown) return;
    const { times, action, path } = this.shown, [c, s] = action.direction;
    const after = times.findIndex((each) => each >= time - 1e-9), k = after < 0 ? times.length - 1 : after;
    for (const { names, poses } of this.moving) for (const name of names) this.scene.things.get(name).pose = poses[k];
    const { x, z, pitch } = Lever.tip(path, time), [a, b] = [Math.cos(pitch), Math.sin(pitch)];
    const pose = Matrix.of([c * a, s * a, -b], [-s, c, 0], [c * b, s * b, a], [...View.frames(action).leave([x, 0]), z]);
    for (const part of FACTS.tool) this.scene.things.get(`tool ${part.name}`).pose = pose;
  }

  draw() {
    const [, ...parts] = /(\d+), (\d+), (\d+)/.exec(getComputedStyle(document.body).backgroundColor);
    const paper = parts.map((value) => value / 255), dark = paper[0] < 0.5;
    for (const name of ["table", "grid"]) {
      const colour = FACTS.colours[name].map((value) => (dark ? 0.4 + 0.15 * (name === "grid") : 1) * value);
      this.scene.things.get(name).colour = [...colour, 1];
    }
    this.scene.draw(paper);
    const taken = [];
    for (const element of this.labels.children) {
      let [left, top] = this.scene.project(element.place);
      while (taken.some(([x, y]) => Math.abs(x - left) < 110 && Math.abs(y - top) < 20)) top -= 21;
      taken.push([left, top]);
      Object.assign(element.style, { left: `${left}px`, top: `${top}px` });
    }
  }
}
