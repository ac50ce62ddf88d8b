"""What goals look at: imagined motions of many actions, in the object's own frame."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from foretrace.actions import Action
from foretrace.errors import PlanningError
from foretrace.geometry import convex_hull, rotate_plane, wrap_angle
from foretrace.imagined import Futures, ImaginedBatch

SAME_TIME = 1e-9
"""Times that differ by less are the same [s]."""
FLAT = 0.1
"""An object at rest that is tilted by less lies on the side on which it lay [rad]."""


@dataclass(frozen=True, eq=False)
class Motions:
    """Futures of several actions on one object, in the object's frame at rest: z is up, z = 0 the table.

    Each motion counts until its action's path ends.
    """

    actions: Sequence[Action]
    """The actions, in the object's frame."""
    times: Float[np.ndarray, " time"]
    """Time of each sample [s]."""
    com: Float[np.ndarray, "batch futures time 3"]
    """Centres of mass [m]."""
    turned: Float[np.ndarray, "batch futures time 3"]
    """Rotation vectors since rest [rad]; NaN where only positions are imagined."""
    futures: Futures
    """The futures as imagined, one row for each action, in its action frame."""
    end: Int[np.ndarray, " batch"]
    """Last sample that counts."""
    outline: Float[np.ndarray, "corners 2"]
    """Outline of the object at rest [m], counter-clockwise."""
    height: float
    """Its height [m]."""
    gain: Float[np.ndarray, " batch"] | None = field(default=None, kw_only=True)
    """Information that each action is expected to give about the object's constants, where a goal asks for it [nat]."""

    @classmethod
    def of(
        cls,
        imagined: ImaginedBatch,
        actions: Sequence[Action],
        outline: Float[np.ndarray, "corners 2"],
        height: float,
        whole: bool = False,
    ) -> "Motions":
        """Motions in the frame in which the actions are given.

        Args:
            imagined: What was imagined, in the frame of each action.
            actions: The actions.
            outline: Outline of the object at rest in their frame [m].
            height: Its height [m].
            whole: Motions count to the last imagined sample, not only until the path ends.
        """
        ends = np.array([np.inf if whole else action.duration for action in actions])
        last = np.searchsorted(imagined.times, ends + SAME_TIME, side="right") - 1
        count = int(last.max()) + 1
        contacts = np.array([action.contact for action in actions])
        x = np.array([action.direction for action in actions])
        axes = np.stack([x, x[:, ::-1] * [-1, 1]], axis=1)[:, None]  # (batch, 1, action axis, coordinate)
        states = imagined.futures.states[:, :, :count]
        com, turned = states[..., :3].copy(), states[..., 3:].copy()
        for vectors in (com, turned):
            vectors[..., :2] = vectors[..., :2] @ axes
        com[..., :2] += contacts[:, None, None]
        return cls(
            tuple(actions), imagined.times[:count], com, turned, imagined.futures, last, outline, height
        )

    def __len__(self) -> int:
        return len(self.com)

    def __getitem__(self, rows: np.ndarray) -> "Motions":
        kept = {name: getattr(self, name)[rows] for name in ("com", "turned", "futures", "end")}
        kept["gain"] = None if self.gain is None else self.gain[rows]
        return replace(self, actions=tuple(self.actions[k] for k in np.arange(len(self))[rows]), **kept)

    def thinned(self, count: int) -> "Motions":
        """The same with a few samples, evenly from the start to the end of each; ``times`` are those of the longest."""
        rows = np.rint(np.linspace(0, 1, count) * self.end[:, None]).astype(int)  # (batch, count)
        at = np.arange(len(self))[:, None]
        com, turned, states = (
            np.moveaxis(each[at, :, rows], 1, 2) for each in (self.com, self.turned, self.futures.states)
        )
        spread = np.moveaxis(self.futures.spread[at, :, rows], 1, 2)
        futures = replace(self.futures, states=states, spread=spread)
        end = np.full(len(self), count - 1)
        times = self.times[rows[int(self.end.argmax())]]
        return replace(self, times=times, com=com, turned=turned, futures=futures, end=end)

    def continuing(self, T_start_now: Float[np.ndarray, "4 4"], com: Float[np.ndarray, "3"]) -> "Motions":
        """Motions that follow earlier ones, from the frame at the very start, with the rest there as first sample.

        Args:
            T_start_now: The object's frame now in its frame at the start.
            com: Centre of mass at the start, in the latter [m].
        """
        turn = T_start_now[:3, :3]
        moved, turned = self.com @ turn.T + T_start_now[:3, 3], self.turned
        if abs(turn[2, 2] - 1) < 1e-9 and not np.abs(turned[..., :2]).max(initial=0.0) > 1e-9:
            turned = turned + np.array([0.0, 0.0, np.arctan2(turn[1, 0], turn[0, 0])])
        else:
            from scipy.spatial.transform import Rotation

            own = Rotation.from_rotvec(np.nan_to_num(turned).reshape(-1, 3))
            turned = (Rotation.from_matrix(turn) * own).as_rotvec().reshape(turned.shape)
        rest = np.broadcast_to(com, (*moved.shape[:2], 1, 3))
        first = {"states": self.futures.states[:, :, :1], "spread": self.futures.spread[:, :, :1]}
        grown = {
            name: np.concatenate([each, getattr(self.futures, name)], axis=2) for name, each in first.items()
        }
        return Motions(
            _Moved(self.actions, T_start_now),
            np.concatenate([self.times[:1], self.times]),
            np.concatenate([rest, moved], axis=2),
            np.concatenate([np.zeros_like(rest), turned], axis=2),
            replace(self.futures, **grown),
            self.end + 1,
            self.outline,
            self.height,
            gain=self.gain,
        )

    def moved_on(self, by: Float[np.ndarray, "batch 3"]) -> "Motions":
        """Motions that end elsewhere, by x, y [m] and a turn [rad] in the frame where each ends; evenly over time."""
        share = np.clip(np.arange(len(self.times)) / np.maximum(self.end, 1)[:, None], 0.0, 1.0)
        turn = (share * by[:, 2:])[:, None]  # (batch, 1, time)
        turned = self.turned + np.stack([0 * turn, 0 * turn, turn], axis=-1)
        start = self.com[:, :, :1, :2]
        shift = share[:, None, :, None] * by[:, None, None, :2] + rotate_plane(start, turn) - start
        com = self.com.copy()
        com[..., :2] += rotate_plane(shift, self.heading[:, :, None])
        return replace(self, com=com, turned=turned)

    def resting_frames(self) -> tuple[Float[np.ndarray, "batch 4 4"], Bool[np.ndarray, " batch"]]:
        """The object's frame at the end of each likeliest motion, in its frame at rest; and whether it lies flat again.

        What lies on another side keeps its frame as it turned.
        """
        rows, best = np.arange(len(self)), self.probability.argmax(axis=1)
        frames = np.tile(np.eye(4), (len(self), 1, 1))
        flat = self.at_end(self.tilt)[rows, best] < FLAT
        angle = self.heading[rows, best]
        frames[:, 0, 0] = frames[:, 1, 1] = np.cos(angle)
        frames[:, 1, 0] = np.sin(angle)
        frames[:, 0, 1] = -frames[:, 1, 0]
        start, end = self.com[rows, best, 0], self.end_com[rows, best]
        frames[:, :2, 3] = end[:, :2] - np.einsum("nij,nj->ni", frames[:, :2, :2], start[:, :2])
        return frames, flat

    @property
    def outcome(self) -> np.ndarray:
        """Outcome of each future: (futures,) array of names."""
        return np.array(self.futures.outcome)

    @property
    def probability(self) -> Float[np.ndarray, "batch futures"]:
        """Probability of each future."""
        return self.futures.probability

    @property
    def duration(self) -> Float[np.ndarray, " batch"]:
        """Time at which each motion ends [s]."""
        return self.times[self.end]

    @cached_property
    def counts(self) -> Bool[np.ndarray, "batch time"]:
        """Samples that count."""
        return np.arange(len(self.times)) <= self.end[:, None]

    def is_outcome(self, *names: str) -> np.ndarray:
        """Whether futures have one of these outcomes: (batch, futures) bool."""
        return np.broadcast_to(np.isin(self.outcome, names), self.probability.shape)

    def at_end(self, values: Float[np.ndarray, "batch futures time *rest"]) -> np.ndarray:
        """Values at the last sample that counts: (batch, futures, ...)."""
        return values[np.arange(len(self)), :, self.end]

    def most(self, values: Float[np.ndarray, "batch futures time"]) -> Float[np.ndarray, "batch futures"]:
        """Greatest of the values that count."""
        return np.where(self.counts[:, None], values, -np.inf).max(axis=2)

    @cached_property
    def end_com(self) -> Float[np.ndarray, "batch futures 3"]:
        """Where the centre of mass ends [m]."""
        return self.at_end(self.com)

    @cached_property
    def shift(self) -> Float[np.ndarray, "batch futures 3"]:
        """How far the centre of mass has come at the end [m]."""
        return self.end_com - self.com[:, :, 0]

    @cached_property
    def up(self) -> Float[np.ndarray, "batch futures time 3"]:
        """Where the object's own z axis points.

        Raises:
            PlanningError: Only positions were imagined.
        """
        if np.isnan(self.turned).all():
            raise PlanningError(
                "the imaginer imagines positions alone, the goal asks for a rotation: use one that imagines poses"
            )
        angle = np.linalg.norm(self.turned, axis=-1)
        # Rodrigues' formula for the z axis; sinc is sin(pi x) / (pi x).
        first = np.sinc(angle / np.pi)
        second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
        x, y, z = np.moveaxis(self.turned, -1, 0)
        return np.stack(
            [first * y + second * x * z, -first * x + second * y * z, 1 - second * (x * x + y * y)], axis=-1
        )

    @cached_property
    def tilt(self) -> Float[np.ndarray, "batch futures time"]:
        """Angle between the object's z axis and the vertical [rad]."""
        return np.arccos(np.clip(self.up[..., 2], -1.0, 1.0))

    @cached_property
    def heading(self) -> Float[np.ndarray, "batch futures"]:
        """Turn about the vertical at the end [rad], between -pi and pi: the twist of the rotation."""
        angle = np.linalg.norm(self.at_end(self.turned), axis=-1)
        z = self.at_end(self.turned)[..., 2]
        share = np.divide(z, angle, out=np.zeros_like(z), where=angle > 0)
        turn = 2 * np.arctan2(np.sin(angle / 2) * share, np.cos(angle / 2))
        return wrap_angle(turn)

    def footprints(
        self, rows: Int[np.ndarray, " n"], futures: Int[np.ndarray, " n"], samples: Int[np.ndarray, " time"]
    ) -> Float[np.ndarray, "n time points 2"]:
        """Corners of the object's hull from above, upper and lower ones, at samples of some futures [m]."""
        from scipy.spatial.transform import Rotation

        hull = convex_hull(self.outline)
        low = np.column_stack([hull, np.zeros(len(hull))])
        corners = np.concatenate([low, low + np.array([0.0, 0.0, self.height])])
        turned = np.nan_to_num(self.turned[rows, futures][:, samples])
        turns = Rotation.from_rotvec(turned.reshape(-1, 3)).as_matrix().reshape(*turned.shape, 3)
        com = self.com[rows, futures][:, samples]
        start = self.com[rows, futures, 0]
        arms = corners - start[:, None]  # (n, points, 3)
        return np.einsum("ntij,npj->ntpi", turns[:, :, :2], arms) + com[:, :, None, :2]


class _Moved(Sequence[Action]):
    """Actions as seen from another frame, each placed there when it is asked for."""

    def __init__(self, actions: Sequence[Action], T: Float[np.ndarray, "4 4"]) -> None:
        self._actions, self._T = actions, T

    def __len__(self) -> int:
        return len(self._actions)

    def __getitem__(self, row: Any) -> Any:
        return placed(self._actions[row], self._T)


def placed(action: Action, T: Float[np.ndarray, "4 4"]) -> Action:
    """An action of a frame in another one, by the first one's place in that, turned about the vertical."""
    turn = T[:2, :2]
    return replace(action, contact=turn @ action.contact + T[:2, 3], direction=turn @ action.direction)
