"""What the autoencoders' codes retain of a mask (paper, section 3.2.2)."""

import base64
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from jaxtyping import Bool, Float
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from tyro.conf import Positional

from foretrace.errors import PredictionError, shown
from foretrace.evaluation.experiment import Experiment, Row, Trial
from foretrace.evaluation.tables import markdown_table
from foretrace.experiments import SUMMARIES
from foretrace.features.autoencoder import AutoencoderFeatures
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.topdown import VIEW_SIZE
from foretrace.pictures.style import DPI, INK, styled
from foretrace.predictor import EffectPredictor, load_predictor, part_of
from foretrace.predictor.run_folder import fingerprint

Masks = Bool[np.ndarray, "batch 128 128"]
BLANK, KEPT, LOST, ADDED = "#f2f4f7", "#7f8fa6", "#d55e00", "#0072b2"


@dataclass(frozen=True)
class CodeTrial(Trial):
    """One autoencoder."""

    training: str
    """Folder of the training."""


@dataclass(frozen=True)
class Reconstruction(Experiment):
    """Masks as the codes of autoencoders retain them, on the test part."""

    runs: Positional[tuple[Path, ...]]
    """Folders of trainings with features ae-256 or ae-512, of the same split."""
    data: Path
    """Folder of the data set that they were trained on."""
    columns: int = 8
    """Masks in the picture, at equal steps through the test part."""

    label = "reconstruction"
    summary = SUMMARIES["reconstruction"]
    trial = CodeTrial
    needs_folder = False

    def __post_init__(self) -> None:
        if not self.runs:
            raise PredictionError("no training given: name the folders of trainings with ae-256 or ae-512")
        if self.columns < 1:
            raise PredictionError(f"--columns is {self.columns}: show at least one mask")

    def trials(self) -> Sequence[CodeTrial]:
        """One for each training."""
        return [CodeTrial(str(run)) for run in self.runs]

    def identity(self) -> dict[str, Any]:
        """The test part."""
        return {"test": fingerprint(self._test)}

    def run(self, trial: CodeTrial, folder: Path) -> Sequence[Row]:
        """For each mask its overlap with what the code retains of it, and both as text."""
        predictor, batch = load_predictor(Path(trial.training)), self._test
        made = reconstruct_masks(predictor, batch)
        return [
            {"features": predictor.features.label, "id": int(id), "iou": float(iou)}
            | {"mask": pack_mask(mask), "restored": pack_mask(restored)}
            for id, iou, mask, restored in zip(
                batch.ids, overlap(batch.mask, made), batch.mask, made, strict=True
            )
        ]

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """By training: features, and the mean and the worst overlap (intersection over union)."""
        return {
            str(name): {
                "features": part["features"].iloc[0],
                "iou_mean": round(float(np.mean(part["iou"].to_numpy(float))), 4),
                "iou_worst": round(float(part["iou"].to_numpy(float).min()), 4),
                "masks": len(part),
            }
            for name, part in rows.groupby("training", sort=False)
        }

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """A table of the overlaps."""
        lines = [
            [f"`{name}`", f["features"], str(f["masks"]), f"{f['iou_mean']:.4f}", f"{f['iou_worst']:.4f}"]
            for name, f in summary.items()
        ]
        head = ["Training", "Features", "Test masks", "IoU, mean", "IoU, worst"]
        return f"# Masks as autoencoders retain them\n\n{markdown_table(head, lines)}\n"

    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Some masks above what each code made of them."""
        masks, restored = None, {}
        for name, part in rows.groupby("training", sort=False):
            shown = np.linspace(0, len(part) - 1, min(self.columns, len(part))).round().astype(int)
            label = part["features"].iloc[0]
            masks, made = (
                np.stack([unpack_mask(part[c].iloc[k]) for k in shown]) for c in ("mask", "restored")
            )
            restored[label if label not in restored else str(name)] = made
        return {} if masks is None else {"reconstruction": reconstruction_figure(masks, restored)}

    @cached_property
    def _test(self) -> InteractionBatch:
        dataset = Dataset.open(self.data)
        parts = [part_of(run, dataset) for run in self.runs]
        if any(not np.array_equal(part.ids, parts[0].ids) for part in parts):
            raise PredictionError(
                "the trainings have different test parts: give trainings of the same split and seed"
            )
        return parts[0]


def pack_mask(mask: Bool[np.ndarray, "128 128"]) -> str:
    """A mask as a short text."""
    return "mask:" + base64.b64encode(zlib.compress(np.packbits(mask).tobytes(), 9)).decode()


def unpack_mask(text: str) -> Bool[np.ndarray, "128 128"]:
    """The mask that `pack_mask` has made a text of."""
    bits = np.frombuffer(zlib.decompress(base64.b64decode(text.removeprefix("mask:"))), dtype=np.uint8)
    return np.unpackbits(bits)[: VIEW_SIZE**2].reshape(VIEW_SIZE, VIEW_SIZE).astype(bool)


def reconstruct_masks(predictor: EffectPredictor, batch: InteractionBatch) -> Masks:
    """Masks as the code of a predictor's autoencoder retains them: pixels more likely object than table.

    Raises:
        PredictionError: The predictor's features are not those of an autoencoder.
    """
    features = predictor.features
    if not isinstance(features, AutoencoderFeatures):
        raise PredictionError(
            f"features {shown(features.label)} have no code to restore a mask from: "
            "give a predictor with ae-256 or ae-512"
        )
    with torch.no_grad():
        restored = features.reconstruct(features.inputs(batch).to(predictor.device))
    return (restored[:, 0] > 0.5).cpu().numpy()


def overlap(one: Masks, other: Masks) -> Float[np.ndarray, " batch"]:
    """Intersection over union of two masks each; 1 where both are empty."""
    union = (one | other).sum(axis=(1, 2))
    return np.where(union == 0, 1.0, (one & other).sum(axis=(1, 2)) / np.maximum(union, 1))


@styled
def reconstruction_figure(masks: Masks, restored: Mapping[str, Masks]) -> Figure:
    """Masks, a column each, above what each code, by name, made of them."""
    colors = ListedColormap([BLANK, KEPT, LOST, ADDED])
    figure = Figure(figsize=(1.25 * len(masks) + 0.6, 1.35 * (1 + len(restored)) + 0.5), dpi=DPI)
    axes = figure.subplots(1 + len(restored), len(masks), squeeze=False)
    for row, (name, made) in enumerate({"mask": masks, **restored}.items()):
        scores = overlap(masks, made)
        for column, ax in enumerate(axes[row]):
            codes = masks[column] * 1 + (masks[column] & ~made[column]) + 3 * (made[column] & ~masks[column])
            ax.imshow(codes, cmap=colors, vmin=-0.5, vmax=3.5, interpolation="nearest")
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set_visible(False)
            if row:
                ax.set_title(
                    f"IoU {scores[column]:.3f}", fontsize=7.5, fontweight="normal", loc="center", pad=2
                )
        axes[row, 0].set_ylabel(name, color=INK, fontweight="bold")
    words = {"object": KEPT, "lost": LOST, "added": ADDED}
    handles = [Patch(color=color, label=name) for name, color in words.items()]
    figure.legend(handles=handles, loc="lower center", ncols=3)
    figure.subplots_adjust(left=0.07, right=0.995, top=0.97, bottom=0.09, wspace=0.06, hspace=0.16)
    return figure
