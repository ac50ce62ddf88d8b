"""Which corners objects stand on while they are lifted: simulated against recorded trials, and the closed-form rule.

Usage: python benchmarks/support_corners.py TRIALS.json

The file is a list of shapes, ``{"corners": [[x, y], ...], "trials": [{"contact": [x, y], "support_corners": [i, j]},
...]}``, in metres about the centre of mass. Only trials with two support corners count.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from foretrace.actions import LeverUp
from foretrace.geometry import support_edge
from foretrace.interactions.record import Outcome
from foretrace.objects import Prism
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up


@dataclass(frozen=True)
class Comparison:
    """One trial: what was recorded, what the simulator shows, what the rule says."""

    recorded: tuple[int, ...]
    observed: tuple[int, ...]
    rule: tuple[int, ...]
    outcome: Outcome


def compare_trials(file: Path, every: int = 1) -> list[Comparison]:
    """Plays every so many of the recorded two-corner trials with the tool alone.

    Args:
        file: The recorded trials.
        every: Take one of so many.
    """
    config, rows = SimulationConfig(embodiment="tool"), []
    for shape in json.loads(file.read_text(encoding="utf-8-sig")):
        corners = np.array(shape["corners"])
        prism = Prism(corners)
        # A clockwise polygon is reordered: find each corner again.
        order = [int(np.linalg.norm(prism.corners - corner, axis=1).argmin()) for corner in corners]
        for record in shape["trials"]:
            if len(record["support_corners"]) == 2:
                rows.append(
                    (prism, tuple(sorted(order[i] for i in record["support_corners"])), record["contact"])
                )
    result = []
    for prism, recorded, contact in rows[::every]:
        action = LeverUp.nearest(prism, contact)
        effect = simulate_lever_up(prism, action, config).effect
        rule = support_edge(prism.support_corners, action.contact, prism.mass_properties(1.0).com[:2])
        result.append(Comparison(recorded, effect.support_corners, rule, effect.outcome))
    return result


def agreement(rows: list[Comparison]) -> dict[str, float]:
    """Shares of trials that agree."""
    observed = np.array([row.observed == row.recorded for row in rows])
    rule = np.array([row.rule == row.recorded for row in rows])
    levered = np.array([row.outcome == Outcome.LEVERED for row in rows])
    two = np.array([len(row.observed) == 2 for row in rows])
    return {
        "trials": len(rows),
        "levered": float(levered.mean()),
        "simulated_as_recorded": float(observed.mean()),
        "simulated_as_recorded_levered": float(observed[levered].mean()),
        "simulated_as_recorded_where_two_observed": float(observed[two].mean()),
        "rule_as_recorded": float(rule.mean()),
        "rule_as_simulated_where_two_observed": float(
            np.mean([row.rule == row.observed for row in rows if len(row.observed) == 2])
        ),
    }


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python benchmarks/support_corners.py TRIALS.json")
    print(json.dumps(agreement(compare_trials(Path(sys.argv[1]))), indent=2))
