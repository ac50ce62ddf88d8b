"""Objects described relative to an action, for actions that turn their object about no edge; such as pushes.

Displacements and turns are predicted along the axes of the action frame. All of it is in closed form from the hull's
corners and the centre of mass.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from foretrace.errors import TrainingError
from foretrace.features.pivot_edges import PivotEdges
from foretrace.interactions.batch import MIRROR
from foretrace.interactions.hull import UNIT

RAYS = 16
"""Directions in which the distance from centre of mass to outline is measured."""
REACH = 0.02
"""Distance beside the path over which the outline's front is described [m]."""
PROBES = 7
"""Places beside the path at which it is, an odd number: the middle one is on it."""
NUM_VALUES = 3 + RAYS + PROBES
"""Numbers that describe an object relative to an action."""
FARTHEST = 0.1
"""A front that is not met counts as this far ahead [m]."""


def find_action_frame(
    corners: Float[Tensor, "batch corners 2"],
    com: Float[Tensor, "batch 3"],
    num_edges: int = 1,
    heights: Float[Tensor, "batch rows columns"] | None = None,
) -> PivotEdges:
    """The action frame itself as the only frame, and the object in it.

    Args:
        corners: Corners of convex hulls in the action frame [m], counter-clockwise; the first one fills the row.
        com: Centres of mass at rest in the action frame [m].
        num_edges: As `find_pivot_edges`; there is one frame only.
        heights: As `find_pivot_edges`.

    Raises:
        TrainingError: Heights are given, which describe objects relative to edges.
    """
    if heights is not None:
        raise TrainingError("heights describe an object relative to its edges: train without --heights")
    side = corners.roll(-1, dims=1) - corners
    length = side.norm(dim=2)
    there = length > 1e-6
    out = F.normalize(torch.stack([side[..., 1], -side[..., 0]], dim=-1), dim=-1)
    angle = torch.arange(RAYS, device=com.device) * (2 * torch.pi / RAYS)
    rays = torch.stack([angle.cos(), angle.sin()], dim=1).to(com)
    radii = _exit(out, corners, there, com[:, None, :2].expand(-1, RAYS, -1), rays)
    beside = torch.linspace(-REACH, REACH, PROBES).to(com)
    # Backwards from far ahead: where a line beside the path enters the object, seen from the contact.
    starts = com[:, None, :2] * com.new_tensor([1.0, 0.0]) + torch.stack([0 * beside, beside], dim=1)
    back = com.new_tensor([[-1.0, 0.0]]).expand(PROBES, -1)
    front = starts[..., 0] - _exit(out, corners, there, starts, back)
    front = front.clamp(-FARTHEST, FARTHEST)
    values = torch.cat([com, radii, front], dim=1) / UNIT
    # In the mirror a ray's place is that of the opposite angle; the sides of the path change places.
    other = torch.cat([radii[:, :1], radii[:, 1:].flip(1), front.flip(1)], dim=1) / UNIT
    mirrored = torch.cat([com * com.new_tensor(MIRROR) / UNIT, other], dim=1)
    axes = torch.eye(3).to(com).expand(len(com), 1, 3, 3)
    views = torch.stack([axes, axes * axes.new_tensor(MIRROR)[:, None]], dim=1)
    ends = com.new_full((len(com), 1, 2, 2), torch.nan)
    return PivotEdges(torch.stack([values, mirrored], dim=1)[:, :, None], views, ends)


def _exit(
    out: Float[Tensor, "batch corners 2"],
    corners: Float[Tensor, "batch corners 2"],
    there: Tensor,
    start: Float[Tensor, "batch rays 2"],
    ray: Float[Tensor, "rays 2"],
) -> Float[Tensor, "batch rays"]:
    """Distance from points to where rays leave a convex outline; negative where that lies behind the point [m]."""
    ahead = ray @ out.mT  # (batch, rays, corners)
    gap = (out * corners).sum(dim=-1)[:, None] - start @ out.mT
    leaves = (ahead > 1e-3) & there[:, None]
    return (
        (gap / ahead.clamp(min=1e-3)).masked_fill(~leaves, FARTHEST).amin(dim=-1).clamp(-FARTHEST, FARTHEST)
    )
