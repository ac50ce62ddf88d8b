"""What is exported of a predictor: its network from tensors in SI units to tensors in SI units."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from foretrace.actions import LeverUp
from foretrace.errors import ViewError
from foretrace.features import ImageCnn
from foretrace.features.cnn import HEIGHT_SCALE
from foretrace.features.outline import HEIGHT_CELLS, MAX_CORNERS, UNIT
from foretrace.features.windows import convolve_unbranched
from foretrace.geometry import convex_hull, quaternion_to_matrix, rotation_from_6d
from foretrace.imagined import FLOOR, LEVELS
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.topdown import VIEW_SIZE, TopDownView
from foretrace.objects import sample_prism
from foretrace.predictor import EffectPredictor, OneShotPredictor
from foretrace.predictor.base import estimate_com
from foretrace.predictor.context import KNOWN
from foretrace.predictor.states import rest_states

FRAME = "action: origin at the contact point on the table top, x along the action, y left, z up"
ROTATION = "of the object since rest about the action frame's axes"


class Network(nn.Module, ABC):
    """What is exported of a predictor: tensors in SI units in, tensors in SI units out.

    Args:
        predictor: The predictor.
    """

    inputs: dict[str, str]
    """What the network reads, by name, in the order of ``forward``: what it is."""
    outputs: dict[str, str]
    """What it says, likewise."""

    def __init__(self, predictor: EffectPredictor):
        super().__init__()
        self.predictor = predictor
        self.inputs = {"com": "centre of mass at rest in the action frame [m]"}
        if predictor.known:
            said = ", ".join(f"{name} {KNOWN[name]}" for name in predictor.known)
            self.inputs["known"] = f"constants of the action: {said}"

    @abstractmethod
    def imagine(self, inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What the predictor itself says, in PyTorch."""

    @abstractmethod
    def draw(self, rng: np.random.Generator, number: int, noise: bool) -> dict[str, np.ndarray]:
        """Inputs to compare with: of prisms that are levered, or noise."""

    def facts(self) -> dict[str, Any]:
        """What a reader of the file has to know beside its inputs and outputs."""
        times = self.predictor.times.tolist()
        return {"frame": FRAME, "units": "SI", "times": times, "known": list(self.predictor.known)}

    def add_known(self, features: Tensor, known: Tensor | None) -> Tensor:
        """As `EffectPredictor.add_known`, with tensors alone."""
        if known is None:
            return features
        predictor = self.predictor
        return torch.cat([features, (known - predictor.known_mean) / predictor.known_scale], dim=1)

    def draw_rest(
        self, rng: np.random.Generator, views: InteractionBatch, noise: bool
    ) -> dict[str, np.ndarray]:
        """Centres of mass, and what is known."""
        com = estimate_com(views)
        if noise:
            com = rng.uniform([0.0, -0.1, 0.0], [0.2, 0.1, 0.1], com.shape)
        drawn = {"com": com}
        if self.predictor.known:
            mean, scale = (t.numpy() for t in (self.predictor.known_mean, self.predictor.known_scale))
            drawn["known"] = mean + scale * rng.uniform(-2, 2, (len(views), len(mean)))
        return {name: values.astype(np.float32) for name, values in drawn.items()}


class Distribution(Network):
    """A one-shot predictor: from outlines to all futures."""

    predictor: OneShotPredictor

    def __init__(self, predictor: OneShotPredictor):
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
            "support_points": "ends of the edge that the object turns about, in the action frame [m]",
        }

    def forward(self, features: Tensor, com: Tensor, known: Tensor | None = None) -> tuple[Tensor, ...]:
        """The distribution."""
        mixture = self.predictor.mixture(self.add_known(features, known), com)
        states = mixture.states()
        ends = mixture.ends[:, :, None].expand(-1, -1, mixture.odds.shape[2], -1, -1).flatten(1, 2)
        return mixture.odds.flatten(1).exp(), states[..., :3], states[..., 3:], mixture.spread(), ends

    def facts(self) -> dict[str, Any]:
        """What a reader of the file has to know beside its inputs and outputs."""
        quantiles = [q if np.isfinite(q) else None for q in self.predictor.quantiles.tolist()]
        return super().facts() | {
            "futures": self.predictor.outcomes * self.predictor.settings.hinges,
            "levels": LEVELS.tolist(),
            "quantiles": quantiles,
            "floor": FLOOR,
            "radius": "of the tube of a level [m]: its quantile x (spread + floor)",
        }

    def imagine(self, inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What the predictor itself says, in PyTorch."""
        features = torch.from_numpy(inputs["features"])
        if self.predictor.known:
            features = self.predictor.add_known(features, inputs["known"])
        futures = self.predictor.imagine_effects(features, inputs["com"]).futures
        assert futures is not None
        return {
            "probability": futures.probability,
            "com_trajectory": futures.com,
            "rotation_vector": quaternion_to_matrix(futures.pose[..., 3:]),
            "spread": np.where(futures.counted[..., None], futures.spread, np.inf),
            "support_points": futures.support_points,
        }

    def draw(self, rng: np.random.Generator, number: int, noise: bool) -> dict[str, np.ndarray]:
        """Outlines of prisms; or hulls of random points, with random heights."""
        views = _views(rng, number)
        features = self.predictor.features.inputs(views).numpy()
        if noise:
            features = rng.uniform(0, 5, features.shape).astype(np.float32)
            for row in features:
                hull = convex_hull(rng.uniform(-0.2, 0.2, (MAX_CORNERS, 2)))
                corners = np.concatenate([hull, hull[:1].repeat(MAX_CORNERS - len(hull), axis=0)])
                row[: 2 * MAX_CORNERS] = corners.ravel() / UNIT
        return {"features": features} | self.draw_rest(rng, views, noise)


class Trajectory(Network):
    """Any other predictor: from a view, or from features, to one motion."""

    unturned: Tensor

    def __init__(self, predictor: EffectPredictor):
        super().__init__(predictor)
        features = predictor.features
        self.seen = features.channel if isinstance(features, ImageCnn) else "features"
        said = {
            "mask": "view from above, 1 where the object is",
            "height": "view from above, heights [m], 0 beside the object",
            "features": f"as from foretrace's features {features.label}",
        }
        self.inputs = {self.seen: said[self.seen]} | self.inputs
        self.outputs = {"com_trajectory": "centre of mass over time in the action frame [m]"}
        if predictor.state != "position":
            self.outputs["rotation_matrix"] = ROTATION
        unturned = rest_states(np.zeros((1, 3)), predictor.state)[:, 3:]
        self.register_buffer("unturned", torch.from_numpy(unturned).float())

    def forward(self, seen: Tensor, com: Tensor, known: Tensor | None = None) -> tuple[Tensor, ...]:
        """The motion."""
        predictor, features = self.predictor, self.predictor.features
        inputs = seen
        if isinstance(features, ImageCnn):
            images = seen[:, None].float() / (HEIGHT_SCALE if self.seen == "height" else 1.0)
            inputs = F.relu(features.dense(convolve_unbranched(images, features.stack).flatten(1)))
        first = torch.cat([com, self.unturned.expand(com.shape[0], -1)], dim=1)
        start = (first - predictor.state_mean) / predictor.state_scale
        rolled = predictor.roll_out(self.add_known(inputs, known), start)
        states = rolled * predictor.state_scale + predictor.state_mean
        states = torch.cat([first[:, None], states[:, 1:]], dim=1)
        if predictor.state == "position":
            return (states,)
        return states[..., :3], _rotation_from_6d(states[..., 3:])

    def imagine(self, inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What the predictor itself says, in PyTorch."""
        predictor, seen = self.predictor, torch.from_numpy(inputs[self.seen])
        if isinstance(predictor.features, ImageCnn):
            seen = seen[:, None] if self.seen == "mask" else seen[:, None] / HEIGHT_SCALE
            seen = predictor.compute_features(seen)
        if predictor.known:
            seen = predictor.add_known(seen, inputs["known"])
        states = predictor.imagine_states(seen, rest_states(inputs["com"], predictor.state))
        return {"com_trajectory": states[..., :3]} | (
            {"rotation_matrix": rotation_from_6d(states[..., 3:])} if predictor.state != "position" else {}
        )

    def draw(self, rng: np.random.Generator, number: int, noise: bool) -> dict[str, np.ndarray]:
        """Views of prisms and features of them; or random pictures that fill all or a part of the view."""
        views, features = _views(rng, number), self.predictor.features
        if self.seen == "features":
            if noise or features.oracle:
                drawn = rng.normal(size=(number, features.num_features)).astype(np.float32)
            else:
                drawn = self.predictor.compute_features(features.inputs(views)).numpy()
        else:
            pictures = {"mask": views.mask, "height": views.height}[self.seen]
            if noise:
                filled = np.zeros_like(pictures)
                for picture in filled:
                    size = rng.integers(1, VIEW_SIZE, 2)
                    picture[: size[0], : size[1]] = rng.random(tuple(size)) < 0.5
                pictures = filled
            drawn = pictures.astype(np.uint8 if self.seen == "mask" else np.float32)
        return {self.seen: drawn} | self.draw_rest(rng, views, noise)


def network_of(predictor: EffectPredictor) -> Network:
    """What is exported of a predictor, on the CPU, outside training."""
    predictor = predictor.cpu().eval()
    if isinstance(predictor, OneShotPredictor):
        return Distribution(predictor).eval()
    return Trajectory(predictor).eval()


def _views(rng: np.random.Generator, number: int) -> InteractionBatch:
    """Random prisms at random edges."""
    views: list[TopDownView] = []
    while len(views) < number:
        prism = sample_prism(rng, int(rng.integers(3, 11)))
        try:
            views.append(
                TopDownView.of(
                    prism,
                    LeverUp.at_edge(prism, int(rng.integers(len(prism.corners))), rng.uniform(0.2, 0.8)),
                )
            )
        except ViewError:  # it does not fit
            continue
    return InteractionBatch.from_views(views)


def _rotation_from_6d(columns: Tensor) -> Tensor:
    """As `foretrace.geometry.rotation_from_6d`."""
    first = F.normalize(columns[..., :3], dim=-1)
    second = columns[..., 3:]
    second = F.normalize(second - (first * second).sum(dim=-1, keepdim=True) * first, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)
