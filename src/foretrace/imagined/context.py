"""Context of a prediction: constants and parameters that it is conditioned on beside the view (paper, section 6)."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cache
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from foretrace.actions import ACTIONS, Action
from foretrace.errors import ForetraceError, PredictionError, TrainingError, is_number, shown
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.record import PHYSICS_RANGES, Physics
from foretrace.objects import BEVEL, ObjectModel, Prism

CONSTANTS = {
    "friction": "of object and table",
    "tool_friction": "of object and blade",
    "density": "in kg/m^3",
    "contact_error": "in m: 0 where the contact is executed as commanded",
    "bevel_width": "in m: how far the bottom face lies inside the outline",
    "bevel_height": "in m: room for the blade under the rim",
}
"""Constants by name: those of `Physics`, how far the executed contact may be from the commanded one, and the object's
`Bevel`, which a view from above does not show."""
BEVELS = ("bevel_width", "bevel_height")
"""Constants of the object itself."""
EXACT = "contact_error"
"""The constant that is either 0 or not known."""
RANGES = PHYSICS_RANGES | dict.fromkeys(BEVELS, (0.0, 0.1))
"""Values that constants may have [SI]."""
UNKNOWN = "unknown"
"""Context in which no constant is told."""
Context = Mapping[str, float] | Literal["unknown"] | None
"""What an imaginer is told. None: the nominal constants. Values by name: these, and no others. ``unknown``: none."""
SAME = 1e-9
"""Values of a parameter that differ by less are the same."""


def context_units() -> dict[str, str]:
    """Units of everything that a predictor may be conditioned on: constants, and parameters of all actions' paths."""
    found: dict[str, dict[str, str]] = {}  # label of the first action with a parameter of that name and unit
    for kind in ACTIONS.values():
        for name in kind.nominal_parameters():
            unit = kind.units.get(name, "in SI units")
            found.setdefault(name, {}).setdefault(unit, kind.label)
    return CONSTANTS | {
        name: next(iter(units))
        if len(units) == 1
        else ", ".join(f"{unit} ({label})" for unit, label in units.items())
        for name, units in found.items()
    }


def check_names(names: Sequence[str]) -> tuple[str, ...]:
    """Names of conditioning variables, each once.

    Raises:
        TrainingError: One of them is unknown, or comes twice.
    """
    for name in names:
        if name not in context_units():
            raise TrainingError(
                f"{shown(name)} is no context of a prediction: choose from {', '.join(context_units())}"
            )
        if list(names).count(name) > 1:
            raise TrainingError(f"{shown(name)} is named twice in the context: name it once")
    return tuple(names)


def first_action(outcomes: Sequence[str] = ()) -> type[Action]:
    """The first registered action that can have these outcomes; without any, or if none can, the first of all."""
    kinds = list(ACTIONS.values())
    return next((kind for kind in kinds if set(outcomes) <= set(kind.outcomes)), kinds[0])


@cache
def nominal_parameters(kind: type[Action] | None = None) -> Mapping[str, float]:
    """Parameters and further settings of an action's nominal path, by default of the first action's."""
    return MappingProxyType((kind or first_action()).nominal().settings())


def parameters_of(actions: Sequence[Action]) -> dict[str, Float[np.ndarray, " n"]]:
    """Parameters and further settings of the actions' paths, by name; NaN where an action has no such one."""
    kinds: dict[tuple[type[Action], Any], Mapping[str, float]] = {}
    found = []
    for action in actions:
        key = type(action), action.path
        if key not in kinds:
            kinds[key] = action.settings()
        found.append(kinds[key])
    names = dict.fromkeys(name for settings in kinds.values() for name in settings)
    return {name: np.array([settings.get(name, np.nan) for settings in found]) for name in names}


def column_of(batch: InteractionBatch, name: str) -> Float[np.ndarray, " batch"]:
    """Recorded values of one constant or parameter."""
    if name in BEVELS:
        return batch.bevel[:, BEVELS.index(name)]
    return batch.parameters.get(name, np.full(len(batch), np.nan))


def true_context(
    physics: Physics, names: Sequence[str], parameters: Mapping[str, float] | None = None
) -> dict[str, float]:
    """True values of one interaction's context [SI] by the given names; those of the nominal path by default."""
    bevel = dict(zip(BEVELS, (BEVEL.width, BEVEL.height), strict=True))
    values = (
        asdict(physics)
        | {EXACT: 0.0}
        | bevel
        | dict(nominal_parameters() if parameters is None else parameters)
    )
    return {name: values[name] for name in names}


@cache
def nominal_constants() -> Mapping[str, float]:
    """The nominal constants."""
    return MappingProxyType(true_context(Physics(), tuple(CONSTANTS)))


def recorded_context(
    batch: InteractionBatch, names: Sequence[str], optional: bool = False
) -> Float[np.ndarray, "batch context"]:
    """Recorded context of interactions, in SI units.

    Args:
        batch: The interactions.
        names: The variables that the imaginer is conditioned on.
        optional: Whether it can do without constants: those that were not recorded are NaN then. A contact that was
            not executed as commanded is not known.

    Raises:
        PredictionError: One of them lacks a value that it needs.
    """
    values = (
        np.array([column_of(batch, name) for name in names], dtype=float).reshape(len(names), len(batch)).T
    )
    if EXACT in names:
        column = values[:, names.index(EXACT)]
        column[column != 0] = np.nan
    needed = np.array([not (optional and name in CONSTANTS) for name in names], dtype=bool)
    rows, columns = np.nonzero(~np.isfinite(values) & needed)
    if len(rows):
        name = names[int(columns[0])]
        raise PredictionError(
            f"interaction {batch.ids[rows[0]]} has {name} = {column_of(batch, name)[rows[0]]}: record its {name}, "
            f"leave it out, or use a predictor that is not conditioned on {name}"
        )
    return values


def given_context(
    names: Sequence[str],
    context: Context,
    parameters: Mapping[str, Float[np.ndarray, " n"]],
    number: int = 1,
    optional: bool = False,
    *,
    kind: type[Action] | None = None,
    usual: Mapping[str, float] | None = None,
) -> Float[np.ndarray, "n context"]:
    """Context of actions, in SI units; NaN where a constant is not told.

    Args:
        names: The variables that the imaginer is conditioned on.
        context: What was given, the same for all actions.
        parameters: Parameters of the actions' paths, where actions were given, else the path is nominal; ``context``
            may add to them.
        number: Number of actions.
        optional: Whether the imaginer can do without constants.
        kind: The kind of action; by default the first one.
        usual: Constants that a context of None tells; by default the nominal ones.

    Raises:
        PredictionError: A value is missing, is no finite number or out of range, contradicts an action's path, or is
            none that the imaginer is conditioned on.
    """
    nominal = nominal_parameters(kind)
    told = _told(names, context, optional, nominal_constants() if usual is None else usual)
    for name, value in told.items():
        for planned in parameters.get(name, ()):
            if abs(planned - nominal[name]) > SAME < abs(planned - value):
                raise PredictionError(
                    f"context {name} is {value}, the action's path has {planned}: give one of the two"
                )
    wanted = {name: told[name] for name in told if name in (kind or first_action()).nominal_parameters()}
    try:
        (kind or first_action()).path_of(**wanted)
    except ForetraceError as reason:
        raise PredictionError(f"context {', '.join(wanted)}: {reason}") from None
    usually = {name: np.where(np.isnan(each), nominal[name], each) for name, each in parameters.items()}
    planned = usually or dict(nominal)
    found = np.full((number, len(names)), np.nan)
    for k, name in enumerate(names):
        found[:, k] = told.get(name, planned.get(name, np.nan))
    return found


def _told(
    names: Sequence[str], context: Context, optional: bool, usual: Mapping[str, float]
) -> dict[str, float]:
    """Values that are told, by name.

    Raises:
        PredictionError: As `given_context`.
    """
    constants = [name for name in names if name in CONSTANTS]
    if context is None:
        return {name: usual[name] for name in constants}
    if isinstance(context, str) and context == UNKNOWN:
        context = {}
    elif not isinstance(context, Mapping):
        raise PredictionError(
            f"context is {shown(context)}: give values by name, as {{'friction': 0.8}}, 'unknown', or None for the "
            "nominal ones"
        )
    if not optional and (missing := [name for name in constants if name not in context]):
        wanted = ", ".join(f"{shown(name)}: value {CONSTANTS[name]}" for name in constants)
        raise PredictionError(
            f"the predictor is conditioned on {', '.join(missing)}: give context={{{wanted}}}, or None for the nominal "
            "values"
        )
    if odd := [name for name in context if name not in names]:
        accepted = ", ".join(names) or "nothing but the view"
        raise PredictionError(
            f"the predictor is conditioned on {accepted}, not on {shown(odd[0])}: leave it out of context"
        )
    for name, value in context.items():
        if not is_number(value) or not np.isfinite(value):
            raise PredictionError(
                f"context {name} is {shown(value)}: give a finite value {context_units().get(name, 'in m')}"
            )
        low, high = RANGES.get(name, (-np.inf, np.inf))
        if not low <= float(value) <= high:
            raise PredictionError(f"context {name} is {shown(value)}: give a value from {low:g} to {high:g}")
    if sum(context.get(name) == 0 for name in BEVELS) == 1:
        raise PredictionError(
            f"context bevel_width is {context.get(BEVELS[0])}, bevel_height is {context.get(BEVELS[1])}: give two "
            "numbers above 0, or 0 twice for an object without a bevel"
        )
    if context.get(EXACT, 0) != 0:
        raise PredictionError(
            f"context {EXACT} is {shown(context[EXACT])}: give 0 for a contact as commanded, or leave it out"
        )
    return dict(context)


def told_of(obj: ObjectModel, *contexts: Sequence[str]) -> Context:
    """What is told of a known object by default: the nominal constants and its own bevel.

    Args:
        obj: The object.
        contexts: Contexts of the imaginers that are told.

    Returns:
        None where that is the same as telling the nominal constants, or an imaginer is not conditioned on all of them.
    """
    nominal = nominal_constants()
    bevel = obj.bevel if isinstance(obj, Prism) else BEVEL
    if bevel == BEVEL or any(name not in context for name in nominal for context in contexts):
        return None
    return {**nominal, **dict(zip(BEVELS, (bevel.width, bevel.height), strict=True))}


def find_unconditioned(
    parameters: Mapping[str, Float[np.ndarray, " batch"]],
    names: Sequence[str],
    kind: type[Action] | None = None,
) -> tuple[tuple[str, ...], ...]:
    """Warnings about paths that differ from the nominal one in what a predictor is not conditioned on.

    Args:
        parameters: Values of each parameter; NaN: unknown.
        names: The variables that the predictor is conditioned on.
        kind: The kind of action; by default the first one.

    Returns:
        The lines of each action.
    """
    nominal, number = nominal_parameters(kind), len(next(iter(parameters.values())))
    warnings: list[list[str]] = [[] for _ in range(number)]
    for name, values in parameters.items():
        if name in names or name not in nominal:
            continue
        for row in np.flatnonzero(np.abs(values - nominal[name]) > SAME):
            warnings[row].append(
                f"{name} {values[row]:.3g} is not the nominal {nominal[name]:.3g}, and the predictor is not "
                "conditioned on it"
            )
    return tuple(map(tuple, warnings))


def find_cut_short(
    actions: Sequence[Action], times: Float[np.ndarray, " time"]
) -> tuple[tuple[str, ...], ...]:
    """Warnings about actions that take longer than the nominal one and than what is imagined.

    Args:
        actions: The actions.
        times: Times of the imagined samples [s].

    Returns:
        The lines of each action.
    """
    end = float(times[-1])
    return tuple(
        (f"the action takes {each.duration:.3g} s, of which the first {end:.3g} s are imagined",)
        if each.duration > max(end, type(each).nominal().duration) + SAME
        else ()
        for each in actions
    )
