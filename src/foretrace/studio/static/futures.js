"use strict";
// Futures with probabilities and regions from what the network returns, as foretrace.imagined.Futures.

const Futures = (() => {
  /** Quantile of the region that is drawn, for how much of the physics is known. */
  function width(context) {
    const [told, nothing] = FACTS.widths;
    const known = FACTS.optional.map((name) => Number.isFinite(context[FACTS.context.indexOf(name)]));
    if (known.every(Boolean)) return told;
    return known.some(Boolean) ? Math.max(told, nothing) : nothing;
  }

  /** Motions up to the end of the blade's path, the most probable one first; radii are null where none is known. */
  function read(outputs, context, duration) {
    const { futures: names, times } = FACTS, samples = times.length, wide = width(context);
    const probability = Array.from(outputs.probability), best = Math.max(...probability);
    const count = times.filter((time) => time <= duration + 1e-9).length;
    const triples = (values, k) => Array.from({ length: count }, (_, t) =>
      Array.from(values.subarray(3 * (samples * k + t), 3 * (samples * k + t) + 3)));
    const motions = names.map((outcome, k) => {
      const counted = probability[k] >= Math.min(best, FACTS.leastCounted) && wide !== null;
      const spread = Array.from(outputs.spread.subarray(samples * k, samples * k + count));
      return {
        outcome,
        probability: probability[k],
        com: triples(outputs.com_trajectory, k),
        turn: triples(outputs.rotation_vector, k),
        radius: counted ? spread.map((value) => wide * (value + FACTS.floor)) : null,
      };
    }).sort((a, b) => b.probability - a.probability);
    const outcomes = {};
    for (const { outcome, probability: share } of motions) outcomes[outcome] = (outcomes[outcome] || 0) + share;
    return { motions, outcomes, times: times.slice(0, count) };
  }

  /** A probability as it is shown: nothing is certain, as foretrace.imagined.shown has it. */
  function percentage(probability) {
    const told = (share) => `${(100 * share).toFixed(1)} %`;
    if (probability > FACTS.surest) return `over ${told(FACTS.surest)}`;
    return probability > 1 - FACTS.surest ? told(probability) : `under ${told(1 - FACTS.surest)}`;
  }

  return { read, percentage };
})();
