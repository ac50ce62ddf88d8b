"""Drift: whether a calibration still holds, from the scores of one execution after the other."""

import numpy as np

from foretrace.errors import MonitoringError, check_type, is_number, is_whole, shown, wrong_type
from foretrace.imagined import LEVELS
from foretrace.monitoring.calibration import MonitorCalibration

POWERS = np.array([0.1, 0.25, 0.5, 0.75, 1.0])
"""Bets on p-values: a bet of power a pays a p^(a - 1); of power 1, it keeps what it has."""
SHARED = 0.01
"""Share of the stake that is dealt out anew among the bets after each execution."""


class Drift:
    """A conformal test martingale over executions (Vovk et al., 2005; Vovk, 2021).

    Each execution's score becomes a p-value among those of the calibration. Bets that p-values are too small keep the
    mean stake at 1 as long as executions are like those of the calibration, so that the stake hardly ever gets large.
    Nothing is alarmed about single executions: that is the monitor's task.

    Args:
        calibration: The calibration in question.
        false_alarms: Probability of a false alarm, ever; the calibration's own scatter counts in addition.
        seed: Decides between equal scores.

    Raises:
        MonitoringError: An argument cannot be used.
    """

    def __init__(self, calibration: MonitorCalibration, false_alarms: float = 0.01, seed: int = 0) -> None:
        check_type("calibration", calibration, MonitorCalibration, MonitoringError)
        if not is_number(false_alarms) or not 1e-6 <= false_alarms <= 0.5:
            raise MonitoringError(
                f"false_alarms is {shown(false_alarms)}: give a probability from 1e-6 to 0.5"
            )
        if not is_whole(seed, 0, 2**63 - 1):
            raise MonitoringError(f"seed is {shown(seed)}: give a whole number from 0 on")
        self.calibration = calibration
        """The calibration in question."""
        self.scores: list[float] = []
        """Scores so far, one for each execution."""
        self.largest = 1.0
        """Largest stake so far: the evidence against the calibration."""
        self._limit = 1 / float(false_alarms)
        self._stakes = np.full(len(POWERS), 1 / len(POWERS))
        self._rng = np.random.default_rng(seed)

    @property
    def drifted(self) -> bool:
        """Whether the calibration no longer holds."""
        return self.largest >= self._limit

    def update(self, score: float) -> bool:
        """Take in the score that the monitor of one execution ended with; returns whether the calibration has drifted.

        Raises:
            MonitoringError: The score is no number from 0 on.
        """
        if not is_number(score) or not 0 <= score < np.inf:
            raise (MonitoringError if is_number(score) else wrong_type(MonitoringError))(
                f"score is {shown(score)}: give the score of an execution's last verdict"
            )
        self.scores.append(float(score))
        low, high = (
            np.searchsorted(self.calibration.quantiles, score, side=side) / (len(LEVELS) + 1)
            for side in ("left", "right")
        )
        # Between two quantiles any share is as probable as any other.
        p = max(1 - low - (high - low + 1 / (len(LEVELS) + 1)) * self._rng.random(), 1e-4)
        stakes = self._stakes * POWERS * p ** (POWERS - 1)
        total = stakes.sum()
        self.largest = max(self.largest, float(total))
        self._stakes = (1 - SHARED) * stakes + SHARED * total / len(POWERS)
        return self.drifted

    def recalibrate(self, last: int | None = None) -> MonitorCalibration:
        """A calibration from the scores of the last executions, all of them normal; by default of all.

        Raises:
            MonitoringError: There are fewer.
        """
        count = len(self.scores) if last is None else last
        if not is_whole(count, 1, len(self.scores)):
            raise MonitoringError(
                f"last is {shown(count)}, and there are {len(self.scores)} scores: give a number from 1 to that"
            )
        return MonitorCalibration.of(self.scores[-count:], about=f"the last {count} executions")
