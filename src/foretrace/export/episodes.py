"""What is exported: interactions of a data set, each with what a predictor had imagined about it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from foretrace.errors import ExportError, PredictionError, shown
from foretrace.geometry import matrix_to_quaternion, quaternion_to_matrix
from foretrace.imagined import ImaginedEffect
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import Interaction
from foretrace.predictor import load_predictor, parts_of
from foretrace.predictor.base import EffectPredictor

REST = "rest"
"""What is in no part of a training's split: of outcomes that it leaves out, or cut off by the parts' sizes."""
MOST_LISTED = 8
"""Most unknown ids that a message names."""


@dataclass(frozen=True)
class Episode:
    """One interaction, and what had been imagined about it."""

    interaction: Interaction
    """What was seen, done and observed."""
    imagined: ImaginedEffect | None = None
    """What a predictor had expected, if one was asked."""

    @property
    def imagined_pose(self) -> Float[np.ndarray, "time 7"] | None:
        """The imagined pose of the object frame in the action frame: position [m], quaternion (w, x, y, z).

        None where nothing was imagined, or positions only.
        """
        if self.imagined is None or self.imagined.pose_trajectory is None:
            return None
        effect = self.interaction.effect
        since_rest = quaternion_to_matrix(self.imagined.pose_trajectory[:, 3:])  # (time, 3, 3)
        from_com = effect.pose_trajectory[0, :3] - effect.com_trajectory[0]
        position = self.imagined.com_trajectory + since_rest @ from_com
        rotation = since_rest @ quaternion_to_matrix(effect.pose_trajectory[0, 3:])
        return np.concatenate([position, matrix_to_quaternion(rotation)], axis=1)


class Episodes(Sequence[Episode]):
    """The chosen interactions in the order of their choice; each is read and imagined when it is asked for."""

    def __init__(self, dataset: Dataset, predictor: EffectPredictor | None = None):
        self.dataset = dataset
        self.predictor = predictor

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> Episode:  # pyright: ignore[reportIncompatibleMethodOverride]
        interaction = self.dataset[index]
        if self.predictor is None:
            return Episode(interaction)
        # As a batch, which brings along whatever else the predictor was trained to know.
        return Episode(interaction, self.predictor.imagine_batch(self.dataset[index : index + 1].batch())[0])


def choose_by_part(
    data: Path, ids: Sequence[int] | None = None, run: Path | None = None
) -> tuple[Episodes, dict[str, range]]:
    """Choose what to export, ordered by the parts of the training's split; and where each part is.

    Args:
        data: Folder of the data set.
        ids: Numbers of the interactions; None: all that have a motion.
        run: Folder of a training, whose predictor imagines each of them. What is in none of its parts comes last.
            Without a run, or one that was trained on other data, all is one part in the given order.

    Raises:
        ForetraceError: As `choose` does.
    """
    chosen = choose(data, ids, run)
    parts = {} if run is None else parts_of(run, Dataset.open(data))
    part_of_id = {id: name for name, members in parts.items() for id in members}
    names = [*parts, REST] if parts else ["train"]
    mine = [part_of_id.get(int(id), names[-1]) for id in chosen.dataset.index["id"].to_numpy()]
    order = sorted(range(len(mine)), key=lambda row: names.index(mine[row]))
    ends = np.cumsum([mine.count(name) for name in names]).tolist()
    ranges = {name: range(end - mine.count(name), end) for name, end in zip(names, ends, strict=True)}
    return Episodes(chosen.dataset[order], chosen.predictor), {name: r for name, r in ranges.items() if r}


def choose(data: Path, ids: Sequence[int] | None = None, run: Path | None = None) -> Episodes:
    """Choose what to export.

    Args:
        data: Folder of the data set.
        ids: Numbers of the interactions; None: all that have a motion.
        run: Folder of a training, whose predictor imagines each of them.

    Raises:
        DatasetError: There is no such data set.
        ExportError: Nothing is chosen, or an id is not among those that have a motion.
        CheckpointError: There is no such training.
        PredictionError: The predictor's features are only known after the action.
    """
    dataset = Dataset.open(data)
    known = dataset.index["id"].to_numpy()
    ids = known.tolist() if ids is None else list(dict.fromkeys(ids))
    if not ids:
        raise ExportError(f"nothing to export: no interaction of {data} is chosen, name some with --ids")
    row_of = {int(id): row for row, id in enumerate(known)}
    if unknown := [id for id in ids if id not in row_of]:
        listed = ", ".join(map(str, unknown[:MOST_LISTED])) + " and more" * (len(unknown) > MOST_LISTED)
        there = f"{known.min()} to {known.max()}" if len(known) else "none"
        raise ExportError(
            f"{data} has no interaction {listed} with a motion: there are {len(known)} ({there})"
        )
    predictor = None if run is None else load_predictor(run)
    if predictor is not None and predictor.features.oracle:
        raise PredictionError(
            f"the predictor in {run} cannot imagine: its features {shown(predictor.features.label)} are observed "
            "during the action; choose a run with other features"
        )
    return Episodes(dataset[[row_of[id] for id in ids]], predictor)
