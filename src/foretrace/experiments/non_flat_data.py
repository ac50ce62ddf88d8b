"""Data sets in which objects look alike from above."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int

from foretrace.errors import DatasetError
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.splits import Split, split_by_object, split_by_seed
from foretrace.objects import ObjectModel, object_from_json
from foretrace.predictor.states import valid_lengths

Setting = Literal["by-outline", "random"]
SETTINGS: tuple[Setting, ...] = ("by-outline", "random")
"""How the split is drawn. ``by-outline``: no outline is in two parts; ``random``: any interaction in any part."""
KINDS = ("cylinder", "box", "flat prism", "prism")
"""The three that share an outline, and prisms that have theirs for themselves."""


@dataclass(frozen=True)
class NonFlatData:
    """A data set in which objects look alike."""

    dataset: Dataset
    """The interactions; those that are too short to learn from are left out."""
    batch: InteractionBatch
    """The same as arrays."""
    kinds: np.ndarray
    """(batch,) names of KINDS."""
    outlines: Int[np.ndarray, " batch"]
    """Number of each object's outline; those that look alike have the same."""
    contacts: Int[np.ndarray, " batch"]
    """Number of outline and contact together: those that look alike in the same lever-up have the same."""

    @classmethod
    def open(cls, path: str | Path, known_heights: bool = True) -> "NonFlatData":
        """Read a data set of ``foretrace simulate --recipe mixed`` or ``solids``.

        Args:
            path: Its folder.
            known_heights: Whether trajectories have their heights. Otherwise all start at 0: the first sample, which
                predictors are given, then does not tell what a mask does not.

        Raises:
            DatasetError: There is none, or no two of its objects look alike.
        """
        dataset = Dataset.open(path)
        dataset = dataset[valid_lengths(dataset.batch()) >= 2]
        texts = dataset.table["object"].to_pylist()
        known = {text: object_from_json(text) for text in set(texts)}
        keys = {text: _outline_key(obj) for text, obj in known.items()}
        kinds = {text: obj.kind for text, obj in known.items()}
        alike = {keys[text] for text, kind in kinds.items() if kind == "cylinder"}
        names = {
            text: "flat prism" if kind == "prism" and keys[text] in alike else kind
            for text, kind in kinds.items()
        }
        if len(alike & {keys[text] for text, kind in kinds.items() if kind != "cylinder"}) < 3:
            raise DatasetError(
                f"{path} has too few objects that look alike, three outlines are needed at least: simulate more with "
                "foretrace simulate --recipe mixed"
            )
        places = zip(*(dataset.index[name].to_pylist() for name in ("contact", "direction")), strict=True)
        rounded = [tuple(np.round([*contact, *direction], 6)) for contact, direction in places]
        batch = dataset.batch()
        if not known_heights:
            batch = replace(batch, com=batch.com - batch.com[:, :1] * [0.0, 0.0, 1.0])
        return cls(
            dataset,
            batch,
            np.array([names[text] for text in texts]),
            _numbered([keys[text] for text in texts]),
            _numbered([(keys[text], place) for text, place in zip(texts, rounded, strict=True)]),
        )

    def split(self, setting: Setting, seed: int) -> Split:
        """Parts in the paper's proportions.

        By outline, those that look alike and the other prisms are drawn apart, so that every part has its share of
        both.
        """
        if setting == "random":
            return split_by_seed(len(self.batch), seed, None)
        shared = np.isin(self.outlines, self.outlines[self.kinds == "cylinder"])
        groups = [rows for rows in (np.flatnonzero(shared), np.flatnonzero(~shared)) if len(rows)]
        drawn = [(rows, split_by_object(self.outlines[rows], seed)) for rows in groups]
        parts = (
            np.sort(np.concatenate([rows[getattr(split, name)] for rows, split in drawn]))
            for name in ("train", "validation", "test")
        )
        return Split(*parts)

    @cached_property
    def drawn(self) -> Int[np.ndarray, " alike"]:
        """Rows of the objects that look like others, in the order in which they are played again."""
        return np.random.default_rng(0).permutation(np.flatnonzero(self.kinds != "prism"))


def _outline_key(obj: ObjectModel) -> tuple[float, ...]:
    """The same for objects of one outline in one place; corners may be listed from another one on."""
    return tuple(sum(sorted(map(tuple, np.round(obj.corners, 7).tolist())), ()))


def _numbered(keys: Sequence[Any]) -> Int[np.ndarray, " n"]:
    numbers = {key: k for k, key in enumerate(dict.fromkeys(keys))}
    return np.array([numbers[key] for key in keys], dtype=np.int64)
