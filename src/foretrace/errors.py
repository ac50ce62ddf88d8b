"""What can go wrong, one class per kind of mistake.

Every message names the offending value and says what to do; the command line prints it as one line.
"""

from collections.abc import Mapping
from dataclasses import fields
from functools import lru_cache
from math import prod
from numbers import Integral, Real
from reprlib import Repr
from typing import Any, Literal, get_args, get_origin, get_type_hints

LONGEST = 600
"""Longest message; of a longer one the middle is left out, since it ends with the remedy."""
SHOWN = 80
"""Longest form of a value in a message."""
_SHORT = Repr()
for _limit in ("dict", "list", "tuple", "set", "frozenset", "deque", "array", "long", "string", "other"):
    setattr(_SHORT, f"max{_limit}", SHOWN)


class ForetraceError(Exception):
    """Base of every error that foretrace raises on purpose.

    Its message is one line of at most `LONGEST` characters, whatever it quotes.
    """

    def __str__(self) -> str:
        message = super().__str__()
        if "\n" in message:
            message = " ".join(message.split())
        half = LONGEST // 2 - 3
        return message if len(message) <= LONGEST else f"{message[:half]} ... {message[-half:]}"


class CommandError(ForetraceError):
    """A command that does not exist, or whose options do not go together."""


class ShapeError(ForetraceError):
    """An object's geometry cannot be used: too few corners, self-intersection, not watertight, absurd size."""


class ActionError(ForetraceError):
    """A lever-up that cannot be placed on its object, or a tool path that cannot be followed."""


class ViewError(ForetraceError):
    """A top-down view that cannot be made: empty mask, wrong size, object outside the window."""


class SimulationError(ForetraceError):
    """The simulation was asked for something it cannot do, or a renderer is missing."""


class DatasetError(ForetraceError):
    """A data set that is missing, damaged, of another version or made with another configuration."""


class RowError(DatasetError, IndexError):
    """A row that a data set does not have; an IndexError too, as of any sequence."""


class TrainingError(ForetraceError):
    """A training that cannot start: unknown features, a split larger than the data, a folder in use."""


class CheckpointError(ForetraceError):
    """A checkpoint that is missing, of another version, or whose tensors do not fit."""


class PredictionError(ForetraceError):
    """An input that the predictor cannot imagine an effect for."""


class PlanningError(ForetraceError):
    """A goal that cannot be planned for: no contact is free, nothing is asked for, a value is out of its range."""


class MonitoringError(ForetraceError):
    """An execution that cannot be watched: poses in another frame, no rest to compare with, an unknown calibration."""


class ResultsError(ForetraceError):
    """Results that are missing, damaged or of another version, data set or recipe; an experiment that is unknown."""


class PerceptionError(ForetraceError):
    """A picture, a camera or a recording that tells too little: no marker, wrong size, dark, cut off, out of order."""


class RobotError(ForetraceError):
    """A real arm that cannot be reached, a path that it must not follow, or a motion that was stopped."""


class StudioError(ForetraceError):
    """A studio or a service that cannot start, or a wish of a visitor that it cannot grant: too large, too many."""


class ExportError(ForetraceError):
    """An export that cannot be written: nothing chosen, the target exists, a library is missing, uneven sampling."""


def check_ranges(
    error: type[ForetraceError],
    what: str,
    thing: Any,
    limits: Mapping[str, tuple[int | float, int | float]],
    remedy: str = "give SI units",
) -> None:
    """Refuse a thing with an attribute out of its range.

    Args:
        error: The class to raise.
        what: Name of the thing, for the message.
        thing: Has the attributes.
        limits: Least and greatest value of each attribute.
        remedy: What to do about it; ends the message.

    Raises:
        ForetraceError: Of the given class: an attribute is no number or outside its range.
    """
    for name, (low, high) in limits.items():
        value = getattr(thing, name)
        number = is_number(value) or getattr(value, "ndim", None) == 0
        if not (number and low <= value <= high):
            raise fault(error, bool(number))(
                f"{what}: {name} = {shown(value)} is outside {low:g} to {high:g}: {remedy}"
            )


def check_type(
    name: str,
    value: object,
    kinds: type | tuple[type, ...],
    error: type[ForetraceError],
    wanted: str | None = None,
) -> None:
    """Refuse a value of another type.

    Args:
        name: Name of the value in the message.
        value: The value.
        kinds: The types that it may have.
        error: The class to raise.
        wanted: What to give instead, for the message; by default the names of the types.
    """
    if not isinstance(value, kinds):
        kinds = kinds if isinstance(kinds, tuple) else (kinds,)
        wanted = wanted or " or ".join(kind.__name__ for kind in kinds if kind is not type(None))
        raise wrong_type(error)(f"{name} of type {type(value).__name__}: give {wanted}")


def check_choices(error: type[ForetraceError], settings: Any) -> None:
    """Refuse a dataclass whose switches are not True or False, or whose choices are not among their ``Literal``.

    Args:
        error: The class to raise.
        settings: An instance; fields of other types are not looked at.

    Raises:
        ForetraceError: Of the given class.
    """
    hints = get_type_hints(type(settings))
    for name in (each.name for each in fields(settings)):
        value = getattr(settings, name)
        if hints[name] is bool and not isinstance(value, bool):
            raise wrong_type(error)(f"{name} is {shown(value)}: give True or False")
        if get_origin(hints[name]) is Literal:
            choices = get_args(hints[name])
            if not (isinstance(value, str) and value in choices):
                raise fault(error, isinstance(value, str))(
                    f"{name} is {shown(value)}: choose from {', '.join(choices)}"
                )


def shown(value: object) -> str:
    """A value as messages show it: in one line of at most `SHOWN` characters; long arrays as shape and type."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if isinstance(shape, tuple) and dtype is not None and prod(shape) > 8:
        return f"an array of shape {tuple(shape)} and type {dtype}"
    try:
        text = _SHORT.repr(value)
    except Exception:  # whatever the value's own method raises
        text = f"a {type(value).__name__}"
    text = " ".join(text.split()) if "\n" in text else text
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def counted(number: int, noun: str) -> str:
    """A number of things in words: "no shards", "1 shard", "2 shards"."""
    return f"{number or 'no'} {noun}{'s'[: number != 1]}"


@lru_cache
def wrong_type(error: type[ForetraceError]) -> type[ForetraceError]:
    """The class of those errors of a kind that are TypeErrors, too, as Python has it for a value of a wrong type."""
    if issubclass(error, TypeError):
        return error
    members = {"__module__": error.__module__, "__reduce__": lambda self: (_rebuilt, (error, self.args))}
    return type(error.__name__, (error, TypeError), members)


def fault(error: type[ForetraceError], right_type: bool) -> type[ForetraceError]:
    """The class of the error about a value that is of the right type, or of a wrong one."""
    return error if right_type else wrong_type(error)


def _rebuilt(error: type[ForetraceError], arguments: tuple[Any, ...]) -> ForetraceError:
    """An error of `wrong_type` that comes from another process."""
    return wrong_type(error)(*arguments)


def is_number(value: object) -> bool:
    """Whether a value is one real number; True and False are none."""
    return isinstance(value, Real) and not isinstance(value, bool)


def is_whole(value: object, least: int, most: int) -> bool:
    """Whether a value is a whole number within limits; True and False are none."""
    return isinstance(value, Integral) and not isinstance(value, bool) and least <= int(value) <= most
