"""Candidate pivot edges of an object, and lever-ups described relative to them.

A lifted object turns about an edge of its footprint, nearly as on a hinge. Relative to it, lever-ups of different
objects look alike: what matters is how far contact and centre of mass are from it, and which way the blade pushes. All
of it is in closed form from the hull's corners and the centre of mass.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from foretrace.features.base import FeatureExtractor
from foretrace.features.outline import Outline
from foretrace.features.support_points import HALF_WIDTH, SETBACK
from foretrace.geometry import polygon_centroid
from foretrace.interactions.batch import MIRROR, InteractionBatch
from foretrace.interactions.hull import MAX_CORNERS, UNIT, mask_contour
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, VIEW_SIZE
from foretrace.objects import BEVEL

NEAR_CORNER = 0.01
"""Distance from a corner within which the place where the ray leaves the hull is described in more detail [m]."""
AT_CORNER = 0.003
"""The same for the places where rays leave the bottom face [m]."""
RIM = BEVEL.width
"""Distance of the bottom face, on which objects stand, from the outline [m]."""
SHARPEST = 2.6
"""Largest turn of the outline at a corner [rad]: the bottom face's corner would be far away at sharper ones."""
OUT_OF_SIGHT = 0.15
"""Positions along an edge are cut off this far from it [m]."""
NUM_VALUES = 27
"""Numbers that describe a lever-up relative to one edge."""
PROBES = 5
"""Places along either side of the rectangle about the hull at which heights are read."""
IN_MIRROR = [0, 1, 2, 4, 3, 5, 7, 6, 8, 9, 11, 10, 13, 12, 15, 14, 16, 17, 19, 18, 21, 20, 23, 22, 25, 24, 26]
"""Index that each of the numbers has in the mirror image, which may change its sign."""
SIGN_IN_MIRROR = torch.ones(NUM_VALUES)
"""That sign: positions along the edge are counted the other way."""
SIGN_IN_MIRROR[[2, 3, 4, 5, 8, 10, 11, 17, 26]] = -1


@dataclass(frozen=True)
class PivotEdges:
    """Edges that objects may turn about, each with a frame of its own; and those of their mirror images.

    The axes of that frame: out of the object, along the edge counter-clockwise, up. An object that turns outwards
    over the edge turns about the second axis by a positive angle. The second view is that of a mirror along the
    action axis; its axes are mirrored back, so they are left-handed.
    """

    values: Float[Tensor, "batch views edges values"]
    """The lever-up relative to them, of unit scale."""
    axes: Float[Tensor, "batch views edges 3 3"]
    """Rows: the axes in the action frame."""
    ends: Float[Tensor, "batch edges 2 2"]
    """Ends of the edges in the action frame [m], the right one first as seen from inside."""


def find_pivot_edges(
    corners: Float[Tensor, "batch corners 2"],
    com: Float[Tensor, "batch 3"],
    num_edges: int = 2,
    heights: Float[Tensor, "batch rows columns"] | None = None,
) -> PivotEdges:
    """The edges crossed by the rays from lift point through centre of mass, and their neighbours there.

    The first is the edge of `foretrace.features.support_points.support_points_by_rule`, the second the one beyond
    the corner that the ray passes next to it.

    Args:
        corners: Corners of convex hulls in the action frame [m], counter-clockwise; the first one fills the row.
        com: Centres of mass at rest in the action frame [m].
        num_edges: 1 or 2.
        heights: Height maps over the whole view [m], of any resolution. They add ``PROBES`` squared values.
    """
    lift = torch.stack([torch.full_like(com[:, 1], -SETBACK), HALF_WIDTH * com[:, 1].sign()], dim=1)
    ray = F.normalize(com[:, :2] - lift, dim=1)
    hull = _Hull(corners)
    values, axes, ends = _describe(hull, hull.crossed(lift, ray, num_edges), com, lift, ray)
    values = torch.stack([values, values[..., IN_MIRROR] * SIGN_IN_MIRROR.to(values)], dim=1)
    if heights is not None:
        probed = _probe(heights, corners, axes)
        values = torch.cat([values, torch.stack([probed, probed.flip(-1)], dim=1).flatten(3)], dim=-1)
    # A vector out of the object or up stays so in the mirror; along the edge it is reversed.
    return PivotEdges(values, torch.stack([axes, axes * axes.new_tensor(MIRROR)[:, None]], dim=1), ends)


class _Hull:
    """Edges of convex hulls, whose number differs between objects."""

    def __init__(self, corners: Float[Tensor, "batch corners 2"]):
        self.start = corners
        self.side = corners.roll(-1, dims=1) - corners
        self.length = self.side.norm(dim=2)
        self.there: Bool[Tensor, "batch corners"] = self.length > 1e-6
        self.count: Int[Tensor, " batch"] = self.there.sum(dim=1).clamp(min=1)
        number = torch.arange(corners.shape[1], device=corners.device)
        self._next, self._last_one = ((number + by) % self.count[:, None] for by in (1, -1))

    def edges(self, edges: Int[Tensor, "batch edges"]) -> tuple[Tensor, Tensor, Tensor]:
        """Start (batch, edges, 2), direction (batch, edges, 2) and length (batch, edges)."""
        edges = edges % self.count[:, None]
        pairs = edges[..., None].expand(-1, -1, 2)
        length = self.length.gather(1, edges).clamp(min=1e-6)
        return self.start.gather(1, pairs), self.side.gather(1, pairs) / length[..., None], length

    def crossed(self, lift: Tensor, ray: Tensor, num: int) -> Int[Tensor, "batch edges"]:
        """The edge across which a ray leaves (the one furthest along it where there is none), and a neighbour."""
        first, last = self.bottom()
        right = _cross(ray[:, None], first - lift[:, None])
        left = _cross(ray[:, None], last - lift[:, None])
        leaves = (right < 0) & (left >= 0) & self.there
        ahead = ((self.start + self.side / 2) * ray[:, None]).sum(dim=2)
        edge = (ahead + 10 * leaves).masked_fill(~self.there, -torch.inf).argmax(dim=1, keepdim=True)
        if num == 1:
            return edge
        # How far the ends of the edge are from the ray: the nearer one is where the neighbour begins.
        from_start, from_end = (side.gather(1, edge).abs() for side in (right, left))
        step = torch.where(from_end < from_start, 1, -1)
        return torch.cat([edge, (edge + step) % self.count[:, None]], dim=1)

    def bottom(self) -> tuple[Tensor, Tensor]:
        """Where the edges of the bottom face start and end (batch, corners, 2)."""
        along = self.side / self.length.clamp(min=1e-6)[..., None]
        turn = _turn(along, along.gather(1, self._next[..., None].expand_as(along)))
        cut = RIM * torch.tan(turn / 2)[..., None]
        before = cut.gather(1, self._last_one[..., None])
        inwards = RIM * torch.stack([-along[..., 1], along[..., 0]], dim=-1)
        return self.start + inwards + before * along, self.start + self.side + inwards - cut * along

    def levered(self) -> tuple[Tensor, Tensor]:
        """Where the edge nearest to the contact point starts and ends, measured along it from there (batch, 1)."""
        share = (-(self.start * self.side).sum(dim=2) / self.length.clamp(min=1e-6) ** 2).clamp(0, 1)
        distance = (self.start + share[..., None] * self.side).norm(dim=2).masked_fill(~self.there, torch.inf)
        # A corner is nearest on two edges: of these, it is the one that leads less ahead, in the mirror, too.
        nearest = (distance + 1e-5 * self.side[..., 0].abs()).argmin(dim=1, keepdim=True)
        start, along, length = self.edges(nearest)
        first = (start * along).sum(dim=2)
        return first, first + length


def _describe(
    hull: _Hull, edges: Int[Tensor, "batch edges"], com: Tensor, lift: Tensor, ray: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Lever-ups relative to edges. Along them, positions count from the contact point."""
    start, along, length = hull.edges(edges)
    along_before, along_after = (hull.edges(edges + by)[1] for by in (-1, 1))
    out = torch.stack([along[..., 1], -along[..., 0]], dim=-1)
    mass, lift, ray = com[:, None, :2], lift[:, None], ray[:, None]

    def ahead(normal: Tensor, point: Tensor) -> Tensor:
        return (normal * point).sum(dim=-1)

    def crossing(lift: Tensor, ray: Tensor, inside: float) -> Tensor:
        """Where a ray crosses an edge that is moved inwards, along the edge."""
        travel = (ahead(out, start) - inside - ahead(out, lift)) / ahead(out, ray).clamp(min=0.02)
        place = ahead(along, lift) + travel * ahead(along, ray)
        return place.maximum(first - OUT_OF_SIGHT).minimum(last + OUT_OF_SIGHT)

    first, beside = ahead(along, start), ahead(along, mass)
    last = first + length
    leaves = crossing(lift, ray, 0.0)
    # How sharply the hull turns at the edge's ends: beyond a blunt corner, the neighbour is nearly the same edge.
    turns = [_turn(along_before, along), _turn(along, along_after)]
    right, left = (RIM * torch.tan(turn / 2) for turn in turns)
    other = lift * lift.new_tensor(MIRROR[:2])
    # From both corners of the blade: between these rays, the object stands on a corner alone.
    below = [crossing(lift, ray, RIM), crossing(other, F.normalize(mass - other, dim=-1), RIM)]
    apart = [gap for place in below for gap in (place - first - right, last - left - place)]
    lengths = [
        # From contact, and from centre of mass, to the edge; the centre of mass and the ends along it.
        *(ahead(out, start), ahead(out, start - mass), beside, first, last),
        # Where the ray leaves: along the edge, from its ends, from the centre of mass.
        *(leaves, leaves - first, last - leaves, leaves - beside),
        com[:, 2:].expand_as(length),
        # The edge that the blade goes under.
        *(end.clamp(-OUT_OF_SIGHT, OUT_OF_SIGHT).expand_as(length) for end in hull.levered()),
        # Where rays leave the bottom face, from its ends.
        *apart,
    ]
    values = torch.cat(
        [
            torch.stack(lengths, dim=-1) / UNIT,
            torch.stack([out[..., 0], along[..., 0], *turns], dim=-1),
            torch.tanh(torch.stack([leaves - first, last - leaves], dim=-1) / NEAR_CORNER),
            torch.tanh(torch.stack(apart, dim=-1) / AT_CORNER),
            com[:, 1:2].sign().expand_as(length)[..., None],
        ],
        dim=-1,
    )
    flat, up = torch.zeros_like(length), torch.ones_like(length)
    axes = torch.stack(
        [
            torch.cat([out, flat[..., None]], dim=-1),
            torch.cat([along, flat[..., None]], dim=-1),
            torch.stack([flat, flat, up], dim=-1),
        ],
        dim=-2,
    )
    return values, axes, torch.stack([start, start + along * length[..., None]], dim=-2)


def _probe(
    heights: Float[Tensor, "batch rows columns"],
    corners: Float[Tensor, "batch corners 2"],
    axes: Float[Tensor, "batch edges 3 3"],
) -> Float[Tensor, "batch edges out along"]:
    """Heights on a grid over the rectangle about the hull with sides along the edge, of unit scale."""
    sides = axes[..., :2, :2]  # rows: out of the object, along the edge
    reach = corners[:, None] @ sides.mT  # (batch, edges, corners, 2)
    low, high = reach.amin(dim=-2), reach.amax(dim=-2)
    share = (torch.arange(PROBES, dtype=low.dtype, device=low.device) + 0.5) / PROBES
    grid = torch.stack(torch.meshgrid(share, share, indexing="ij"), dim=-1).flatten(0, 1)
    points = (low[..., None, :] + (high - low)[..., None, :] * grid) @ sides
    # Positions in the picture, from -1 to 1 between its borders; columns first.
    pixels = points.new_tensor(CONTACT_PIXEL) - points / METRES_PER_PIXEL
    places = ((2 * pixels + 1) / VIEW_SIZE - 1).flip(-1)
    found = F.grid_sample(heights[:, None], places, align_corners=False)
    return found[:, 0].unflatten(-1, (PROBES, PROBES)) / UNIT


class PivotEdgeFeatures(FeatureExtractor):
    """``pivot-edge``: a lever-up relative to the edge ahead of the centre of mass; not in the paper.

    The ``NUM_VALUES`` numbers with which the direct trajectory predictor describes its first candidate edge, from the
    view alone.
    """

    label = "pivot-edge"

    @property
    def num_features(self) -> int:
        """The numbers that describe a lever-up relative to one edge."""
        return NUM_VALUES

    def inputs(self, batch: InteractionBatch) -> Float[Tensor, "batch 27"]:
        """The numbers themselves, with the centre of mass above that of the mask's area, at half the object's height.

        Raises:
            PredictionError: A mask is empty.
        """
        corners = UNIT * Outline().inputs(batch).unflatten(1, (MAX_CORNERS, 2))
        centres = [polygon_centroid(mask_contour(batch, row)) for row in range(len(batch))]
        com = np.column_stack([np.reshape(centres, (-1, 2)), batch.height.max(axis=(1, 2), initial=0.0) / 2])
        return find_pivot_edges(corners, torch.from_numpy(com).float(), 1).values[:, 0, 0]

    def forward(self, inputs: Float[Tensor, "batch 27"]) -> Float[Tensor, "batch 27"]:
        """Hand them on."""
        return inputs


def _turn(before: Tensor, after: Tensor) -> Tensor:
    """The angle from one direction to the next, counter-clockwise [rad]."""
    return torch.atan2(_cross(before, after), (before * after).sum(dim=-1)).clamp(max=SHARPEST)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
