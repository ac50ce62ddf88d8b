"""How long a prediction takes: one view, many contacts of one object, and the same lever-ups simulated instead.

    python benchmarks/prediction.py                  # the predictor that comes with the package
    python benchmarks/prediction.py --run RUN        # another one-shot predictor

The same predictor in PyTorch and in ONNX Runtime, the twin, the simulation of a whole interaction with the blade alone,
and bare stepping of the same model take turns on one core, so that a machine whose speed drifts changes all of them.
Times are those of the processor, medians over objects. Of one view, all futures are told with positions and turns; of
many contacts all with positions, the most probable one with turns. Run it on an idle machine.
"""

import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
import tyro

from foretrace.actions import LeverUp, sample_contacts
from foretrace.files import write_json
from foretrace.geometry import matrix_to_pose
from foretrace.imagined import Imaginer
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import Prism, sample_prism
from foretrace.predictor import OneShotPredictor, load_predictor
from foretrace.predictor.loading import PORTABLE, default_checkpoint
from foretrace.predictor.portable import OnnxPredictor
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.mujoco_engine import STATE, plan_carriage
from foretrace.simulation.scene import build_scene
from foretrace.twin import TwinConfig, TwinImaginer

CONTACTS = 512
SIMULATED = 4
"""Lever-ups of each object that are simulated for comparison."""
BLADE = SimulationConfig(embodiment="tool")


@dataclass(frozen=True)
class Options:
    """What is measured."""

    run: Path | None = None
    """Folder of a training of the one-shot predictor; by default the one that comes with the package."""
    objects: int = 12
    """Number of objects."""
    out: Path | None = None
    """File for the results (JSON)."""


def seconds(work: Callable[[], object], repeats: int = 1) -> float:
    """Processor time of one call, in the mean over repeats."""
    start = time.process_time()
    for _ in range(repeats):
        work()
    return (time.process_time() - start) / repeats


def candidates_of(prism: Prism, first: LeverUp, rng: np.random.Generator) -> list[LeverUp]:
    """Lever-ups around a prism, in the action frame of its first one."""
    per_edge = -(-CONTACTS // len(prism.corners))
    actions = sample_contacts(prism, rng, per_edge=per_edge)[:CONTACTS]
    frames = [first.T_action_object @ np.linalg.inv(action.T_action_object) for action in actions]
    return [LeverUp(frame[:2, 3], frame[:2, 0]) for frame in frames]


def bare_stepping(prism: Prism, action: LeverUp) -> float:
    """Processor time of nothing but ``mj_step``, for as long as the blade moves."""
    steps = round(action.duration / BLADE.timestep)
    samples = action.tool_motion(
        np.arange(round(action.duration / BLADE.sample_period) + 1) * BLADE.sample_period
    )
    control = plan_carriage(action.tool_motion, samples, action.tool, steps, BLADE.timestep)
    place = (BLADE.embodiment, BLADE.timestep, control.coordinates)
    model = build_scene(prism, BLADE.physics, action.tool, *place).compile()
    data = mujoco.MjData(model)
    data.qpos[:7], data.qpos[7:] = matrix_to_pose(action.T_action_object), control.start
    assert mujoco.mj_stateSize(model, STATE)

    def work() -> None:
        for point in control.setpoints[:steps]:
            data.ctrl[:] = point
            mujoco.mj_step(model, data)

    return seconds(work)


def of_object(k: int, learned: dict[str, Imaginer], twin: TwinImaginer) -> dict[str, float]:
    """Times of one object [ms]."""
    rng = np.random.default_rng(k)
    prism = sample_prism(rng, 3 + k % 8)
    actions = sample_contacts(prism, rng, per_edge=2)
    view = TopDownView.of(prism, actions[0])
    candidates = candidates_of(prism, actions[0], rng)
    found: dict[str, float] = {}
    for name, imaginer in learned.items():
        found[f"view, {name}"] = seconds(lambda: imaginer.imagine(view).futures.pose, 20)  # noqa: B023
        many = seconds(lambda: imaginer.imagine_candidates(view, candidates), 2)  # noqa: B023
        found[f"contacts, {name}"] = many
    found["view, twin"] = seconds(lambda: twin.imagine(view, actions[0]), 2)
    some = actions[:SIMULATED]
    found["simulated"] = float(np.mean([seconds(lambda: simulate_lever_up(prism, a, BLADE)) for a in some]))  # noqa: B023
    found["stepped"] = float(np.mean([bare_stepping(prism, each) for each in some]))
    return {name: 1e3 * value for name, value in found.items()}


def onnx_of(predictor: OneShotPredictor, run: Path | None) -> OnnxPredictor:
    """The same predictor in ONNX Runtime."""
    if run is None:
        return OnnxPredictor(default_checkpoint() / PORTABLE)
    from foretrace.export.onnx import export_onnx

    file = Path(tempfile.mkdtemp()) / PORTABLE
    export_onnx(predictor, file)
    return OnnxPredictor(file)


def main() -> None:
    """Measure and print."""
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(1)
    predictor = load_predictor(options.run)
    if not isinstance(predictor, OneShotPredictor):
        sys.exit(f"{options.run} holds a {predictor.label} predictor: give a one-shot one")
    learned: dict[str, Imaginer] = {"PyTorch": predictor, "ONNX Runtime": onnx_of(predictor, options.run)}
    twin = TwinImaginer(config=TwinConfig(workers=1))
    rows = [of_object(k, learned, twin) for k in range(options.objects + 1)][1:]  # the first one warms up
    found = {name: round(float(np.median([row[name] for row in rows])), 3) for name in rows[0]}
    results = {
        "predictor": "default" if options.run is None else str(options.run),
        "objects": options.objects,
        "contacts": CONTACTS,
        "futures": len(learned["PyTorch"].imagine(TopDownView.of(*_example())).futures.outcome),
        "milliseconds": found,
        "times_faster_than_simulating": {
            name: round(found["simulated"] / (found[name] / (CONTACTS if "contacts" in name else 1)), 1)
            for name in found
            if name != "simulated"
        },
    }
    print(json.dumps(results, indent=2))
    if options.out is not None:
        write_json(options.out, results, indent=2)


def _example() -> tuple[Prism, LeverUp]:
    prism = sample_prism(np.random.default_rng(0), 5)
    return prism, LeverUp.at_edge(prism, 0)


if __name__ == "__main__":
    main()
