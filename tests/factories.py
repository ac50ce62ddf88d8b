"""Synthetic interactions for tests: plausible, quick to make, and without a physics engine.

Each object turns rigidly about the closed-form support edge, so that there is something to learn.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from foretrace.actions import LeverUp, ToolPath, sample_pushes
from foretrace.geometry import continuous_quaternions, matrix_to_pose, rotate_plane
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.pushes import PushedShape, RecordedPushes
from foretrace.interactions.record import Effect, Interaction, Outcome, Physics, Provenance
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import NO_BEVEL, ObjectModel, Prism, sample_prism
from foretrace.simulation.collect import CollectConfig, collect, trial
from foretrace.simulation.randomisation import NOTHING, Randomisation
from foretrace.twin.sliding import SlidingTwin

SAMPLE_PERIOD = 0.05
FINAL_TILT = np.radians(40)
QUICK_OPTIONS: dict[str, dict[str, int]] = {
    "ae-256": {"epochs": 2, "min_steps": 1, "width": 8},
    "ae-512": {"epochs": 2, "min_steps": 1, "width": 8},
    "sp-pred": {"epochs": 5},
}
"""Settings with which features that train on their own are quick to fit."""


def fake_interaction(
    rng: np.random.Generator,
    id: int,
    *,
    num_corners: int | None = None,
    outcome: Outcome = Outcome.LEVERED,
    num_samples: int = 60,
    num_joints: int = 6,
) -> Interaction:
    """A lever-up of a random prism of 3 to 10 corners (by turns, unless given) at a random edge."""
    obj = sample_prism(rng, 3 + id % 8 if num_corners is None else num_corners)
    action = LeverUp.at_edge(obj, int(rng.integers(len(obj.corners))), rng.uniform(0.2, 0.8))
    return fake_lever_up(obj, action, id=id, outcome=outcome, num_samples=num_samples, num_joints=num_joints)


def fake_interactions(rng: np.random.Generator, n: int, num_samples: int = 60) -> list[Interaction]:
    """Levered interactions, but every tenth has slipped and every tenth is ten samples shorter."""
    return [
        fake_interaction(
            rng,
            k,
            outcome=Outcome.SLIPPED if k % 10 == 4 else Outcome.LEVERED,
            num_samples=num_samples - 10 if k % 10 == 9 else num_samples,
        )
        for k in range(n)
    ]


def fake_batch(rng: np.random.Generator, n: int, num_samples: int = 60) -> InteractionBatch:
    """`fake_interactions` as arrays."""
    return InteractionBatch.from_interactions(fake_interactions(rng, n, num_samples))


def fake_lever_up(
    obj: ObjectModel,
    action: LeverUp,
    *,
    id: int = 0,
    seed: int = 0,
    outcome: Outcome = Outcome.LEVERED,
    num_samples: int = 60,
    num_joints: int = 6,
) -> Interaction:
    """What lifting the contact point by 40 degrees about the support edge would look like."""
    in_action = obj.corners @ action.T_action_object[:2, :2].T + action.T_action_object[:2, 3]
    com_at_rest = (
        action.T_action_object[:3, :3] @ obj.mass_properties(500.0).com + action.T_action_object[:3, 3]
    )
    i, j = support_corners(in_action, com_at_rest[:2])
    progress = np.clip(np.linspace(-0.2, 1.1, num_samples), 0, 1)
    slip_index = num_samples // 2 if outcome == Outcome.SLIPPED else None
    if slip_index is not None:
        progress[slip_index:] = np.clip(
            progress[slip_index] - 0.2 * np.arange(num_samples - slip_index), 0, 1
        )
    motion = _turn(in_action[i], in_action[j], FINAL_TILT * progress)  # (time, 4, 4)
    poses = matrix_to_pose(motion @ action.T_action_object)
    tool = np.zeros((num_samples, 7))
    tool[:, 0], tool[:, 2], tool[:, 3] = 0.01, motion[:, 2, 3], 1.0
    return Interaction(
        object=obj,
        action=action,
        view=TopDownView.of(obj, action),
        effect=Effect(
            times=SAMPLE_PERIOD * np.arange(num_samples),
            pose_trajectory=np.concatenate([poses[:, :3], continuous_quaternions(poses[:, 3:])], axis=1),
            com_trajectory=motion[:, :3, :3] @ com_at_rest + motion[:, :3, 3],
            tool_trajectory=tool,
            joint_trajectory=np.outer(progress, np.arange(num_joints) / 10),
            support_points=in_action[[i, j]],
            support_corners=(i, j),
            outcome=outcome,
            slip_index=slip_index,
            path_error=1e-4,
        ),
        physics=Physics(density=500.0, friction=0.6, tool_friction=0.5),
        provenance=Provenance(seed=seed, versions={"foretrace": "0.1.0"}),
        id=id,
    )


def fake_data_set(
    folder: Path, drawn: Randomisation = NOTHING, objects: int = 8, num_samples: int = 12
) -> Path:
    """A data set of made-up motions, with what varies drawn as told, and then more slips."""
    config = CollectConfig(objects, 1, randomisation=drawn)

    def simulate(config: CollectConfig, id: int) -> Interaction:
        obj, action, seed = trial(config, id)
        outcome = Outcome.SLIPPED if id % (13 if drawn == NOTHING else 5) == 3 else Outcome.LEVERED
        made = fake_lever_up(obj, action, id=id, seed=seed, num_samples=num_samples, outcome=outcome)
        _, physics, path, _ = config.randomisation.vary(obj, Physics(), ToolPath(), np.random.default_rng(id))
        return replace(made, physics=physics, action=replace(made.action, path=path))

    collect(config, folder, workers=1, console=Console(quiet=True), simulate=simulate)
    return folder


def support_corners(corners: np.ndarray, com: np.ndarray) -> tuple[int, int]:
    """The edge of a convex outline hit by the ray from the origin (the contact) through the centre."""
    side = corners @ np.array([-com[1], com[0]])
    for i in range(len(corners)):
        j = (i + 1) % len(corners)
        if side[i] <= 0 < side[j]:  # the ray leaves a counter-clockwise outline from right to left
            return i, j
    raise AssertionError("the ray through the centre of mass leaves no edge")


def _turn(start: np.ndarray, end: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """(time, 4, 4) motions: turns by ``angles`` about the line on the table from ``start`` to ``end``."""
    x, y = (end - start) / np.linalg.norm(end - start)
    skew = np.array([[0, 0, y], [0, 0, -x], [-y, x, 0]])
    a = angles[:, None, None]
    motion = np.tile(np.eye(4), (len(angles), 1, 1))
    motion[:, :3, :3] = np.eye(3) + np.sin(a) * skew + (1 - np.cos(a)) * skew @ skew
    pivot = np.append(start, 0.0)
    motion[:, :3, 3] = pivot - motion[:, :3, :3] @ pivot
    return motion


def besides_doubt(warnings):
    """Warnings without those about an expected error: predictors of tests have hardly learned."""
    return tuple(line for line in warnings if not line.startswith("an error of"))


PUSHED_SHAPES = {
    "square": [[0.045, 0.045], [-0.045, 0.045], [-0.045, -0.045], [0.045, -0.045]],
    "triangle": [[0.06, -0.03], [-0.04, 0.06], [-0.04, -0.03]],
}


def write_push_table(
    folder: Path,
    count: int,
    constants: np.ndarray | None = None,
    farther: float = 0.0,
    noise: float = 0.0,
) -> tuple[Path, Path]:
    """A table of quasi-static pushes of two shapes, and their file.

    Args:
        folder: Where both go.
        count: Number of pushes.
        constants: Those of the world, as a `SlidingTwin` has them; nominal ones by default.
        farther: All objects end so much farther along the push [m].
        noise: Standard deviation of recorded positions [m], and of angles for a radius of 5 cm.
    """
    rng = np.random.default_rng(5)
    shapes = {
        name: {"outline": outline, "thickness": 0.013, "mass": 0.8} for name, outline in PUSHED_SHAPES.items()
    }
    plates = [
        PushedShape(name, Prism(outline, 0.013, NO_BEVEL), 0.8) for name, outline in PUSHED_SHAPES.items()
    ]
    which = np.arange(count) % len(plates)
    before = np.column_stack([rng.uniform(-0.2, 0.2, (count, 2)), rng.uniform(-3, 3, count)])
    rod = np.zeros((count, 2, 2))
    for row in range(count):
        push = sample_pushes(plates[which[row]].model, rng, 1)[0]
        start = push.contact - (push.path.approach + push.tool.radius) * push.direction
        ends = np.stack([start, start + 0.03 * push.direction])
        rod[row] = before[row, :2] + rotate_plane(ends, np.full(2, before[row, 2]))
    tips = np.round(rod, 6)
    before = np.round(before, 6)
    speed, lines = np.full(count, 0.02), np.arange(count) + 2
    pushes = RecordedPushes(tuple(plates), which, ("steel",) * count, speed, before, before, tips, {}, lines)
    twin = SlidingTwin() if constants is None else SlidingTwin(constants)
    moved = twin.predict(pushes)
    moved[:, :2] += farther * pushes.motion / np.linalg.norm(pushes.motion, axis=1)[:, None]
    moved += noise * rng.standard_normal((count, 3)) * [1, 1, 20]
    after = before + np.column_stack([rotate_plane(moved[:, :2], before[:, 2]), moved[:, 2]])
    head = ["surface", "shape", "speed_mm_s", "x0", "y0", "theta0", "x1", "y1", "theta1"]
    head += ["tip_x0", "tip_y0", "tip_x1", "tip_y1"]
    lines = [",".join(head)]
    for row in range(count):
        numbers = [20.0, *before[row], *after[row], *tips[row].ravel()]
        lines.append(",".join(["steel", plates[which[row]].name, *(f"{value:.6f}" for value in numbers)]))
    table, file = folder / "pushes.csv", folder / "shapes.json"
    table.write_text("\n".join(lines) + "\n")
    file.write_text(json.dumps(shapes))
    return table, file
