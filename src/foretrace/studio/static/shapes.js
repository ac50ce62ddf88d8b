"use strict";
// Corners of triangles, or ends of lines, of what a scene shows [m].

const Shapes = (() => {
  const triangles = ({ vertices, faces }) => faces.flatMap((face) => face.map((k) => vertices[k]));

  function box([x, y, z], [a, b, c]) {
    const vertices = [-1, 1].flatMap((i) => [-1, 1].flatMap((j) => [-1, 1].map((k) => [x + i * a, y + j * b, z + k * c])));
    const quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
    return triangles({ vertices, faces: quads.flatMap(([p, q, r, s]) => [[p, q, r], [p, r, s]]) });
  }

  /** Rings of points joined by triangles. */
  function joined(rings) {
    const sides = rings[0].length;
    return rings.slice(1).flatMap((ring, k) => ring.flatMap((_, i) => {
      const j = (i + 1) % sides, before = rings[k];
      return [before[i], before[j], ring[j], before[i], ring[j], ring[i]];
    }));
  }

  /** The surface about a path, round at both ends: `radius` is one for each point; nothing is below `lowest`. */
  function tube(path, radius, sides = 14, lowest = -Infinity) {
    const kept = path.reduce((found, point, k) => {
      const last = path[found[found.length - 1]];
      return !found.length || Math.hypot(...Vector.add(point, last, -1)) > 1e-4 ? [...found, k] : found;
    }, []);
    let centres = kept.map((k) => path[k]), wide = kept.map((k) => radius[k]);
    if (kept.length === 1) [centres, wide] = [[path[0], Vector.add(path[0], [0, 0, 1e-4])], [Math.max(...radius), Math.max(...radius)]];
    let side = null;
    const rings = centres.flatMap((centre, k) => {
      const ahead = Vector.unit(Vector.add(centres[Math.min(k + 1, centres.length - 1)], centres[Math.max(k - 1, 0)], -1));
      side = side || Vector.cross(ahead, Math.abs(ahead[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0]);
      side = Vector.unit(Vector.add(side, ahead, -Vector.dot(side, ahead))); // carried along without twist
      const other = Vector.cross(ahead, side);
      const ring = (back, small) => Array.from({ length: sides }, (_, i) => {
        const angle = (2 * Math.PI * i) / sides, [c, s] = [small * Math.cos(angle), small * Math.sin(angle)];
        const at = centre.map((value, n) => value + wide[k] * (back * ahead[n] + c * side[n] + s * other[n]));
        return [at[0], at[1], Math.max(at[2], lowest)];
      });
      const ends = [[0.15, 0.989], [0.6, 0.8], [0.9, 0.436]]; // rings beyond an end: radius and distance
      if (k === 0) return [...ends.map(([small, back]) => ring(-back, small)), ring(0, 1)];
      if (k === centres.length - 1) return [ring(0, 1), ...ends.reverse().map(([small, back]) => ring(back, small))];
      return [ring(0, 1)];
    });
    return joined(rings);
  }

  const ball = (centre, radius) => tube([centre, Vector.add(centre, [0, 0, 1.5e-4])], [radius, radius], 18);

  /** A plane's lines, `cell` apart [m]. */
  function grid(half, cell) {
    const count = Math.round(half / cell);
    return Array.from({ length: 2 * count + 1 }, (_, k) => (k - count) * cell)
      .flatMap((at) => [[at, -half, 0], [at, half, 0], [-half, at, 0], [half, at, 0]]);
  }

  return { ball, box, grid, triangles, tube };
})();
