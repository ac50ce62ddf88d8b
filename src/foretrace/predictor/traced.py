"""Networks for export: what a predictor computes, from tensors in SI units to tensors in SI units."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from foretrace.geometry import quaternion_to_matrix, rotation_from_6d
from foretrace.imagined import FLOOR, LEVELS, STARTS
from foretrace.imagined.context import context_units
from foretrace.interactions.hull import HEIGHT_CELLS, MAX_CORNERS, UNIT
from foretrace.predictor.states import decode_poses, rest_states

if TYPE_CHECKING:
    from foretrace.predictor.base import EffectPredictor
    from foretrace.predictor.one_shot import OneShotPredictor

FRAME = "action: origin at the contact point on the table top, x along the action, y left, z up"
ROTATION = "of the object since rest about the action frame's axes"


class TracedPredictor(nn.Module, ABC):
    """A network that can be exported: tensors in SI units in, tensors in SI units out.

    Args:
        predictor: The predictor.
    """

    inputs: dict[str, str]
    """Meaning of each input by name, in the order of ``forward``; the first is ``features``, ``mask`` or ``height``."""
    outputs: dict[str, str]
    """Meaning of each output, likewise."""

    def __init__(self, predictor: "EffectPredictor"):
        super().__init__()
        self.predictor = predictor
        self.inputs = {"com": "centre of mass at rest in the action frame [m]"}
        if predictor.context:
            units = context_units()
            meanings = ", ".join(f"{name} {units[name]}" for name in predictor.context)
            hidden = "; NaN: a constant that is not told" if predictor.marginal else ""
            self.inputs["context"] = f"conditioning variables of the action: {meanings}{hidden}"

    @abstractmethod
    def imagine(self, inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Outputs of the predictor itself, to compare with."""

    def facts(self) -> dict[str, Any]:
        """Facts that a reader of the file needs beside its inputs and outputs."""
        times, context = self.predictor.times.tolist(), list(self.predictor.context)
        return {"frame": FRAME, "units": "SI", "times": times, "context": context}


class TracedDistribution(TracedPredictor):
    """The one-shot predictor: from outlines to all futures."""

    predictor: "OneShotPredictor"

    def __init__(self, predictor: "OneShotPredictor"):
        super().__init__(predictor)
        heights = f"; then {HEIGHT_CELLS} x {HEIGHT_CELLS} mean heights, row by row" * predictor.heights
        corners = f"x and y of {MAX_CORNERS} corners of the hull, the first one filling the row"
        self.inputs = {
            "features": f"{corners}{heights}, in units of {UNIT} m, as from foretrace.features.Outline"
        } | self.inputs
        self.outputs = {
            "probability": "of each future",
            "com_trajectory": "centre of mass over time in each future, in the action frame [m]",
            "rotation_vector": f"axis times angle [rad] {ROTATION}",
            "spread": "expected distance of the centre of mass from it [m]",
            "start_spread": "that of a centre of mass at rest that is estimated from the view [m]",
            "support_points": "ends of the edge that the object turns about, in the action frame [m]",
        }

    def forward(self, features: Tensor, com: Tensor, context: Tensor | None = None) -> tuple[Tensor, ...]:
        """The distribution."""
        mixture = self.predictor.mixture(self.predictor.add_context(features, context), com)
        states, outcomes = mixture.states(), mixture.log_probability.shape[2]
        ends = mixture.ends[:, :, None].expand(-1, -1, outcomes, -1, -1).flatten(1, 2)
        probability = mixture.log_probability.flatten(1).exp()
        spreads = mixture.spread(), self.predictor.start_spread(features)
        return probability, states[..., :3], states[..., 3:], *spreads, ends

    def facts(self) -> dict[str, Any]:
        """Facts that a reader of the file needs beside its inputs and outputs."""
        quantiles = {
            f"start {start}, context {told}": [q if np.isfinite(q) else None for q in values.tolist()]
            for start, kinds in zip(STARTS, self.predictor.quantiles, strict=True)
            for told, values in zip(("told", "unknown"), kinds, strict=True)
        }
        return super().facts() | {
            "futures": self.predictor.outcomes * self.predictor.num_edges,
            "levels": LEVELS.tolist(),
            "quantiles": quantiles,
            "floor": FLOOR,
            "radius": "of the tube of a level [m]: its quantile x (spread + floor); where the centre of mass was "
            "estimated, spread is sqrt(spread^2 + start_spread^2)",
        }

    def imagine(self, inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Outputs of the predictor itself; spreads are infinite where a future does not count."""
        features = self.predictor.add_context(torch.from_numpy(inputs["features"]), inputs.get("context"))
        futures = self.predictor.imagine_effects(features, inputs["com"]).futures
        return {
            "probability": futures.probability,
            "com_trajectory": futures.com,
            "rotation_vector": quaternion_to_matrix(futures.pose[..., 3:]),
            "spread": np.where(futures.counted[..., None], futures.spread, np.inf),
            "start_spread": self.predictor.start_spread(features).numpy(),
            "support_points": futures.support_points,
        }


class TracedTrajectory(TracedPredictor):
    """Any other predictor: from an image of the view, or from features, to one motion."""

    unturned: Tensor

    def __init__(self, predictor: "EffectPredictor"):
        super().__init__(predictor)
        self.features = predictor.features.traced()
        own = "features", f"as from foretrace's features {predictor.features.label}"
        self.source, meaning = (self.features.name, self.features.meaning) if self.features else own
        self.inputs = {self.source: meaning} | self.inputs
        self.outputs = {"com_trajectory": "centre of mass over time in the action frame [m]"}
        if predictor.state != "position":
            self.outputs["rotation_matrix"] = ROTATION
        unturned = rest_states(np.zeros((1, 3)), predictor.state)[:, 3:]
        self.register_buffer("unturned", torch.from_numpy(unturned).float())

    def forward(self, source: Tensor, com: Tensor, context: Tensor | None = None) -> tuple[Tensor, ...]:
        """The motion."""
        predictor = self.predictor
        features = source if self.features is None else self.features(source)
        first = torch.cat([com, self.unturned.expand(com.shape[0], -1)], dim=1)
        start = (first - predictor.state_mean) / predictor.state_scale
        rolled = predictor.roll_out(self.predictor.add_context(features, context), start)
        states = rolled * predictor.state_scale + predictor.state_mean
        states = torch.cat([first[:, None], states[:, 1:]], dim=1)
        if predictor.state == "position":
            return (states,)
        rotation = _rotation_from_6d if predictor.state == "pose" else _rotation_from_vector
        return states[..., :3], rotation(states[..., 3:])

    def imagine(self, inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Outputs of the predictor itself."""
        predictor, source = self.predictor, torch.from_numpy(inputs[self.source])
        if self.features is not None:
            source = predictor.compute_features(self.features.inputs(source))
        features = predictor.add_context(source, inputs.get("context"))
        states = predictor.imagine_states(features, rest_states(inputs["com"], predictor.state))
        if predictor.state == "position":
            return {"com_trajectory": states}
        if predictor.state == "pose":
            rotation = rotation_from_6d(states[..., 3:])
        else:
            rotation = quaternion_to_matrix(decode_poses(states)[..., 3:])
        return {"com_trajectory": states[..., :3], "rotation_matrix": rotation}


def _rotation_from_6d(columns: Tensor) -> Tensor:
    """As `foretrace.geometry.rotation_from_6d`."""
    first = F.normalize(columns[..., :3], dim=-1)
    second = columns[..., 3:]
    second = F.normalize(second - (first * second).sum(dim=-1, keepdim=True) * first, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)


def _rotation_from_vector(vector: Tensor) -> Tensor:
    """Rotation matrix of axis times angle (Rodrigues)."""
    angle = vector.square().sum(dim=-1).add(1e-12).sqrt()[..., None, None]
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, dim=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    skew = torch.stack(rows, dim=-2)
    identity = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return identity + angle.sin() / angle * skew + (1 - angle.cos()) / angle**2 * (skew @ skew)
