"""What a monitor concludes."""

from dataclasses import dataclass, field
from functools import cached_property

from foretrace.imagined import Futures, ImaginedEffect
from foretrace.monitoring.remainder import Remainder


@dataclass(frozen=True, eq=False)
class Verdict:
    """What a monitor concludes from an execution so far."""

    time: float
    """Time of the sample [s]."""
    alarm: bool
    """Whether no future explains what was observed, now or before: the robot should stop."""
    cause: str | None
    """Why, where there is an alarm; ``unknown`` if no hypothesis is convincing."""
    score: float
    """Largest deviation so far from the future that fits best, in widths of its band."""
    threshold: float
    """Score above which there is an alarm."""
    transition: bool
    """Whether another outcome than the one that was most probable before the motion has taken over, as foreseen."""
    outcomes: dict[str, float]
    """Probability of each outcome, given what was observed."""
    causes: dict[str, float]
    """Probability of each cause, where there is an alarm."""
    message: str
    """The same in a line."""
    _remainder: Remainder | None = field(default=None, repr=False)

    @cached_property
    def futures(self) -> Futures | None:
        """Futures by outcome over the whole motion, as probable as they are now; None before the first pose."""
        return None if self._remainder is None else self._remainder.whole()

    @cached_property
    def rest(self) -> ImaginedEffect | None:
        """What is still to come, imagined anew, with regions; None before the first pose or past the last sample."""
        return None if self._remainder is None else self._remainder.rest()
