"""The studio's static page in headless Chromium: size, first picture, answers to a drag, numbers against Python's.

`first_picture_s` counts until the first futures are drawn, `network_ready_s` until others can be; `drag_ms` from
the pointer's event until the new futures are drawn, one after the other around the object; `imagined_ms` is what the
network and all before it takes of that, `frame_ms` the time from one picture to the next while time runs.
Needs `pip install playwright`, Chromium and npm, or --onnxruntime-web.
"""

import argparse
import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from foretrace.studio.static_page import write_static_page

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
DRAG = """async (count) => {
  const taken = [];
  for (let k = 0; k < count; k++) {
    const started = performance.now();
    await Choices.imagine({ ...Choices.first(), along: k / count }, Network.run);
    taken.push(performance.now() - started);
  }
  return taken;
}"""

FRAMES = """async (count) => {
  const next = () => new Promise(requestAnimationFrame), taken = [];
  for (let k = 0, last = await next(); k < count; k++) {
    const now = await next();
    taken.push(now - last);
    last = now;
  }
  return taken;
}"""
LISTEN = """() => {
  const found = window.found = { taken: [], asked: null, shown: false };
  document.getElementById("canvas").addEventListener("pointermove", (event) => {
    if (event.buttons) found.asked = event.timeStamp;
  }, true);
  const { draw, showFutures } = Stage.prototype;
  Stage.prototype.showFutures = function (...given) {
    showFutures.apply(this, given);
    found.shown = found.asked !== null;
  };
  Stage.prototype.draw = function () {
    draw.apply(this);
    found.stage = this;
    if (found.shown) found.taken.push(performance.now() - found.asked);
    if (found.shown) Object.assign(found, { asked: null, shown: false });
  };
}"""
PLACE = """([x, y]) => {
  const { scene, grip } = found.stage, { left, top } = scene.canvas.getBoundingClientRect();
  const place = scene.project(x === null ? grip : [x, y, 0]);
  return [left + place[0], top + place[1]];
}"""


def summary(taken: list[float]) -> dict[str, float]:
    """Median and 95 % quantile."""
    return {"median": float(np.median(taken)), "p95": float(np.quantile(taken, 0.95)), "n": len(taken)}


def drag(page: Any, count: int) -> list[float]:
    """Drag the grip around the object; returns the time until the futures have followed, each time [ms]."""
    page.evaluate(LISTEN)
    page.wait_for_function("found.stage")
    page.mouse.move(*page.evaluate(PLACE, [None, None]))
    page.mouse.down()
    for k in range(count):
        angle = 2 * np.pi * k / count
        page.mouse.move(*page.evaluate(PLACE, [0.12 * np.cos(angle), 0.12 * np.sin(angle)]))
        page.wait_for_function(f"found.taken.length > {k}")
    page.mouse.up()
    return page.evaluate("found.taken")


def main() -> None:
    """Print what was measured as JSON."""
    from static_page_cases import (
        IMAGINE,
        as_page_choices,
        differences,
        imagined_in_python,
        opened,
        static_page_cases,
    )

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--onnxruntime-web", type=Path, default=None)
    parser.add_argument("--cases", type=int, default=50)
    parser.add_argument("--opened", type=int, default=5, help="how often the page is opened")
    parser.add_argument("--drags", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture", type=Path, default=None, help="PNG of the page")
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--dark", action="store_true")
    options = parser.parse_args()
    cases = static_page_cases(options.cases, options.seed)
    wanted = [imagined_in_python(each) for each in cases]
    looks: dict[str, Any] = {
        "viewport": {"width": options.width, "height": round(options.width * 0.6)},
        "color_scheme": "dark" if options.dark else "light",
    }
    first, ready, found, taken, followed, shown = [], [], [], [], [], []
    with TemporaryDirectory() as folder:
        page = write_static_page(Path(folder), options.onnxruntime_web)
        size = sum(file.stat().st_size for file in Path(folder).iterdir())
        for number in range(options.opened):
            with opened(page, **looks) as visited:
                visited.wait_for_function("performance.getEntriesByName('network ready').length")
                for times, mark in ((first, "first picture"), (ready, "network ready")):
                    times.append(visited.evaluate(f"performance.getEntriesByName('{mark}')[0].startTime"))
                if number:
                    continue
                found = visited.evaluate(IMAGINE, [as_page_choices(each) for each in cases])
                taken = visited.evaluate(DRAG, options.drags)
                shown = visited.evaluate(FRAMES, options.drags)
                followed = drag(visited, options.drags)
                if options.picture is not None:
                    visited.uncheck("#play")
                    visited.evaluate("document.getElementById('time').value = 2.0")
                    visited.evaluate("location.hash = 'along:0.79,friction:unknown,tool_friction:unknown'")
                    visited.wait_for_timeout(1500)
                    visited.screenshot(path=options.picture)
    both = [(page, python) for page, python in zip(found, wanted, strict=True) if page and python]
    apart = [differences(*pair) for pair in both]
    print(
        json.dumps(
            {
                "size_mb": size / 1e6,
                "first_picture_s": [each / 1000 for each in first],
                "network_ready_s": [each / 1000 for each in ready],
                "imagined_ms": summary(taken),
                "frame_ms": summary(shown),
                "drag_ms": summary(followed),
                "cases": len(cases),
                "refused_alike": sum(
                    page is None and python is None for page, python in zip(found, wanted, strict=True)
                ),
                "compared": len(both),
                "largest_difference": {name: max(each[name] for each in apart) for name in apart[0]},
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
