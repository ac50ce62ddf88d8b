"""What is believed of an execution's constants: weighted particles, drawn from a prior, or what was learned."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from jaxtyping import Float

from foretrace.errors import PredictionError, check_type, is_number, is_whole, shown
from foretrace.files import as_path, read_versioned, write_json
from foretrace.imagined.context import RANGES as LIMITS
from foretrace.objects import BEVEL

RANGES: Mapping[str, tuple[float, float]] = {
    "friction": (0.5, 1.1),
    "tool_friction": (0.2, 0.45),
    "density": (300.0, 1200.0),
    "com_x": (0.0, 0.0),
    "com_y": (0.0, 0.0),
    "bevel_width": (0.8 * BEVEL.width, 1.2 * BEVEL.width),
    "bevel_height": (0.8 * BEVEL.height, 1.2 * BEVEL.height),
    "contact_ahead": (-0.003, 0.003),
    "contact_left": (-0.003, 0.003),
    "contact_turn": (-float(np.deg2rad(3.0)), float(np.deg2rad(3.0))),
}
"""Ranges of the default prior, those of randomised data sets [SI]. ``com_x`` and ``com_y``: distance of the centre of
mass from where it was given or estimated, in the object frame. ``contact_...``: execution error (`ExecutionOffset`)."""
NOMINAL_BEVEL = {"bevel_width": (BEVEL.width, BEVEL.width), "bevel_height": (BEVEL.height, BEVEL.height)}
"""Ranges where the object is known to have the nominal bevel [m]."""
EXECUTION = ("contact_ahead", "contact_left", "contact_turn")
"""What differs between executions on the same object."""
COM = ("com_x", "com_y")
WORLD = ("friction", "tool_friction")
"""What is the same for all objects on one table, under one blade."""
LEARNED = 0.8
"""A constant counts as learned if its standard deviation is below this share of the prior's."""
MOST = 1 << 20
FORMAT, VERSION = "foretrace-belief", 1
REMEDY = "save what foretrace.identify returned again"


class BeliefEntries(TypedDict):
    """Schema of a belief's file."""

    ranges: dict[str, list[float]]
    worlds: int
    prior: bool
    values: dict[str, list[float]]
    weights: list[float]


class Belief:
    """Weighted particles over the constants of executions on one object: a prior, or what `foretrace.identify` learned.

    Given as ``context``, an imaginer averages over it.

    Args:
        ranges: Ranges by name, in place of those of `RANGES`: constants are drawn uniformly from them [SI]. Equal ends
            fix a constant.
        worlds: Number of draws that an imaginer imagines one action in.
        particles: Number of particles.
        seed: Decides how they are drawn.

    Raises:
        PredictionError: A name is unknown, a range is none, or a number is out of range.
    """

    def __init__(
        self,
        ranges: Mapping[str, Any] | None = None,
        *,
        worlds: int = 256,
        particles: int = 4096,
        seed: int = 0,
    ) -> None:
        from scipy.stats import qmc  # a fifth of a second to import

        check_type("ranges", ranges, (Mapping, type(None)), PredictionError, "ranges by name")
        for name, value, least, most in (
            ("worlds", worlds, 2, 65536),
            ("particles", particles, 2, MOST),
            ("seed", seed, 0, 2**63 - 1),
        ):
            if not is_whole(value, least, most):
                raise PredictionError(f"{name} is {shown(value)}: give a whole number from {least} to {most}")
        limits = dict(RANGES) | {name: _range(name, pair) for name, pair in (ranges or {}).items()}
        shares = qmc.Sobol(len(limits), rng=np.random.default_rng(seed)).random(particles)
        low, high = np.array(list(limits.values())).T
        self.names: tuple[str, ...] = tuple(limits)
        """Names of the constants."""
        self.values: Float[np.ndarray, "particles names"] = low + shares * (high - low)
        """Values of the particles [SI]."""
        self.weights: Float[np.ndarray, " particles"] = np.full(particles, 1 / particles)
        """Their weights, which sum to 1."""
        self.worlds = worlds
        """Number of draws that an imaginer imagines one action in."""
        self.prior_std: Mapping[str, float] = {
            name: (pair[1] - pair[0]) / 12**0.5 for name, pair in limits.items()
        }
        """Standard deviations before anything was observed."""
        self.ranges: Mapping[str, tuple[float, float]] = limits
        """Ranges of the prior."""
        self.is_prior = True
        """Whether nothing was observed yet."""

    def updated(
        self, values: Float[np.ndarray, "particles names"], weights: Float[np.ndarray, " particles"]
    ) -> "Belief":
        """The same constants with other particles.

        Raises:
            PredictionError: The weights are not finite, or add up to nothing.
        """
        if not (len(weights) and np.isfinite(weights).all() and weights.min() >= 0 and weights.sum() > 0):
            raise PredictionError(
                f"weights are {shown(weights.tolist())}: give finite ones from 0 on, not all of them 0"
            )
        found = object.__new__(Belief)
        found.__dict__ = {
            **{name: each for name, each in self.__dict__.items() if name not in ("mean", "std", "learned")},
            "values": values,
            "weights": weights / weights.sum(),
            "is_prior": False,
        }
        return found

    def of_another_object(self, shared: tuple[str, ...] = WORLD) -> "Belief":
        """What is believed of another object in the same world: all but what is shared is drawn anew from the prior.

        Args:
            shared: Names of the constants that stay.

        Raises:
            PredictionError: One of them is no constant of the belief.
        """
        check_type("shared", shared, (tuple, list), PredictionError, "names of constants")
        if unknown := [name for name in shared if name not in self.names]:
            raise PredictionError(
                f"{shown(unknown[0])} is no constant of the belief: choose from {', '.join(self.names)}"
            )
        rng = np.random.default_rng(0)
        count = len(self.values)
        kept, fresh = self.sample(count, rng), Belief(self.ranges, particles=count)
        values = fresh.values[rng.permutation(count)]
        for name in shared:
            values[:, self.names.index(name)] = kept[name]
        return self.updated(values, np.full(count, 1 / count))

    @cached_property
    def mean(self) -> dict[str, float]:
        """Mean of each constant [SI]."""
        return dict(zip(self.names, (self.weights @ self.values).tolist(), strict=True))

    @cached_property
    def std(self) -> dict[str, float]:
        """Standard deviation of each constant [SI]."""
        off = self.values - self.weights @ self.values
        return dict(zip(self.names, np.sqrt(self.weights @ off**2).tolist(), strict=True))

    @cached_property
    def learned(self) -> tuple[str, ...]:
        """Constants that observation has told something about; all others keep their prior."""
        return tuple(name for name in self._open if self.std[name] < LEARNED * self.prior_std[name])

    @property
    def _open(self) -> list[str]:
        """Constants that were not fixed from the beginning."""
        return [name for name in self.names if self.ranges[name][0] < self.ranges[name][1]]

    def __repr__(self) -> str:
        words = [f"{name} {self.mean[name]:.3g} ± {self.std[name]:.2g}" for name in self.learned]
        kept = [name for name in self._open if name not in self.learned]
        return f"Belief({', '.join(words) or 'nothing learned'}; prior: {', '.join(kept) or 'none'})"

    def sample(self, n: int, rng: np.random.Generator | None = None) -> dict[str, Float[np.ndarray, " n"]]:
        """Draws of the constants, by name [SI].

        Particles are drawn evenly along their cumulative weights, and each is moved a little, by as much as they are
        apart, so that a few heavy ones do not repeat exactly. They stay within the prior's ranges.

        Args:
            n: Number of draws.
            rng: Random numbers; by default always the same.

        Raises:
            PredictionError: n is no number from 1 on.
        """
        if not is_whole(n, 1, MOST):
            raise PredictionError(f"n is {shown(n)}: give a number of draws from 1 to {MOST}")
        check_type("rng", rng, (np.random.Generator, type(None)), PredictionError)
        rng = np.random.default_rng(0) if rng is None else rng
        places = (np.arange(n) + rng.random()) / n
        rows = np.minimum(np.searchsorted(np.cumsum(self.weights), places), len(self.weights) - 1)
        width = len(self.weights) ** -0.2 * 0.5 * np.array([self.std[name] for name in self.names])
        if np.ptp(self.weights) == 0:  # a prior's own particles: any that follow each other are evenly spread
            rows = (np.arange(n) + rng.integers(len(self.weights))) % len(self.weights)
            width = np.zeros_like(width)
        low, high = np.array([self.ranges[name] for name in self.names]).T
        moved = self.values[rows] + width * rng.normal(size=(n, len(self.names)))
        drawn = np.clip(moved, low, high)[rng.permutation(n)]
        return dict(zip(self.names, drawn.T, strict=True))

    def sample_ahead(
        self, n: int, rng: np.random.Generator | None = None
    ) -> dict[str, Float[np.ndarray, " n"]]:
        """As `sample`, of an execution to come: what differs between executions (`EXECUTION`) is not known of it.

        Args:
            n: Number of draws.
            rng: Random numbers; by default always the same.

        Raises:
            PredictionError: n is no number from 1 on.
        """
        rng = np.random.default_rng(0) if rng is None else rng
        drawn = self.sample(n, rng)
        if not self.is_prior:
            for name in EXECUTION:
                low, high = self.ranges[name]
                drawn[name] = low + (high - low) * (rng.permutation(n) + rng.random(n)) / n  # evenly spread
        return drawn

    def save(self, path: str | Path) -> None:
        """Write it to a file.

        Raises:
            PredictionError: The file cannot be written.
        """
        content = {
            "ranges": {name: list(pair) for name, pair in self.ranges.items()},
            "worlds": self.worlds,
            "prior": self.is_prior,
            "values": dict(zip(self.names, self.values.T.tolist(), strict=True)),
            "weights": self.weights.tolist(),
        }
        try:
            write_json(as_path(path, PredictionError), {"format": FORMAT, "version": VERSION, **content})
        except OSError as error:
            raise PredictionError(f"{path} cannot be written ({error}): choose another file") from error

    @classmethod
    def load(cls, path: str | Path) -> "Belief":
        """Read it from a file.

        Raises:
            PredictionError: The file is missing, damaged or of another version.
        """
        file = as_path(path, PredictionError)
        found = read_versioned(file, BeliefEntries, FORMAT, VERSION, PredictionError, REMEDY, key="version")
        try:
            prior = cls(found["ranges"], worlds=found["worlds"])
        except PredictionError as error:
            raise PredictionError(f"{file}: {error}") from None
        weights = np.array(found["weights"])
        if (
            set(found["values"]) != set(prior.names)
            or {len(each) for each in found["values"].values()} != {len(weights)}
            or not (((weights >= 0) & (weights <= 1)).all() and weights.sum() > 0)
        ):
            raise PredictionError(f"{file} holds no belief: {REMEDY}")
        values = np.column_stack([found["values"][name] for name in prior.names])
        low, high = np.array(list(prior.ranges.values())).T
        if not ((low - 1e-9 <= values) & (values <= high + 1e-9)).all():
            raise PredictionError(f"{file} has a constant out of its range: {REMEDY}")
        belief = prior.updated(values, weights)
        belief.is_prior = found["prior"]
        return belief


def _range(name: object, pair: Any) -> tuple[float, float]:
    if name not in RANGES:
        raise PredictionError(
            f"{shown(name)} is no constant of an execution: choose from {', '.join(RANGES)}"
        )
    fits = isinstance(pair, tuple | list) and len(pair) == 2 and all(map(is_number, pair))
    if not fits or not -np.inf < pair[0] <= pair[1] < np.inf:
        raise PredictionError(f"{name} has the range {shown(pair)}: give a least and a greatest number")
    low, high = LIMITS.get(str(name), (-np.inf, np.inf))
    if not low <= pair[0] <= pair[1] <= high:
        raise PredictionError(f"{name} has the range {shown(pair)}: give numbers from {low:g} to {high:g}")
    return float(pair[0]), float(pair[1])
