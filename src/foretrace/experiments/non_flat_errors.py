"""Masks against height maps of objects that are not flat (paper, section 5.5).

The same predictor is trained twice on the same split: once it sees masks, once depth-enriched masks, that is, height
maps. The paper's is im-cnn with an LSTM; the predictor of whole motions can take its place. All outcomes are learned
and judged, and whole trajectories: a cylinder that rolls away and a box that tumbles leave the blade, but that is what
they do. Only a lifted object that slips off is judged up to where it slips.

Objects with one outline are three of a kind: a lying cylinder, a box, a flat prism. Were one of them learned from and
another one tested, a mask would tell which outline it is, so the split that counts keeps them together.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Int

from foretrace.errors import DatasetError
from foretrace.evaluation.metrics import METRICS
from foretrace.interactions.dataset import Dataset, InteractionBatch
from foretrace.interactions.splits import Split, split_by_object, split_by_seed
from foretrace.objects import ObjectModel, object_from_dict
from foretrace.predictor import EffectPredictor, OneShotPredictor, TrainConfig, train_predictor
from foretrace.predictor.states import valid_lengths, valid_samples
from foretrace.simulation.lever_up import replay
from foretrace.trajectories import mean_distance

Channel = Literal["mask", "height"]
Setting = Literal["by-outline", "random"]
CHANNELS: tuple[Channel, ...] = ("mask", "height")
"""What the convolutional network sees."""
SETTINGS: tuple[Setting, ...] = ("by-outline", "random")
"""How the split is drawn. ``by-outline``: no outline is in two parts; ``random``: any interaction in any part."""
KINDS = ("cylinder", "box", "flat prism", "prism")
"""The three that share an outline, and prisms that have theirs for themselves."""
ONE_SHOT: dict[str, Any] = {"hidden": 192, "predictor_options": {"motions": 64}}
"""The predictor of whole motions is larger here: objects that roll and tumble move in more ways."""
NEARLY = 0.0005
"""Two lever-ups whose contacts lie so far to either side of a third one are nearly equal to it [m]."""
CM = 100.0


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
    def open(cls, path: str | Path, told_heights: bool = True) -> "NonFlatData":
        """Read a data set of ``foretrace simulate --recipe mixed`` or ``solids``.

        Args:
            path: Its folder.
            told_heights: Whether trajectories have the heights that they have. Otherwise all start at 0: from the
                first sample, which predictors are given, nobody learns what a mask does not tell.

        Raises:
            DatasetError: There is none, or no two of its objects look alike.
        """
        dataset = Dataset.open(path)
        dataset = dataset[valid_lengths(dataset.batch()) >= 2]
        texts = dataset.table["object"].to_pylist()
        known = {text: object_from_dict(json.loads(text)) for text in set(texts)}
        keys = {text: _outline_key(obj) for text, obj in known.items()}
        kinds = {text: str(json.loads(text)["kind"]) for text in known}
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
        places = zip(*(dataset.table[name].to_pylist() for name in ("contact", "direction")), strict=True)
        rounded = [tuple(np.round([*contact, *direction], 6)) for contact, direction in places]
        batch = dataset.batch()
        if not told_heights:
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


def train(
    data: NonFlatData,
    folder: Path,
    channel: Channel,
    setting: Setting,
    seed: int,
    config: TrainConfig,
    progress: bool = True,
) -> Path:
    """Train on one channel, unless that is done already.

    Args:
        data: The interactions.
        folder: Where trainings are kept; one that was cut short goes on.
        channel: What the network sees.
        setting: How the split is drawn.
        seed: Of split and training.
        config: Further settings; features, outcomes, split and seed are replaced.
        progress: Show a progress bar.

    Returns:
        The folder of the training.

    Raises:
        TrainingError: The folder holds another training.
    """
    one_shot = config.predictor == OneShotPredictor.label
    config = replace(
        config,
        features="outline" if one_shot else "im-cnn",
        feature_options={"heights": channel == "height"} if one_shot else {"channel": channel},
        outcomes=tuple(np.unique(data.batch.outcome).tolist()),
        split=None,
        seed=seed,
    )
    out = folder / f"{setting}-{channel}-{seed}"
    return train_predictor(data.batch, config, out, split=data.split(setting, seed), progress=progress)


def measure(predictor: EffectPredictor, data: NonFlatData, rows: Int[np.ndarray, " rows"]) -> pd.DataFrame:
    """Errors of the imagined trajectories, one row per interaction.

    Returns:
        ``id``, ``kind``, ``outcome``, ``full_cm``, ``final_cm`` (from the observed first sample), and ``still_cm``: the
        full-trajectory error of saying that nothing moves.
    """
    batch = data.batch[rows]
    truth = np.where(valid_samples(batch)[..., None], batch.com, np.nan)
    imagined = predictor.imagine_batch(batch).com
    still = np.broadcast_to(batch.com[:, :1], truth.shape)
    errors = {f"{name}_cm": CM * np.asarray(distance(imagined, truth)) for name, distance in METRICS.items()}
    errors["still_cm"] = CM * np.asarray(mean_distance(still, truth))
    return pd.DataFrame({"id": batch.ids, "kind": data.kinds[rows], "outcome": batch.outcome, **errors})


def example_paths(
    predictors: dict[Channel, EffectPredictor], data: NonFlatData, rows: Int[np.ndarray, " rows"]
) -> pd.DataFrame:
    """Observed and imagined paths of three objects that look alike (paper, figure 16, right).

    Chosen is the lever-up of which the three ends lie farthest apart; what was imagined plays no part in it.

    Returns:
        ``kind``, ``outcome``, ``path`` (``observed`` or a channel), ``time_s``, ``x_cm``, ``y_cm``, ``z_cm`` in the
        action frame.
    """
    ends = _ends(data.batch)
    widest, chosen = -1.0, rows[:0]
    for contact in np.unique(data.contacts[rows]):
        alike = rows[data.contacts[rows] == contact]
        if len(set(data.kinds[alike])) < 3:
            continue
        apart = min(float(np.linalg.norm(ends[a] - ends[b])) for a, b in combinations(alike, 2))
        if apart > widest:
            widest, chosen = apart, alike
    batch, lengths = data.batch[chosen], valid_lengths(data.batch[chosen])
    paths = {"observed": batch.com} | {
        name: each.imagine_batch(batch).com for name, each in predictors.items()
    }
    frames = [
        pd.DataFrame(
            {"kind": data.kinds[row], "outcome": batch.outcome[k], "path": name, "time_s": batch.times[:n]}
            | {f"{axis}_cm": CM * com[k, :n, i] for i, axis in enumerate("xyz")}
        )
        for k, (row, n) in enumerate(zip(chosen, lengths, strict=True))
        for name, com in paths.items()
    ]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()


def spread_of_fates(data: NonFlatData, probes: int, seed: int = 0) -> pd.DataFrame:
    """How far apart nearly equal lever-ups end up, half of which no predictor that takes them for one can avoid.

    Each probe is an interaction of an object that looks like others, simulated twice more with its contact moved along
    the edge by `NEARLY` to one side and to the other.

    Args:
        data: The interactions.
        probes: How many of them to play again, drawn at random.
        seed: Seed of the draw.

    Returns:
        ``id``, ``kind``, ``outcome``, ``floor_cm`` (half the mean distance of the two paths), ``same`` (whether the two
        outcomes are the same).
    """
    alike = np.flatnonzero(data.kinds != "prism")
    chosen = np.sort(np.random.default_rng(seed).permutation(alike)[:probes])
    rows: list[dict[str, Any]] = []
    for row in chosen.tolist():
        done = data.dataset[row]
        one, other = (
            replay(replace(done, action=done.action.moved(0.0, shift, 0.0))).effect
            for shift in (-NEARLY, NEARLY)
        )
        until = min(len(e.times) if e.slip_index is None else e.slip_index for e in (one, other))
        # Each in its own action's frame: bring them into one.
        off = other.com_trajectory[:until] - one.com_trajectory[:until] + [0.0, 2 * NEARLY, 0.0]
        apart = np.linalg.norm(off, axis=1)
        rows.append(
            {"id": done.id, "kind": data.kinds[row], "outcome": str(done.effect.outcome)}
            | {"floor_cm": CM * float(apart.mean()) / 2, "same": one.outcome == other.outcome}
        )
    return pd.DataFrame(rows)


def _outline_key(obj: ObjectModel) -> tuple[float, ...]:
    """The same for objects of one outline in one place; corners may be listed from another one on."""
    return tuple(sum(sorted(map(tuple, np.round(obj.corners, 7).tolist())), ()))


def _numbered(keys: Sequence[Any]) -> Int[np.ndarray, " n"]:
    numbers = {key: k for k, key in enumerate(dict.fromkeys(keys))}
    return np.array([numbers[key] for key in keys], dtype=np.int64)


def _ends(batch: InteractionBatch) -> np.ndarray:
    """(batch, 3) last valid centre of mass of each [m]."""
    return batch.com[np.arange(len(batch)), valid_lengths(batch) - 1]
