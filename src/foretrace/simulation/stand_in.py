"""A stand-in for the real robot: another physics engine, other constants, and senses that err.

There is no robot here. What section 5.4 of the paper does with a UR10 is done with lever-ups that differ from those in
training as a real one would: they are played by another engine with other friction, density and thickness, the blade
does not meet the object quite where it is commanded to, the camera's mask is shifted, turned and frayed, the marker's
poses are noisy, and samples are taken at another rate. All of it is drawn anew for every lever-up. What a stand-in
cannot show is what no simulator models: bending, screws that loosen, a table that is not flat.
"""

from dataclasses import dataclass, field, fields

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from foretrace.actions import CONTACT_TOLERANCE, LeverUp
from foretrace.errors import SimulationError, ViewError, check_ranges
from foretrace.geometry import cross, pose_to_matrix, transform_points
from foretrace.interactions.record import Effect, ExecutionOffset, Physics
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import Prism
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up
from foretrace.simulation.randomisation import Range

LONGEST_STEP = 0.002
"""Largest time step of the physics, about [s]."""
RANGES = {
    "sample_rate": (1.0, 500.0),
    "contact_error": (0.0, CONTACT_TOLERANCE),
    "direction_error": (0.0, 0.5),
    "view_shift": (0.0, 0.02),
    "view_turn": (0.0, 0.5),
    "frayed": (0.0, 1.0),
    "marker_position": (0.0, 0.02),
    "marker_rotation": (0.0, 0.5),
}
"""Limits of its settings."""


@dataclass(frozen=True)
class Perturbation:
    """Differences of one lever-up from what predictor and simulator are given."""

    friction: float
    """Friction coefficient between object and table."""
    tool_friction: float
    """Friction coefficient between object and blade."""
    density_factor: float
    """Multiple of the density that the simulator is given."""
    thickness_error: float
    """How much thicker the object is [m]."""
    contact_along: float
    """How far to the left, seen along the action, the blade meets the object [m]."""
    contact_across: float
    """How far ahead along the action the blade meets it [m]."""
    direction_error: float
    """By how much the action points to the left [rad]."""
    view_shift_x: float
    """How far along the action the mask is shifted [m]."""
    view_shift_y: float
    """How far to the left it is shifted [m]."""
    view_turn: float
    """By how much it is turned to the left [rad]."""
    noise_seed: int
    """Seed of the noise of pixels and marker."""


@dataclass(frozen=True)
class StandIn:
    """What stands in for the real robot, and how much it differs from the simulator in training."""

    engine: str = "bullet"
    """Physics engine; the training data's is MuJoCo."""
    embodiment: str = "tool"
    """``tool``: the blade alone; Bullet has no arm."""
    sample_rate: float = 30.0
    """Poses of the marker per second [Hz]; training data have 20."""
    friction: Range = (0.6, 1.0)
    """Friction coefficients between object and table; 0.8 in training."""
    tool_friction: Range = (0.2, 0.4)
    """Friction coefficients between object and blade; 0.3 in training."""
    density_factor: Range = (0.5, 2.0)
    """Multiple of the density that the simulator is given."""
    thickness_error: Range = (-0.002, 0.002)
    """Thickness of the object beyond the one that the simulator is given [m]."""
    contact_error: float = 0.003
    """The blade meets the object up to this far off, along the edge and across it [m]."""
    direction_error: float = np.deg2rad(3.0)
    """The action points up to this far off [rad]."""
    view_shift: float = 0.0016
    """The mask is shifted by up to this, each way [m]; a pixel has 3.2 mm."""
    view_turn: float = np.deg2rad(1.0)
    """The mask is turned by up to this [rad]."""
    frayed: float = 0.1
    """Share of the pixels on both sides of the mask's border that change sides."""
    marker_position: float = 0.0005
    """Standard deviation of the marker's position, each coordinate of each sample [m]."""
    marker_rotation: float = np.deg2rad(0.3)
    """Standard deviation of its rotation about each axis [rad]."""

    def __post_init__(self) -> None:
        for name in ("friction", "tool_friction", "density_factor", "thickness_error"):
            low, high = getattr(self, name)
            if not low <= high or (low <= 0 and name != "thickness_error"):
                raise SimulationError(f"stand-in: {name} = {low} to {high} is no range of possible values")
        check_ranges(SimulationError, "stand-in", self, RANGES)
        self.simulation(Physics())

    @classmethod
    def undisturbed(cls, engine: str = "mujoco", embodiment: str = "arm") -> "StandIn":
        """No difference from the simulator in training but, if asked for, the engine."""
        same = {each.name: 0.0 for each in fields(cls) if isinstance(each.default, float)} | {
            "friction": (Physics.friction,) * 2,
            "tool_friction": (Physics.tool_friction,) * 2,
            "density_factor": (1.0, 1.0),
            "thickness_error": (0.0, 0.0),
            "sample_rate": 1 / SimulationConfig.sample_period,
        }
        return cls(engine=engine, embodiment=embodiment, **same)  # pyright: ignore[reportArgumentType]

    def simulation(self, physics: Physics) -> SimulationConfig:
        """How its lever-ups are played.

        Raises:
            SimulationError: The engine is unknown or not installed, or cannot play the embodiment.
        """
        period = 1 / self.sample_rate
        return SimulationConfig(
            engine=self.engine,
            embodiment=self.embodiment,
            timestep=period / max(1, round(period / LONGEST_STEP)),
            sample_period=period,
            physics=physics,
        )

    def draw(self, rng: np.random.Generator) -> Perturbation:
        """What is different in one lever-up."""
        names = ("friction", "tool_friction", "density_factor", "thickness_error")
        drawn = {name: float(rng.uniform(*getattr(self, name))) for name in names}
        for name, limit in (
            ("contact_along", self.contact_error),
            ("contact_across", self.contact_error),
            ("direction_error", self.direction_error),
            ("view_shift_x", self.view_shift),
            ("view_shift_y", self.view_shift),
            ("view_turn", self.view_turn),
        ):
            drawn[name] = float(rng.uniform(-limit, limit))
        return Perturbation(**drawn, noise_seed=int(rng.integers(2**31)))

    def observe(
        self, obj: Prism, action: LeverUp, perturbation: Perturbation, density: float = Physics.density
    ) -> "Observation":
        """Play one lever-up and report what the robot would see of it.

        Args:
            obj: The object as it is known.
            action: The lever-up as commanded.
            perturbation: What is different.
            density: The object's density as it is known [kg/m^3].

        Raises:
            ViewError: The object does not fit in the view.
        """
        drawn = perturbation
        real = Prism(obj.corners, obj.height + drawn.thickness_error, obj.bevel)
        error = ExecutionOffset(drawn.contact_across, drawn.contact_along, drawn.direction_error)
        physics = Physics(density * drawn.density_factor, drawn.friction, drawn.tool_friction)
        rng = np.random.default_rng(drawn.noise_seed)
        view = self._see(real, action, drawn, rng)
        simulation = self.simulation(physics)
        effect = simulate_lever_up(real, action, simulation, execution_error=error).effect
        com = self._track(real, effect, rng)
        end = len(com) if effect.slip_index is None else effect.slip_index
        return Observation(
            view=view,
            times=effect.times[:end],
            com=com[:end],
            slip_time=None if effect.slip_index is None else float(effect.times[effect.slip_index]),
            outcome=effect.outcome,
            perturbation=drawn,
            physics=physics,
        )

    def see(self, obj: Prism, action: LeverUp, perturbation: Perturbation) -> TopDownView:
        """The view that `observe` reports, without playing the lever-up.

        Raises:
            ViewError: The object does not fit in the view.
        """
        real = Prism(obj.corners, obj.height + perturbation.thickness_error, obj.bevel)
        return self._see(real, action, perturbation, np.random.default_rng(perturbation.noise_seed))

    def _see(
        self, real: Prism, action: LeverUp, drawn: Perturbation, rng: np.random.Generator
    ) -> TopDownView:
        """The object from above, in the commanded action's frame, as a camera with small errors shows it."""
        # The mask shifts one way where its frame shifts the other way.
        wrong = action.moved(-drawn.view_shift_x, -drawn.view_shift_y, -drawn.view_turn)
        exact = TopDownView.of(real, wrong)
        mask = exact.mask.astype(np.uint8)
        cross_shape = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        border = cv2.dilate(mask, cross_shape) != cv2.erode(mask, cross_shape, borderValue=0)
        mask = exact.mask ^ (border & (rng.random(border.shape) < self.frayed))
        return TopDownView(mask, np.where(mask, np.float32(real.height), np.float32(0)))

    def _track(self, real: Prism, effect: Effect, rng: np.random.Generator) -> Float[np.ndarray, "time 3"]:
        """Centres of mass in the commanded action's frame [m], from noisy poses of a marker on top of the object."""
        centre = real.mass_properties(1.0).com
        marker = np.array([centre[0], centre[1], real.height])
        count = len(effect.times)
        turns = Rotation.from_rotvec(rng.normal(0, self.marker_rotation, (count, 3))).as_matrix()
        seen = marker + turns @ (centre - marker)  # (time, 3), object frame
        com = transform_points(pose_to_matrix(effect.pose_trajectory), seen[:, None])[:, 0]
        return com + rng.normal(0, self.marker_position, (count, 3))


@dataclass(frozen=True)
class Observation:
    """What the robot sees of one lever-up, in the action frame that it believes in."""

    view: TopDownView
    """The object from above before the action."""
    times: Float[np.ndarray, " time"]
    """Time of each sample [s], up to where the object slips; empty if the simulation diverged."""
    com: Float[np.ndarray, "time 3"]
    """Centre of mass [m]."""
    slip_time: float | None
    """When the object left the blade [s], or None."""
    outcome: str
    """What became of the object."""
    perturbation: Perturbation | None
    """What was different; None: not known."""
    physics: Physics = field(default_factory=Physics)
    """Friction and density as they really were."""


def hull_of(view: TopDownView) -> TopDownView:
    """The convex hull of a view's mask, as high as the object's highest point (paper, figure 15).

    Raises:
        ViewError: The mask is empty.
    """
    rows, columns = np.nonzero(view.mask)
    if len(rows) == 0:
        raise ViewError("the view's mask is empty: it has no hull")
    hull = cv2.convexHull(np.column_stack([columns, rows]).astype(np.int32))[:, 0].astype(float)
    ahead = np.roll(hull, -1, axis=0) - hull
    grid = np.meshgrid(np.arange(view.mask.shape[1]), np.arange(view.mask.shape[0]))
    pixels = np.stack(grid, axis=-1).astype(float)
    # Whole numbers are exact, so that a mask that is convex already stays as it is.
    sides = cross(ahead, pixels[..., None, :] - hull)  # (row, column, side of the hull)
    mask = np.asarray((sides >= 0).all(axis=-1) | (sides <= 0).all(axis=-1))
    return TopDownView(mask, np.where(mask, view.height.max(), np.float32(0)), view.metres_per_pixel)
