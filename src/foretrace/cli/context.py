"""Options that say what imaginers are told: values of constants, or a belief."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foretrace.errors import PlanningError, PredictionError, ShapeError
from foretrace.imagined.context import BEVELS

if TYPE_CHECKING:
    from foretrace.imagined import Belief, Imaginer

CONSTANTS = ("friction", "tool_friction", "density", *BEVELS)
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
    bevel_width: float | None = None
    """How far the bottom face lies inside the outline [m]."""
    bevel_height: float | None = None
    """Room for the blade under the rim [m]."""
    belief: Path | None = None
    """File of a belief about the constants, as `Belief.save` writes it, in place of their values; with --goal learn, by
    default what is believed before the first action."""

    @property
    def given(self) -> dict[str, float]:
        """Values that were given."""
        return {name: getattr(self, name) for name in CONSTANTS if getattr(self, name) is not None}

    def context(
        self, imaginer: "Imaginer", learns: bool, unknown: bool, obj: object = None
    ) -> "Mapping[str, float] | Belief | None":
        """What an imaginer is told.

        Args:
            imaginer: The imaginer.
            learns: Whether the goal is to learn.
            unknown: Whether constants that are not given are not told.
            obj: The object, where it is known: its bevel is told by default.

        Raises:
            PlanningError: A value is none, is of no use, or does not go together with others.
        """
        from foretrace.imagined import Belief
        from foretrace.monitoring.identification import first_prior

        given = self.given
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
        usual = {} if unknown else {**imaginer.nominal, **bevel_of(obj)}
        return {name: value for name, value in (usual | given).items() if name in imaginer.context}


def bevel_of(obj: object) -> dict[str, float]:
    """The bevel of an outline, by name; nothing of other objects."""
    from foretrace.objects import Prism

    if type(obj) is not Prism:
        return {}
    return dict(zip(BEVELS, (obj.bevel.width, obj.bevel.height), strict=True))


def bevelled(obj: Any, given: Mapping[str, float]) -> Any:
    """The object with the bevel that was given.

    Raises:
        PredictionError: It is no outline, or it bears no such bevel.
    """
    from foretrace.objects import Bevel, Prism

    found = [name for name in BEVELS if name in given]
    if not found:
        return obj
    if type(obj) is not Prism:
        raise PredictionError(
            f"{option_name(found[0])} is for outlines; the object is a {type(obj).__name__}: leave it out"
        )
    width, height = ({**bevel_of(obj), **given}[name] for name in BEVELS)
    try:
        return Prism(obj.corners, obj.height, Bevel(width, height))
    except ShapeError as error:
        options = " and ".join(map(option_name, found))
        raise PredictionError(
            f"{str(error).partition(': ')[0]}: give a smaller {options}, or leave it out"
        ) from None


def option_name(name: str) -> str:
    """An option as it is written on the command line."""
    return f"--{name.replace('_', '-')}"
