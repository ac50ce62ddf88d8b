"""Cases for the studio's static page: what Python imagines of them, and a browser that opens the page."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from foretrace.actions.lever_up import VARIED_ACTION
from foretrace.errors import ForetraceError
from foretrace.objects import Prism
from foretrace.objects.prism import sample_prism
from foretrace.studio.choices import LIMITS, PHYSICS, Choices
from foretrace.studio.session import Session
from foretrace.studio.shapes import EXAMPLES, prism_of

SOFTWARE = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
"""Draws in three dimensions without a graphics card."""
CHOSEN = ("along", "turn", *VARIED_ACTION, *PHYSICS)


def outlines(rng: np.random.Generator, number: int) -> Prism:
    """In turn: an example, one of the paper's objects, and a drawing with dents."""
    if number % 3 == 0:
        prisms = [each for each in EXAMPLES.values() if type(each) is Prism]
        return prisms[number // 3 % len(prisms)]
    if number % 3 == 1:
        return prism_of(sample_prism(rng, int(rng.integers(3, 11))).corners, float(rng.uniform(0.008, 0.05)))
    while True:
        count = int(rng.integers(5, 10))
        angles, radii = 2 * np.pi * np.arange(count) / count, rng.uniform(0.05, 0.1, count)
        return prism_of(radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]), 0.02)


def static_page_cases(count: int, seed: int = 0) -> list[Choices]:
    """Random choices about many outlines."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(count):
        values: dict[str, Any] = {name: float(rng.uniform(*LIMITS[name])) for name in CHOSEN}
        unknown = [name for name in PHYSICS if rng.uniform() < 0.3]
        found.append(
            Choices(outlines(rng, number), exact=bool(rng.integers(2)), **values | dict.fromkeys(unknown))
        )
    return found


def as_page_choices(chosen: Choices) -> dict[str, Any]:
    """The same for the page; JSON-able."""
    prism = chosen.object
    assert isinstance(prism, Prism)
    outline = {"corners": prism.corners.tolist(), "height": prism.height}
    return {"outline": outline, "exact": chosen.exact, **{name: getattr(chosen, name) for name in CHOSEN}}


def imagined_in_python(chosen: Choices, level: float = 0.9) -> dict[str, Any] | None:
    """Outcomes, and futures in the order of their probability; None: refused."""
    session = Session(chosen)
    try:
        imagined = session.imagined.until(session.action.duration)
    except ForetraceError:
        return None
    futures = imagined.futures
    order = np.argsort(-futures.probability[0], kind="stable")
    return {
        "outcomes": {name: float(each[0]) for name, each in futures.outcomes().items()},
        "probability": futures.probability[0, order],
        "com": futures.com[0, order],
        "turn": futures.states[0, order, :, 3:],
        "radius": futures.radius(level)[0, order],
    }


def differences(page: dict[str, Any], python: dict[str, Any]) -> dict[str, float]:
    """Largest differences of what page and Python imagine of one case, over futures that count [m, rad, 1]."""
    motions = page["motions"]
    counted = python["probability"] >= 0.05
    apart: dict[str, float] = {
        "probability": float(
            np.abs(np.array([each["probability"] for each in motions]) - python["probability"]).max()
        )
    }
    for name in ("com", "turn", "radius"):
        found = [np.array(motions[k][name], dtype=float) for k in np.flatnonzero(counted)]
        apart[name] = float(np.nanmax(np.abs(np.array(found) - python[name][counted])))
    return apart


def chromium() -> str | None:
    """A browser that is installed."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@contextmanager
def opened(page: Path, **settings: Any) -> Iterator[Any]:
    """The page in headless Chromium, as a file, when its first futures are drawn."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=list(SOFTWARE))
        visited = browser.new_page(**settings)
        faults: list[str] = []
        visited.on("pageerror", lambda error: faults.append(str(error)))
        visited.goto(page.resolve().as_uri())
        visited.wait_for_function("document.body.dataset.drawn", timeout=60_000)
        yield visited
        browser.close()
        assert not faults, faults


IMAGINE = """async (cases) => {
  const found = [];
  for (const { outline, ...rest } of cases) {
    try {
      const object = Prism.make(outline.corners, outline.height);
      found.push(await Choices.imagine({ ...rest, object }, Network.run));
    } catch (error) { found.push(null); }
  }
  return found;
}"""
"""What the page imagines of cases; null: refused."""
