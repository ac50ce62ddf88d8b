"""Write example recordings: a box that tips over an edge and a cylinder that rolls, simulated and seen with noise.

They show the format. Being simulated, they say nothing about how well the simulation agrees with reality.

Usage: python examples/replay_recording/make_recordings.py [recordings.json]
"""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from foretrace.interactions.motions import ContactParameters
from foretrace.objects.body import Body
from foretrace.simulation.free_motion import simulate_free_motion

SEED = 3
FRAME_RATE = 60.0
POSITION_NOISE = 0.0003
"""Standard deviation of a marker tracker's positions [m]."""
ROTATION_NOISE = np.deg2rad(0.2)


def record(name: str, geometry: dict, body: Body, pose: list, velocity: list | None, duration: float) -> dict:
    rng = np.random.default_rng([SEED, len(name)])
    around = ContactParameters(friction=0.6, restitution=0.1)
    speed = [0.0] * 6 if velocity is None else velocity
    motion = simulate_free_motion(
        body, pose, duration, velocity=speed, contact_parameters=around, timestep=0.0005
    ).at(np.arange(round(duration * FRAME_RATE) + 1) / FRAME_RATE)
    poses = motion.poses.copy()
    poses[:, :3] += rng.normal(0, POSITION_NOISE, (len(poses), 3))
    turns = Rotation.from_rotvec(rng.normal(0, ROTATION_NOISE, (len(poses), 3)))
    seen = (turns * Rotation.from_quat(poses[:, 3:], scalar_first=True)).as_quat(scalar_first=True)
    poses[:, 3:] = seen * np.sign((seen * motion.poses[:, 3:]).sum(axis=1))[:, None]
    entry = {"name": name, "source": f"simulated by foretrace with noise, seed {SEED}", "object": geometry}
    entry |= {"mass": body.mass.mass, "friction": around.friction, "restitution": around.restitution}
    if velocity is not None:
        entry |= {"linear_velocity": velocity[:3], "angular_velocity": velocity[3:]}
    return entry | {"times": motion.times.round(6).tolist(), "poses": poses.round(6).tolist()}


def main() -> None:
    tilt = np.deg2rad(40)  # over its edge: a box of this shape balances at 31 degrees
    size = (0.06, 0.10, 0.10)
    height = 0.03 * float(np.sin(tilt)) + 0.05 * float(np.cos(tilt))
    box_pose = [0.0, 0.0, height, np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0]
    half = float(np.sqrt(0.5))
    tipped = record(
        "box tipped over", {"kind": "box", "size": size}, Body.box(size, 0.3), box_pose, [0.0] * 6, 1.0
    )
    round_body, lying = (
        {"kind": "cylinder", "radius": 0.03, "length": 0.08},
        [0.0, 0.0, 0.03, half, half, 0, 0],
    )
    rolled = record(
        "cylinder rolled", round_body, Body.cylinder(0.03, 0.08, 0.2), lying, [0.3, 0, 0, 0, 10, 0], 1.0
    )
    del rolled["linear_velocity"], rolled["angular_velocity"]  # to be estimated from the first frames
    content = {
        "format": "foretrace-motion",
        "version": 1,
        "units": "m, kg, s",
        "recordings": [tipped, rolled],
    }
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("recordings.json")
    out.write_text(json.dumps(content) + "\n", encoding="utf-8")
    print(f"{out}: {len(content['recordings'])} recordings")


if __name__ == "__main__":
    main()
