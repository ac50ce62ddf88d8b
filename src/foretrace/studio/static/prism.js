"use strict";
// An outline, extruded, with a bevelled lower rim: as foretrace.Prism with its fitting bevel.

const Prism = (() => {
  /** Object of an outline [m] and a height [m]. */
  function make(corners, height, bevel = null) {
    corners = Geometry.simplePolygon(corners);
    const size = Math.max(...corners.map((a) => Math.max(...corners.map((b) => Geometry.distance(a, b)))));
    if (size < FACTS.smallest || size > FACTS.largest) {
      throw new Error(`the object is ${(100 * size).toFixed(1)} cm long: draw it between 1 and 100 cm`);
    }
    return { corners, height, bevel: bevel || fittingBevel(corners, height) };
  }

  function fittingBevel(corners, height) {
    const { width, height: depth } = FACTS.bevel;
    const scale = Math.min(1, (0.5 * Geometry.innerRadius(corners)) / width, (0.5 * height) / depth);
    return { width: width * scale, height: depth * scale };
  }

  /** The outline moved inwards by a distance [m], each corner along its bisector. */
  function inset(corners, width) {
    const normals = Geometry.normals(corners);
    return corners.map((corner, k) => {
      const [n, m] = [normals[k], normals[(k + corners.length - 1) % corners.length]];
      const stretch = width / Math.max(1 + n[0] * m[0] + n[1] * m[1], 1e-9);
      return [corner[0] + stretch * (n[0] + m[0]), corner[1] + stretch * (n[1] + m[1])];
    });
  }

  /** Centre of mass of uniform density [m]: three sections of the bevel (Gauss-Legendre), and the rest. */
  function centreOfMass({ corners, height, bevel }) {
    const sections = [[-Math.sqrt(0.6), 5 / 18], [0, 8 / 18], [Math.sqrt(0.6), 5 / 18]].map(([place, weight]) => {
      const share = (1 + place) / 2;
      return { outline: inset(corners, bevel.width * (1 - share)), z: share * bevel.height, depth: weight * bevel.height };
    });
    sections.push({ outline: corners, z: (height + bevel.height) / 2, depth: height - bevel.height });
    let volume = 0;
    const sum = [0, 0, 0];
    for (const { outline, z, depth } of sections) {
      const { area, centroid } = Geometry.area(outline);
      volume += area * depth;
      [...centroid, z].forEach((value, k) => { sum[k] += area * depth * value; });
    }
    return sum.map((value) => value / volume);
  }

  /** Corner indices of triangles that tile a polygon: ears are cut off. */
  function triangles(corners) {
    const left = corners.map((_, k) => k), found = [];
    while (left.length > 3) {
      const ear = left.findIndex((b, k) => {
        const a = left[(k + left.length - 1) % left.length], c = left[(k + 1) % left.length];
        const ring = [corners[a], corners[b], corners[c]];
        return Geometry.cross(Geometry.minus(ring[1], ring[0]), Geometry.minus(ring[2], ring[1])) > 0
          && !left.some((i) => i !== a && i !== b && i !== c && Geometry.inside(corners[i], ring));
      });
      const k = Math.max(ear, 0);
      found.push([left[(k + left.length - 1) % left.length], left[k], left[(k + 1) % left.length]]);
      left.splice(k, 1);
    }
    return [...found, left];
  }

  /** Vertices [m] and triangles of the surface; pairs of vertices that are its edges. */
  function mesh({ corners, height, bevel }) {
    const layers = [[inset(corners, bevel.width), 0], [corners, bevel.height], [corners, height]];
    const vertices = layers.flatMap(([outline, z]) => outline.map(([x, y]) => [x, y, z]));
    const n = corners.length, lid = triangles(corners), faces = lid.map(([a, b, c]) => [2 * n + a, 2 * n + b, 2 * n + c]);
    const lines = [];
    for (let k = 0; k < n; k++) {
      const after = (k + 1) % n;
      for (const base of [0, n]) {
        faces.push([base + k, base + after, base + n + after], [base + k, base + n + after, base + n + k]);
      }
      for (const base of [n, 2 * n]) lines.push([base + k, base + after]);
      if (n <= FACTS.mostUprights) lines.push([n + k, 2 * n + k]);
    }
    faces.push(...lid.map(([a, b, c]) => [a, c, b]));
    return { vertices, faces, lines };
  }

  return { make, centreOfMass, mesh };
})();
