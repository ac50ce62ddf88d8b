"""Motions by the phase of the tool's path: slow and fast actions look alike at equal phases, not at equal times.

The phase is the time at which the nominal path is where the path of an action is. Each motion is known at slots, which
are evenly spaced phases; at sample times it is interpolated between them.
"""

from dataclasses import dataclass, replace

from jaxtyping import Float, Int
from torch import Tensor

from foretrace.actions import ToolPath
from foretrace.predictor.states import Effects


def phase_of(times: Tensor, speed: Tensor) -> Tensor:
    """Phases of the path at times [s], of paths at multiples of the nominal speed; shapes broadcast."""
    start, moving = ToolPath.phases()
    return times + (speed - 1) * (times - start).clamp(min=0).minimum(moving / speed)


def time_of(phases: Tensor, speed: Tensor) -> Tensor:
    """Times of phases [s], as the inverse of `phase_of`."""
    start, moving = ToolPath.phases()
    return phases + (1 / speed - 1) * (phases - start).clamp(min=0, max=moving)


@dataclass(frozen=True)
class Warp:
    """Where evenly spaced samples are read from others: between which two, and how far."""

    before: Int[Tensor, "rows time"]
    """Number of the sample before."""
    share: Float[Tensor, "rows time"]
    """Share of the sample after it."""

    @classmethod
    def to(cls, wanted: Float[Tensor, "rows time"], period: Tensor, count: int) -> "Warp":
        """Where wanted times lie among ``count`` samples that begin at 0; past their end, the last one stays."""
        place = (wanted / period).clamp(min=0, max=count - 1)
        before = place.detach().floor().clamp(max=max(count - 2, 0))
        return cls(before.long(), (place - before).float())

    def read(
        self, samples: Float[Tensor, "rows *more time numbers"]
    ) -> Float[Tensor, "rows *more out numbers"]:
        """Samples, second to last axis, at the wanted times."""
        extra = (1,) * (samples.dim() - 3)
        shape = (*samples.shape[:-2], self.before.shape[1], samples.shape[-1])
        rows = self.before.view(self.before.shape[0], *extra, -1, 1).expand(shape)
        share = self.share.view(self.share.shape[0], *extra, -1, 1)
        last = samples.shape[-2] - 1
        low, high = samples.gather(-2, rows), samples.gather(-2, (rows + 1).clamp(max=last))
        return low + share * (high - low)


def in_phase(
    effects: Effects, speed: Float[Tensor, " batch"], slots: Float[Tensor, " time"], period: Tensor
) -> Effects:
    """Effects whose samples are those at the phases of slots; their lengths count the slots that were observed.

    Args:
        effects: Effects with samples at equal times.
        speed: Speeds of their actions' paths, as multiples of the nominal one.
        slots: The phases [s].
        period: Time between samples [s].
    """
    wanted = time_of(slots, speed[:, None])
    end = (effects.lengths[:, None] - 1) * period
    warp = Warp.to(wanted.minimum(end), period, effects.states.shape[1])
    observed = (wanted <= end + 1e-6).sum(dim=1)
    return replace(effects, states=warp.read(effects.states), lengths=observed)
