"""Lever-ups that a monitor watches: normal ones, and ones in which something goes wrong, tracked with noise.

Everything is simulated with the blade alone, in MuJoCo or Bullet. Each execution has a twin of its own in which nothing
goes wrong, with the same object, constants and execution error: what separates the two is the fault's own effect.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float

from foretrace.actions import LeverUp, sample_reachable_contacts
from foretrace.errors import ShapeError, ViewError
from foretrace.geometry import (
    invert_transform,
    matrix_to_pose,
    pose_to_matrix,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
)
from foretrace.imagined import ObservedMotion
from foretrace.interactions.record import ExecutionOffset, Physics
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import ObjectModel, Prism, Weighted, sample_prism
from foretrace.simulation.bullet_engine import BulletEngine
from foretrace.simulation.bullet_world import World
from foretrace.simulation.engine import sample_tool
from foretrace.simulation.mujoco_engine import plan_carriage
from foretrace.simulation.randomisation import RANDOMISED
from foretrace.simulation.recipes import ROUND
from foretrace.simulation.scene import build_scene

FAULTS = ("slip", "missed", "fixed", "pushed", "friction", "off centre", "other shape", "freeze", "jump")
"""What goes wrong."""
CAUSES = {
    "slip": "slipped",
    "missed": "missed contact",
    "fixed": "held",
    "pushed": "moved by something else",
    "friction": "other physics",
    "off centre": "other object",
    "other shape": "other object",
    "freeze": "tracker frozen",
    "jump": "tracker jumped",
}
"""Cause that a monitor is to name."""
POSITION_NOISE, ANGLE_NOISE = 0.0003, float(np.deg2rad(0.1))
"""Standard deviation of tracked poses along and about each axis [m, rad]."""
DROPOUT = 0.03
"""Share of the samples at which the tracker loses the object."""
ENGINES = ("mujoco", "bullet")
"""What simulates."""
TIMESTEP, PERIOD = 0.002, 0.05
"""Time step of the simulation, and time between tracked samples [s]."""
MOVED = 0.003
"""A fault counts if it moves the object, or what the tracker says, by more than this [m]."""


@dataclass(frozen=True, eq=False)
class Execution:
    """One lever-up as tracked."""

    object: ObjectModel
    """The object, as the robot believes it to be."""
    action: LeverUp
    """The action as commanded."""
    view: TopDownView
    """The object from above in the action frame."""
    physics: Physics
    """Constants of the execution, as they are without a fault."""
    times: Float[np.ndarray, " time"]
    """Time of each sample [s]."""
    poses: Float[np.ndarray, "time 7"]
    """True poses of the object frame in the action frame, as `Effect.pose_trajectory`."""
    normal: Float[np.ndarray, "time 7"]
    """Poses as they would be without the fault."""
    tracked: tuple[Float[np.ndarray, "7"] | None, ...]
    """Poses as tracked; None where the tracker lost the object."""
    fault: str = ""
    """One of FAULTS; empty: none."""

    @property
    def deviation(self) -> Float[np.ndarray, " time"]:
        """How far the fault moves the object's rim or what is tracked of it [m], up to each time."""
        ends = np.column_stack([self.object.corners, np.zeros(len(self.object.corners))])
        lost = np.array([each is None for each in self.tracked])
        seen = np.array([np.zeros(7) if each is None else each for each in self.tracked])
        shown = (
            self.poses if self.fault not in ("freeze", "jump") else np.where(lost[:, None], self.poses, seen)
        )
        apart = [_points(shown, end) - _points(self.normal, end) for end in ends]
        return np.maximum.accumulate(np.linalg.norm(apart, axis=-1).max(axis=0))


Draw = Callable[[np.random.Generator], tuple[Prism, LeverUp]]
"""Draws an object and a lever-up of it."""


def draw_polygon(rng: np.random.Generator) -> tuple[Prism, LeverUp]:
    """A polygon of the paper's kind, levered along an edge."""
    prism = sample_prism(rng, int(rng.integers(3, 11)))
    return prism, LeverUp.at_edge(prism, int(rng.integers(len(prism.corners))), rng.uniform(0.15, 0.85))


def draw_round(rng: np.random.Generator) -> tuple[Prism, LeverUp]:
    """A flat object with a round, organic or dented outline, levered anywhere that a blade gets to."""
    families = list(ROUND.values())
    return reachable(families[int(rng.integers(len(families)))](rng), rng)


def reachable(prism: Prism, rng: np.random.Generator) -> tuple[Prism, LeverUp]:
    """An object, levered anywhere that a blade gets to."""
    return prism, sample_reachable_contacts(prism, rng, 1)[0]


def make_execution(
    seed: int, number: int, fault: str = "", draw: Draw = draw_polygon, engine: str = "mujoco"
) -> Execution:
    """One execution, decided by its seed, number, fault and engine.

    Args:
        seed: Seed of the set.
        number: Number within the set.
        fault: One of FAULTS, or empty.
        draw: Draws object and action.
        engine: One of ENGINES.
    """
    rng = np.random.default_rng([seed, number, FAULTS.index(fault) + 1 if fault else 0])
    while True:
        prism, action = draw(rng)
        try:
            view = TopDownView.of(prism, action)
            varied, physics, _, offset = RANDOMISED.vary(prism, Physics(), action.path, rng)
        except (ViewError, ShapeError):
            continue
        scene = Scene(varied, physics, action, offset, engine)
        normal = scene.play()
        changed = with_fault(scene, fault, rng)
        poses = normal if changed is scene else changed.play()
        if normal is None or poses is None:
            continue
        times = PERIOD * np.arange(len(normal))
        tracked = track(poses, times, fault, rng)
        return Execution(prism, action, view, physics, times, poses, normal, tracked, fault)


@dataclass(frozen=True, eq=False)
class Scene:
    """What is simulated."""

    object: ObjectModel
    """The object."""
    physics: Physics
    """Constants."""
    action: LeverUp
    """The action as commanded."""
    offset: ExecutionOffset
    """Execution error."""
    engine: str = "mujoco"
    """One of ENGINES."""
    slip_time: float = np.inf
    """Time at which the blade is pulled out [s]."""
    fixed: Float[np.ndarray, "3"] | None = None
    """Point of the object that is fixed to the table [m], object frame."""
    push: tuple[float, float, float, float] = (np.inf, 0.0, 0.0, 0.0)
    """Time [s], duration [s] and force along x and y [N] of a push."""

    def play(self) -> Float[np.ndarray, "time 7"] | None:
        """Poses of the object frame in the frame of the action as commanded; None: the simulation blew up."""
        executed = self.action.moved(**vars(self.offset))
        poses = (self._in_bullet if self.engine == "bullet" else self._in_mujoco)(executed)
        if not np.isfinite(poses).all():
            return None
        back = self.action.T_action_object @ invert_transform(executed.T_action_object)
        return matrix_to_pose(back @ pose_to_matrix(poses))

    def _force(self, executed: LeverUp, now: float) -> Float[np.ndarray, "3"]:
        """Force of the push at a time [N], in the executed action's frame."""
        start, lasting, *force = self.push
        if not start <= now < start + lasting:
            return np.zeros(3)
        turn = (executed.T_action_object @ invert_transform(self.action.T_action_object))[:2, :2]
        return np.array([*(turn @ force), 0.0])

    def _in_bullet(self, executed: LeverUp) -> Float[np.ndarray, "time 7"]:
        """Poses of the object in the executed action's frame."""

        def disturb(world: World, body: int, now: float) -> None:
            if self.fixed is not None and now == 0:
                world.pin(body, self.fixed)
            if (force := self._force(executed, now)).any():
                world.push(body, force)

        motion = BulletEngine("tool", TIMESTEP, PERIOD).play(
            self.object,
            executed.T_action_object,
            executed.tool,
            self._withdrawing(executed.tool_motion),
            executed.duration,
            self.physics,
            disturb,
        )
        return motion.object_pose if not motion.diverged else np.full((1, 7), np.nan)

    def _in_mujoco(self, executed: LeverUp) -> Float[np.ndarray, "time 7"]:
        """Poses of the object in the executed action's frame."""
        samples = round(executed.duration / PERIOD)
        stride = round(PERIOD / TIMESTEP)
        motion = self._withdrawing(executed.tool_motion)
        control = plan_carriage(
            motion,
            sample_tool(motion, np.arange(samples + 1) * PERIOD),
            executed.tool,
            samples * stride,
            TIMESTEP,
        )
        spec = build_scene(self.object, self.physics, executed.tool, "tool", TIMESTEP, control.coordinates)
        pose = executed.T_action_object
        if self.fixed is not None:  # both ends of it coincide where the body is at first
            place = matrix_to_pose(pose)
            spec.body("object").pos, spec.body("object").quat = place[:3], place[3:]
            spec.add_equality(
                type=mujoco.mjtEq.mjEQ_CONNECT,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
                name1="object",
                data=[*self.fixed, *np.zeros(9)],
            )
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qpos[:7] = matrix_to_pose(pose)
        data.qpos[7:] = control.start
        body = model.body("object").id
        poses = [data.qpos[:7].copy()]
        for step, setpoint in enumerate(control.setpoints):
            data.ctrl[:] = setpoint
            data.xfrc_applied[body, :3] = self._force(executed, step * TIMESTEP)
            mujoco.mj_step(model, data)
            if (step + 1) % stride == 0:
                poses.append(data.qpos[:7].copy())
        return np.array(poses)

    def _withdrawing(
        self, motion: Callable[[np.ndarray], Float[np.ndarray, "time 6"]]
    ) -> Callable[[np.ndarray], Float[np.ndarray, "time 6"]]:
        """The tool's motion, with the blade pulled out by 4 cm within a tenth of a second."""
        if not np.isfinite(self.slip_time):
            return motion

        def withdrawn(times: np.ndarray) -> np.ndarray:
            coordinates = motion(times)
            coordinates[:, 0] -= 0.04 * np.clip((times - self.slip_time) / 0.1, 0.0, 1.0)
            return coordinates

        return withdrawn


def with_fault(scene: Scene, fault: str, rng: np.random.Generator) -> Scene:
    """The scene with what goes wrong.

    Args:
        scene: The scene; for the fault ``other shape``, of a prism.
        fault: One of FAULTS, or empty.
        rng: Random numbers.
    """
    angle = rng.uniform(0, 2 * np.pi)
    way = np.array([np.cos(angle), np.sin(angle)])
    if fault == "slip":
        return replace(scene, slip_time=rng.uniform(1.0, 2.0))
    if fault == "missed":
        ahead, left = (-1, 0) if (side := rng.integers(3)) == 0 else (0, 2 * side - 3)
        far = rng.uniform(0.005, 0.010)
        moved = replace(
            scene.offset, ahead=scene.offset.ahead + far * ahead, left=scene.offset.left + far * left
        )
        return replace(scene, offset=moved)
    if fault == "fixed":
        corner = scene.object.corners[rng.integers(len(scene.object.corners))]
        return replace(scene, fixed=np.array([*(0.85 * corner), 0.0]))
    if fault == "pushed":
        weight = 9.81 * scene.object.mass_properties(scene.physics.density).mass
        return replace(scene, push=(rng.uniform(0.2, 2.4), 0.1, *(rng.uniform(0.9, 1.6) * weight * way)))
    if fault == "friction":
        factor = 2.0 if rng.random() < 0.5 else 0.5
        nominal = Physics()
        return replace(
            scene,
            physics=replace(
                scene.physics,
                friction=factor * nominal.friction,
                tool_friction=factor * nominal.tool_friction,
            ),
        )
    if fault == "off centre":
        return replace(scene, object=Weighted(scene.object, 0.02 * way))
    if fault == "other shape":
        return replace(scene, object=_stretched(scene, 1.35 if rng.random() < 0.5 else 0.7))
    return scene


def _stretched(scene: Scene, factor: float) -> ObjectModel:
    """The object stretched along the action, with the contact where it was."""
    prism = scene.object
    assert isinstance(prism, Prism)
    along = (prism.corners - scene.action.contact) @ scene.action.direction
    corners = prism.corners + np.outer((factor - 1) * along, scene.action.direction)
    return Prism(corners, prism.height, prism.bevel)


def track(
    poses: Float[np.ndarray, "time 7"],
    times: Float[np.ndarray, " time"],
    fault: str,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "7"] | None, ...]:
    """Poses with the tracker's noise, dropouts and faults.

    Args:
        poses: True poses.
        times: Their times [s].
        fault: One of FAULTS, or empty.
        rng: Random numbers.
    """
    noisy = pose_to_matrix(poses)
    turned = rng.normal(scale=ANGLE_NOISE, size=(len(poses), 3))
    noisy[:, :3, :3] = quaternion_to_matrix(rotation_vector_to_quaternion(turned)) @ noisy[:, :3, :3]
    noisy[:, :3, 3] += rng.normal(scale=POSITION_NOISE, size=(len(poses), 3))
    seen = matrix_to_pose(noisy)
    lost = rng.random(len(poses)) < DROPOUT
    lost[0] = False
    when = int(np.searchsorted(times, rng.uniform(0.9, 1.9)))
    if fault == "freeze":
        seen[when:] = seen[when]
    if fault == "jump":
        way = rng.normal(size=3)
        seen[when:, :3] += rng.uniform(0.005, 0.02) * way / np.linalg.norm(way)
    return tuple(None if gone else pose for gone, pose in zip(lost, seen, strict=True))


def observed(
    poses: Float[np.ndarray, "time 7"], times: Float[np.ndarray, " time"], rng: np.random.Generator
) -> ObservedMotion:
    """What the tracker sees of an execution without a fault, see `track`; lost poses are left out."""
    tracked = track(poses, times, "", rng)
    seen = [row for row, pose in enumerate(tracked) if pose is not None]
    return ObservedMotion(times[seen], np.array([tracked[row] for row in seen]))


def _points(poses: Float[np.ndarray, "time 7"], point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "time 3"]:
    """Path of a point of the object."""
    return poses[:, :3] + quaternion_to_matrix(poses[:, 3:]) @ point
