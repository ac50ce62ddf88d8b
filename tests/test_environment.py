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
    camera = made.episode.camera
    turn = camera.T_action_object[:2, :2]
    contact = np.array(info["contact"]) @ turn + camera.contact
    again = ft.simulate(BOX, ft.LeverUp.nearest(BOX, contact), embodiment="tool").effect
    rise = again.com_trajectory[-1, 2] - again.com_trajectory[0, 2]
    if info["outcome"] == "levered":
        assert reward == pytest.approx(10 * rise, abs=0.02)
    else:
        assert reward == 0


def test_several_steps_earn_by_how_much_nearer_the_goal_each_brings():
    """Rewards add up to the fall of the cost; the view shows the object as it lies, the camera stays."""
    made = environment.LeverUpEnv(ft.goals.Move((1.0, 0.0)), steps=3)
    seen, _ = made.reset(seed=2, options={"object": BOX})
    com = np.append(environment.observed_view(seen).contour().mean(axis=0), 0.0)
    total, ends = 0.0, []
    for _ in range(3):
        before = seen["mask"]
        seen, reward, ended, cut, info = made.step(np.array([-0.9, 0.0], dtype=np.float32))
        total += reward
        ends.append((ended, cut))
        assert (seen["mask"] != before).any(), "the object has moved in the view"
        moved = info["T_start_now"] @ np.append(com, 1.0)
        middle = environment.observed_view(seen).contour().mean(axis=0)
        np.testing.assert_allclose(moved[:2], middle, atol=0.003)
        if ended or cut:
            break
    assert total == pytest.approx(-info["cost"], abs=1e-6), "at the start, the object has not moved"
    assert info["reached"] == ended
    assert ends[-1] == (ended, made.episode.steps == 3 and not ended)
    assert not any(any(each) for each in ends[:-1])
    with pytest.raises(PlanningError, match="call reset"):
        made.step(np.zeros(2, dtype=np.float32))


def test_an_episode_goes_on_after_a_contact_that_no_blade_gets_to_and_is_cut_off():
    made = gymnasium.make("foretrace/LeverUp-v1", goal=ft.goals.Turn(1.5), steps=2, render_mode="rgb_array")
    made.reset(seed=0)
    env = made.unwrapped
    within = env.episode.scene.outline.mean(axis=0)
    env.lever_up = lambda action: ft.LeverUp(within, (1.0, 0.0))
    found = [made.step(np.zeros(2, dtype=np.float32)) for _ in range(2)]
    assert [each[1:4] for each in found] == [(-1.0, False, False), (-1.0, False, True)]
    assert made.render().shape == (384, 384, 3)


def test_an_episode_ends_where_the_object_lies_on_another_side():
    made = environment.LeverUpEnv(ft.goals.Move((1.0, 0.0)), steps=5)
    made.reset(seed=0, options={"object": ft.Box(0.05, 0.04, 0.1)})
    for _ in range(5):
        _, _, ended, _, info = made.step(np.array([0.0, 0.0], dtype=np.float32))
        if ended:
            break
    assert "another side" in info["lost"]


def test_a_function_of_motions_is_never_reached():
    """It has costs alone, so an episode lasts until it is cut off."""
    made = environment.LeverUpEnv(lambda motions: -motions.shift[..., 0], steps=2)
    made.reset(seed=2, options={"object": BOX})
    found = [made.step(np.array([-0.9, 0.0], dtype=np.float32)) for _ in range(2)]
    assert [each[2:4] for each in found] == [(False, False), (False, True)]
    assert not any(each[4]["reached"] for each in found)


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
        (lambda: environment.LeverUpEnv(steps=0), "steps is 0: give a whole number from 1 to 20"),
        (lambda: environment.LeverUpEnv(ft.goals.Learn()), "about what is believed"),
        (lambda: environment.ImaginedCost(ft.goals.Lift() + ft.goals.Learn()), "about what is believed"),
        (lambda: unchecked("reset")(_after_reset(), options=["cup"]), "options of type list"),
        (lambda: unchecked("lever_up")(_after_reset(), "left"), "the action is 'left': give"),
        (
            lambda: environment.LeverUpEnv(ft.goals.MoveTo((5, 5))).reset(options={"object": BOX}),
            "cannot be taken: .* outside what one view shows",
        ),
        (
            lambda: environment.LeverUpEnv(ft.goals.KeepUpright(), steps=2).reset(options={"object": BOX}),
            r"the goal KeepUpright\(\) is reached already",
        ),
        (lambda: environment.LeverUpEnv(steps=3), "a goal about where it lies"),
    ],
)
def test_mistakes_are_told_in_one_line(make, message):
    with pytest.raises(PlanningError, match=message):
        make()


def unchecked(name):
    """A method without the tests' checks of types."""
    method = getattr(environment.LeverUpEnv, name)
    return getattr(method, "__wrapped__", method)


def _after_reset():
    made = environment.LeverUpEnv()
    made.reset(seed=0)
    return made


def test_imagined_costs_are_minus_the_rewards_that_are_expected():
    made, cost = environment.LeverUpEnv(), environment.ImaginedCost()
    seen, _ = made.reset(seed=0, options={"object": BOX})
    actions = np.random.default_rng(0).uniform(-1, 1, (1, 24, 1, 2)).astype(np.float32)
    found = cost.get_cost({name: values[None, None] for name, values in seen.items()}, actions)
    assert found.shape == (1, 24)
    best, worst = found[0].argmin(), found[0].argmax()
    rewards = []
    for k in (best, worst):
        made.reset(seed=0, options={"object": BOX})
        rewards.append(made.step(actions[0, k, 0])[1])
    with pytest.raises(PlanningError, match="call reset"):
        made.step(actions[0, 0, 0])
    assert rewards[0] > rewards[1]
    assert -found[0, best] == pytest.approx(rewards[0], abs=0.15)
    torch = pytest.importorskip("torch")
    tensors = {name: torch.as_tensor(values)[None] for name, values in seen.items()}
    again = cost.get_cost(tensors, torch.as_tensor(actions[:, :, 0]))
    assert isinstance(again, torch.Tensor)
    np.testing.assert_allclose(again.numpy(), found, atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "views", "wanted"),
    [
        ((1, 4, 2, 2), 1, "an episode has one action"),
        ((2, 4, 1, 2), 1, "not that of 2 environments"),
        ((1, 0, 1, 2), 1, "candidates are none"),
    ],
)
def test_costs_of_something_else_are_refused(shape, views, wanted):
    made = environment.LeverUpEnv()
    seen, _ = made.reset(seed=0, options={"object": BOX})
    info = {name: np.stack([values] * views) for name, values in seen.items()}
    with pytest.raises(PlanningError, match=wanted):
        environment.ImaginedCost().get_cost(info, np.zeros(shape))
