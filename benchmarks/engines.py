"""MuJoCo against Bullet: the same lever-ups in both, and both against mechanics in closed form.

Usage: python benchmarks/engines.py [--lever-ups 200] [--out docs/results/engines.json]
"""

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np

from foretrace.geometry import quaternion_to_matrix
from foretrace.interactions.motions import ContactParameters
from foretrace.interactions.record import Effect, Outcome
from foretrace.objects.body import Body
from foretrace.simulation import tool
from foretrace.simulation.collect import CollectConfig, num_trials, trial
from foretrace.simulation.free_motion import simulate_free_motion
from foretrace.simulation.lever_up import SimulationConfig, make_engine, simulate_lever_up

G = 9.81
ENGINES = ("mujoco", "bullet")
LYING = [0.0, 0.0, 0.03, float(np.sqrt(0.5)), float(np.sqrt(0.5)), 0.0, 0.0]
"""A cylinder of 3 cm radius on its side, axis along -y."""
FLAT_BOX = Body.box((0.10, 0.08, 0.04), 0.3)
TALL_BOX = Body.box((0.06, 0.10, 0.12), 0.3)
CYLINDER = Body.cylinder(0.03, 0.10, 0.25)


def upright(height: float) -> list[float]:
    return [0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]


def incline(angle: float) -> tuple[float, float, float]:
    return (G * float(np.sin(angle)), 0.0, -G * float(np.cos(angle)))


def free_fall(engine: str, timestep: float) -> tuple[float, float]:
    """Depth after 0.4 s [m]."""
    motion = simulate_free_motion(FLAT_BOX, upright(1.0), 0.4, engine=engine, timestep=timestep)
    return 1.0 - float(motion.poses[-1, 2]), 0.5 * G * 0.4**2


def slide(engine: str, timestep: float, friction: float = 0.3, angle: float = 0.0) -> tuple[float, float]:
    """How far a box slides that starts at 1 m/s [m]."""
    velocity = [np.cos(angle), np.sin(angle), 0.0, 0.0, 0.0, 0.0]
    motion = simulate_free_motion(
        FLAT_BOX,
        upright(0.02),
        0.8,
        velocity=velocity,
        contact_parameters=ContactParameters(friction=friction),
        engine=engine,
        timestep=timestep,
    )
    return float(np.hypot(*motion.poses[-1, :2])), 1 / (2 * friction * G)


def slide_diagonally(engine: str, timestep: float) -> tuple[float, float]:
    """The same along the box's diagonal and with more friction: friction has no favoured direction."""
    return slide(engine, timestep, friction=0.8, angle=np.pi / 4)


def slide_down(engine: str, timestep: float) -> tuple[float, float]:
    """How far a box slides down an incline of 40 degrees in 0.5 s [m]."""
    angle = np.deg2rad(40)
    around = ContactParameters(friction=0.5, gravity=incline(angle))
    motion = simulate_free_motion(
        FLAT_BOX, upright(0.02), 0.5, contact_parameters=around, engine=engine, timestep=timestep
    )
    return float(motion.poses[-1, 0]), 0.125 * G * float(np.sin(angle) - 0.5 * np.cos(angle))


def critical_slope(moved: Callable[[float], bool], expected: float) -> float:
    """The slope, tan of the incline's angle, above which something happens: halving, to 1 % of what is expected."""
    low, high = 0.8 * expected, 1.2 * expected
    while high - low > 0.01 * expected:
        middle = (low + high) / 2
        low, high = (low, middle) if moved(float(np.arctan(middle))) else (middle, high)
    return (low + high) / 2


def friction_slope(engine: str, timestep: float) -> tuple[float, float]:
    """Slope at which a box begins to slide: the friction coefficient."""

    def moved(angle: float) -> bool:
        around = ContactParameters(friction=0.5, gravity=incline(angle))
        motion = simulate_free_motion(
            FLAT_BOX, upright(0.02), 1.0, contact_parameters=around, engine=engine, timestep=timestep
        )
        return motion.poses[-1, 0] > 0.005

    return critical_slope(moved, 0.5), 0.5


def tipping_slope(engine: str, timestep: float) -> tuple[float, float]:
    """Slope at which a box of 6 cm x 12 cm tips over: width by height."""

    def moved(angle: float) -> bool:
        around = ContactParameters(friction=2.0, gravity=incline(angle))
        motion = simulate_free_motion(
            TALL_BOX, upright(0.06), 1.5, contact_parameters=around, engine=engine, timestep=timestep
        )
        return abs(motion.poses[-1, 5]) > 0.2

    return critical_slope(moved, 0.5), 0.5


def roll_down(engine: str, timestep: float) -> tuple[float, float]:
    """Acceleration of a cylinder that rolls down an incline of 0.15 rad [m/s^2]."""
    around = ContactParameters(gravity=incline(0.15))
    motion = simulate_free_motion(
        CYLINDER, LYING, 1.0, contact_parameters=around, engine=engine, timestep=timestep
    )
    return 2 * float(motion.poses[-1, 0]), 2 / 3 * G * float(np.sin(0.15))


def roll_out(engine: str, timestep: float) -> tuple[float, float]:
    """How far a cylinder rolls that starts at 0.5 m/s against a lever arm of 3 mm [m]."""
    arm, around = 0.003, ContactParameters(rolling_friction=0.003)
    velocity = [0.5, 0.0, 0.0, 0.0, 0.5 / 0.03, 0.0]
    motion = simulate_free_motion(
        CYLINDER, LYING, 1.5, velocity=velocity, contact_parameters=around, engine=engine, timestep=timestep
    )
    return float(motion.poses[:, 0].max()), 0.5**2 / 2 / (2 / 3 * G * arm / 0.03)


def bounce(engine: str, timestep: float) -> tuple[float, float]:
    """Share of the speed that a cube keeps which falls by 20 cm, of restitution 0.5."""
    around, fall = ContactParameters(restitution=0.5), float(np.sqrt(2 * 0.2 / G))
    motion = simulate_free_motion(
        Body.box((0.04, 0.04, 0.04), 0.1),
        upright(0.22),
        0.6,
        contact_parameters=around,
        engine=engine,
        timestep=timestep,
    )
    rebound = motion.poses[motion.times > fall + 0.03, 2].max() - 0.02
    return float(np.sqrt(max(rebound, 0.0) / 0.2)), 0.5


def tumble(engine: str, timestep: float) -> tuple[float, float]:
    """Kinetic energy of a box that tumbled for 1 s without gravity, by its energy at the start."""
    velocity = [0.3, 0.0, 2.0, 3.0, 7.0, 2.0]
    around = ContactParameters(gravity=(0.0, 0.0, 0.0))
    body = Body.box((0.10, 0.06, 0.02), 0.3)
    motion = simulate_free_motion(
        body,
        upright(5.0),
        1.0,
        velocity=velocity,
        contact_parameters=around,
        engine=engine,
        timestep=timestep,
    )
    R, spin = quaternion_to_matrix(motion.poses[:, 3:]), motion.velocities[:, 3:]
    momentum = np.einsum("tij,jk,tlk,tl->ti", R, body.mass.inertia, R, spin)
    energy = (momentum * spin).sum(axis=1) / 2
    return float(energy[-1] / energy[0]), 1.0


CHECKS = (
    (free_fall, 0.01, 0.01),
    (slide, 0.01, 0.01),
    (slide_diagonally, 0.02, 0.02),
    (slide_down, 0.01, 0.02),
    (friction_slope, 0.02, 0.04),
    (tipping_slope, 0.02, 0.06),
    (roll_down, 0.01, 0.06),
    (roll_out, 0.01, 0.03),
    (bounce, 0.1, 0.25),
    (tumble, 0.02, 0.02),
)
"""Closed-form checks, and by what share MuJoCo and Bullet may miss the expected value with steps of 2 ms."""


def run_checks(engine: str, timestep: float) -> dict[str, dict[str, float]]:
    rows = {}
    for check, *_ in CHECKS:
        measured, expected = check(engine, timestep)
        rows[check.__name__] = {"expected": expected, "measured": measured, "ratio": measured / expected}
    return rows


def play(engine: str, ids: list[int]) -> tuple[list[Effect], float]:
    """The lever-ups' effects, and the mean time of one [s]."""
    config = CollectConfig(simulation=SimulationConfig(engine=engine, embodiment="tool"))
    effects, spent = [], 0.0
    for id in ids:
        obj, action, _ = trial(config, id)
        begun = time.process_time()
        effects.append(simulate_lever_up(obj, action, config.simulation).effect)
        spent += time.process_time() - begun
    return effects, spent / len(ids)


def distances(pairs: list[tuple[Effect, Effect]]) -> dict[str, float]:
    """Mean distance of the two centre-of-mass trajectories [mm], and of their ends."""
    if not pairs:
        return {"number": 0}
    apart = [1e3 * np.linalg.norm(a.com_trajectory - b.com_trajectory, axis=1) for a, b in pairs]
    mean, last = np.array([path.mean() for path in apart]), np.array([path[-1] for path in apart])
    result = {"number": len(pairs)}
    for name, values in (("trajectory", mean), ("final", last)):
        result |= {
            f"{name}_mean_mm": float(values.mean()),
            f"{name}_median_mm": float(np.median(values)),
            f"{name}_p95_mm": float(np.percentile(values, 95)),
        }
    return result


def play_without_touch_margin(ids: list[int]) -> list[Effect]:
    """MuJoCo's effects with a blade that acts where it touches, as Bullet's, and not from a millimetre away."""
    margin, tool.TOUCH_MARGIN = tool.TOUCH_MARGIN, 0.0
    make_engine.cache_clear()
    try:
        return play("mujoco", ids)[0]
    finally:
        tool.TOUCH_MARGIN = margin
        make_engine.cache_clear()


def levered_in_both(pairs: list[tuple[Effect, Effect]]) -> list[tuple[Effect, Effect]]:
    return [(a, b) for a, b in pairs if a.outcome == b.outcome == Outcome.LEVERED]


def compare_lever_ups(number: int) -> dict[str, object]:
    """Trials of the paper's 2080, evenly spaced, with the tool alone."""
    config = CollectConfig()
    ids = np.linspace(0, num_trials(config) - 1, number).round().astype(int).tolist()
    corners = [len(trial(config, id)[0].corners) for id in ids]
    (first, first_time), (second, second_time) = (play(engine, ids) for engine in ENGINES)
    pairs = list(zip(first, second, strict=True))
    confusion = Counter(f"{a.outcome} in {ENGINES[0]}, {b.outcome} in {ENGINES[1]}" for a, b in pairs)
    both = levered_in_both(pairs)
    thin = list(zip(play_without_touch_margin(ids), second, strict=True))
    return {
        "lever_ups": number,
        "ids": "evenly spaced over the 2080 trials of seed 0",
        "outcomes": dict(confusion.most_common()),
        "same_outcome": float(np.mean([a.outcome == b.outcome for a, b in pairs])),
        "same_support_corners": float(np.mean([a.support_corners == b.support_corners for a, b in pairs])),
        "same_support_corners_levered": float(
            np.mean([a.support_corners == b.support_corners for a, b in both])
        ),
        "levered_in_both": distances(both),
        "levered_in_both_without_touch_margin": distances(levered_in_both(thin)),
        "levered_in_both_by_corners": {
            str(n): distances(
                levered_in_both([pair for pair, count in zip(pairs, corners, strict=True) if count == n])
            )
            for n in sorted(set(corners))
        },
        "largest_path_error_mm": {
            engine: 1e3 * max(effect.path_error for effect in effects)
            for engine, effects in zip(ENGINES, (first, second), strict=True)
        },
        "cpu_seconds_each": {ENGINES[0]: first_time, ENGINES[1]: second_time},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lever-ups", type=int, default=200, help="how many lever-ups are compared")
    parser.add_argument("--out", type=Path, help="JSON file to write the figures to")
    arguments = parser.parse_args()
    checks = {
        f"{1e3 * timestep:g} ms": {engine: run_checks(engine, timestep) for engine in ENGINES}
        for timestep in (0.002, 0.001)
    }
    result = {
        "command": " ".join(["python", *sys.argv]),
        "seed": CollectConfig().seed,
        "versions": {name: version(name) for name in ("foretrace", "mujoco", "pybullet")},
        "closed_form": checks,
        "lever_ups": compare_lever_ups(arguments.lever_ups),
    }
    text = json.dumps(result, indent=2)
    print(text)
    if arguments.out:
        arguments.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
