"""Options that say what imaginers are told: values of constants, or a belief."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from foretrace.errors import PlanningError

if TYPE_CHECKING:
    from foretrace.imagined import Belief, Imaginer

CONSTANTS = ("friction", "tool_friction", "density")
"""Options that are constants."""


@dataclass(frozen=True)
class PhysicsOptions:
    """What the imaginers are told."""

    friction: float | None = None
    """Friction of object and table."""
    tool_friction: float | None = None
    """Friction of object and blade."""
    density: float | None = None
    """Density of the object [kg/m^3]."""
    belief: Path | None = None
    """File of a belief about the constants, as `Belief.save` writes it, in place of their values; with --goal learn, by
    default what is believed before the first action."""

    def context(
        self, imaginer: "Imaginer", learns: bool, unknown: bool
    ) -> "Mapping[str, float] | Belief | None":
        """What an imaginer is told.

        Args:
            imaginer: The imaginer.
            learns: Whether the goal is to learn.
            unknown: Whether constants that are not given are not told.

        Raises:
            PlanningError: A value is none, is of no use, or does not go together with others.
        """
        from foretrace.imagined import Belief
        from foretrace.monitoring.identification import first_prior

        given = {name: getattr(self, name) for name in CONSTANTS if getattr(self, name) is not None}
        for name, value in given.items():
            if not 0 < value < float("inf"):
                raise PlanningError(f"{option_name(name)} is {value}: give a number above 0")
        if idle := [option_name(name) for name in given if name not in imaginer.context]:
            raise PlanningError(
                f"{' and '.join(idle)}: the {imaginer.name} imaginer is not conditioned on it, leave it out"
            )
        if self.belief is not None or learns:
            what = "--goal learn" if self.belief is None else "--belief"
            if given or unknown:
                raise PlanningError(
                    f"{what} has ranges of the constants in place of values: leave out "
                    f"{' and '.join([*map(option_name, given), *(['--unknown'] if unknown else [])])}"
                )
            return first_prior() if self.belief is None else Belief.load(self.belief)
        if not given and not unknown:
            return None
        usual = {} if unknown else dict(imaginer.nominal)
        return {name: value for name, value in (usual | given).items() if name in imaginer.context}


def option_name(name: str) -> str:
    """An option as it is written on the command line."""
    return f"--{name.replace('_', '-')}"
