"""How long a plan takes from the view on: learned alone, and with the best eight checked by the twin; on one core.

    python benchmarks/planning.py --out docs/results/planning-times.json

Objects are drawn as in `foretrace evaluate planning`; each is planned for every goal with its 40 contacts, without
refinement, and as `foretrace.plan` does by default. Run it on an idle machine.
"""

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from foretrace.experiments.planning import FAMILIES, Case, Planning, PlanningTrial
from foretrace.files import write_json
from foretrace.planning import PlanConfig, plan
from foretrace.planning.candidates import Rim
from foretrace.predictor import load_imaginer
from foretrace.twin import TwinConfig, TwinImaginer

STREAM = 72
"""Tells the random numbers of these objects from those of the experiment."""


@dataclass(frozen=True)
class Options:
    """What is measured."""

    objects: int = 8
    """Objects of each family."""
    out: Path | None = None
    """File for the results (JSON)."""


def cases(objects: int) -> list[Case]:
    """Objects with their candidates."""
    experiment = Planning()
    return [
        experiment._draw(PlanningTrial(family, number), np.random.default_rng([STREAM, k, number]))
        for number in range(objects)
        for k, family in enumerate(FAMILIES[:-1])
    ]


def main() -> None:
    """Measure and print."""
    options = tyro.cli(Options, description=__doc__)
    imaginer, twin = load_imaginer(), TwinImaginer(config=TwinConfig(workers=1))
    found: dict[str, list[float]] = {}
    for number, case in enumerate(cases(options.objects + 1)):
        spacing = float(np.clip(Rim(case.scene.outline).length / 40, 0.001, 0.1))
        few = PlanConfig(spacing, directions=1, refine=0, check=0)
        configs = {
            "40 contacts, learned": few,
            "40 contacts, eight checked": replace(few, check=8),
            "by default, learned": PlanConfig(check=0),
            "by default, eight checked": PlanConfig(),
        }
        for goal in case.goals.values():
            for name, config in configs.items():
                start = time.perf_counter()
                plan(case.scene.view, goal, imaginer, config=config, checker=twin)
                if number >= len(FAMILIES) - 1:  # the first objects warm up
                    found.setdefault(name, []).append(1e3 * (time.perf_counter() - start))
    results = {
        "plans": len(next(iter(found.values()))),
        "milliseconds": {
            name: {
                "median": round(float(np.median(each)), 1),
                "p95": round(float(np.percentile(each, 95)), 1),
            }
            for name, each in found.items()
        },
    }
    print(json.dumps(results, indent=2))
    if options.out is not None:
        write_json(options.out, results, indent=2)


if __name__ == "__main__":
    main()
