"""The Gymnasium environment: its contract, its rewards, and that a planner is better than chance there."""

import numpy as np
import pytest

import foretrace as ft
from foretrace.errors import PlanningError

gymnasium = pytest.importorskip("gymnasium")
environment = pytest.importorskip("foretrace.environment")
BOX = ft.Box(0.2, 0.1, 0.02)


def test_contract():
    from gymnasium.utils.env_checker import check_env

    for settings in ({}, {"vary_path": True, "randomise": True}):
        made = gymnasium.make("foretrace/LeverUp-v1", render_mode="rgb_array", **settings)
        check_env(made.unwrapped, skip_render_check=True)
        assert made.unwrapped.render().shape == (384, 384, 3)


def test_environments_side_by_side():
    made = gymnasium.make_vec("foretrace/LeverUp-v1", num_envs=2, vectorization_mode="sync")
    seen, _ = made.reset(seed=3)
    assert seen["mask"].shape == (2, 128, 128)
    assert not (seen["mask"][0] == seen["mask"][1]).all()
    _, rewards, over, cut, _ = made.step(np.zeros((2, 2), dtype=np.float32))
    assert np.isfinite(rewards).all()
    assert over.all()
    assert not cut.any()


def test_same_seed_same_episode():
    found = []
    for _ in range(2):
        made = environment.LeverUpEnv(randomise=True)
        seen, _ = made.reset(seed=7)
        found.append((seen, made.step(np.array([0.3, 0.1], dtype=np.float32))[1]))
    (one, first), (other, second) = found
    assert first == second
    assert all((one[name] == other[name]).all() for name in one)


def test_reward_is_what_the_goal_makes_of_what_is_simulated():
    made = environment.LeverUpEnv(goal=ft.goals.Lift(max_slip=None))
    made.reset(seed=0, options={"object": BOX})
    _, reward, over, _, info = made.step(np.array([0.0, 0.0], dtype=np.float32))
    assert over
    assert info["free"]
    _, camera, _, _ = made._drawn
    turn = camera.T_action_object[:2, :2]
    contact = np.array(info["contact"]) @ turn + camera.contact
    again = ft.simulate(BOX, ft.LeverUp.nearest(BOX, contact), embodiment="tool").effect
    rise = again.com_trajectory[-1, 2] - again.com_trajectory[0, 2]
    if info["outcome"] == "levered":
        assert reward == pytest.approx(10 * rise, abs=0.02)
    else:
        assert reward == 0


def triangle(rng):
    return ft.sample_prism(rng, 3)


def test_what_must_not_happen_costs_one():
    never, punished = (
        environment.LeverUpEnv(ft.goals.Lift(max_slip=most), triangle) for most in (None, 0.05)
    )
    differences = []
    for seed in range(8):
        rewards = []
        for made in (never, punished):
            made.reset(seed=seed)
            _, reward, _, _, info = made.step(np.array([0.4, 0.0], dtype=np.float32))
            rewards.append(reward)
        differences.append(rewards[0] - rewards[1])
        assert differences[-1] == len(info.get("broken", []))
    assert set(differences) == {0, 1}


def test_a_plan_is_the_action_that_it_means():
    """The planner's contact comes back from the environment's action, and earns more than chance."""
    made = environment.LeverUpEnv()
    rng = np.random.default_rng(0)
    planned, chance = [], []
    for seed in range(6):
        seen, _ = made.reset(seed=seed)
        view = environment.observed_view(seen)
        found = ft.plan(view, ft.goals.Lift(), config=ft.PlanConfig(check=0))
        action = made.action_of(found)
        assert np.linalg.norm(made.lever_up(action).contact - found.action.contact) < 0.004
        planned.append(made.step(action)[1])
        made.reset(seed=seed)
        chance.append(made.step(rng.uniform(-1, 1, 2).astype(np.float32))[1])
    assert np.mean(planned) > np.mean(chance) + 0.1
    assert environment.observed_context(seen)["friction"] == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: environment.LeverUpEnv(render_mode="film"), "choose rgb_array"),
        (lambda: environment.LeverUpEnv().step(np.zeros(2, np.float32)), "call reset first"),
        (lambda: _after_reset().step(np.zeros(3, np.float32)), "finite numbers"),
        (lambda: _after_reset().step(np.full(2, np.nan, np.float32)), "finite numbers"),
        (lambda: environment.LeverUpEnv().reset(options={"object": 3}), "object of type int"),
    ],
)
def test_mistakes_are_told_in_one_line(make, message):
    with pytest.raises(PlanningError, match=message):
        make()


def _after_reset():
    made = environment.LeverUpEnv()
    made.reset(seed=0)
    return made
