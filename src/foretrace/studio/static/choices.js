"use strict";
// What is chosen, what follows from it, and the text that stands for it in a link (the same as in `foretrace studio`).

const Choices = (() => {
  const first = () => ({ object: example(FACTS.first), ...FACTS.choices });

  function example(name) {
    const { corners, height, bevel } = FACTS.examples[name];
    return { ...Prism.make(corners, height, bevel), name };
  }

  /** What is imagined of an object that is levered as chosen; throws what is wrong with it. */
  async function imagine(chosen, run) {
    const action = Lever.place(chosen.object.corners, chosen.along, chosen.turn);
    const path = Object.fromEntries(FACTS.parameters.map((name) => [name, chosen[name]]));
    const physics = Object.fromEntries(FACTS.physics.map((name) => [name, chosen[name]]));
    const inputs = View.inputs(chosen.object, action, path, { ...physics, contact_error: chosen.exact ? 0 : null });
    const outputs = await run(inputs);
    return { action, path, com: Array.from(inputs.com), ...Futures.read(outputs, inputs.context, Lever.times(path.speed).duration) };
  }

  /** The network's outputs for the first choices, which are there before the network is. */
  const runFirst = async () =>
    Object.fromEntries(Object.entries(FACTS.firstOutputs).map(([name, values]) => [name, Float32Array.from(values)]));

  /** All that differs from the first choices. */
  function toText(chosen) {
    const parts = [];
    if (chosen.object.name !== FACTS.first) parts.push(`object:${chosen.object.name || numbers(chosen.object)}`);
    for (const [name, value] of Object.entries(FACTS.choices)) {
      if (chosen[name] === value) continue;
      if (name === "exact") parts.push(`exact:${chosen.exact ? "True" : "False"}`);
      else parts.push(`${name}:${chosen[name] === null ? "unknown" : Number(chosen[name].toPrecision(5))}`);
    }
    return parts.join(",");
  }

  const numbers = ({ corners, height, bevel }) =>
    [height, bevel.width, bevel.height, ...corners.flat()].map((value) => Math.round(1e4 * value)).join("_");

  /** The choices of a link; what it does not say stays as at first. Throws what is wrong with it. */
  function fromText(text) {
    const chosen = first();
    for (const part of decodeURIComponent(text).split(",").filter(Boolean)) {
      const [name, value] = part.split(":");
      if (name === "object" && value) chosen.object = objectOf(value);
      else if (!(name in FACTS.choices) || value === undefined) throw new Error(`the link says ${part}: give name:value`);
      else if (name === "exact") chosen.exact = value === "True";
      else if (value === "unknown" && FACTS.physics.includes(name)) chosen[name] = null;
      else {
        const [low, high] = FACTS.knobs[name].limits, number = Number(value);
        if (!(number >= low - 1e-9 && number <= high + 1e-9)) {
          throw new Error(`the link says ${part}: give a number from ${low} to ${high}`);
        }
        chosen[name] = number;
      }
    }
    return chosen;
  }

  function objectOf(text) {
    if (/^[a-z]/i.test(text)) {
      if (!(text in FACTS.examples)) throw new Error(`there is no example ${text}: choose from ${Object.keys(FACTS.examples).join(", ")}`);
      return example(text);
    }
    const [height, width, depth, ...rest] = text.split("_").map((each) => 1e-4 * parseInt(each, 10));
    const corners = Array.from({ length: Math.floor(rest.length / 2) }, (_, k) => [rest[2 * k], rest[2 * k + 1]]);
    return Prism.make(corners, height, { width, height: depth });
  }

  return { example, first, fromText, imagine, runFirst, toText };
})();
