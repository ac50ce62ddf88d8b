"""Add an action of your own, a push with a rod, and record it: python examples/own_action.py FOLDER."""

import sys
from dataclasses import dataclass, field, replace

import numpy as np

import foretrace as ft
from foretrace.actions import Judgement, Motion, Rod, minimum_jerk
from foretrace.simulation.collect import trial


@dataclass(frozen=True)
class PushPath:
    distance: float = 0.06  # past the contact [m]
    height: float = 0.008  # of the rod's tip above the table [m]
    speed: float = 0.08  # mean speed [m/s]


@dataclass(frozen=True, eq=False)
class Push(ft.Action):
    label, outcomes = "push", ("pushed", "toppled", "missed")
    path: PushPath = PushPath()
    tool: Rod = field(default_factory=Rod)

    @property
    def duration(self) -> float:
        return 0.5 + self.path.distance / self.path.speed

    def tool_motion(self, times: np.ndarray) -> np.ndarray:
        motion = np.zeros((len(times), 6))  # position, rotation vector
        motion[:, 0] = -self.tool.radius - 0.005
        motion[:, 0] += (self.path.distance + 0.005) * minimum_jerk((times - 0.1) / (self.duration - 0.3))
        motion[:, 2], motion[:, 4] = self.path.height, np.pi / 2  # the rod points down
        return motion

    def judge(self, motion: Motion, obj: ft.Prism, com: np.ndarray) -> Judgement:
        shift, rise = np.linalg.norm(com[-1] - com[0]), com[-1, 2] / com[0, 2]
        return Judgement("missed" if shift < 0.005 else "toppled" if rise > 1.1 else "pushed")

    def parameters(self) -> dict[str, float]:
        return {"distance": self.path.distance, "speed": self.path.speed}


def push_trial(config: ft.CollectConfig, id: int, engine: str = "mujoco") -> ft.Interaction:
    obj, lever_up, _ = trial(config, id)
    push = Push(lever_up.contact, lever_up.direction)
    return replace(ft.simulate(obj, push, engine=engine, embodiment="tool"), id=id)


if __name__ == "__main__":
    config, folder = ft.CollectConfig(objects=1, contacts_per_edge=1), sys.argv[1]
    ft.collect(config, folder, workers=1, simulate=push_trial)
    for stored in ft.Dataset.open(folder):
        same = np.array_equal(ft.replay(stored).effect.com_trajectory, stored.effect.com_trajectory)
        ways = [push_trial(config, stored.id, name).effect.com_trajectory for name in ("mujoco", "bullet")]
        mujoco, bullet = (100 * np.linalg.norm(way[-1] - way[0]) for way in ways)
        print(
            f"{stored.effect.outcome}, {mujoco:.2f} cm in MuJoCo, {bullet:.2f} in Bullet; same again: {same}"
        )
