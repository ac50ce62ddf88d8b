"""The edge that an object will turn about, and the lever-up as seen from there.

A lifted object turns about an edge of its footprint, nearly as on a hinge. Seen from there, lever-ups of different
objects look alike: what matters is how far contact and centre of mass are from the hinge, and which way the blade
pushes. All of it is in closed form from the hull's corners and the centre of mass.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from foretrace.features.support_points import HALF_WIDTH, SETBACK

UNIT = 0.1
"""Lengths are divided by this to be of unit scale [m]."""
NEAR_CORNER = 0.01
"""Where the ray leaves the hull is told in more detail this near to a corner [m]."""
OUT_OF_SIGHT = 0.15
"""Positions along an edge are cut off this far from it [m]."""
NUM_VALUES = 19
"""Numbers that describe a lever-up as seen from one hinge."""


@dataclass(frozen=True)
class Hinges:
    """The edges that objects are expected to turn about, each a frame of its own.

    The axes of that frame: out of the object, along the edge counter-clockwise, up. An object that turns outwards
    over the edge turns about the second axis by a positive angle.
    """

    values: Float[Tensor, "batch 19"]
    """The lever-up as seen from there, of unit scale."""
    axes: Float[Tensor, "batch 3 3"]
    """Rows: the axes in the action frame."""
    ends: Float[Tensor, "batch 2 2"]
    """Ends of the edge in the action frame [m], the right one first as seen from inside."""


def find_hinges(corners: Float[Tensor, "batch corners 2"], com: Float[Tensor, "batch 3"]) -> Hinges:
    """The edges crossed by the rays from lift point through centre of mass.

    The rule is that of `foretrace.features.support_points.support_points_by_rule`.

    Args:
        corners: Corners of convex hulls in the action frame [m], counter-clockwise; the first one fills the row.
        com: Centres of mass at rest in the action frame [m].
    """
    hull = _Hull(corners)
    lift = torch.stack([torch.full_like(com[:, 1], -SETBACK), HALF_WIDTH * com[:, 1].sign()], dim=1)
    ray = F.normalize(com[:, :2] - lift, dim=1)
    return _see(hull, hull.crossed(lift, ray), com, lift, ray)


def mirror_corners(corners: Float[Tensor, "batch corners 2"]) -> Float[Tensor, "batch corners 2"]:
    """The hulls of `find_hinges` seen in a mirror along the action axis, counter-clockwise again."""
    number = torch.arange(corners.shape[1], device=corners.device)
    count = _Hull(corners).count[:, None]
    order = torch.where(number < count, -number % count, 0)
    return corners.gather(1, order[..., None].expand(-1, -1, 2)) * corners.new_tensor([1.0, -1.0])


class _Hull:
    """Edges of convex hulls, of which each object has another number."""

    def __init__(self, corners: Float[Tensor, "batch corners 2"]):
        self.start = corners
        self.side = corners.roll(-1, dims=1) - corners
        self.length = self.side.norm(dim=2)
        self.there: Bool[Tensor, "batch corners"] = self.length > 1e-6
        self.count: Int[Tensor, " batch"] = self.there.sum(dim=1).clamp(min=1)

    def step(self, edge: Int[Tensor, " batch"], by: Int[Tensor, " batch"] | int) -> Int[Tensor, " batch"]:
        """The edge so many edges further on."""
        return (edge + by) % self.count

    def edge(self, edge: Int[Tensor, " batch"]) -> tuple[Tensor, Tensor, Tensor]:
        """Start (batch, 2), direction (batch, 2) and length (batch,)."""
        rows = torch.arange(len(edge), device=edge.device)
        length = self.length[rows, edge].clamp(min=1e-6)
        return self.start[rows, edge], self.side[rows, edge] / length[:, None], length

    def crossed(self, lift: Tensor, ray: Tensor) -> Int[Tensor, " batch"]:
        """The edge across which a ray leaves; the one furthest along it where there is none."""
        right = _cross(ray[:, None], self.start - lift[:, None])
        left = _cross(ray[:, None], self.start + self.side - lift[:, None])
        leaves = (right < 0) & (left >= 0) & self.there
        ahead = ((self.start + self.side / 2) * ray[:, None]).sum(dim=2)
        return (ahead + 10 * leaves).masked_fill(~self.there, -torch.inf).argmax(dim=1)

    def levered(self) -> tuple[Tensor, Tensor]:
        """Where the edge nearest to the contact point starts and ends, measured along it from there (batch,)."""
        share = (-(self.start * self.side).sum(dim=2) / self.length.clamp(min=1e-6) ** 2).clamp(0, 1)
        distance = (self.start + share[..., None] * self.side).norm(dim=2).masked_fill(~self.there, torch.inf)
        start, along, length = self.edge(distance.argmin(dim=1))
        first = (start * along).sum(dim=1)
        return first, first + length


def _see(hull: _Hull, edge: Int[Tensor, " batch"], com: Tensor, lift: Tensor, ray: Tensor) -> Hinges:
    """The lever-ups as seen from one edge each. Along it, positions count from the contact point."""
    start, along, length = hull.edge(edge)
    along_before, along_after = (hull.edge(hull.step(edge, by))[1] for by in (-1, 1))
    out = torch.stack([along[:, 1], -along[:, 0]], dim=1)

    def ahead(normal: Tensor, point: Tensor) -> Tensor:
        return (normal * point).sum(dim=1)

    mass = com[:, :2]
    first, last, beside = ahead(along, start), ahead(along, start) + length, ahead(along, mass)
    travel = (ahead(out, start) - ahead(out, lift)) / ahead(out, ray).clamp(min=0.02)
    leaves = (ahead(along, lift) + travel * ahead(along, ray)).clamp(
        first - OUT_OF_SIGHT, last + OUT_OF_SIGHT
    )
    lengths = [
        # From contact, and from centre of mass, to the hinge; the centre of mass and the ends along it.
        *(ahead(out, start), ahead(out, start - mass), beside, first, last),
        # Where the ray leaves: along the hinge, from its ends, from the centre of mass.
        *(leaves, leaves - first, last - leaves, leaves - beside),
        com[:, 2],
        # The edge that the blade goes under.
        *(end.clamp(-OUT_OF_SIGHT, OUT_OF_SIGHT) for end in hull.levered()),
    ]
    # How sharply the hull turns at the hinge's ends: at a blunt corner, its neighbour is nearly the same hinge.
    turns = [torch.atan2(_cross(a, b), ahead(a, b)) for a, b in ((along_before, along), (along, along_after))]
    near = [torch.tanh(distance / NEAR_CORNER) for distance in (leaves - first, last - leaves)]
    values = torch.stack(
        [length / UNIT for length in lengths] + [out[:, 0], along[:, 0], *turns, *near], dim=1
    )
    values = torch.cat([values, mass[:, 1:].sign()], dim=1)
    flat, up = torch.zeros_like(length), torch.ones_like(length)
    axes = [torch.cat([a, flat[:, None]], dim=1) for a in (out, along)] + [
        torch.stack([flat, flat, up], dim=1)
    ]
    ends = torch.stack([start, start + along * length[:, None]], dim=1)
    return Hinges(values, torch.stack(axes, dim=1), ends)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
