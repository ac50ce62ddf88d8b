"use strict";
// A lever-up: where it meets an outline, and how its blade moves. As foretrace.planning.candidates and foretrace.ToolPath.

const Lever = (() => {
  /** Where the outline's edges begin along it [m]; the last entry is its length. */
  function starts(corners) {
    const found = [0];
    for (const [a, b] of Geometry.edges(corners)) found.push(found[found.length - 1] + Geometry.distance(a, b));
    return found;
  }

  const edgeAt = (along, at) => {
    let edge = at.length - 2;
    while (edge > 0 && at[edge] > along) edge--;
    return edge;
  };

  function pointAt(along, corners, at) {
    const length = at[corners.length], place = ((along % length) + length) % length;
    const edge = edgeAt(place, at), [a, b] = [corners[edge], corners[(edge + 1) % corners.length]];
    const share = (place - at[edge]) / (at[edge + 1] - at[edge]);
    return [a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])];
  }

  /** Contact and direction at a share of the outline's length, turned from the inward normal [rad]. */
  function place(corners, share, turn) {
    const at = starts(corners), length = at[corners.length];
    let along = (share * length) % length;
    const edge = edgeAt(along, at), [low, high] = [at[edge], at[edge + 1]];
    const margin = Math.min(FACTS.cornerMargin, (high - low) / 2);
    along = Math.min(Math.max(along, low + margin), high - margin);
    const short = high - low < 2 * FACTS.blade;
    const first = pointAt(short ? along - FACTS.blade : low, corners, at);
    const last = pointAt(short ? along + FACTS.blade : high - 1e-9, corners, at);
    const chord = Geometry.minus(last, first), wide = Math.max(Math.hypot(...chord), 1e-12);
    const normal = [-chord[1] / wide, chord[0] / wide], [c, s] = [Math.cos(turn), Math.sin(turn)];
    const direction = [c * normal[0] - s * normal[1], s * normal[0] + c * normal[1]];
    return { contact: pointAt(along, corners, at), direction, normal };
  }

  /** Share of the outline's length at the point that is nearest to another one. */
  function shareAt(corners, point) {
    const at = starts(corners);
    const found = Geometry.edges(corners).map((edge, k) => {
      const near = Geometry.nearest(point, edge);
      return { apart: Geometry.distance(point, near.point), along: at[k] + near.along };
    });
    return found.reduce((best, each) => (each.apart < best.apart ? each : best)).along / at[corners.length];
  }

  const minimumJerk = (t) => {
    const s = Math.min(1, Math.max(0, t));
    return s ** 3 * (10 - 15 * s + 6 * s * s);
  };

  /** The path's times for a speed [s]. */
  function times(speed) {
    const { wait_time: wait, insert_time, lift_time, hold_time } = FACTS.path;
    const insert = insert_time / speed, lift = lift_time / speed;
    return { wait, insert, lift, duration: wait + insert + lift + hold_time };
  }

  /** Tip of the blade, x and z in the action frame [m], and its pitch [rad], at a time [s]. */
  function tip({ insertion, arc_radius: radius, sweep, speed }, time) {
    const { standoff, clearance, pitch, pitch_gain: gain } = FACTS.path, { wait, insert, lift } = times(speed);
    const angle = sweep * minimumJerk((time - wait - insert) / lift);
    const x = -standoff + (insertion + standoff) * minimumJerk((time - wait) / insert) + radius * (1 - Math.cos(angle));
    return { x, z: clearance + radius * Math.sin(angle), pitch: pitch + gain * angle };
  }

  return { place, shareAt, times, tip };
})();
