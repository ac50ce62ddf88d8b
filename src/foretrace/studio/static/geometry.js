"use strict";
// Plane polygons: arrays of [x, y] in metres, counter-clockwise, without a repeated first corner.

const Geometry = (() => {
  const cross = (a, b) => a[0] * b[1] - a[1] * b[0];
  const minus = (a, b) => [a[0] - b[0], a[1] - b[1]];
  const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);

  /** Each corner with the next one. */
  const edges = (corners) => corners.map((corner, k) => [corner, corners[(k + 1) % corners.length]]);

  /** Signed area [m^2] and centroid [m]. */
  function area(corners) {
    let sum = 0, x = 0, y = 0;
    for (const [a, b] of edges(corners.map((corner) => minus(corner, corners[0])))) {
      const part = cross(a, b);
      sum += part;
      x += part * (a[0] + b[0]);
      y += part * (a[1] + b[1]);
    }
    return { area: sum / 2, centroid: [corners[0][0] + x / (3 * sum), corners[0][1] + y / (3 * sum)] };
  }

  /** Indices of the corners of the convex hull, counter-clockwise, collinear points left out (monotone chain). */
  function hullIndices(points) {
    const order = points.map((_, k) => k).sort((i, j) => points[i][0] - points[j][0] || points[i][1] - points[j][1]);
    const distinct = order.filter((i, k) => !k || distance(points[i], points[order[k - 1]]) > 0);
    if (distinct.length < 3) return distinct;
    const chain = (sequence) => {
      const kept = [];
      for (const i of sequence) {
        while (kept.length >= 2) {
          const [a, b] = [points[kept[kept.length - 2]], points[kept[kept.length - 1]]];
          if ((b[0] - a[0]) * (points[i][1] - a[1]) - (b[1] - a[1]) * (points[i][0] - a[0]) > 0) break;
          kept.pop();
        }
        kept.push(i);
      }
      return kept.slice(0, -1);
    };
    return [...chain(distinct), ...chain(distinct.reverse())];
  }

  const convexHull = (points) => hullIndices(points).map((k) => points[k]);

  /** Inward unit normal of each edge. */
  const normals = (corners) => edges(corners).map(([a, b]) => {
    const length = distance(a, b);
    return [(a[1] - b[1]) / length, (b[0] - a[0]) / length];
  });

  /** Nearest point of a segment, and how far along it that is [m]. */
  function nearest(point, [a, b]) {
    const way = minus(b, a), length = Math.hypot(...way);
    const share = Math.min(1, Math.max(0, (minus(point, a)[0] * way[0] + minus(point, a)[1] * way[1]) / length ** 2));
    return { point: [a[0] + share * way[0], a[1] + share * way[1]], along: share * length };
  }

  const toOutline = (point, corners) =>
    Math.min(...edges(corners).map((edge) => distance(point, nearest(point, edge).point)));

  /** Whether a point lies in a polygon. */
  function inside([x, y], corners) {
    let within = false;
    for (const [a, b] of edges(corners)) {
      if (a[1] > y !== b[1] > y && x < a[0] + ((y - a[1]) / (b[1] - a[1])) * (b[0] - a[0])) within = !within;
    }
    return within;
  }

  /** Radius of the widest circle inside a polygon [m], to a hundredth of a millimetre: on ever finer grids. */
  function innerRadius(corners) {
    const low = [0, 1].map((k) => Math.min(...corners.map((corner) => corner[k])));
    const high = [0, 1].map((k) => Math.max(...corners.map((corner) => corner[k])));
    let step = Math.max(high[0] - low[0], high[1] - low[1]) / 32;
    const reach = (point) => (inside(point, corners) ? 1 : -1) * toOutline(point, corners);
    let best = [];
    for (let i = 0; i <= 32; i++) {
      for (let j = 0; j <= 32; j++) {
        const point = [low[0] + i * step, low[1] + j * step];
        best.push({ point, reach: reach(point) });
      }
    }
    while (step > 1e-5) {
      step /= 2;
      best = best.sort((a, b) => b.reach - a.reach).slice(0, 6).flatMap(({ point: [x, y] }) =>
        [-1, 0, 1].flatMap((i) => [-1, 0, 1].map((j) => [x + i * step, y + j * step])))
        .map((point) => ({ point, reach: reach(point) }));
    }
    return Math.max(...best.map((each) => each.reach));
  }

  /** Corners in counter-clockwise order, the first one first; throws what is wrong with them. */
  function simplePolygon(corners) {
    corners = corners.filter((corner, k) => distance(corner, corners[(k + 1) % corners.length]) > 1e-6);
    if (corners.length < 3) throw new Error(`an outline of ${corners.length} corners: at least 3 are needed`);
    const all = edges(corners);
    const side = (a, b, c) => Math.sign(cross(minus(b, a), minus(c, a)));
    all.forEach(([a, b], i) => all.forEach(([c, d], j) => {
      if (j <= i + 1 || (i === 0 && j === all.length - 1)) return;
      if (side(a, b, c) !== side(a, b, d) && side(c, d, a) !== side(c, d, b)) {
        throw new Error("the outline crosses itself: give the corners in order");
      }
    }));
    const signed = area(corners).area;
    if (Math.abs(signed) < 1e-6) throw new Error("the outline has no area: draw it larger");
    return signed > 0 ? corners : [corners[0], ...corners.slice(1).reverse()];
  }

  return { area, convexHull, cross, distance, edges, hullIndices, innerRadius, inside, minus, nearest, normals, simplePolygon, toOutline };
})();
