"""PCA basis of trajectories, and the covariance of residuals in it."""

import torch
from jaxtyping import Float
from torch import Tensor

from foretrace.predictor.mixture import COORDINATES

ODD = (1, 3, 5)
"""Coordinates of a motion that change their sign in a mirror: along the edge; turns about the other two axes."""
FEW = 10
"""Lever-ups of an outcome from which on its residuals' size is estimated from them."""


def find_basis(
    moved: Float[Tensor, "batch time 6"], number: int
) -> tuple[Float[Tensor, "time 6"], Float[Tensor, "components time 6"], Float[Tensor, " components"]]:
    """The largest principal components of trajectories along the axes of their edges.

    Components are found separately for the coordinates that stay the same in a mirror and those that change their
    sign: each is its own mirror image, up to its sign.

    Args:
        moved: Displacements and turns [m].
        number: Number of components, at most.

    Returns:
        The mean trajectory, the components at one standard deviation [m], and the sign of each in a mirror.
    """
    odd = torch.isin(torch.arange(COORDINATES), torch.tensor(ODD)).to(moved)
    mean = moved.mean(dim=0) * (1 - odd)
    found: list[tuple[float, float, Tensor]] = []
    for parity, part in ((1.0, 1 - odd), (-1.0, odd)):
        _, sizes, directions = torch.linalg.svd(((moved - mean) * part).flatten(1), full_matrices=False)
        found += [(float(s), parity, d) for s, d in zip(sizes / len(moved) ** 0.5, directions, strict=True)]
    found = sorted(found, key=lambda component: -component[0])[:number]
    components = torch.stack([size * direction.view_as(mean) for size, _, direction in found])
    return mean, components, moved.new_tensor([parity for _, parity, _ in found])


def fit_covariance(
    residuals: Float[Tensor, "batch components"], others: Float[Tensor, "other components"]
) -> Float[Tensor, "components components"]:
    """Covariance of normalised residuals of an outcome.

    Args:
        residuals: Those of the training part, which correlations come from.
        others: Those of the validation part, which their size comes from if there are ``FEW``.
    """
    covariance = residuals.mT @ residuals / len(residuals)
    ridge = 1e-3 * covariance.diagonal().mean() + 1e-12
    covariance = covariance + ridge * torch.eye(len(covariance)).to(covariance)
    if len(others) >= FEW:
        root = torch.linalg.cholesky(covariance)
        white = torch.linalg.solve_triangular(root, others.mT, upper=False)
        covariance = covariance * white.square().mean()
    return covariance
