"""The direct trajectory predictor as an ONNX file: the same futures without PyTorch, in ONNX Runtime."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypedDict

import numpy as np
from jaxtyping import Float
from msgspec import Meta

from foretrace.errors import CheckpointError, shown
from foretrace.files import as_path
from foretrace.geometry import rotation_vector_to_quaternion
from foretrace.imagined import STARTS, Futures, ImaginedBatch, Imaginer, Scenes
from foretrace.imagined.context import CONSTANTS
from foretrace.imagined.domain import find_unusual, known_ranges, measure_context
from foretrace.interactions.batch import Candidates, InteractionBatch
from foretrace.interactions.hull import HEIGHT_CELLS, MAX_CORNERS, UNIT, coarse_heights, hull_rows
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, VIEW_SIZE
from foretrace.schema import Vector2, conform

ONE_SHOT = "one-shot"
OUTPUTS = ("probability", "com_trajectory", "rotation_vector", "spread", "start_spread", "support_points")
REMEDY = "give a file that `foretrace export onnx` wrote of a one-shot predictor"


class Facts(TypedDict):
    """Schema of what the file says of itself."""

    predictor: str
    config: dict[str, Any]
    outcomes: list[str]
    ranges: dict[str, Vector2]
    times: Annotated[list[float], Meta(min_length=2)]
    context: list[str]
    futures: list[str]
    quantiles: dict[str, list[float | None]]


class OnnxPredictor(Imaginer):
    """A one-shot predictor whose network runs in ONNX Runtime.

    It imagines what the `foretrace.predictor.OneShotPredictor` imagines that it was exported from, up to the rounding
    of float32.

    Args:
        file: A file that ``foretrace export onnx`` wrote.

    Raises:
        CheckpointError: It is missing, damaged, or of another predictor.
    """

    observes = True

    def __init__(self, file: str | Path):
        import onnxruntime

        file = as_path(file, CheckpointError)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.log_severity_level = 3
        # Its own heap would keep what the largest batch needed, 400 MB for the rim of a plan.
        options.enable_cpu_mem_arena = options.enable_mem_pattern = False
        if not file.is_file():
            raise CheckpointError(f"{file} does not exist: {REMEDY}")
        try:
            self._session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
            about = self._session.get_modelmeta().custom_metadata_map
            told = {name.removeprefix("foretrace."): json.loads(text) for name, text in about.items()}
        except Exception as reason:  # onnxruntime's have no class in common
            raise CheckpointError(f"{file} cannot be read ({shown(reason)}): {REMEDY}") from None
        facts = conform(told, Facts, str(file), CheckpointError, REMEDY)
        if facts["predictor"] != ONE_SHOT:
            raise CheckpointError(f"{file} is a predictor {shown(facts['predictor'])}: {REMEDY}")
        self.file = file
        """The file."""
        self.context = tuple(facts["context"])
        self.marginal = bool(facts["config"].get("hidden_share", 0.0) > 0)
        self.ranges = known_ranges(facts["ranges"])
        """Range of each of `foretrace.imagined.domain.MEASURES` in the training part."""
        self._heights = bool(facts["config"]["feature_options"].get("heights", False))
        self.optional = [k for k, name in enumerate(self.context) if self.marginal and name in CONSTANTS]
        """Columns of the context that need not be told, as `EffectPredictor.optional`."""
        self._times = np.array(facts["times"])
        self.outcome = tuple(facts["futures"])
        """Outcome of each future."""
        self.quantiles = _quantiles(facts["quantiles"])
        """Quantiles of `Futures` for each start, and for a context that is told or unknown."""

    @property
    def name(self) -> str:
        """Name in messages."""
        return ONE_SHOT

    @property
    def learned_outcomes(self) -> tuple[str, ...]:
        """Outcomes that it distinguishes."""
        return tuple(dict.fromkeys(self.outcome))

    @property
    def sample_times(self) -> Float[np.ndarray, " time"]:
        """Times of the imagined samples [s]."""
        return self._times

    def imagine_scenes(self, scenes: Scenes) -> ImaginedBatch:
        """Imagine the effects in scenes, with warnings about objects that are unlike those learned from."""
        source = scenes.source
        features = (
            self._candidate_features(source) if isinstance(source, Candidates) else self._features(source)
        )
        futures = self._futures(features, scenes)
        if scenes.observed is not None:
            futures = futures.given(scenes.observed, float(self._times[1] - self._times[0]))
        best = futures.states[np.arange(len(scenes)), futures.probability.argmax(axis=1)].astype(float)
        pose = np.concatenate([best[..., :3], rotation_vector_to_quaternion(best[..., 3:])], axis=-1)
        corners = features[:, : 2 * MAX_CORNERS].reshape(len(features), -1, 2)
        count = 1 + (corners[:, 1:] != corners[:, :1]).any(axis=2).sum(axis=1)
        told = measure_context(self.context, scenes.context)
        unusual = find_unusual(scenes.measure() | {"corners": count.astype(float)} | told, self.ranges)
        return ImaginedBatch(self._times, best[..., :3], pose, futures, unusual)

    def _futures(self, features: Float[np.ndarray, "batch inputs"], scenes: Scenes) -> Futures:
        inputs = {"features": features, "com": scenes.com.astype(np.float32)}
        if self.context:
            inputs["context"] = scenes.context.astype(np.float32)
        found = dict(zip(OUTPUTS, map(np.asarray, self._session.run(list(OUTPUTS), inputs)), strict=True))
        spread = found["spread"].astype(float)
        if scenes.start == "estimated":
            spread = np.hypot(spread, found["start_spread"].astype(float)[:, None, None])
        return Futures(
            probability=found["probability"].astype(float),
            outcome=self.outcome,
            states=np.concatenate([found["com_trajectory"], found["rotation_vector"]], axis=-1),
            spread=spread,
            support_points=found["support_points"].astype(float),
            quantiles=self._widths(scenes),
        )

    def _widths(self, scenes: Scenes) -> Float[np.ndarray, "*batch levels"]:
        """Quantiles for how much of the context is told; of a part of it, the larger ones."""
        told, nothing = self.quantiles[STARTS.index(scenes.start)]
        if not self.optional:
            return told
        known = np.isfinite(scenes.context[:, self.optional])
        some = np.where(known.any(axis=1, keepdims=True), np.maximum(told, nothing), nothing)
        return np.where(known.all(axis=1, keepdims=True), told, some)

    def _features(self, batch: InteractionBatch) -> Float[np.ndarray, "batch inputs"]:
        """As of the features ``outline``."""
        corners = (hull_rows(batch) / UNIT).astype(np.float32).reshape(len(batch), -1)
        if not self._heights:
            return corners
        cells = (coarse_heights(batch.height) / UNIT).astype(np.float32)
        return np.concatenate([corners, cells.reshape(len(batch), -1)], axis=1)

    def _candidate_features(self, candidates: Candidates) -> Float[np.ndarray, "batch inputs"]:
        """The same for several actions on one object, whose outline is fitted once and moved into each frame."""
        seen = self._features(InteractionBatch.from_views([candidates.view]))
        axes, origins = candidates.axes.astype(np.float32), candidates.contacts.astype(np.float32)
        corners = seen[:, : 2 * MAX_CORNERS].reshape(1, -1, 2) - origins[:, None] / np.float32(UNIT)
        moved = (corners @ axes.transpose(0, 2, 1)).reshape(len(axes), -1)
        if not self._heights:
            return moved
        cells = seen[0, 2 * MAX_CORNERS :].reshape(HEIGHT_CELLS, HEIGHT_CELLS)
        return np.concatenate([moved, moved_map(cells, axes, origins).reshape(len(axes), -1)], axis=1)


def moved_map(
    cells: Float[np.ndarray, "rows rows"],
    axes: Float[np.ndarray, "n 2 2"],
    origins: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "n rows rows"]:
    """A map over a whole view as seen from other frames, bilinear, 0 beyond its border.

    Args:
        cells: The map.
        axes: Rows: the frames' axes in the view's.
        origins: Their origins in the view's [m].
    """
    size = len(cells)
    metres = METRES_PER_PIXEL * VIEW_SIZE / size
    contact = (np.array(CONTACT_PIXEL, dtype=np.float32) + 0.5) * size / VIEW_SIZE - 0.5
    own = contact - np.stack(np.meshgrid(*2 * (np.arange(size, dtype=np.float32),), indexing="ij"), axis=-1)
    places = own.reshape(-1, 2) @ axes + (origins / np.float32(metres))[:, None]
    row, column = np.moveaxis(contact - places, -1, 0)
    low_row, low_column = np.floor(row), np.floor(column)
    down, across = row - low_row, column - low_column
    padded = np.pad(cells, 1)
    found = np.zeros_like(row)
    for by_row, row_share in ((0, 1 - down), (1, down)):
        for by_column, column_share in ((0, 1 - across), (1, across)):
            at = (np.clip(low_row + by_row, -1, size) + 1).astype(np.int64)
            beside = (np.clip(low_column + by_column, -1, size) + 1).astype(np.int64)
            found += row_share * column_share * padded[at, beside]
    return found.reshape(-1, size, size)


def _quantiles(told: Mapping[str, list[float | None]]) -> Float[np.ndarray, "starts told levels"]:
    """Quantiles for each start, and for a context that is told or unknown; None: infinite."""
    rows = [
        [[np.inf if value is None else value for value in told[f"start {start}, context {name}"]]
         for name in ("told", "unknown")]
        for start in STARTS
    ]  # fmt: skip
    return np.array(rows, dtype=float)
