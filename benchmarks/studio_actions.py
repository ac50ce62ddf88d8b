"""Random actions of scripted visitors of the studio, who come and go: errors, memory, and whether it still answers.

The studio runs as a command of its own; visitors speak its protocol without a browser. The exit status is 1 if it
reported an error, or did not answer in the end.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
TEXTS = (
    "0 0\n0.1 0\n0.05 0.1",
    "0 0\n0.1 0",
    "x",
    "",
    "0 0\n0.1 0.1\n0.1 0\n0 0.1",
    "1 2 3\n4",
    "0,0;0.1,0;0.1,0.1",
)
PATIENCE = 300
"""Time until a picture has to come [s]: plans that were asked for may have to be made before."""
EXAMPLES = ("pentagon", "heptagon", "hdd", "pcb", "book", "racket", "bracket", "disc", "box")


def act(visitor, rng: np.random.Generator) -> str:
    """One random action; returns what it was."""
    kind = rng.choice(
        [
            "drag",
            "turn",
            "slider",
            "switch",
            "example",
            "goal",
            "simulate",
            "watch",
            "corners",
            "draw",
            "save",
            "plan",
            "photo",
        ],
        p=[0.3, 0.08, 0.19, 0.08, 0.06, 0.06, 0.06, 0.03, 0.04, 0.05, 0.03, 0.01, 0.01],
    )
    x, y = rng.uniform(-0.25, 0.25, 2).tolist()
    if kind in ("drag", "turn"):
        visitor.drag(x, y, modifier="shift" if kind == "turn" else None)
    elif kind == "slider":
        sliders = [each for each in visitor.controls.values() if each["type"] == "GuiSliderMessage"]
        chosen = sliders[int(rng.integers(len(sliders)))]
        visitor.set(chosen["label"], float(rng.uniform(chosen["min"], chosen["max"])))
    elif kind == "switch":
        visitor.set(
            str(rng.choice(["play", "contact is", "90% region", "twin beside", "cost around", "arm"])),
            bool(rng.integers(2)),
        )
    elif kind == "example":
        visitor.set("example", str(rng.choice(EXAMPLES)))
    elif kind == "goal":
        visitor.set("goal", str(rng.choice(["lift", "tilt", "tumble", "turn-over", "move", "move-to"])))
    elif kind == "corners":
        visitor.set("x y [m]", str(rng.choice(TEXTS)))
        visitor.click("use these corners")
    elif kind == "draw":
        visitor.click("draw an outline")
        for _ in range(int(rng.integers(6))):
            visitor.press(*rng.uniform(-0.15, 0.15, 2).tolist())
        visitor.click(str(rng.choice(["finish the outline", "cancel"])))
    else:
        buttons = {"simulate": "simulate it", "watch": "watch", "plan": "plan", "save": "picture (PNG)"}
        buttons["photo"] = "example photograph"
        visitor.click(buttons[str(kind)])
    return str(kind)


def memory(process: subprocess.Popen) -> float:
    """Resident memory [MB]."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def visit(address: str, actions: int, rng: np.random.Generator) -> Counter[str]:
    """The actions of one visitor, who waits in the end until a drag has moved the contact."""
    from studio_visitor import Visitor

    done = Counter()
    with Visitor(address) as visitor:
        visitor.look(lambda: "/rim" in visitor.nodes, PATIENCE)
        for _ in range(actions):
            done[act(visitor, rng)] += 1
            visitor.look(seconds=float(rng.uniform(0.0, 0.15)))
        visitor.set("example", "book")
        visitor.look(seconds=0.5)
        before = visitor.drawn
        visitor.drag(0.2, 0.0)
        visitor.look(lambda: visitor.drawn > before, PATIENCE)
    return done


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--actions", type=int, default=1000)
    parser.add_argument(
        "--visitors", type=int, default=10, help="one after the other, each with a share of the actions"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng, done, used = np.random.default_rng(options.seed), Counter(), []
    program = [sys.executable, "-m", "foretrace", "studio", "--port", "0"]
    with tempfile.TemporaryFile("w+") as errors:
        with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=errors, text=True) as process:
            assert process.stdout is not None
            try:
                address = process.stdout.readline().strip().removeprefix("http://")
                for _ in range(options.visitors):
                    done += visit(address, options.actions // options.visitors, rng)
                    used.append(round(memory(process), 1))
            finally:
                process.terminate()
        errors.seek(0)
        said = errors.read()
    print(json.dumps({"actions": done, "memory_mb": used, "errors": said[:4000]}, indent=2))
    return 1 if "Traceback" in said or "exception" in said else 0


if __name__ == "__main__":
    raise SystemExit(main())
