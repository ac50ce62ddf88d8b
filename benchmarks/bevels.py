"""How far a lever-up depends on the object's bevel, which no view from above shows.

Polygons of the paper's recipe, levered by the blade alone with nominal physics; each is simulated again with a bevel a
fifth wider, narrower, higher or lower. Mean distance of the centre of mass's displacement over the record, where both
are levered.
"""

import argparse
from itertools import islice
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed

from foretrace.actions import LeverUp
from foretrace.files import write_json
from foretrace.interactions.record import Effect, Outcome
from foretrace.objects import ObjectModel
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.randomisation import reshaped
from foretrace.simulation.recipes import RECIPES

FACTORS = {"narrower": (0.8, 1.0), "wider": (1.2, 1.0), "lower": (1.0, 0.8), "higher": (1.0, 1.2)}
TOOL = SimulationConfig(embodiment="tool")


def effects(obj: ObjectModel, action: LeverUp) -> list[Effect]:
    others = [reshaped(obj, 1.0, *factors) for factors in FACTORS.values()]
    return [simulate_lever_up(each, action, TOOL).effect for each in (obj, *others)]


def displacement(effect: Effect) -> np.ndarray:
    return effect.com_trajectory - effect.com_trajectory[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=int, default=40)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--out", type=Path, default=None, help="JSON file")
    options = parser.parse_args()
    made = (RECIPES["paper"].make(options.seed, k, 2) for k in range(options.objects))
    jobs = [(obj, action) for obj, actions in made for action in islice(actions, 4)]
    found = Parallel(n_jobs=-1)(delayed(effects)(obj, action) for obj, action in jobs)
    result: dict[str, object] = {"lever_ups": len(jobs), "seed": options.seed}
    for k, name in enumerate(FACTORS, start=1):
        pairs = [(each[0], each[k]) for each in found]
        both = [(a, b) for a, b in pairs if a.outcome == b.outcome == Outcome.LEVERED]
        apart = [1e3 * np.linalg.norm(displacement(a) - displacement(b), axis=1).mean() for a, b in both]
        result[name] = {
            "same_outcome": round(float(np.mean([a.outcome is b.outcome for a, b in pairs])), 3),
            "median_mm": round(float(np.median(apart)), 2),
            "p75_mm": round(float(np.percentile(apart, 75)), 2),
            "p95_mm": round(float(np.percentile(apart, 95)), 2),
        }
    print(result)
    if options.out is not None:
        write_json(options.out, result)


if __name__ == "__main__":
    main()
