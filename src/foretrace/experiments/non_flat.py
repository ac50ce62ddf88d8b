"""Masks against height maps of objects that are not flat (paper, section 5.5).

The same predictor is trained twice on the same split: once it has masks, once depth-enriched masks, that is, height
maps. The paper's is im-cnn with an LSTM; another predictor can take its place. All outcomes are learned and evaluated,
and whole trajectories: a cylinder that rolls away and a box that tumbles leave the blade, but that is what they do.
Only a lifted object that slips off counts up to where it slips.

Objects with one outline are three of a kind: a lying cylinder, a box, a flat prism. Were one of them learned from and
another one tested, a mask would tell which outline it is, so the split that counts keeps them together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Int
from matplotlib.figure import Figure
from tyro.conf import Fixed, Suppress

from foretrace.errors import ResultsError, shown
from foretrace.evaluation.experiment import Experiment, Row, Trial, checked_seeds, kept_folder
from foretrace.evaluation.metrics import METRICS
from foretrace.evaluation.statistics import interval
from foretrace.evaluation.tables import capitalised, markdown_table, mean_with_interval
from foretrace.experiments import SUMMARIES
from foretrace.experiments.non_flat_data import KINDS, SETTINGS, NonFlatData, Setting
from foretrace.experiments.non_flat_figures import errors_figure, paths_figure
from foretrace.experiments.training import BASE, Recipe
from foretrace.features import Option
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.splits import Split
from foretrace.predictor import EffectPredictor, load_predictor
from foretrace.predictor.config import Device
from foretrace.predictor.run_folder import fingerprint
from foretrace.predictor.states import valid_lengths, valid_samples
from foretrace.simulation.lever_up import replay
from foretrace.trajectories import mean_distance

Channel = Literal["mask", "height"]
CHANNELS: tuple[Channel, ...] = ("mask", "height")
"""What the features are computed from."""
SENSITIVITY = "outcome-sensitivity"
"""Setting of the trials that play a lever-up again."""
CHANNEL_OPTIONS: dict[str, dict[Channel, dict[str, Option]]] = {
    "im-cnn": {name: {"channel": name} for name in CHANNELS},
    "outline": {name: {"heights": name == "height"} for name in CHANNELS},
}
"""Options of features that can be computed from either channel."""
LARGER: dict[str, dict[str, Any]] = {"one-shot": {"hidden": 192, "components": 64}}
"""Settings of predictors that are larger here: objects that roll and tumble move in more ways."""
NEARLY = 0.0005
"""Two lever-ups whose contacts lie this far to either side of a third one are nearly equal to it [m]."""
CM = 100.0
KEPT = "trainings"
"""Folder of the trainings within the results."""
PAPER = {"mask": 7.23, "height": 2.77}
"""Full-trajectory errors over the paper's whole set [cm] (section 5.5)."""
GOAL = 0.2
"""The height map's error is wanted to be at most this part of the mask's; the paper's is 0.38 of it."""
GROUPS = ("all", "alike", *KINDS)
"""What errors are averaged over: everything, what looks like something else, and each kind."""


@dataclass(frozen=True)
class NonFlatTrial(Trial):
    """Both trainings on one split, or one lever-up that is played again."""

    setting: str
    """One of SETTINGS, or SENSITIVITY."""
    seed: int
    """Seed of split and trainings; or the number of the lever-up in the order in which they are drawn."""


@dataclass(frozen=True)
class NonFlat(Experiment):
    """Train on masks and on height maps of objects that are not flat, and compare (paper, section 5.5)."""

    data: Path | None = None
    """Folder of the data set: that of `foretrace simulate --recipe mixed` or `solids`. Without one nothing is trained:
    results that are there are drawn again."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of splits and trainings."""
    splits: tuple[Setting, ...] = SETTINGS
    """by-outline: objects that look alike are all in one part. random: any interaction in any part."""
    predictor: str = BASE
    """lstm: im-cnn with an LSTM, as in the paper. one-shot: the direct trajectory predictor."""
    told_heights: bool = True
    """Whether predictors are given the height of the centre of mass at rest. That tells a box from a flat prism, which
    a mask does not."""
    epochs: int | None = None
    """Passes over the training part, as in `foretrace train`."""
    probes: int = 60
    """Lever-ups that are simulated again, nearly equal, to see how far apart they end. 0 for none."""
    device: Device = "auto"
    """Where to compute."""
    recipe: Suppress[Fixed[Recipe | None]] = None
    """Other settings of the trainings than those of the predictor."""

    label = "non-flat"
    summary = SUMMARIES["non-flat"]
    trial = NonFlatTrial

    def __post_init__(self) -> None:
        checked_seeds(self.seeds)
        if not self.splits:
            raise ResultsError("no split is given: give by-outline, random or both")
        if self.probes < 0:
            raise ResultsError(f"--probes is {self.probes}: give a number from 0")

    def trials(self) -> Sequence[NonFlatTrial]:
        """Split by split, seed by seed, then the lever-ups that are played again; none without data."""
        if self.data is None:
            return []
        settings = list(dict.fromkeys(self.splits))
        probes = min(self.probes, len(self._data.drawn))
        trials = [NonFlatTrial(setting, seed) for setting in settings for seed in checked_seeds(self.seeds)]
        return trials + [NonFlatTrial(SENSITIVITY, number) for number in range(probes)]

    def identity(self) -> dict[str, Any] | None:
        """The data, and how predictors are trained."""
        if self.data is None:
            return None
        recipe = {"features": self._recipe.features, **self._recipe.describe()}
        return {"data": fingerprint(self._data.batch), "recipe": recipe, "told_heights": self.told_heights}

    def run(self, trial: NonFlatTrial, folder: Path) -> Sequence[Row]:
        """Errors of both channels, a row for each interaction, and paths of an example; or outcome sensitivity."""
        if trial.setting == SENSITIVITY:
            row = outcome_sensitivity(self._data, int(self._data.drawn[trial.seed]))
            return [{"part": "sensitivity", **row}]
        split = self._data.split("random" if trial.setting == "random" else "by-outline", trial.seed)
        predictors, rows = {}, []
        for channel in CHANNELS:
            predictors[channel] = load_predictor(self._train(channel, trial, split, folder))
            errors = measure(predictors[channel], self._data, split.test).to_dict("records")
            rows += [{"part": "error", "channel": channel, **row} for row in errors]
        paths = example_paths(predictors, self._data, split.test).to_dict("records")
        return rows + [{"part": "path", **row} for row in paths]

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """By setting and group, the errors of both channels [cm]; by kind, the outcome sensitivity.

        ``settings``: by setting, for each group the errors and the ratio of height map to mask, means and 95 %
        intervals over the seeds; and by outcome. ``outcome_sensitivity``: by kind. ``paper``: its numbers.
        """
        errors, probes = (rows.loc[rows["part"].eq(part)] for part in ("error", "sensitivity"))
        settings: dict[str, Any] = {}
        for setting in (name for name in SETTINGS if name in set(errors["setting"])):
            mine = errors.loc[errors["setting"].eq(setting)]
            groups = {name: _compare(_members(mine, name)) for name in GROUPS}
            settings[setting] = {
                "seeds": sorted(int(seed) for seed in set(mine["seed"])),
                "groups": {name: found for name, found in groups.items() if found},
                "outcomes": {str(name): _compare(part) for name, part in mine.groupby("outcome")},
            }
        sensitivity = {}
        for name in ("alike", *KINDS):
            if len(part := _members(probes, name)):
                apart = part["irreducible_cm"].astype(float)
                sensitivity[name] = {
                    "probes": len(part),
                    "irreducible_cm": round(float(apart.to_numpy().mean()), 4),
                    "median_irreducible_cm": round(float(np.median(apart.to_numpy())), 4),
                    "same_outcome": round(float(part["same"].to_numpy(float).mean()), 4),
                }
        return {"paper": PAPER, "goal": GOAL, "settings": settings, "outcome_sensitivity": sensitivity}

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """The paper's two numbers with ours beside them, and the least error that any predictor can have."""
        parts = ["# Masks against height maps of objects that are not flat"]
        paper = summary["paper"]
        for setting, found in summary["settings"].items():
            met = "met" if found["groups"]["all"]["ratio"]["mean"] <= summary["goal"] else "not met"
            share = f"{paper['height'] / paper['mask']:.2f}"
            lines = [["Paper, all", "", "", f"{paper['mask']:.2f}", f"{paper['height']:.2f}", share]]
            lines += [_line(name, group) for name, group in found["groups"].items()]
            lines += [_line(f"`{name}`", group) for name, group in found["outcomes"].items()]
            head = ["", "Interactions", "Nothing moves", "Mask", "Height map", "Height map / mask"]
            parts += [
                f"## Split {setting}, seeds {', '.join(map(str, found['seeds']))}",
                "Full-trajectory error of the centre of mass [cm], means over the test part [95 % interval]:",
                markdown_table(head, lines),
                f"Goal: a ratio of at most {summary['goal']:g} over all: {met}.",
            ]
        if summary["outcome_sensitivity"]:
            head = ["", "Probes", "Irreducible error, mean [cm]", "Median [cm]", "Same outcome"]
            lines = [
                [name, str(each["probes"]), f"{each['irreducible_cm']:.3f}", f"{each['median_irreducible_cm']:.3f}",
                 f"{100 * each['same_outcome']:.0f} %"]
                for name, each in summary["outcome_sensitivity"].items()
            ]  # fmt: skip
            parts += ["## Outcome sensitivity: nearly equal lever-ups", markdown_table(head, lines)]
        return "\n\n".join(parts) + "\n"

    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Errors by kind of object, and paths of objects that look alike."""
        figures = {}
        if settings := self.summarise(rows)["settings"]:
            figures["errors"] = errors_figure(settings, PAPER)
        paths = rows.loc[rows["part"].eq("path")]
        if len(paths):
            first = paths[["setting", "seed"]].eq(paths[["setting", "seed"]].iloc[0]).all(axis=1)
            figures["paths"] = paths_figure(paths.loc[first])
        return figures

    @cached_property
    def _data(self) -> NonFlatData:
        assert self.data is not None
        return NonFlatData.open(self.data, self.told_heights)

    @cached_property
    def _recipe(self) -> Recipe:
        recipe = self.recipe
        if recipe is None:
            recipe = Recipe.of(self.predictor).change(**LARGER.get(self.predictor, {}))
        if recipe.features not in CHANNEL_OPTIONS:
            raise ResultsError(
                f"features {shown(recipe.features)} of {self.predictor} do not come from both masks and height maps: "
                f"choose a predictor with {' or '.join(CHANNEL_OPTIONS)}"
            )
        return recipe.change(epochs=self.epochs, device=self.device)

    def _train(self, channel: Channel, trial: NonFlatTrial, split: Split, folder: Path) -> Path:
        options = CHANNEL_OPTIONS[self._recipe.features][channel]
        outcomes = tuple(np.unique(self._data.batch.outcome).tolist())
        recipe = self._recipe.change(feature_options=options, outcomes=outcomes, seed=trial.seed)
        out = kept_folder(folder, KEPT) / f"{trial.setting}-{channel}-{trial.seed}"
        return recipe.train(self._data.batch, split, out)


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


def outcome_sensitivity(data: NonFlatData, row: int) -> dict[str, Any]:
    """Distance between the motions of two lever-ups that are nearly equal to a recorded one.

    They are simulated with the contact moved along the edge by `NEARLY` to one side and to the other. Half their
    distance is an error that no predictor avoids for which the two are one and the same.

    Args:
        data: The interactions.
        row: Which of them to play again.

    Returns:
        ``id``, ``kind``, ``outcome``, ``irreducible_cm`` (half the mean distance of the two paths), ``same`` (whether
        the two outcomes are the same).
    """
    done = data.dataset[row]
    one, other = (
        replay(replace(done, action=done.action.moved(0.0, shift, 0.0))).effect for shift in (-NEARLY, NEARLY)
    )
    until = min(len(e.times) if e.slip_index is None else e.slip_index for e in (one, other))
    # Each in its own action's frame: bring them into one.
    off = other.com_trajectory[:until] - one.com_trajectory[:until] + [0.0, 2 * NEARLY, 0.0]
    apart = CM * float(np.linalg.norm(off, axis=1).mean()) / 2
    about = {"id": done.id, "kind": data.kinds[row], "outcome": str(done.effect.outcome)}
    return about | {"irreducible_cm": apart, "same": one.outcome == other.outcome}


def _members(rows: pd.DataFrame, group: str) -> pd.DataFrame:
    if group == "all":
        return rows
    return rows.loc[rows["kind"].ne("prism") if group == "alike" else rows["kind"].eq(group)]


def _compare(rows: pd.DataFrame) -> dict[str, Any]:
    """Both channels on the same interactions; empty if there are none."""
    if rows.empty:
        return {}
    columns = ["full_cm", "final_cm", "still_cm"]
    means = rows.groupby(["channel", "seed"])[columns].agg(lambda values: values.to_numpy(float).mean())
    mask, height = (means.loc[channel] for channel in CHANNELS)
    found: dict[str, Any] = {
        channel: {
            "full_cm": interval(part["full_cm"]).as_dict(4),
            "final_cm": interval(part["final_cm"]).as_dict(4),
            "median_cm": round(float(rows.loc[rows["channel"].eq(channel), "full_cm"].median()), 4),
        }
        for channel, part in zip(CHANNELS, (mask, height), strict=True)
    }
    return found | {
        "interactions": round(len(rows) / len(CHANNELS) / len(mask)),
        "still_cm": round(float(mask["still_cm"].to_numpy().mean()), 4),
        "ratio": interval(height["full_cm"] / mask["full_cm"]).as_dict(4),
    }


def _line(name: str, group: Mapping[str, Any]) -> list[str]:
    words = {"all": "Ours, all", "alike": "Look-alikes"}.get(name, capitalised(name))
    cells = [mean_with_interval(group[channel]["full_cm"], 2) for channel in CHANNELS]
    still = f"{group['still_cm']:.2f}"
    return [words, str(group["interactions"]), still, *cells, mean_with_interval(group["ratio"], 2)]


def _ends(batch: InteractionBatch) -> np.ndarray:
    """(batch, 3) last valid centre of mass of each [m]."""
    return batch.com[np.arange(len(batch)), valid_lengths(batch) - 1]
