"""What makes a simulated lever-up cheaper, and what it changes: time and motion against the simulation as it is.

Every variant plays the same lever-ups, in turn, so that a machine whose speed drifts changes all of them; times are of
the processor. Usage: python benchmarks/steps.py [--lever-ups 100] [--embodiment tool] [--out steps.json]
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from foretrace.objects import HullShape, ObjectModel
from foretrace.simulation import mujoco_engine, scene
from foretrace.simulation.collect import CollectConfig, num_trials, trial
from foretrace.simulation.lever_up import SimulationConfig, Trial, simulate_lever_up
from foretrace.simulation.mujoco_engine import MujocoEngine

BUILD = scene.build_scene
STIFFER = 0.012
"""Time constant of the contacts of one hull with the table, of which there are fewer [s]."""


def convex(obj: ObjectModel) -> np.ndarray | None:
    """Vertices of the hull of all pieces, where these fill it."""
    shapes = obj.collision_shapes()
    if not all(isinstance(shape, HullShape) for shape in shapes):
        return None
    pieces = [np.asarray(shape.vertices) for shape in shapes if isinstance(shape, HullShape)]
    hull = ConvexHull(np.concatenate(pieces))
    filled = sum(ConvexHull(piece).volume for piece in pieces)
    return hull.points[hull.vertices] if filled > 0.999 * hull.volume else None


def without(*flags: mujoco.mjtDisableBit) -> Callable[..., mujoco.MjSpec]:
    """Scenes without parts of MuJoCo's pipeline."""

    def build(*arguments: object) -> mujoco.MjSpec:
        spec = BUILD(*arguments)  # type: ignore[arg-type]
        for flag in flags:
            spec.option.disableflags |= flag
        return spec

    return build


def one_hull(stiffness_time: float, *flags: mujoco.mjtDisableBit) -> Callable[..., mujoco.MjSpec]:
    """Scenes in which a convex object is one hull."""

    def build(obj: ObjectModel, *arguments: object) -> mujoco.MjSpec:
        hull = convex(obj)
        if hull is None:
            return without(*flags)(obj, *arguments)
        shapes = obj.collision_shapes

        def single() -> list[HullShape]:
            return [HullShape(hull)]

        object.__setattr__(obj, "collision_shapes", single)
        try:
            spec = without(*flags)(obj, *arguments)
        finally:
            object.__setattr__(obj, "collision_shapes", shapes)
        for geom in spec.geoms:
            if geom.name == "table" or geom.meshname == "piece_0":
                geom.solref = [stiffness_time, 1.0]
        return spec

    return build


NO_TREES, NO_ISLANDS = mujoco.mjtDisableBit.mjDSBL_MIDPHASE, mujoco.mjtDisableBit.mjDSBL_ISLAND
VARIANTS: dict[str, tuple[Callable[..., mujoco.MjSpec], float]] = {
    "as it is": (BUILD, 0.002),
    "no search trees over pieces": (without(NO_TREES), 0.002),
    "no islands": (without(NO_ISLANDS), 0.002),
    "one hull": (one_hull(scene.CONTACT_TIME), 0.002),
    "one hull on a stiffer table": (one_hull(STIFFER), 0.002),
    "one hull on a stiffer table, neither trees nor islands": (
        one_hull(STIFFER, NO_TREES, NO_ISLANDS),
        0.002,
    ),
    "steps of 1 ms": (BUILD, 0.001),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--lever-ups", type=int, default=100)
    parser.add_argument("--embodiment", default="tool", choices=("arm", "tool"))
    parser.add_argument("--recipe", default="paper")
    parser.add_argument("--out", type=Path, help="file for the numbers")
    arguments = parser.parse_args()
    seconds = dict.fromkeys(VARIANTS, 0.0)
    off: dict[str, list[float]] = {name: [] for name in VARIANTS}
    same: dict[str, list[bool]] = {name: [] for name in VARIANTS}
    config = CollectConfig(recipe=arguments.recipe)
    engines = {name: MujocoEngine(arguments.embodiment, timestep) for name, (_, timestep) in VARIANTS.items()}
    for id in np.linspace(0, num_trials(config) - 1, arguments.lever_ups).astype(int).tolist():
        obj, action, seed = trial(config, id)
        mujoco_engine.build_scene = BUILD
        simulate_lever_up(
            obj, action, SimulationConfig(embodiment=arguments.embodiment)
        )  # what is kept is there
        base = None
        for name, (build, timestep) in VARIANTS.items():
            one = Trial(
                obj, action, SimulationConfig("mujoco", arguments.embodiment, timestep=timestep), seed
            )
            mujoco_engine.build_scene = build
            start = time.process_time()
            motion = engines[name].play_many([one.play()])[0]
            seconds[name] += time.process_time() - start
            effect = one.record(one.view(), motion, engines[name]).effect
            base = effect if base is None else base
            num = min(len(effect.times), len(base.times))
            between = effect.com_trajectory[:num] - base.com_trajectory[:num]
            off[name].append(1e3 * float(np.linalg.norm(between, axis=1).mean()))
            same[name].append(effect.outcome == base.outcome)
    rows = {
        name: {
            "times_faster": round(seconds["as it is"] / seconds[name], 3),
            "difference_mm": {
                "median": round(float(np.median(off[name])), 4),
                "p95": round(float(np.quantile(off[name], 0.95)), 3),
            },
            "outcomes_equal": round(float(np.mean(same[name])), 4),
        }
        for name in VARIANTS
    }
    text = json.dumps(
        {
            "lever_ups": arguments.lever_ups,
            "embodiment": arguments.embodiment,
            "recipe": arguments.recipe,
            "rows": rows,
        },
        indent=2,
    )
    print(text)
    if arguments.out:
        arguments.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
