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
    const object = { corners, height, bevel: bevel || fittingBevel(corners, height) };
    return { ...object, com: centreOfMass(object) };
  }

  function fittingBevel(corners, height) {
    const { width, height: depth } = FACTS.bevel;
    const scale = Math.min(1, (0.5 * Geometry.innerRadius(corners)) / width, (0.5 * height) / depth);
    return { width: width * scale, height: depth * scale };
  }

  const GAUSS = [[(1 - Math.sqrt(0.6)) / 2, 5 / 18], [1 / 2, 8 / 18], [(1 + Math.sqrt(0.6)) / 2, 5 / 18]];

  /** Centre of mass of uniform density [m]: three sections of the bevel (Gauss-Legendre), and the rest. */
  function centreOfMass({ corners, height, bevel }) {
    let volume = 0;
    const sum = [0, 0, 0];
    const add = (outline, z, depth) => {
      const { area, centroid } = Geometry.area(outline);
      volume += area * depth;
      [...centroid, z].forEach((value, k) => { sum[k] += area * depth * value; });
    };
    for (const { part, lower } of Pieces.of(corners, bevel.width)) {
      for (const [share, weight] of lower.length < 3 ? [] : GAUSS) {
        add(Pieces.between(lower, part, share), share * bevel.height, weight * bevel.height);
      }
      add(part, (height + bevel.height) / 2, height - bevel.height);
    }
    return sum.map((value) => value / volume);
  }

  /** Vertices [m] and triangles of the surface; pairs of vertices that are its edges. */
  function mesh({ corners, height, bevel }) {
    const layers = [[Pieces.inset(corners, bevel.width), 0], [corners, bevel.height], [corners, height]];
    const vertices = layers.flatMap(([outline, z]) => outline.map(([x, y]) => [x, y, z]));
    const n = corners.length, lid = Pieces.triangles(corners), faces = lid.map(([a, b, c]) => [2 * n + a, 2 * n + b, 2 * n + c]);
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

  return { make, mesh };
})();
