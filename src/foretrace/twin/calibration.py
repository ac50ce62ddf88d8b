"""How far a twin is off: measured on recorded actions, kept as a small JSON file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from jaxtyping import Float

from foretrace.errors import PredictionError, check_type
from foretrace.files import as_path, read_versioned, write_json
from foretrace.imagined import LEVELS

FORMAT, VERSION = "foretrace-twin-calibration", 1
REMEDY = "calibrate the twin anew, and save that"


class CalibrationEntries(TypedDict):
    """Schema of the file."""

    interactions: int
    times: list[float]
    error: list[float]
    quantiles: list[float]


@dataclass(frozen=True, eq=False)
class TwinCalibration:
    """Errors of a twin's nearest futures on recorded actions."""

    interactions: int
    """Number of actions that they were measured on."""
    times: Float[np.ndarray, " time"]
    """Times of the samples [s]."""
    error: Float[np.ndarray, " time"]
    """Root mean square error of the centre of mass [m]."""
    quantiles: Float[np.ndarray, " levels"]
    """As `foretrace.imagined.Futures.quantiles`."""

    def save(self, path: str | Path) -> None:
        """Write it to a file.

        Raises:
            PredictionError: The file cannot be written.
        """
        content: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "interactions": self.interactions,
            "times": self.times.tolist(),
            "error": np.round(self.error, 9).tolist(),
            # JSON has no infinity: levels that too few actions leave open are -1.
            "quantiles": np.where(np.isfinite(self.quantiles), np.round(self.quantiles, 6), -1.0).tolist(),
        }
        try:
            write_json(as_path(path, PredictionError), content)
        except OSError as error:
            raise PredictionError(f"{path} cannot be written ({error}): choose another file") from error

    @classmethod
    def load(cls, path: str | Path) -> "TwinCalibration":
        """Read it from a file.

        Raises:
            PredictionError: The file is missing, damaged or of another version.
        """
        file = as_path(path, PredictionError)
        entries = read_versioned(
            file, CalibrationEntries, FORMAT, VERSION, PredictionError, REMEDY, key="version"
        )
        times, error, quantiles = (
            np.array(entries[name], dtype=float) for name in ("times", "error", "quantiles")
        )
        fits = len(times) == len(error) >= 2 and len(quantiles) == len(LEVELS)
        if (
            not fits
            or not np.isfinite([*times, *error]).all()
            or (error < 0).any()
            or (np.diff(times) <= 0).any()
        ):
            raise PredictionError(f"{file} holds no calibration of a twin: {REMEDY}")
        return cls(entries["interactions"], times, error, np.where(quantiles < 0, np.inf, quantiles))

    def at(self, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, " time"]:
        """The error at other times [m]; past the last one, that."""
        return np.interp(times, self.times, self.error)


def check_calibration(calibration: Any) -> TwinCalibration | None:
    """A calibration as it was given: one, a file, or none.

    Raises:
        PredictionError: It is something else, or the file cannot be used.
    """
    if isinstance(calibration, str | Path):
        return TwinCalibration.load(calibration)
    check_type("calibration", calibration, (TwinCalibration, type(None)), PredictionError)
    return calibration
