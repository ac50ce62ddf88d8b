"""Calibration of monitors: how far normal executions leave their bands, measured on executions that are set aside."""

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from jaxtyping import Float

from foretrace.errors import MonitoringError, check_type, shown
from foretrace.files import as_path, read_versioned, write_json
from foretrace.geometry import Numbers
from foretrace.imagined import LEVELS, quantiles_of

FORMAT, VERSION = "foretrace-monitor-calibration", 1
REMEDY = "make it anew with MonitorCalibration.of"
SHIPPED = Path(__file__).with_name("calibration.json")
"""The calibration that comes with foretrace, for its predictor: `foretrace evaluate monitoring` makes it."""


class CalibrationEntries(TypedDict):
    """Schema of the file."""

    about: str
    executions: int
    quantiles: list[float]
    rest: list[float]


class ShippedEntries(TypedDict):
    """Schema of the file that comes with foretrace."""

    kinds: dict[str, CalibrationEntries]
    causes: dict[str, Any]


@dataclass(frozen=True, eq=False)
class MonitorCalibration:
    """Quantiles of the scores of normal executions (split-conformal)."""

    executions: int
    """Number of executions that they were measured on."""
    quantiles: Float[np.ndarray, " levels"]
    """Score that a share of `foretrace.imagined.LEVELS` of whole executions never exceeds; infinite where there were
    too few."""
    rest: Float[np.ndarray, " levels"] = field(default_factory=lambda: np.full(len(LEVELS), np.nan))
    """As `foretrace.imagined.Futures.quantiles`, of the re-imagined rest of motions; NaN: not measured."""
    about: str = ""
    """What it was measured with."""

    @classmethod
    def of(cls, scores: Numbers, rest: Numbers | None = None, about: str = "") -> "MonitorCalibration":
        """A calibration from the scores that monitors of normal executions end with.

        Raises:
            MonitoringError: There is none, or one is not a finite number from 0 on.
        """
        found = np.asarray(scores, dtype=float)
        if found.ndim != 1 or not len(found) or not np.isfinite(found).all() or found.min() < 0:
            raise MonitoringError(f"scores are {shown(scores)}: give those of normal executions, from 0 on")
        left = np.full(len(LEVELS), np.nan) if rest is None else quantiles_of(np.asarray(rest, dtype=float))
        return cls(len(found), quantiles_of(found), left, about)

    @classmethod
    def shipped(cls, kind: str) -> "MonitorCalibration":
        """The one that comes with foretrace, for effects imagined with a belief (``worlds``) or without (``futures``).

        The label of another action than the lever-up comes before: ``push worlds``.

        Raises:
            MonitoringError: There is no such kind.
        """
        kinds = shipped()["kinds"]
        if kind not in kinds:
            raise MonitoringError(
                f"no calibration of monitors for {shown(kind)} comes with foretrace, only for {', '.join(kinds)}: "
                "imagine with a Belief as context, or give a calibration of your own"
            )
        return cls.of_entries(kinds[kind], SHIPPED.name)

    def threshold(self, false_alarms: float) -> float:
        """Score above which there is an alarm.

        Args:
            false_alarms: Share of whole normal executions with an alarm, at most.

        Raises:
            MonitoringError: There were too few executions for that share.
        """
        level = 1 - false_alarms
        k = int(np.searchsorted(LEVELS, level - 1e-9))
        value = float(self.quantiles[k])
        if not np.isfinite(value):
            raise MonitoringError(
                f"{self.executions} executions cannot tell a rate of {false_alarms:g} false alarms: calibrate with at "
                f"least {int(np.ceil(1 / (1 - LEVELS[k]) - 1e-9))}"
            )
        return value

    def entries(self) -> CalibrationEntries:
        """JSON-able; infinity is -1, NaN -2."""
        tables = [
            np.nan_to_num(np.round(each, 6), nan=-2.0, posinf=-1.0).tolist()
            for each in (self.quantiles, self.rest)
        ]
        return {"about": self.about, "executions": self.executions, "quantiles": tables[0], "rest": tables[1]}

    @classmethod
    def of_entries(cls, entries: CalibrationEntries, where: str) -> "MonitorCalibration":
        """The calibration that `entries` described.

        Raises:
            MonitoringError: It is none.
        """
        tables = [np.array(entries[name], dtype=float) for name in ("quantiles", "rest")]
        if (
            any(each.shape != LEVELS.shape for each in tables)
            or (np.diff(tables[0][tables[0] >= 0]) < 0).any()
        ):
            raise MonitoringError(f"{where} holds no calibration of a monitor: {REMEDY}")
        quantiles, rest = (np.where(each == -1, np.inf, each) for each in tables)
        return cls(entries["executions"], quantiles, np.where(rest < 0, np.nan, rest), entries["about"])

    def save(self, path: str | Path) -> None:
        """Write it to a file.

        Raises:
            MonitoringError: The file cannot be written.
        """
        try:
            write_json(
                as_path(path, MonitoringError), {"format": FORMAT, "version": VERSION, **self.entries()}
            )
        except OSError as error:
            raise MonitoringError(f"{path} cannot be written ({error}): choose another file") from error

    @classmethod
    def load(cls, path: str | Path) -> "MonitorCalibration":
        """Read it from a file.

        Raises:
            MonitoringError: The file is missing, damaged or of another version.
        """
        file = as_path(path, MonitoringError)
        entries = read_versioned(
            file, CalibrationEntries, FORMAT, VERSION, MonitoringError, REMEDY, key="version"
        )
        return cls.of_entries(entries, str(file))


@cache
def shipped() -> ShippedEntries:
    """What comes with foretrace."""
    return read_versioned(
        SHIPPED, ShippedEntries, FORMAT, VERSION, MonitoringError, "install foretrace anew", key="version"
    )


def check_calibration(calibration: Any, kind: str) -> MonitorCalibration:
    """A calibration as it was given: one, a file, or none for the one that comes with foretrace.

    Args:
        calibration: What was given.
        kind: Kind of imagined effect: ``worlds``, ``futures`` or ``push worlds``.

    Raises:
        MonitoringError: It is something else, or the file cannot be used.
    """
    if isinstance(calibration, str | Path):
        return MonitorCalibration.load(calibration)
    check_type("calibration", calibration, (MonitorCalibration, type(None)), MonitoringError)
    return MonitorCalibration.shipped(kind) if calibration is None else calibration
