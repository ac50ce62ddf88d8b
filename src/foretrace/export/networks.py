"""Inputs for comparing an exported network with PyTorch: prisms that are levered, and noise."""

import numpy as np

from foretrace.actions import LeverUp
from foretrace.errors import ViewError
from foretrace.features import Outline
from foretrace.geometry import convex_hull
from foretrace.imagined import estimate_com
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.hull import MAX_CORNERS, UNIT
from foretrace.interactions.topdown import VIEW_SIZE, TopDownView
from foretrace.objects import sample_prism
from foretrace.predictor import EffectPredictor
from foretrace.predictor.traced import TracedPredictor


def network_of(predictor: EffectPredictor) -> TracedPredictor:
    """The network that is exported of a predictor, on the CPU, outside training."""
    return predictor.cpu().eval().traced().eval()


def draw_inputs(
    network: TracedPredictor, rng: np.random.Generator, number: int, noise: bool
) -> dict[str, np.ndarray]:
    """Inputs by name.

    Args:
        network: The network.
        rng: Random numbers.
        number: Number of lever-ups.
        noise: Random numbers instead of random prisms.
    """
    views, predictor = _views(rng, number), network.predictor
    source = next(iter(network.inputs))
    if source == "features":
        drawn = _draw_features(predictor, rng, views, noise)
    else:
        drawn = _draw_images({"mask": views.mask, "height": views.height}[source], rng, noise)
    com = estimate_com(views)
    if noise:
        com = rng.uniform([0.0, -0.1, 0.0], [0.2, 0.1, 0.1], com.shape)
    inputs = {source: drawn, "com": com.astype(np.float32)}
    if predictor.context:
        mean, scale = (tensor.numpy() for tensor in (predictor.known_mean, predictor.known_scale))
        values = mean + scale * rng.uniform(-2, 2, (len(views), len(mean)))
        hidden = rng.random((len(views), len(predictor.optional))) < 0.5
        values[:, predictor.optional] = np.where(hidden, np.nan, values[:, predictor.optional])
        inputs["context"] = values.astype(np.float32)
    return inputs


def _draw_features(
    predictor: EffectPredictor, rng: np.random.Generator, views: InteractionBatch, noise: bool
) -> np.ndarray:
    """Features of the views; noise for outlines are hulls of random points, with random heights."""
    features = predictor.features
    shape = len(views), features.num_features
    if noise and isinstance(features, Outline):
        rows = rng.uniform(0, 5, shape).astype(np.float32)
        for row in rows:
            hull = convex_hull(rng.uniform(-0.2, 0.2, (MAX_CORNERS, 2)))
            corners = np.concatenate([hull, hull[:1].repeat(MAX_CORNERS - len(hull), axis=0)])
            row[: 2 * MAX_CORNERS] = corners.ravel() / UNIT
        return rows
    if noise or features.oracle:
        return rng.normal(size=shape).astype(np.float32)
    return predictor.compute_features(features.inputs(views)).numpy()


def _draw_images(images: np.ndarray, rng: np.random.Generator, noise: bool) -> np.ndarray:
    """The images; noise are random pixels that fill all or a part of the view."""
    dtype = np.uint8 if images.dtype == bool else np.float32
    if noise:
        images = np.zeros_like(images)
        for image in images:
            size = rng.integers(1, VIEW_SIZE, 2)
            image[: size[0], : size[1]] = rng.random(tuple(size)) < 0.5
    return images.astype(dtype)


def _views(rng: np.random.Generator, number: int) -> InteractionBatch:
    """Random prisms at random edges."""
    views: list[TopDownView] = []
    while len(views) < number:
        prism = sample_prism(rng, int(rng.integers(3, 11)))
        action = LeverUp.at_edge(prism, int(rng.integers(len(prism.corners))), rng.uniform(0.2, 0.8))
        try:
            views.append(TopDownView.of(prism, action))
        except ViewError:  # it does not fit
            continue
    return InteractionBatch.from_views(views)
