"""What a predictor may be told before the action beside what it sees: constants and parameters (paper, section 6)."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np
from jaxtyping import Float

from foretrace.actions import LeverUp
from foretrace.errors import PredictionError, TrainingError
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.record import Physics

CONSTANTS = {
    "friction": "of object and table",
    "tool_friction": "of object and blade",
    "density": "in kg/m^3",
}
"""What can be known of the world, by the names of `Physics`."""
PARAMETERS = {
    "insertion": "in m",
    "arc_radius": "in m",
    "sweep": "in rad",
    "speed": "as a multiple of the usual one",
}
"""What can be known of the action, by the names of its parameters."""
KNOWN = CONSTANTS | PARAMETERS
"""What can be known."""


def check_names(names: Sequence[str]) -> tuple[str, ...]:
    """Names of what a predictor is to know, each once.

    Raises:
        TrainingError: One of them cannot be known, or comes twice.
    """
    for name in names:
        if name not in KNOWN:
            raise TrainingError(f"{name!r} cannot be known to a predictor: choose from {', '.join(KNOWN)}")
        if list(names).count(name) > 1:
            raise TrainingError(f"{name!r} is named twice among what is known: name it once")
    return tuple(names)


def observed_values(batch: InteractionBatch, names: Sequence[str]) -> Float[np.ndarray, "batch known"]:
    """What is recorded of interactions, in SI units.

    Raises:
        PredictionError: One of them lacks a value.
    """
    unknown = np.full(len(batch), np.nan)
    columns = [batch.parameters.get(name, unknown) for name in names]
    values = np.array(columns, dtype=float).reshape(len(names), len(batch)).T
    rows, columns = np.nonzero(~np.isfinite(values))
    if len(rows):
        name = names[columns[0]]
        raise PredictionError(
            f"interaction {batch.ids[rows[0]]} has {name} = {values[rows[0], columns[0]]}: record its {name}, leave "
            f"it out, or use a predictor that does not know {name}"
        )
    return values


def true_values(
    physics: Physics, names: Sequence[str], parameters: Mapping[str, float] | None = None
) -> dict[str, float]:
    """What holds of one lever-up, in SI units, by the given names."""
    values = asdict(physics) | dict(parameters or LeverUp.nominal_parameters())
    return {name: values[name] for name in names}


def given_values(values: Mapping[str, float] | None, names: Sequence[str]) -> Float[np.ndarray, "1 known"]:
    """What somebody says of one action, in SI units.

    Raises:
        PredictionError: A value is missing, is no finite number, or is not known to the predictor.
    """
    values = {} if values is None else values
    if missing := [name for name in names if name not in values]:
        wanted = ", ".join(f"{name!r}: value {KNOWN[name]}" for name in names)
        raise PredictionError(f"the predictor has to know {', '.join(missing)}: give known={{{wanted}}}")
    if odd := [name for name in values if name not in names]:
        knows = ", ".join(names) or "nothing but the view"
        raise PredictionError(f"the predictor knows {knows}, not {odd[0]!r}: leave it out of known")
    for name in names:
        if not np.isfinite(values[name]):
            raise PredictionError(f"known {name} is {values[name]}: give a finite value {KNOWN[name]}")
    return np.array([[values[name] for name in names]], dtype=float).reshape(1, len(names))
