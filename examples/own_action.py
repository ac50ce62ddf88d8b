"""Add an action of your own, and record it (extras sim and bullet). Usage: python examples/own_action.py FOLDER."""

import sys
from dataclasses import dataclass, field

import numpy as np

import foretrace as ft
from foretrace.actions import Judgement, Motion, Rod, minimum_jerk
from foretrace.simulation.recipes import RECIPES, Families


@dataclass(frozen=True)
class NudgePath:
    distance: float = 0.06  # past the contact [m]
    height: float = 0.008  # of the rod's tip above the table [m]
    speed: float = 0.08  # mean speed [m/s]


@dataclass(frozen=True, eq=False)
class Nudge(ft.Action):  # with a rod
    label, outcomes = "nudge", ("nudged", "toppled", "missed")
    path: NudgePath = NudgePath()
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
        return Judgement("missed" if shift < 0.005 else "toppled" if rise > 1.1 else "nudged")

    def parameters(self) -> dict[str, float]:
        return {"distance": self.path.distance, "speed": self.path.speed}


class Nudges(Families):  # of the paper's objects, where it levers them
    def make(self, seed: int, object_index: int, per_edge: int) -> tuple[ft.Prism, list[Nudge]]:
        obj, lever_ups = super().make(seed, object_index, per_edge)
        return obj, [Nudge(each.contact, each.direction) for each in lever_ups]


if __name__ == "__main__":
    folder = sys.argv[1] if len(sys.argv) == 2 else sys.exit(__doc__)
    RECIPES.add("nudges", Nudges(("prism",)))  # in a package: an entry point of the group foretrace.recipes
    ft.collect(ft.CollectConfig(1, 1, 0, ft.SimulationConfig(embodiment="tool"), "nudges"), folder, workers=1)
    for stored in ft.Dataset.open(folder):
        same = np.array_equal(ft.replay(stored).effect.com_trajectory, stored.effect.com_trajectory)
        again = ft.simulate(stored.object, stored.action, engine="bullet", embodiment="tool")
        ways = (each.effect.com_trajectory for each in (stored, again))
        mujoco, bullet = (f"{100 * np.linalg.norm(way[-1] - way[0]):.2f}" for way in ways)
        print(f"{stored.effect.outcome}, {mujoco} cm in MuJoCo, {bullet} in Bullet; same again: {same}")
