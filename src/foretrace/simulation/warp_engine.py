"""Actions in MuJoCo Warp: thousands of worlds at once on a GPU, each with an object of its own.

All worlds share one model, which has as many pieces of an object as the most complex one. What differs is batched:
each world says which mesh each piece is, and where; its masses, and its frictions. The same servos follow the same
set points as in MuJoCo, and MuJoCo reads the contacts of the recorded samples afterwards.

Numbers are single precision, and a GPU adds in no fixed order: motions are not reproducible bit for bit.
"""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from foretrace.actions import Motion
from foretrace.errors import SimulationError, shown
from foretrace.extras import named_extras
from foretrace.geometry import matrix_to_pose, planar_transform
from foretrace.interactions.record import Physics
from foretrace.objects import HullShape, ObjectModel
from foretrace.simulation.engine import Play
from foretrace.simulation.mujoco_engine import ControlPath, MujocoEngine
from foretrace.simulation.scene import body_origin, build_scene

BATCHED = (
    "body_mass",
    "body_subtreemass",
    "body_ipos",
    "body_iquat",
    "body_inertia",
    "body_invweight0",
    "dof_invweight0",
)
"""Fields of a body or a joint that differ between worlds."""
GEOM_FIELDS = (
    "geom_dataid",
    "geom_pos",
    "geom_quat",
    "geom_size",
    "geom_aabb",
    "geom_rbound",
    "geom_friction",
)
"""Fields of a collision shape that differ between worlds."""
CONTACTS = (4, 16)
"""Room for contacts: for each collision shape, and besides."""


class WarpEngine(MujocoEngine):
    """MuJoCo Warp: the tool alone, objects of convex pieces on a table without an edge within reach.

    It runs on the GPU that Warp finds, else, slowly, on the processor. The first call compiles kernels for minutes,
    which Warp keeps on disk.

    Args:
        embodiment: ``tool``.
        timestep: Time step [s]; divides the sample period.
        sample_period: Time between recorded samples [s].

    Raises:
        SimulationError: A value does not fit.
        MissingExtraError: MuJoCo Warp is not installed.
    """

    name, library = "warp", "mujoco-warp"
    at_once = 4096

    def __init__(
        self, embodiment: str = "tool", timestep: float = 0.002, sample_period: float = 0.05
    ) -> None:
        if embodiment != "tool":
            raise SimulationError(
                f"engine 'warp' cannot play embodiment {shown(embodiment)}: it moves the tool alone, so take "
                "embodiment 'tool'"
            )
        with named_extras():
            warp = import_module("warp")
            warp.config.log_level = warp.LOG_WARNING  # else a line for each kernel that is loaded
            import_module("mujoco_warp")
        super().__init__(embodiment, timestep, sample_period)

    def check_physics(self, physics: Physics) -> None:
        """Refuse a table with an edge within reach.

        Raises:
            SimulationError: Naming it.
        """
        if physics.table_edge is not None:
            raise SimulationError(
                f"engine 'warp' has a table without edges: table_edge = {physics.table_edge} m; take engine 'mujoco'"
            )

    def play(self, *arguments: Any, **named: Any) -> Motion:
        """Plays one action: a batch of one."""
        return self.play_many([Play(*arguments, **named)])[0]

    def play_many(self, plays: Sequence[Play]) -> list[Motion]:
        """Plays actions at once, each in a world of its own.

        Raises:
            SimulationError: An object has round pieces, a table has an edge, or contacts found no room.
        """
        for play in plays:
            self.check_physics(play.physics)
        controls = [self._control(play.tool, play.tool_motion, play.duration) for play in plays]
        groups: dict[Any, list[int]] = {}
        for row, (play, control) in enumerate(zip(plays, controls, strict=True)):
            groups.setdefault((play.tool, control.coordinates), []).append(row)
        motions: dict[int, Motion] = {}
        for rows in groups.values():
            seen = self._step([plays[row] for row in rows], [controls[row] for row in rows])
            for row, samples in zip(rows, seen, strict=True):
                play, control = plays[row], controls[row]
                model = self._compiled(play.obj, play.physics, play.tool, control.coordinates)
                motions[row] = self._observe(
                    model, mujoco.MjData(model), samples[: len(control.tips)], control
                )
        return [motions[row] for row in range(len(plays))]

    def _step(
        self, plays: Sequence[Play], controls: Sequence[ControlPath]
    ) -> Float[np.ndarray, "world sample state"]:
        """States of every world at every sample, in MuJoCo's order: time, positions, velocities."""
        mjw, wp = import_module("mujoco_warp"), import_module("warp")
        template, fields = self._worlds(plays, controls[0].coordinates)
        num, stride = len(plays), round(self.sample_period / self.timestep)
        room = CONTACTS[0] * template.ngeom + CONTACTS[1]
        start = np.array(
            [
                [
                    *matrix_to_pose(play.T_action_object @ planar_transform(body_origin(play.obj), 0.0)),
                    *control.start,
                ]
                for play, control in zip(plays, controls, strict=True)
            ]
        )
        steps = max(len(control.setpoints) for control in controls)
        # A shorter action's tool stays where it ends; those samples are not used.
        targets = np.stack(
            [np.pad(c.setpoints, ((0, steps - len(c.setpoints)), (0, 0)), mode="edge") for c in controls],
            axis=1,
        ).astype(np.float32)
        model = mjw.put_model(template, batch_sizes=dict.fromkeys(fields, num))
        data = mjw.make_data(template, nworld=num, nconmax=room, njmax=3 * room)
        for name, values in fields.items():
            getattr(model, name).assign(values)
        data.qpos.assign(start.astype(np.float32))
        ahead = [wp.array(target, dtype=float) for target in targets[:stride]]

        def play_sample() -> None:
            for target in ahead:
                wp.copy(data.ctrl, target)
                mjw.step(model, data)

        graph = None
        if wp.get_device().is_cuda:
            play_sample()  # compiles and allocates whatever is still missing
            data.qpos.assign(start.astype(np.float32))
            for zeroed in (data.qvel, data.time, data.qacc_warmstart, data.overflow):
                zeroed.zero_()
            with wp.ScopedCapture() as capture:
                play_sample()
            graph = capture.graph
        states = [np.hstack([np.zeros((num, 1)), start, np.zeros((num, template.nv))])]
        for first in range(0, steps, stride):
            for target, values in zip(ahead, targets[first : first + stride], strict=True):
                target.assign(values)
            if graph is None:
                play_sample()
            else:
                wp.capture_launch(graph)
            time = np.full((num, 1), (first + stride) * self.timestep)
            states.append(np.hstack([time, data.qpos.numpy(), data.qvel.numpy()]))
        if (full := data.overflow.numpy() != 0).any():
            raise SimulationError(
                f"engine 'warp': contacts of {full.sum()} of {num} worlds found no room, the first of them world "
                f"{full.argmax()}: its motion would be wrong; play those objects with engine 'mujoco'"
            )
        return np.stack(states, axis=1).astype(float)

    def _worlds(
        self, plays: Sequence[Play], coordinates: tuple[int, ...]
    ) -> tuple[mujoco.MjModel, dict[str, np.ndarray]]:
        """The model that all worlds share, and the values of what is batched."""
        objects: dict[int, ObjectModel] = {id(play.obj): play.obj for play in plays}
        largest = max(objects.values(), key=lambda obj: len(_hulls(obj)))
        spec = build_scene(largest, plays[0].physics, plays[0].tool, "tool", self.timestep, coordinates)
        # Warp never resets a world, so it has no such flag.
        spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        for number, obj in enumerate(objects.values()):
            for k, shape in enumerate(_hulls(obj)):
                spec.add_mesh(
                    name=f"{number}_{k}", uservert=np.asarray(shape.vertices, dtype=np.float32).ravel()
                )
        template = spec.compile()
        # The table comes first, then the pieces, then the tool.
        shapes = template.ngeom
        values: dict[str, list[np.ndarray]] = {name: [] for name in (*BATCHED, *GEOM_FIELDS)}
        numbers = {key: number for number, key in enumerate(objects)}
        for play in plays:
            model = self._compiled(play.obj, play.physics, play.tool, coordinates)
            count = len(_hulls(play.obj))
            missing = shapes - model.ngeom
            for name in BATCHED:
                values[name].append(np.array(getattr(model, name)))
            for name in GEOM_FIELDS:
                own = np.array(getattr(model, name))
                if name == "geom_dataid":
                    own[1 : 1 + count] = [
                        template.mesh(f"{numbers[id(play.obj)]}_{k}").id for k in range(count)
                    ]
                filler = (
                    np.repeat(own[1:2], missing, axis=0) if name != "geom_dataid" else np.full(missing, -1)
                )
                values[name].append(np.concatenate([own[: 1 + count], filler, own[1 + count :]]))
        stacked = {name: np.stack(rows) for name, rows in values.items()}
        stacked["geom_aabb"] = stacked["geom_aabb"].reshape(len(plays), shapes, 2, 3)
        return template, {
            name: rows if rows.dtype.kind == "i" else rows.astype(np.float32)
            for name, rows in stacked.items()
        }


def _hulls(obj: ObjectModel) -> list[HullShape]:
    """The convex pieces of an object, if it has no others."""
    hulls = [shape for shape in obj.collision_shapes() if isinstance(shape, HullShape)]
    if obj.is_round or len(hulls) < len(obj.collision_shapes()):
        raise SimulationError(
            f"engine 'warp' cannot play a {type(obj).__name__}, which has round surfaces: take engine 'mujoco'"
        )
    return hulls
