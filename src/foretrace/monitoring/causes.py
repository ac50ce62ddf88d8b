"""Why an execution left its band: hypotheses compared by what each would look like."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.special import logsumexp, softmax

from foretrace.errors import MonitoringError
from foretrace.imagined.worlds import MISSED, OBJECT, PHYSICS

SLIPPED, HELD, MOVED = "slipped", "held", "moved by something else"
FROZEN, JUMPED, LOST = "tracker frozen", "tracker jumped", "tracker lost"
BAD_INPUT, UNKNOWN = "bad input", "unknown"
LEARNED = (SLIPPED, MISSED, HELD, MOVED, PHYSICS, OBJECT, FROZEN, JUMPED)
"""Causes that are told apart by evidence; a tracker that loses the object and bad input are seen directly."""
SURE = 0.4
"""A cause that is less probable than this is not named."""
PENALTY = 1.0
"""Weight of the penalty on coefficients, as of that many executions."""
MM = 1000.0


def evidence(
    times: Float[np.ndarray, " time"],
    seen: Float[np.ndarray, "time 6"],
    expected: Float[np.ndarray, "time 6"],
    residuals: Mapping[str, float],
    repeats: int,
) -> Float[np.ndarray, " numbers"]:
    """What hypotheses are told apart by.

    Args:
        times: Times of the tracked samples so far [s].
        seen: Displacements and turns, as `Motions.states` [m].
        expected: Those of the motion that fitted best before the deviation.
        residuals: Root mean square residual of the best motion as believed, and of each cause's worlds [m].
        repeats: Number of the last samples that are exactly equal.
    """
    off = MM * (seen - expected)
    steps = np.diff(off, axis=0, prepend=off[:1])
    sizes = np.linalg.norm(steps, axis=1)
    largest = int(sizes.argmax())
    others = np.delete(sizes, largest)
    after = off[largest:]
    tilt, expected_tilt = (MM * np.linalg.norm(each[:, 3:5], axis=1) for each in (seen, expected))
    height = MM * seen[:, 2]
    last = off[-3:].mean(axis=0)
    believed = MM * residuals.get("", 1.0)
    lengths = [
        sizes[largest],
        np.linalg.norm(steps[largest, :3]),
        np.linalg.norm(steps[largest, 3:]),
        np.linalg.norm(steps[largest, [1, 5]]),
        others.max(initial=0.0),
        after.std(axis=0).max(),
        np.linalg.norm(off[:largest], axis=1).max(initial=0.0),
        height.max() - height[-1],
        tilt.max() - tilt[-1],
        tilt[-1],
        tilt[-1] - expected_tilt[-1],
        expected_tilt[-1],
        last[0],
        last[2],
        abs(last[1]),
        abs(last[5]),
        np.linalg.norm(last[3:5]),
        MM * np.linalg.norm(seen[-1]),
        MM * np.linalg.norm(expected[-1] - expected[largest]),
        believed,
    ]
    signed = np.sign(lengths) * np.log1p(np.abs(lengths))
    ratios = [
        np.log((MM * residuals.get(cause, 1.0) + 0.3) / (believed + 0.3))
        for cause in (MISSED, PHYSICS, OBJECT)
    ]
    rest = [min(repeats, 4) / 4, times[-1], times[largest], times[-1] - times[largest]]
    return np.array([*signed, *ratios, *rest])


@dataclass(frozen=True, eq=False)
class CauseModel:
    """Probabilities of causes from evidence: multinomial logistic regression, fitted to injected faults."""

    causes: tuple[str, ...]
    """Names of the causes."""
    mean: Float[np.ndarray, " numbers"]
    """Mean of the evidence in the fit."""
    scale: Float[np.ndarray, " numbers"]
    """Its standard deviation."""
    coefficients: Float[np.ndarray, "numbers+1 causes"]
    """Coefficients; the last row is the intercept."""

    def probabilities(self, found: Float[np.ndarray, " numbers"]) -> dict[str, float]:
        """Probability of each cause."""
        values = np.append(np.clip((found - self.mean) / self.scale, -4, 4), 1.0)
        return dict(zip(self.causes, softmax(values @ self.coefficients).tolist(), strict=True))

    @classmethod
    def fit(cls, found: Float[np.ndarray, "n numbers"], labels: Sequence[str]) -> "CauseModel":
        """Fitted to evidence of executions whose causes are known."""
        causes = tuple(each for each in LEARNED if each in set(labels))
        mean, scale = found.mean(axis=0), found.std(axis=0) + 1e-6
        values = np.column_stack([np.clip((found - mean) / scale, -4, 4), np.ones(len(found))])
        truth = np.array([causes.index(each) for each in labels])

        def loss(flat: np.ndarray) -> tuple[float, np.ndarray]:
            table = flat.reshape(values.shape[1], len(causes))
            logits = values @ table
            penalty = PENALTY * table.copy()
            penalty[-1] = 0.0
            shares = softmax(logits, axis=1)
            shares[np.arange(len(truth)), truth] -= 1
            own = logsumexp(logits, axis=1) - logits[np.arange(len(truth)), truth]
            return float(own.sum() + 0.5 * (penalty * table).sum()), (values.T @ shares + penalty).ravel()

        best = minimize(loss, np.zeros(values.shape[1] * len(causes)), jac=True, method="L-BFGS-B")
        return cls(causes, mean, scale, best.x.reshape(values.shape[1], len(causes)))

    def entries(self) -> dict[str, Any]:
        """JSON-able."""
        tables = {
            name: np.round(getattr(self, name), 5).tolist() for name in ("mean", "scale", "coefficients")
        }
        return {"causes": list(self.causes), **tables}

    @classmethod
    def of_entries(cls, entries: Mapping[str, Any]) -> "CauseModel":
        """The model that `entries` described.

        Raises:
            MonitoringError: It is none.
        """
        try:
            tables = [np.array(entries[name], dtype=float) for name in ("mean", "scale", "coefficients")]
            causes = tuple(entries["causes"])
        except (KeyError, TypeError, ValueError):
            raise MonitoringError("the file holds no model of causes: install foretrace anew") from None
        if tables[2].shape != (len(tables[0]) + 1, len(causes)):
            raise MonitoringError("the file holds no model of causes: install foretrace anew")
        return cls(causes, *tables)
