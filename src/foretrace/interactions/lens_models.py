"""Lenses by the names that ROS, Kalibr and RealSense give to their distortion models."""

from collections.abc import Sequence

import numpy as np

from foretrace.errors import PerceptionError, shown

OPENCV = ("plumb_bob", "rational_polynomial")
BROWN = ("radtan", "brown_conrady")
FISHEYE = ("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4")
STRAIGHT = ("", "none", "inverse_brown_conrady", "modified_brown_conrady")
"""Models without distortion, and those of RealSense of which no other coefficients than zeros can be used."""
SIZES = (
    dict.fromkeys(OPENCV, (4, 5, 8, 12, 14))
    | dict.fromkeys(BROWN, (4, 5))
    | dict.fromkeys(FISHEYE, (4,))
    | dict.fromkeys(STRAIGHT, (0,))
)
"""How many coefficients each model can have."""


def lens_of(model: str, coefficients: Sequence[float]) -> tuple[tuple[float, ...], bool]:
    """The distortion as `PinholeCamera` has it, and whether it is of a fisheye lens.

    Args:
        model: Name of the distortion model.
        coefficients: Its coefficients; zeros at the end may be left out or be too many.

    Raises:
        PerceptionError: The model is not known, or its coefficients are not as many as it has; what to do is the
            caller's to say.
    """
    name = "_".join(model.lower().replace("-", " ").split())
    values = np.asarray(coefficients, dtype=float).ravel()
    bent = bool((values != 0).any())  # NaN counts
    if name in STRAIGHT and bent:
        said = f"the distortion model {shown(model)}" if name else "no distortion model"
        raise PerceptionError(f"{said} has coefficients {_few(values)}")
    if name not in SIZES:
        raise PerceptionError(
            f"distortion model {shown(model[:40])} is none of {', '.join((*OPENCV, *BROWN, *FISHEYE))}"
        )
    if not bent:  # a fisheye lens bends with zeros, too
        return ((0.0,) * 4, True) if name in FISHEYE else ((), False)
    sizes = SIZES[name]
    if len(values) not in sizes:
        values = values[: next((size for size in sizes if not values[size:].any()), None)]
    if len(values) not in sizes or not np.isfinite(values).all():
        counts = " or ".join(str(size) for size in sizes)
        raise PerceptionError(
            f"distortion model {name} with coefficients {_few(values)}: it has {counts} finite ones"
        )
    return tuple(float(value) for value in values), name in FISHEYE


def _few(values: np.ndarray) -> str:
    shown = ", ".join(f"{value:g}" for value in values[:6])
    return f"[{shown}{', ...' if len(values) > 6 else ''}]"
