"use strict";
// What a predictor is told of an object: seen from above in the action frame, as foretrace.TopDownView.

const View = (() => {
  /** Point of the object's frame in the action frame, and back. */
  function frames({ contact, direction: [c, s] }) {
    const enter = ([x, y]) => {
      const [u, v] = [x - contact[0], y - contact[1]];
      return [c * u + s * v, c * v - s * u];
    };
    const leave = ([x, y]) => [contact[0] + c * x - s * y, contact[1] + s * x + c * y];
    return { enter, leave };
  }

  /** Mask of an object, row by row; throws what is wrong with it. */
  function maskOf(object, action) {
    const { viewSize: size, metresPerPixel: scale, contactPixel } = FACTS;
    const { enter } = frames(action), outline = object.corners.map(enter);
    const mask = new Uint8Array(size * size);
    for (let row = 0; row < size; row++) {
      const x = (contactPixel[0] - row) * scale;
      for (let column = 0; column < size; column++) {
        mask[row * size + column] = Geometry.inside([x, (contactPixel[1] - column) * scale], outline) ? 1 : 0;
      }
    }
    const pixels = outline.flatMap((point) => point.map((value, k) => contactPixel[k] - value / scale));
    if (Math.min(...pixels) < 0.5 || Math.max(...pixels) > size - 1.5) {
      throw new Error("the object reaches beyond the view from that contact: choose another one, or a smaller object");
    }
    if (!mask.includes(1)) throw new Error("the object is too thin to be seen: draw it wider");
    return largest(mask, size);
  }

  /** The largest object in a mask; pixels that touch at a corner belong together. */
  function largest(mask, size) {
    const label = new Int32Array(mask.length), areas = [0];
    mask.forEach((filled, seed) => {
      if (!filled || label[seed]) return;
      const number = areas.push(0) - 1, open = [seed];
      label[seed] = number;
      while (open.length) {
        const place = open.pop(), row = Math.floor(place / size), column = place % size;
        areas[number]++;
        for (const [i, j] of [[-1, -1], [-1, 0], [-1, 1], [0, -1], [0, 1], [1, -1], [1, 0], [1, 1]]) {
          const beside = (row + i) * size + column + j;
          if (!mask[beside] || label[beside]) continue;
          label[beside] = number;
          open.push(beside);
        }
      }
    });
    const most = Math.max(...areas);
    if (areas.filter((area) => area > FACTS.relevantShare * most).length > 1) {
      throw new Error("the object is too thin in places: it falls apart in the view");
    }
    const kept = areas.indexOf(most);
    return mask.map((_, place) => (label[place] === kept ? 1 : 0));
  }

  /** Inputs of the network. */
  function inputs(object, action, path, physics) {
    const { viewSize: size, maxCorners, heightCells: cells, unit } = FACTS, mask = maskOf(object, action);
    const features = new Float32Array(2 * maxCorners + cells * cells), hull = Outline.fitHull(mask);
    for (let k = 0; k < maxCorners; k++) features.set((hull[k] || hull[0]).map((value) => value / unit), 2 * k);
    const side = size / cells, share = object.height / (unit * side * side);
    mask.forEach((filled, place) => {
      const row = Math.floor(place / size / side), column = Math.floor((place % size) / side);
      if (filled) features[2 * maxCorners + row * cells + column] += share;
    });
    const { com, bevel: { width, height } } = object;
    const known = { ...physics, ...path, bevel_width: width, bevel_height: height };
    return {
      features,
      com: Float32Array.from([...frames(action).enter(com), com[2]]),
      context: Float32Array.from(FACTS.context.map((name) => known[name] ?? NaN)),
    };
  }

  return { frames, inputs };
})();
