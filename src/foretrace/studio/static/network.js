"use strict";
// The network in ONNX Runtime; both are packed into this folder, so that the page also works from a file.

const Network = (() => {
  let ready = null, last = Promise.resolve();

  function decoded(text) {
    if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
    const letters = atob(text), bytes = new Uint8Array(letters.length);
    for (let k = 0; k < bytes.length; k++) bytes[k] = letters.charCodeAt(k);
    return bytes;
  }

  async function unpacked(text) {
    const stream = new Blob([decoded(text)]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  /** Get ready, which takes about a second, once the page has been drawn. */
  const load = () => (ready ||= begin());

  async function begin() {
    await new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
    if (typeof PACKED === "undefined") await new Promise((resolve, reject) => {
      const file = document.getElementById("packed");
      file.addEventListener("load", resolve);
      file.addEventListener("error", () => reject(new Error("packed.js, which holds the network, is missing")));
    });
    const [script, wasm, model] = await Promise.all([PACKED.runtime, PACKED.wasm, PACKED.model].map(unpacked));
    const address = URL.createObjectURL(new Blob([script], { type: "text/javascript" }));
    const ort = await import(address);
    URL.revokeObjectURL(address);
    ort.env.wasm.wasmBinary = wasm.buffer;
    ort.env.wasm.numThreads = 1;
    // It was optimised when it was packed.
    const made = await ort.InferenceSession.create(model, { executionProviders: ["wasm"], graphOptimizationLevel: "disabled" });
    performance.mark("network ready");
    return { run: (feeds) => made.run(feeds), tensor: (values) => new ort.Tensor("float32", values, [1, values.length]) };
  }

  /** Outputs by name for inputs by name; one call after the other. */
  function run(inputs) {
    const work = async () => {
      const session = await load();
      const feeds = Object.fromEntries(Object.entries(inputs).map(([name, values]) => [name, session.tensor(values)]));
      const found = await session.run(feeds);
      return Object.fromEntries(Object.entries(found).map(([name, tensor]) => [name, tensor.data]));
    };
    last = last.then(work, work);
    return last;
  }

  return { load, run };
})();
