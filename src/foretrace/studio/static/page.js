"use strict";
// The panel, and what the visitor does.

(() => {
  const find = (id) => document.getElementById(id);
  const degree = Math.PI / 180, sliders = {};
  let chosen, stage, drawn = null, imagined = null, begun = 0, latest = 0, time = 0;

  const say = (text) => { find("message").textContent = text; };

  // --- sliders: of what may be unknown, the leftmost position says so --------------------------------------

  function addSlider(name, where) {
    const { label, unit, step, hint, limits } = FACTS.knobs[name], optional = FACTS.physics.includes(name);
    const [low, high] = limits.map((value) => value / unit), row = document.createElement("label");
    row.className = "row";
    row.title = hint;
    row.innerHTML = `<span></span><input type="range"><output></output>`;
    row.firstChild.textContent = label;
    const input = row.querySelector("input"), digits = Math.max(0, Math.round(-Math.log10(step) + 0.49));
    Object.assign(input, { min: optional ? low - step : low, max: high, step: "any" });
    const show = () => {
      const value = chosen[name];
      input.value = value === null ? low - step : value / unit;
      row.querySelector("output").textContent = value === null ? "unknown" : (value / unit).toFixed(digits);
    };
    input.addEventListener("input", () => {
      const value = Number(input.value);
      change({ [name]: optional && value < low - step / 2 ? null : Math.min(high, Math.max(low, Math.round(value / step) * step)) * unit });
    });
    sliders[name] = show;
    find(where).append(row);
  }

  // --- what follows --------------------------------------------------------------------------------------

  async function change(changes) {
    chosen = { ...chosen, ...changes };
    Object.values(sliders).forEach((show) => show());
    find("exact").checked = chosen.exact;
    find("example").value = chosen.object.name || "";
    find("height").value = Math.round(1e4 * chosen.object.height) / 10;
    if (changes.object) stage.showObject(chosen.object);
    if (!drawn) stage.showGrip(Lever.place(chosen.object.corners, chosen.along, chosen.turn));
    const text = Choices.toText(chosen);
    history.replaceState(null, "", text ? `#${text}` : location.pathname + location.search);
    const number = ++latest;
    let found = null, fault = "";
    try {
      found = await Choices.imagine(chosen, text ? Network.run : Choices.runFirst);
    } catch (error) {
      fault = error.message;
    }
    if (number !== latest || drawn) return; // the visitor has gone on meanwhile
    imagined = found;
    say(fault);
    showResult();
    stage.showFutures(imagined, find("tubes").checked);
    find("time").max = imagined ? imagined.times[imagined.times.length - 1] : 3;
  }

  function showResult() {
    const rows = !imagined ? [] : Object.entries(imagined.outcomes).sort((a, b) => b[1] - a[1]).slice(0, 3)
      .filter(([, share]) => share >= FACTS.leastListed).map(([name, share]) => {
        const row = document.createElement("div"), colour = FACTS.outcomeColours[name].map((value) => Math.round(255 * value));
        row.className = "bar";
        row.innerHTML = `<span>${name}</span><i><b style="width:${100 * share}%;background:rgb(${colour})"></b></i><span>${Futures.percentage(share)}</span>`;
        return row;
      });
    if (imagined) {
      const radius = imagined.motions[0].radius, note = document.createElement("p");
      note.className = "note";
      note.textContent = `radius of the 90 % region at the end: ${radius ? `${(100 * radius[radius.length - 1]).toFixed(1)} cm` : "unknown"}`;
      rows.push(note);
    }
    find("result").replaceChildren(...rows);
  }

  // --- dragging and drawing ------------------------------------------------------------------------------

  function listen(canvas) {
    const open = new Map();
    let held = null, moved = 0, apart = 0;
    const at = (event) => [event.offsetX, event.offsetY];
    const gap = () => {
      const [a, b] = [...open.values()];
      return Math.hypot(a[0] - b[0], a[1] - b[1]);
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      open.set(event.pointerId, at(event));
      moved = 0;
      apart = open.size === 2 ? gap() : 0;
      const [x, y] = stage.scene.project(stage.grip);
      held = !drawn && Math.hypot(x - event.offsetX, y - event.offsetY) < (event.pointerType === "mouse" ? 22 : 36) ? "grip" : "camera";
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!open.has(event.pointerId)) return;
      const [before, now] = [open.get(event.pointerId), at(event)], { camera } = stage.scene;
      const [right, down] = [now[0] - before[0], now[1] - before[1]];
      moved += Math.hypot(right, down);
      open.set(event.pointerId, now);
      if (open.size === 2) {
        camera.distance = limited(camera.distance * (apart / gap()), 0.12, 1.5);
        apart = gap();
      } else if (held === "grip") {
        const point = stage.scene.onTable(now);
        if (point) follow(point, event.shiftKey);
      } else if (!drawn) {
        camera.turn -= 0.008 * right;
        camera.rise = limited(camera.rise + 0.008 * down, 0.08, 1.55);
      }
    });
    const release = (event) => {
      open.delete(event.pointerId);
      if (event.type === "pointerup" && drawn && moved < 6) addCorner(stage.scene.onTable(at(event)));
    };
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, release);
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const { camera } = stage.scene;
      camera.distance = limited(camera.distance * Math.exp(0.001 * event.deltaY), 0.12, 1.5);
    }, { passive: false });
  }

  const limited = (value, low, high) => Math.min(high, Math.max(low, value));

  function follow(point, turns) {
    if (!turns) return change({ along: Lever.shareAt(chosen.object.corners, point) });
    const { contact, normal } = Lever.place(chosen.object.corners, chosen.along, 0), way = Geometry.minus(contact, point);
    const turn = Math.atan2(Geometry.cross(normal, way), normal[0] * way[0] + normal[1] * way[1]), [low, high] = FACTS.knobs.turn.limits;
    return change({ turn: limited(turn, low, high) });
  }

  let kept = null; // the camera, while an outline is drawn from above

  function draw(begins) {
    drawn = begins ? [] : null;
    find("draw").hidden = begins;
    find("finish").hidden = find("cancel").hidden = !begins;
    const { scene } = stage;
    if (begins) kept = { ...scene.camera };
    scene.camera = begins ? { target: [0, 0, 0], turn: -Math.PI / 2, rise: 1.55, distance: 0.55 } : kept;
    if (begins) stage.labels.replaceChildren();
    find("result").hidden = begins;
    stage.showDrawing(drawn);
    say(begins ? "Click the corners of an outline on the table, in order." : "");
  }

  function addCorner(point) {
    if (!point || drawn.length >= FACTS.mostCorners) return;
    drawn.push(point);
    stage.showDrawing(drawn);
    say(`${drawn.length} corners`);
  }

  function finish() {
    try {
      const object = Prism.make(drawn, Number(find("height").value) / 1000);
      draw(false);
      change({ object, along: 0.1, turn: 0 });
    } catch (error) {
      say(error.message);
    }
  }

  function changeHeight() {
    const height = Number(find("height").value) / 1000;
    if (!(height >= 0.004 && height <= 0.2)) return say("the height: give 4 to 200 mm");
    return change({ object: Prism.make(chosen.object.corners, height) });
  }

  // --- time ----------------------------------------------------------------------------------------------

  function tick(now) {
    const end = Number(find("time").max), elapsed = (now - begun) / 1000;
    begun = now;
    if (find("play").checked && imagined && !drawn) {
      time = time > end + 0.8 ? 0 : time + Math.min(elapsed, 0.1);
      find("time").value = Math.min(time, end);
    } else {
      time = Number(find("time").value);
    }
    document.querySelector("#time + output").textContent = `${Math.min(time, end).toFixed(2)} s`;
    stage.showTime(Math.min(time, end));
    stage.draw();
    if (!document.body.dataset.drawn && imagined) {
      performance.mark("first picture");
      document.body.dataset.drawn = "yes";
    }
    requestAnimationFrame(tick);
  }

  async function begin() {
    stage = new Stage(new Scene(find("canvas")), find("labels"));
    for (const name of ["along", "turn"]) addSlider(name, "action");
    for (const name of FACTS.physics) addSlider(name, "physics");
    for (const name of FACTS.parameters) addSlider(name, "path");
    find("example").append(...["", ...Object.keys(FACTS.examples)].map((name) => new Option(name || "your own", name)));
    find("about").textContent = FACTS.about;
    find("example").addEventListener("change", ({ target }) => target.value && change({ object: Choices.example(target.value), along: 0.1, turn: 0 }));
    find("exact").addEventListener("change", ({ target }) => change({ exact: target.checked }));
    find("tubes").addEventListener("change", () => stage.showFutures(imagined, find("tubes").checked));
    find("height").addEventListener("change", () => !drawn && changeHeight());
    find("draw").addEventListener("click", () => draw(true));
    find("finish").addEventListener("click", finish);
    find("cancel").addEventListener("click", () => draw(false));
    listen(find("canvas"));
    const read = () => {
      try {
        return Choices.fromText(location.hash.slice(1));
      } catch (error) {
        queueMicrotask(() => say(error.message));
        return Choices.first();
      }
    };
    chosen = Choices.first();
    change(read());
    window.addEventListener("hashchange", () => change(read()));
    requestAnimationFrame(tick);
    await Network.load();
  }

  begin().catch((error) => say(error.message));
})();
