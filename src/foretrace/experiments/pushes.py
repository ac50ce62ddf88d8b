"""Where recorded pushes leave their objects: simple rules, published models, simulation, and what is learned.

All that is fitted, trained or calibrated sees the pushes to learn from alone; the split depends on the seed. A method
predicts the object's pose after the push from its pose before it and from the rod's path.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from foretrace.errors import ResultsError, is_whole, shown
from foretrace.evaluation.experiment import Experiment, Row, Trial, chosen
from foretrace.experiments import SUMMARIES
from foretrace.experiments.pushes_report import (
    draw_coverage,
    draw_errors,
    draw_poses,
    means_of,
    report_of,
    summary_of,
    worst_of,
)
from foretrace.experiments.pushes_views import VIEWED, ViewedPushes, answer_from_views
from foretrace.files import short_hash
from foretrace.geometry import quaternion_to_matrix, rotate_plane
from foretrace.interactions.pushes import ROD_RADIUS, RecordedPushes, read_pushes
from foretrace.interactions.pushes_data import end_time
from foretrace.interactions.record import Physics
from foretrace.objects import Footed
from foretrace.simulation.engine import make_engine
from foretrace.twin.sliding import SlidingTwin
from foretrace.twin.sliding_constants import FRICTION
from foretrace.twin.sliding_residual import FEWEST, PushRegions, PushResidual, push_errors

MOST_TESTED = 1000
"""Pushes that methods are tested on, at the most."""
LEARNED_SHARE = 0.2
"""Share of the pushes that is learned from, by default."""
FEW = 20
"""Pushes that tell the twin its constants in one of the rows."""
TIMESTEP, SAMPLE_PERIOD = 0.004, 0.04
"""Of the simulation in MuJoCo [s]."""
TABLE_FRICTION = 0.2
"""Friction coefficient between object and table in MuJoCo; slow pushes hardly depend on it."""
SAME_START, SAME_DIRECTION = 0.001, np.deg2rad(2.0)
"""Pushes of one shape that start closer to each other and in more similar directions are repetitions [m, rad]."""


class Answer(NamedTuple):
    """Predicted displacements, and what their regions are made of."""

    found: np.ndarray
    """(pushes, 3) displacement [m] and turn [rad] in the object frame at rest."""
    regions: PushRegions | None = None
    scale: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Task:
    """Pushes to learn from, and pushes to predict."""

    learn: RecordedPushes
    test: RecordedPushes
    new_shape: bool
    """Whether the shape to predict is none of those to learn from."""
    seed: int

    @cached_property
    def twin(self) -> SlidingTwin:
        """The twin with constants from all pushes to learn from."""
        return SlidingTwin.identified(self.learn, self.seed)


@dataclass(frozen=True)
class PushTrial(Trial):
    """One method."""

    method: str
    """Its name."""


@dataclass(frozen=True)
class PushesExperiment(Experiment):
    """Predict where recorded pushes leave their objects, by rules, models, simulation and learning."""

    pushes: Path
    """Table of pushes (CSV); `docs/pushes.md` describes it."""
    shapes: Path
    """Shapes that were pushed (JSON)."""
    train: int | None = None
    """Number of pushes to learn from; by default a fifth of them, or all of the other shapes."""
    held_out: str | None = None
    """Name of a shape: the others are learned from, and this one is predicted."""
    seed: int = 0
    """Decides which pushes are learned from and which are predicted."""
    rod_radius: float = ROD_RADIUS
    """Radius of the rod in metres."""
    skip_bad: bool = False
    """Leave out rows that are wrong, and list them."""
    methods: tuple[str, ...] = ()
    """Methods that are compared: stays, constant, nearest, simulation, mujoco, identified-20, identified, learned,
    im-cnn, one-shot, residual, and models whose predictions are in the table; by default all."""

    label = "pushes"
    summary = SUMMARIES["pushes"]
    trial = PushTrial

    def trials(self) -> Sequence[PushTrial]:
        """One for each method."""
        known = [*_peers(self._task.test), *METHODS]
        return [PushTrial(name) for name in chosen("methods", self.methods or known, known)]

    def identity(self) -> dict[str, Any]:
        """The two files, and the options that decide the split."""
        options = {
            name: getattr(self, name) for name in ("train", "held_out", "seed", "rod_radius", "skip_bad")
        }
        files = [short_hash([path.read_bytes()]) for path in (self.pushes, self.shapes) if path.is_file()]
        return {"files": files} | options

    def run(self, trial: PushTrial, folder: Path) -> Sequence[Row]:
        """Errors of one method on each push to predict, and the levels of its regions that hold them."""
        task = self._task
        method = METHODS.get(trial.method)
        answer = _peer(task, trial.method) if method is None else method(task)
        test, truth = task.test, task.test.displacement()
        errors = push_errors(answer.found, truth)
        levels = radii = np.full((len(test), 2), np.nan)
        if answer.regions is not None and answer.scale is not None:
            levels, radii = (
                answer.regions.level(errors, answer.scale),
                answer.regions.radius(0.9, answer.scale),
            )
        frame = pd.DataFrame(
            {
                "line": test.line,
                "surface": [f"on {name}" for name in test.surface],
                "shape": [_in_words(test.shapes[k].name) for k in test.shape],
                "speed_mm_s": np.round(1000 * test.speed, 3),
                "position_mm": np.round(1000 * errors[:, 0], 4),
                "rotation_deg": np.round(np.rad2deg(errors[:, 1]), 4),
                "position_level": np.round(levels[:, 0], 4),
                "rotation_level": np.round(levels[:, 1], 4),
                "radius_90_mm": np.round(1000 * radii[:, 0], 3),
                "width_90_deg": np.round(np.rad2deg(radii[:, 1]), 3),
                "x_mm": np.round(1000 * answer.found[:, 0], 3),
                "y_mm": np.round(1000 * answer.found[:, 1], 3),
                "turn_deg": np.round(np.rad2deg(answer.found[:, 2]), 3),
            }
        )
        return frame.to_dict("records")  # pyright: ignore[reportReturnType]

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """Mean errors and coverage of each method, and how far repeated pushes are apart."""
        task = self._task
        about = {
            "learned_from": len(task.learn),
            "tested_on": len(task.test),
            "held_out": self.held_out,
            "seed": self.seed,
            "rows_left_out": self._read[1],
            "repetitions": repetitions(self._read[0]),
        }
        found = about | {"methods": summary_of(rows), "worst": worst_of(rows)}
        if set(VIEWED) & set(rows["method"].to_list()):
            seen = ViewedPushes(task.test, end_time(task.test)).seen
            found["viewed"] = means_of(rows.loc[np.isin(rows["line"].to_numpy(), task.test.line[seen])])
        return found

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """A table of all methods, and one by shape."""
        return report_of(summary)

    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Errors of the methods, coverage of their regions, and predicted beside recorded poses."""
        return {
            "errors": draw_errors(rows),
            "coverage": draw_coverage(rows),
            "poses": draw_poses(rows, self._task.test),
        }

    @cached_property
    def _read(self) -> tuple[RecordedPushes, list[str]]:
        return read_pushes(self.pushes, self.shapes, self.skip_bad, self.rod_radius)

    @cached_property
    def _task(self) -> Task:
        return split_pushes(self._read[0], self.train, self.held_out, self.seed)


def split_pushes(pushes: RecordedPushes, train: int | None, held_out: str | None, seed: int) -> Task:
    """Pushes to learn from and to predict.

    With more pushes to learn from, those to predict stay the same.

    Args:
        pushes: All of them.
        train: Number to learn from, or None.
        held_out: Name of the shape to predict, or None for pushes of all shapes.
        seed: Decides the order.

    Raises:
        ResultsError: There is no such shape, or there are too few pushes.
    """
    if not is_whole(seed, 0, 2**32 - 1):
        raise ResultsError(f"seed is {shown(seed)}: give a whole number from 0")
    order = np.random.default_rng(seed).permutation(len(pushes))
    if held_out is None:
        num_test = min(MOST_TESTED, len(pushes) // 2)
        test, rest = order[:num_test], order[num_test:]
        wanted = max(FEWEST, round(LEARNED_SHARE * len(pushes))) if train is None else train
    else:
        names = [shape.name for shape in pushes.shapes]
        if held_out not in names:
            raise ResultsError(f"held_out = {shown(held_out)}: choose one of {', '.join(names)}")
        is_test = pushes.shape[order] == names.index(held_out)
        test, rest = order[is_test][:MOST_TESTED], order[~is_test]
        wanted = len(rest) if train is None else train
    if not is_whole(wanted, FEWEST, len(rest)):
        raise ResultsError(
            f"train = {shown(wanted)}: give {FEWEST} to {len(rest)}, as many pushes as are left for learning"
            if len(rest) >= FEWEST
            else f"{len(rest)} of {len(pushes)} pushes are left to learn from, {len(test)} are set aside: "
            f"give a table with {2 * FEWEST} pushes or more"
        )
    return Task(pushes[np.sort(rest[:wanted])], pushes[np.sort(test)], held_out is not None, seed)


def _peers(pushes: RecordedPushes) -> list[str]:
    """Models whose predictions are in the table, for every push."""
    return [name for name, poses in pushes.peers.items() if np.isfinite(poses).all()]


def _peer(task: Task, name: str) -> Answer:
    """A model whose predictions are in the table."""
    found = (pushes.displacement(pushes.peers[name]) for pushes in (task.test, task.learn))
    return _calibrated(task, *found)


def _calibrated(task: Task, found: np.ndarray, learned: np.ndarray) -> Answer:
    """Regions of equal size everywhere, from the errors on the pushes to learn from."""
    scores = push_errors(learned, task.learn.displacement())
    return Answer(found, PushRegions(scores), np.ones((len(task.test), 2)))


def _stays(task: Task) -> Answer:
    return _calibrated(task, np.zeros((len(task.test), 3)), np.zeros((len(task.learn), 3)))


def _constant(task: Task) -> Answer:
    """The mean displacement along the push and to its left, and the mean turn."""
    ahead = [np.arctan2(each.motion[:, 1], each.motion[:, 0]) for each in (task.learn, task.test)]
    displacement = task.learn.displacement()
    mean = rotate_plane(displacement[:, :2], -ahead[0]).mean(axis=0)
    turn = displacement[:, 2].mean()

    def spread(angle: np.ndarray) -> np.ndarray:
        moved = rotate_plane(np.broadcast_to(mean, (len(angle), 2)), angle)
        return np.column_stack([moved, np.full(len(angle), turn)])

    return _calibrated(task, spread(ahead[1]), spread(ahead[0]))


def _nearest(task: Task) -> Answer:
    """The displacement, as the rod sees it, of the most similar push: by place, direction and shape."""
    learn, test = (_place(pushes, task.new_shape) for pushes in (task.learn, task.test))
    tree = KDTree(learn)
    others = np.asarray(tree.query(learn, k=2)[1])[:, 1]
    nearest = tree.query(test)[1]
    seen = _by_rod(task.learn, task.learn.displacement())
    return _calibrated(
        task,
        _by_object(task.test, seen[nearest]),
        _by_object(task.learn, seen[others]),
    )


def _place(pushes: RecordedPushes, new_shape: bool) -> np.ndarray:
    """Start [cm] and direction of pushes; shapes lie far apart, or pushes are turned into the rod's frame."""
    angle = np.arctan2(pushes.motion[:, 1], pushes.motion[:, 0])
    centre = np.array([shape.centroid for shape in pushes.shapes])[pushes.shape]
    start = 100 * (pushes.start - centre)
    if new_shape:
        return rotate_plane(start, -angle)
    numbers = {name: k for k, name in enumerate(sorted(shape.name for shape in pushes.shapes))}
    which = np.array([numbers[shape.name] for shape in pushes.shapes])[pushes.shape]
    return np.column_stack([start, 3 * np.cos(angle), 3 * np.sin(angle), 1000 * which])


def _by_rod(pushes: RecordedPushes, displacement: np.ndarray) -> np.ndarray:
    angle = np.arctan2(pushes.motion[:, 1], pushes.motion[:, 0])
    return np.column_stack([rotate_plane(displacement[:, :2], -angle), displacement[:, 2]])


def _by_object(pushes: RecordedPushes, displacement: np.ndarray) -> np.ndarray:
    angle = np.arctan2(pushes.motion[:, 1], pushes.motion[:, 0])
    return np.column_stack([rotate_plane(displacement[:, :2], angle), displacement[:, 2]])


def _simulation(task: Task) -> Answer:
    """The quasi-static twin with nominal constants; no recorded push is used."""
    return Answer(SlidingTwin().predict(task.test))


def _mujoco(task: Task) -> Answer:
    """MuJoCo with nominal constants; no recorded push is used."""
    engine = make_engine("mujoco", "tool", TIMESTEP, SAMPLE_PERIOD)
    bodies = [Footed(shape.model, "uniform") for shape in task.test.shapes]
    found = np.zeros((len(task.test), 3))
    # One after the other of each shape: its scene is compiled once.
    for row in np.argsort(task.test.shape, kind="stable"):
        number = int(task.test.shape[row])
        action = task.test.action(int(row))
        if action is None:
            continue
        physics = Physics(
            density=task.test.shapes[number].density, friction=TABLE_FRICTION, tool_friction=FRICTION
        )
        duration = np.ceil(action.duration / SAMPLE_PERIOD) * SAMPLE_PERIOD
        pose = action.T_action_object
        motion = engine.play(bodies[number], pose, action.tool, action.tool_motion, duration, physics)
        shift = pose[:2, :2].T @ (motion.object_pose[-1, :2] - motion.object_pose[0, :2])
        first, last = quaternion_to_matrix(motion.object_pose[[0, -1], 3:])
        turn = first.T @ last
        found[row] = [*shift, np.arctan2(turn[1, 0], turn[0, 0])]
    return Answer(found)


def _identified_from_few(task: Task) -> Answer:
    rng = np.random.default_rng(task.seed)
    few = task.learn[np.sort(rng.permutation(len(task.learn))[:FEW])]
    return Answer(SlidingTwin.identified(few, task.seed).predict(task.test))


def _identified(task: Task) -> Answer:
    return _calibrated(task, task.twin.predict(task.test), task.twin.predict(task.learn))


def _learned(task: Task) -> Answer:
    return _fitted(PushResidual(None, task.new_shape, task.seed), task)


def _residual(task: Task) -> Answer:
    return _fitted(PushResidual(task.twin, task.new_shape, task.seed), task)


def _fitted(model: PushResidual, task: Task) -> Answer:
    model.fit(task.learn)
    found, scale = model.predict(task.test)
    return Answer(found, model.regions, scale)


def _viewed(name: str, task: Task) -> Answer:
    """A predictor that observes a view."""
    return Answer(*answer_from_views(VIEWED[name], task.learn, task.test, task.seed))


METHODS: dict[str, Callable[[Task], Answer]] = {
    "stays": _stays,
    "constant": _constant,
    "nearest": _nearest,
    "simulation": _simulation,
    "mujoco": _mujoco,
    f"identified-{FEW}": _identified_from_few,
    "identified": _identified,
    "learned": _learned,
    **{name: partial(_viewed, name) for name in VIEWED},
    "residual": _residual,
}
"""Every method beside those whose predictions are in the table."""


def _in_words(name: str) -> str:
    """Name of a shape, which must not look like a number in a table."""
    return name if name[:1].isalpha() and name.lower() not in ("nan", "inf", "infinity") else f"shape {name}"


def repetitions(pushes: RecordedPushes) -> dict[str, float | int]:
    """How far the objects of pushes that repeat each other end apart: the floor of every prediction's error.

    Were both ends of a pair spread equally around their mean, the best prediction would err by this over the square
    root of 2.
    """
    direction = np.arctan2(pushes.motion[:, 1], pushes.motion[:, 0])
    reach = SAME_START / SAME_DIRECTION
    place = np.column_stack(
        [pushes.start, reach * np.cos(direction), reach * np.sin(direction), 10.0 * pushes.shape]
    )
    pairs = KDTree(place).query_pairs(SAME_START, output_type="ndarray")
    if len(pairs) == 0:
        return {"pairs": 0}
    ends = pushes.displacement()
    first, second = ends[pairs[:, 0]], ends[pairs[:, 1]]
    apart = push_errors(first, second)
    return {
        "pairs": len(pairs),
        "position_mm": float(1000 * apart[:, 0].mean()),
        "rotation_deg": float(np.rad2deg(apart[:, 1].mean())),
    }
