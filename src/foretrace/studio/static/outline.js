"use strict";
// Corners of an object's convex hull from its mask: foretrace.interactions.hull, step by step.

const Outline = (() => {
  const rolled = (array, by) => array.map((_, k) => array[(k + by) % array.length]);
  const mean = (points) => [0, 1].map((k) => points.reduce((sum, point) => sum + point[k], 0) / points.length);

  /** Middles of the pixel sides around the object, counter-clockwise and closed; which are corners of their hull. */
  function around(mask) {
    const size = FACTS.viewSize, first = { row: [], column: [] }, last = { row: [], column: [] };
    mask.forEach((filled, place) => {
      if (!filled) return;
      const row = Math.floor(place / size), column = place % size;
      first.row[row] = Math.min(first.row[row] ?? column, column);
      last.row[row] = Math.max(last.row[row] ?? column, column);
      first.column[column] = Math.min(first.column[column] ?? row, row);
      last.column[column] = Math.max(last.column[column] ?? row, row);
    });
    const pixels = [];
    first.row.forEach((column, row) => pixels.push([row, column - 0.5]));
    last.row.forEach((column, row) => pixels.push([row, column + 0.5]));
    first.column.forEach((row, column) => pixels.push([row - 0.5, column]));
    last.column.forEach((row, column) => pixels.push([row + 0.5, column]));
    let points = pixels.map(([row, column]) => [FACTS.contactPixel[0] - row, FACTS.contactPixel[1] - column]);
    const middle = mean(points);
    const angle = new Map(points.map((point) => [point, Math.atan2(point[1] - middle[1], point[0] - middle[0])]));
    points.sort((a, b) => angle.get(a) - angle.get(b));
    const centre = mean(points), far = ([x, y]) => (x - centre[0]) ** 2 + (y - centre[1]) ** 2;
    const hull = Geometry.hullIndices(points).sort((a, b) => a - b);
    const start = hull.reduce((best, k) => (far(points[k]) > far(points[best]) ? k : best));
    points = rolled(points, start);
    const nodes = hull.map((k) => (k - start + points.length) % points.length).sort((a, b) => a - b);
    return { points: [...points, points[0]], nodes: [...nodes, points.length] };
  }

  /** Which points do not lie in a notch. */
  function nearHull(points, nodes) {
    let chord = 0;
    return points.map((point, k) => {
      while (chord < nodes.length - 2 && nodes[chord + 1] <= k) chord++;
      const start = points[nodes[chord]], along = Geometry.minus(points[nodes[chord + 1]], start);
      return Math.abs(Geometry.cross(along, Geometry.minus(point, start))) <= FACTS.hullMargin * Math.hypot(...along);
    });
  }

  /** Mean x and y, and sums of squared deviations xx, xy, yy, of the points between two running sums. */
  function deviations(after, before) {
    let [n, x, y, xx, xy, yy] = after.map((value, k) => value - before[k]);
    n = Math.max(n, 1);
    return [x / n, y / n, xx - (x * x) / n, xy - (x * y) / n, yy - (y * y) / n];
  }

  function squaredDistance(after, before) {
    const [, , xx, xy, yy] = deviations(after, before);
    return Math.max((xx + yy) / 2 - Math.hypot((xx - yy) / 2, xy), 0);
  }

  /** The nodes on the cheapest way from the first to the last (dynamic programming). */
  function cheapestCuts(distances, penalty) {
    const total = [0], before = [0];
    for (let node = 1; node < distances.length; node++) {
      total[node] = Infinity;
      for (let from = 0; from < node; from++) {
        const way = total[from] + (distances[from][node] + penalty);
        if (way < total[node]) [total[node], before[node]] = [way, from];
      }
    }
    const cuts = [distances.length - 1];
    while (cuts[cuts.length - 1]) cuts.push(before[cuts[cuts.length - 1]]);
    return cuts.reverse();
  }

  /** Where two lines meet, each a point and a direction; far away if they are parallel. */
  function meeting(a, alongA, b, alongB) {
    const normal = [-alongB[1], alongB[0]];
    let slope = alongA[0] * normal[0] + alongA[1] * normal[1];
    if (Math.abs(slope) < 1e-9) slope = 1e-9;
    const reach = ((b[0] - a[0]) * normal[0] + (b[1] - a[1]) * normal[1]) / slope;
    return [a[0] + reach * alongA[0], a[1] + reach * alongA[1]];
  }

  /** Corners of the convex hull of the object in a mask, counter-clockwise in the action frame [m]. */
  function fitHull(mask) {
    const { points, nodes } = around(mask), centre = mean(points);
    for (let k = 0; k < points.length; k++) points[k] = Geometry.minus(points[k], centre);
    const near = nearHull(points, nodes), sums = [[0, 0, 0, 0, 0, 0]];
    points.forEach(([x, y], k) => {
      const terms = [1, x, y, x * x, x * y, y * y];
      sums.push(sums[k].map((value, i) => value + (near[k] ? terms[i] : 0)));
    });
    const distances = nodes.map((from) => nodes.map((to) => squaredDistance(sums[to + 1], sums[from])));
    let penalty = FACTS.cornerPenalty, cuts;
    while ((cuts = cheapestCuts(distances, penalty).map((k) => nodes[k])).length - 1 > FACTS.maxCorners) penalty *= 2;
    const metres = (corners) => Geometry.convexHull(
      corners.map(([x, y]) => [(x + centre[0]) * FACTS.metresPerPixel, (y + centre[1]) * FACTS.metresPerPixel]));
    if (cuts.length < 4) return metres(nodes.slice(0, -1).map((k) => points[k]).slice(0, FACTS.maxCorners));
    const lines = cuts.slice(0, -1).map((first, k) => {
      const last = cuts[k + 1], inner = Math.min(1, Math.floor((last - first) / 4));
      const [x, y, xx, xy, yy] = deviations(sums[last + 1 - inner], sums[first + inner]);
      const angle = Math.atan2(2 * xy, xx - yy) / 2;
      return { middle: [x, y], along: [Math.cos(angle), Math.sin(angle)], turn: points[first] };
    });
    return metres(lines.map((line, k) => {
      const before = lines[(k + lines.length - 1) % lines.length];
      const corner = meeting(before.middle, before.along, line.middle, line.along);
      return Geometry.distance(corner, line.turn) > FACTS.farthestCorner ? line.turn : corner;
    }));
  }

  return { fitHull };
})();
