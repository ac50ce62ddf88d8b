"use strict";
// Convex pieces of an outline and of its bevelled rim, as foretrace.Prism has them.

const Pieces = (() => {
  /** The outline moved inwards by a distance [m], each corner along its bisector. */
  function inset(corners, width) {
    const normals = Geometry.normals(corners);
    return corners.map((corner, k) => {
      const [n, m] = [normals[k], normals[(k + corners.length - 1) % corners.length]];
      const stretch = width / Math.max(1 + n[0] * m[0] + n[1] * m[1], 1e-9);
      return [corner[0] + stretch * (n[0] + m[0]), corner[1] + stretch * (n[1] + m[1])];
    });
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

  /** Whether a polygon is convex; straight corners count as convex. */
  const convex = (part) => part.every((b, k) => {
    const before = Geometry.minus(b, part[(k + part.length - 1) % part.length]), after = Geometry.minus(part[(k + 1) % part.length], b);
    return Geometry.cross(before, after) >= -1e-9 * Math.hypot(...before) * Math.hypot(...after);
  });

  const pairs = (part) => part.map((i, k) => [i, part[(k + 1) % part.length]]);
  const owners = (parts) => new Map(parts.flatMap((part) => pairs(part).map((edge) => [edge.join(), part])));
  const from = (part, i) => [...part.slice(part.indexOf(i)), ...part.slice(0, part.indexOf(i))];

  /** Whether a point lies inside the circle through three others, which are counter-clockwise. */
  function inCircle([a, b, c], point) {
    const rows = [a, b, c].map((corner) => Geometry.minus(corner, point)), squares = rows.map(([x, y]) => x * x + y * y);
    const by = (i, j) => Geometry.cross(rows[i], rows[j]);
    return squares[0] * by(1, 2) + squares[1] * by(2, 0) + squares[2] * by(0, 1) > 1e-16;
  }

  /** Triangles of which none has a corner of its neighbour in its circle: diagonals are flipped. */
  function delaunay(corners) {
    const found = new Set(triangles(corners)), owner = owners([...found]), open = [...owner.keys()];
    while (open.length) {
      const [i, j] = open.pop().split(",").map(Number), left = owner.get(`${i},${j}`), right = owner.get(`${j},${i}`);
      if (!left || !right || !inCircle(left.map((k) => corners[k]), corners[from(right, j)[2]])) continue;
      const [k, l] = [from(left, i)[2], from(right, j)[2]];
      for (const gone of [left, right]) found.delete(gone);
      for (const edge of [[i, j], [j, i]]) owner.delete(edge.join());
      for (const made of [[i, l, k], [l, j, k]]) {
        found.add(made);
        for (const edge of pairs(made)) {
          owner.set(edge.join(), made);
          open.push(edge.join());
        }
      }
    }
    return [...found];
  }

  /** Corner indices of convex parts: triangles merged across diagonals, the longest first, where that stays convex. */
  function parts(corners) {
    let found = delaunay(corners);
    const owner = owners(found), length = ([i, j]) => Geometry.distance(corners[i], corners[j]);
    const diagonals = found.flatMap(pairs).filter(([i, j]) => i < j && owner.has(`${j},${i}`));
    for (const [i, j] of diagonals.sort((a, b) => length(b) - length(a))) {
      const left = owner.get(`${i},${j}`), right = owner.get(`${j},${i}`);
      const merged = [...from(left, j), ...from(right, i).slice(1, -1)];
      if (left === right || !convex(merged.map((k) => corners[k]))) continue;
      found = [...found.filter((part) => part !== left && part !== right), merged];
      for (const edge of pairs(merged)) owner.set(edge.join(), merged);
    }
    return found;
  }

  /** What is left of a convex part at a distance [m] from an edge's line. */
  function clipped(part, [a, b], width) {
    const inward = Geometry.normals([a, b])[0], reach = (p) => inward[0] * (p[0] - a[0]) + inward[1] * (p[1] - a[1]) - width;
    return Geometry.edges(part).flatMap(([p, q]) => {
      const [s, t] = [reach(p), reach(q)], share = s / (s - t);
      return [...(s >= 0 ? [p] : []), ...(s >= 0 !== t >= 0 ? [between([p], [q], share)[0]] : [])];
    });
  }

  /** The hull of what a convex polygon and another one have in common. */
  function common(part, other) {
    const within = (polygon) => (p) => Geometry.inside(p, polygon) || Geometry.toOutline(p, polygon) < 1e-9;
    const points = [...part.filter(within(other)), ...other.filter(within(part))];
    for (const [a, b] of Geometry.edges(part)) {
      for (const [c, d] of Geometry.edges(other)) {
        const along = Geometry.minus(b, a), across = Geometry.minus(d, c), start = Geometry.minus(c, a);
        const area = Geometry.cross(along, across), s = Geometry.cross(start, across) / area, t = Geometry.cross(start, along) / area;
        if (s >= 0 && s <= 1 && t >= 0 && t <= 1) points.push([a[0] + s * along[0], a[1] + s * along[1]]);
      }
    }
    return Geometry.convexHull(points);
  }

  /** Convex parts, and what the bevel leaves of each at the table. */
  function of(corners, width) {
    const bottom = inset(corners, width), n = corners.length;
    if (convex(corners)) return [{ part: corners, lower: bottom }];
    return parts(corners).filter((part) => Geometry.area(part.map((k) => corners[k])).area > 1e-7).map((indices) => {
      const part = indices.map((k) => corners[k]), own = pairs(indices).filter(([i, j]) => j === (i + 1) % n);
      const lower = own.reduce((left, edge) => (left.length ? clipped(left, edge.map((k) => corners[k]), width) : left), part);
      return { part, lower: lower.length < 3 ? [] : common(lower, bottom) };
    });
  }

  /** The section of the hull of two convex polygons, one above the other, at a share of the way between them. */
  function between(low, high, share) {
    const points = low.flatMap((a) => high.map((b) => [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])]));
    return points.length < 3 ? points : Geometry.convexHull(points);
  }

  return { between, convex, inset, of, triangles };
})();
