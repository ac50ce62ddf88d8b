"""Reinforcement learning against planning: run with ``python learn_by_trial.py [STEPS] [EPISODES]``.

PPO (``pip install stable-baselines3``) levers up objects for minutes. Then it and others face the same unseen objects.
"""

import json
import sys

import gymnasium
import numpy as np
from stable_baselines3 import PPO

import foretrace as ft
from foretrace.environment import LeverUpEnv, observed_view

DIRECTIONS, FIRST_UNSEEN = 36, 1_000_000


class Outline(gymnasium.ObservationWrapper):
    """The view as distances of the outline from its middle, in 36 directions [dm]: enough for a small network."""

    def __init__(self, env: LeverUpEnv) -> None:
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(0.0, 10.0, (DIRECTIONS,), np.float32)

    def observation(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        outline = observed_view(observation).contour()
        points = outline - outline.mean(axis=0)
        sector = np.floor(np.arctan2(points[:, 1], points[:, 0]) * DIRECTIONS / (2 * np.pi)).astype(int)
        far = np.zeros(DIRECTIONS, np.float32)
        np.maximum.at(far, sector % DIRECTIONS, 10 * np.linalg.norm(points, axis=1))
        return far


def main() -> None:
    steps, episodes = (
        int(sys.argv[k]) if len(sys.argv) > k else default for k, default in ((1, 8192), (2, 100))
    )
    env = LeverUpEnv(ft.goals.Lift())
    learner = PPO(
        "MlpPolicy", Outline(env), n_steps=256, batch_size=64, learning_rate=1e-3, gamma=0.0, seed=0
    )
    learner.learn(steps)
    outline = Outline(env)
    agents = {
        "random": lambda seen: env.action_space.sample(),
        "the far side, straight in": lambda seen: np.array([-1.0, 0.0], np.float32),
        "PPO": lambda seen: learner.predict(outline.observation(seen), deterministic=True)[0],
        "planner": lambda seen: env.action_of(ft.plan(observed_view(seen), env.goal)),
    }
    env.action_space.seed(0)
    rewards = {name: [] for name in agents}
    for episode in range(episodes):
        for name, agent in agents.items():
            seen, _ = env.reset(seed=FIRST_UNSEEN + episode)
            rewards[name].append(env.step(agent(seen))[1])
    print(json.dumps({name: round(float(np.mean(values)), 4) for name, values in rewards.items()}))


main()
