"""The beginning of a motion that is under way, as recorded, and as an imaginer is shown it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from foretrace.errors import PredictionError
from foretrace.geometry import Numbers, continuous_rotation_vectors, finite_array, quaternion_to_matrix
from foretrace.interactions.record import Effect
from foretrace.trajectories import check_poses

SAME_TIME = 1e-9
"""Times that differ by less are the same [s]."""
LATEST_START = 0.025
"""An observed motion begins at most this long after the imaginer's first sample [s]: half a sample period."""
REST_TIME = 0.06
"""The object rests for this long at the beginning [s]: the blade has not touched it yet."""
REST_DISTANCE = 0.01
"""Distance that noise may move it by within that time [m]."""
REST_ANGLE = 0.2
"""Angle that noise may turn it by within that time [rad]."""


@dataclass(frozen=True, eq=False, init=False)
class ObservedMotion:
    """Poses of an object from rest on, sampled at any times.

    Raises:
        PredictionError: Shapes do not fit, a number is not finite, times do not rise, a quaternion has no unit length,
            or the object is not at rest at the beginning.
    """

    times: Float[np.ndarray, " time"]
    """Time of each sample [s], rising, from the moment before the blade touches the object."""
    poses: Float[np.ndarray, "time 7"]
    """Object frame in the action frame, as ``Effect.pose_trajectory``: position [m], quaternion (w, x, y, z)."""
    com: Float[np.ndarray, "time 3"] | None = None
    """Centres of mass in the action frame [m], where they were observed. If not, the centre of mass at rest is carried
    along with the object."""

    def __init__(self, times: Numbers, poses: Numbers, com: Numbers | None = None) -> None:
        for name, values, shape in (
            ("times", times, (None,)),
            ("poses", poses, (None, 7)),
            ("com", com, (None, 3)),
        ):
            array = (
                None
                if values is None and name == "com"
                else finite_array(f"{name} of an observed motion", values, shape, PredictionError)
            )
            object.__setattr__(self, name, array)
        check_poses(self.times, self.poses, PredictionError)
        if self.com is not None and len(self.com) != len(self.times):
            raise PredictionError(
                f"{len(self.times)} times and {len(self.com)} com: give one centre of mass for each time"
            )
        first = self.times <= self.times[0] + REST_TIME
        moved = np.linalg.norm(self.poses[first, :3] - self.poses[0, :3], axis=1).max()
        turned = np.linalg.norm(self._rotations()[first], axis=1).max()
        if moved > REST_DISTANCE or turned > REST_ANGLE:
            raise PredictionError(
                f"the observed object moves by {100 * moved:.1f} cm and turns by {np.degrees(turned):.0f} degrees "
                f"in the first {REST_TIME:g} s: give samples from rest on, before the blade touches it"
            )

    @classmethod
    def of(cls, effect: Effect, until: float = np.inf) -> "ObservedMotion":
        """The beginning of a recorded effect, up to a time [s]."""
        kept = effect.times <= until + SAME_TIME
        return cls(effect.times[kept], effect.pose_trajectory[kept], effect.com_trajectory[kept])

    def states(
        self, sample_times: Float[np.ndarray, " time"], com: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "samples 6"]:
        """The motion at an imaginer's sample times, as far as it goes.

        Args:
            sample_times: Times of the imaginer's samples [s].
            com: Centre of mass at rest in the action frame [m]; not looked at where it was observed.

        Returns:
            Centres of mass in the action frame [m] and rotation vectors since rest [rad].

        Raises:
            PredictionError: The motion does not begin with the imaginer's first sample or leaves no sample to imagine.
        """
        from scipy.spatial.transform import Rotation, Slerp

        if self.times[0] - sample_times[0] > LATEST_START:
            raise PredictionError(
                f"the observed motion begins at {self.times[0]:g} s, the predictor's samples at {sample_times[0]:g} s: "
                "give it from the moment before the blade touches the object"
            )
        if self.times[-1] >= sample_times[-1] - SAME_TIME:
            raise PredictionError(
                f"the observed motion lasts until {self.times[-1]:g} s, the predictor's until {sample_times[-1]:g} s: "
                "give its beginning alone"
            )
        turned = self._rotations()
        positions = self.com
        if positions is None:
            offset = com - self.poses[0, :3]
            positions = self.poses[:, :3] + Rotation.from_rotvec(turned).apply(offset)
        count = int(np.sum(sample_times <= self.times[-1] + SAME_TIME))
        wanted = sample_times[:count]
        if count == len(self.times) and np.allclose(wanted, self.times, rtol=0, atol=SAME_TIME):
            return np.concatenate([positions, turned], axis=1)
        wanted = np.clip(wanted, self.times[0], self.times[-1])
        if len(self.times) > 1:
            positions = np.stack([np.interp(wanted, self.times, axis) for axis in positions.T], axis=1)
            between = Slerp(self.times, Rotation.from_rotvec(turned))(wanted)
            turned = continuous_rotation_vectors(between.as_matrix())
        return np.concatenate([positions, turned], axis=1)

    def _rotations(self) -> Float[np.ndarray, "time 3"]:
        return rotations_since_rest(self.poses)


def rotations_since_rest(poses: Float[np.ndarray, "*batch time 7"]) -> Float[np.ndarray, "*batch time 3"]:
    """Rotation vectors since the first sample [rad], about the action frame's axes, whatever the object frame."""
    rotations = quaternion_to_matrix(poses[..., 3:])
    return continuous_rotation_vectors(rotations @ np.swapaxes(rotations[..., :1, :, :], -1, -2))


def observed_motion(observed: Any) -> ObservedMotion:
    """The motion in what a caller gives as ``observed``.

    Raises:
        PredictionError: It is something else, or not as an observed motion has to be.
    """
    if isinstance(observed, ObservedMotion):
        return observed
    if isinstance(observed, Effect):
        return ObservedMotion.of(observed)
    raise PredictionError(
        f"observed of type {type(observed).__name__}: give an Effect, or ObservedMotion(times, poses) with "
        "poses of the object in the action frame"
    )
