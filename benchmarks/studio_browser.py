"""Random actions of visitors of the studio in headless Chromium, who come and go: errors, memory, whether it answers.

Each visitor drags the contact, moves sliders, ticks boxes, presses buttons, chooses, writes and draws at random; in the
end a drag must still move the contact. The exit status is 1 if server or page reported an error, or one did not answer.
Needs `pip install playwright` and Chromium.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
TEXTS = ("0 0\n0.1 0\n0.05 0.1", "0 0\n0.1 0", "x", "", "565 209", "1 2 3 4")
SHARES = {
    "drag": 0.3, "turn": 0.08, "look": 0.05, "slider": 0.18, "box": 0.08, "tab": 0.08, "folder": 0.04, "choose": 0.06,
    "button": 0.08, "write": 0.03, "click": 0.02,
}  # fmt: skip
"""How often each action is taken."""
SIZE = {"width": 860, "height": 520}
COARSE = 0.25
"""Pixels that are drawn for each of the page's: without a graphics card, drawing takes most of the time."""
PATIENCE = 5000
"""An element that cannot be used within this time is left alone [ms]."""
FOLDERS = ("Physics", "Path of the blade", "Show", "Corners as text", "Photograph")
CHOICES = ("Object", "Plan", "Watch")
"""Tabs with something to choose."""
PATIENT = 120
"""Drags in the end, one or two a second: animations that were asked for may have to be made before."""
KEYS = ("ArrowLeft", "ArrowRight", "Home", "End")


class Visit:
    """A visitor in a browser's page; the studio runs in this process, which knows where the grip is."""

    def __init__(self, page: Any, studio: Any, rng: np.random.Generator) -> None:
        self.page, self.studio, self.rng = page, studio, rng
        self.canvas = page.locator("canvas").first.bounding_box()

    def grip(self) -> tuple[float, float] | None:
        """Where the grip is on the screen [pixel]; None: out of sight."""
        camera = self.studio._client.camera
        w, x, y, z = camera.wxyz
        turn = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        right, down, ahead = turn.T @ (np.array(self.studio.stage.grip.position) - camera.position)
        if ahead < 0.01:
            return None
        box, focal = self.canvas, 0.5 / np.tan(camera.fov / 2)
        across = box["x"] + box["width"] / 2 + focal * box["height"] * right / ahead
        along = box["y"] + box["height"] / 2 + focal * box["height"] * down / ahead
        inside = box["x"] < across < box["x"] + box["width"] and box["y"] < along < box["y"] + box["height"]
        return (float(across), float(along)) if inside else None

    def somewhere(self) -> tuple[float, float]:
        """A place on the canvas, away from the panel [pixel]."""
        box = self.canvas
        x, y = self.rng.uniform([0.4, 0.15], [0.95, 0.9])
        return box["x"] + x * box["width"], box["y"] + y * box["height"]

    def pull(self, start: tuple[float, float], end: tuple[float, float], modifier: str = "") -> None:
        """Drag from one place to another."""
        mouse = self.page.mouse
        mouse.move(*start)
        if modifier:
            self.page.keyboard.down(modifier)
        mouse.down()
        mouse.move(*end, steps=2)
        mouse.up()
        if modifier:
            self.page.keyboard.up(modifier)

    def any(self, what: str) -> Any:
        """One of the visible elements of a kind."""
        found = self.page.locator(f"{what}:visible")
        if (count := found.count()) == 0:
            raise LookupError(what)
        return found.nth(int(self.rng.integers(count)))

    def act(self, kind: str) -> None:
        """One random action of a kind."""
        if kind in ("drag", "turn"):
            self.pull(self.grip() or self.somewhere(), self.somewhere(), "Shift" if kind == "turn" else "")
        elif kind == "look":
            self.pull(self.somewhere(), self.somewhere())
        elif kind == "click":
            self.page.mouse.click(*self.somewhere())
        elif kind == "slider":
            self.any("[role=slider]").focus(timeout=PATIENCE)
            for key in self.rng.choice(KEYS, 3):
                self.page.keyboard.press(str(key))
        elif kind == "box":
            self.any("input[type=checkbox]").click(timeout=PATIENCE)
        elif kind == "tab":
            self.any("[role=tab]").click(timeout=PATIENCE)
        elif kind == "button":
            self.any("button.mantine-Button-root").click(timeout=PATIENCE)
        elif kind == "folder":
            shown = [each for each in FOLDERS if self.page.get_by_text(each, exact=True).is_visible()]
            name = str(self.rng.choice([*shown, "Physics"]))
            self.page.get_by_text(name, exact=True).click(timeout=PATIENCE)
        elif kind == "choose":
            self.tab(str(self.rng.choice(CHOICES)))
            self.any("input.mantine-Select-input").click(timeout=PATIENCE)
            self.any("[role=option]").click(timeout=PATIENCE)
        elif kind == "write":
            self.tab("Object")
            if not self.page.get_by_text("use these corners").is_visible():
                self.page.get_by_text("Corners as text", exact=True).click(timeout=PATIENCE)
            self.any("textarea:not([aria-hidden])").fill(str(self.rng.choice(TEXTS)), timeout=PATIENCE)
            self.page.get_by_text("use these corners").click(timeout=PATIENCE)

    def tab(self, name: str) -> None:
        """Open a tab."""
        self.page.get_by_role("tab", name=name).click(timeout=PATIENCE)

    def answers(self) -> float | None:
        """Time until a drag moves the contact again, after all that was asked for before [s]; None: never."""
        started = time.monotonic()
        self.page.keyboard.press("Escape")
        self.studio.act(self.studio._drawing.end)
        self.studio.show_from((0.14, -0.3, 0.3))
        self.page.wait_for_timeout(1000)
        before = self.studio.session.choices
        for _ in range(PATIENT):
            if (grip := self.grip()) is not None:
                self.pull(grip, self.somewhere())
            self.page.wait_for_timeout(500)
            if self.studio.session.choices != before:
                return round(time.monotonic() - started, 1)
        return None


def plain_light(studio: Any) -> None:
    """Without shadows and reflections, of which a processor draws one picture in two seconds."""
    scene = studio._client.scene
    scene.configure_environment_map(None)
    scene.configure_default_lights(cast_shadow=False)


def memory() -> float:
    """Resident memory of this process [MB]."""
    return int(Path("/proc/self/status").read_text().split("VmRSS:")[1].split()[0]) / 1024


def visits(options: argparse.Namespace, faults: list[str]) -> dict[str, Any]:
    """Let visitors come, act and go."""
    from playwright.sync_api import Error, sync_playwright

    from foretrace.studio.heaps import share_heaps
    from foretrace.studio.server import StudioServer
    from static_page_cases import SOFTWARE, chromium

    share_heaps()  # as the command does
    rng, done, missed, used, answered = np.random.default_rng(options.seed), Counter(), Counter(), [], []
    server, started = StudioServer(port=0), time.monotonic()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=list(SOFTWARE))
        for _ in range(options.visitors):
            page = browser.new_page(viewport=SIZE, device_scale_factor=COARSE)  # pyright: ignore
            page.on("pageerror", lambda error: faults.append(str(error)))
            page.goto(f"http://{server.address}")
            page.get_by_text("levered", exact=True).first.wait_for(timeout=120_000)
            page.get_by_label("play").uncheck(timeout=120_000)  # until a visitor ticks it again
            studio = next(iter(server.pages.values()))
            plain_light(studio)
            visit = Visit(page, studio, rng)
            for kind in rng.choice(
                list(SHARES), options.actions // options.visitors, p=list(SHARES.values())
            ):
                try:
                    visit.act(str(kind))
                    done[str(kind)] += 1
                except (LookupError, Error):
                    missed[str(kind)] += 1
                page.wait_for_timeout(float(rng.uniform(0, 100)))
            answered.append(visit.answers())
            page.close()
            used.append(round(memory(), 1))
            print(
                f"{sum(done.values())} actions, {time.monotonic() - started:.0f} s",
                file=sys.stdout,
                flush=True,
            )
        browser.close()
    server.stop()
    took = round(time.monotonic() - started, 1)
    return {
        "actions": dict(done), "not_possible": dict(missed), "seconds": took, "memory_mb": used,
        "answered_s": answered,
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--actions", type=int, default=1000)
    parser.add_argument(
        "--visitors", type=int, default=10, help="one after the other, each with a share of the actions"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    faults: list[str] = []
    with tempfile.TemporaryFile("w+") as errors:
        kept = os.dup(2)
        os.dup2(errors.fileno(), 2)
        try:
            found = visits(options, faults)
        finally:
            os.dup2(kept, 2)
        errors.seek(0)
        said = errors.read()
    print(json.dumps(found | {"page_errors": faults, "errors": said[:4000]}, indent=2))
    return 1 if faults or "Traceback" in said or "exception" in said or None in found["answered_s"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
