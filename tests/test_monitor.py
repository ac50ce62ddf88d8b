"""The monitor: bands, transitions, frames, gaps, clocks and bad input; worlds of a belief."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import foretrace as ft
from foretrace.cli import main
from foretrace.errors import MonitoringError, PredictionError
from foretrace.experiments.executions import make_execution
from foretrace.experiments.monitor_calibration import imagine
from foretrace.geometry import matrix_to_pose, pose_to_matrix, rotation_vector_to_quaternion
from foretrace.imagined import LEVELS, Futures, ImaginedEffect
from foretrace.imagined.belief import NOMINAL_BEVEL
from foretrace.interactions.dataset import Dataset
from foretrace.monitoring import Drift, MonitorCalibration, Verdict
from foretrace.monitoring.causes import BAD_INPUT, FROZEN, LOST, CauseModel
from foretrace.monitoring.motions import motions_of, place_of
from foretrace.pictures.scene import Scene
from foretrace.pictures.watched import MOST, _evenly, monitor_figure, monitor_film
from foretrace.simulation.collect import CollectConfig, collect
from foretrace.simulation.lever_up import SimulationConfig

TIMES = 0.05 * np.arange(60)
COM = np.array([0.08, 0.004, 0.01])
CALIBRATION = MonitorCalibration.of(np.linspace(0.1, 2.0, 200))
PRISM = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])
ACTION = ft.LeverUp.at_edge(PRISM, edge=2)


def states(lift: float, slip: float = np.inf) -> np.ndarray:
    """(time, 6) A lift by a height, dropped at a time."""
    phase = np.clip((TIMES - 0.5) / 1.5, 0, 1)
    phase = phase**2 * (3 - 2 * phase) * (1 - np.clip((TIMES - slip) / 0.15, 0, 1))
    moved = np.zeros((len(TIMES), 6))
    moved[:, :3] = COM + np.outer(phase, [0.01, 0.0, lift])
    moved[:, 4] = -phase * lift / 0.1
    return moved


LIFT = states(0.05)
SLIP = states(0.05, slip=1.2)


def imagined(slips: float = 0.2) -> ImaginedEffect:
    both = np.stack([LIFT, SLIP])[None]
    futures = Futures(
        np.array([[1 - slips, slips]]),
        ("levered", "slipped"),
        both,
        np.full(both.shape[:3], 0.001),
        np.full((1, 2, 2, 2), np.nan),
        np.linspace(1, 3, len(LEVELS)),
    )
    pose = np.concatenate([LIFT[:, :3], rotation_vector_to_quaternion(LIFT[:, 3:])], axis=1)
    return ImaginedEffect(TIMES, LIFT[:, :3], pose, futures)


def poses(motion: np.ndarray, T_com_object: np.ndarray | None = None) -> np.ndarray:
    """(time, 7) Poses of an object frame that is carried along."""
    found = np.concatenate([motion[:, :3], rotation_vector_to_quaternion(motion[:, 3:])], axis=1)
    return found if T_com_object is None else matrix_to_pose(pose_to_matrix(found) @ T_com_object)


def noisy(found: np.ndarray, seed: int = 0) -> np.ndarray:
    moved = found.copy()
    moved[:, :3] += np.random.default_rng(seed).normal(scale=3e-4, size=(len(found), 3))
    return moved


def watch(monitor: ft.Monitor, found, times=TIMES) -> list[ft.Verdict]:
    return [monitor.update(float(t), pose) for t, pose in zip(times, found, strict=True)]


def monitor(effect: ImaginedEffect | None = None, **options) -> ft.Monitor:
    return ft.Monitor(effect or imagined(), calibration=CALIBRATION, **options)


def test_a_motion_as_imagined_raises_no_alarm():
    verdicts = watch(monitor(), noisy(poses(LIFT)))
    assert not any(each.alarm or each.transition for each in verdicts)
    scores = [each.score for each in verdicts]
    assert scores == sorted(scores)
    assert verdicts[-1].score < 1
    assert verdicts[-1].outcomes["levered"] > 0.99
    assert verdicts[-1].rest is None
    assert verdicts[-1].message == "as imagined"


def test_an_object_that_lies_still_while_it_should_rise_alarms():
    still = np.tile(LIFT[:1], (len(TIMES), 1))
    verdicts = watch(monitor(), noisy(poses(still)))
    first = next(k for k, each in enumerate(verdicts) if each.alarm)
    assert np.linalg.norm(LIFT[first, :3] - COM) < 0.02
    assert verdicts[-1].alarm
    assert verdicts[first].cause is not None
    assert not verdicts[first].transition


def test_turning_alone_is_seen():
    turned = LIFT.copy()
    turned[:, 5] += 0.3 * np.clip(TIMES - 1.0, 0, 1)
    assert watch(monitor(), noisy(poses(turned)))[-1].alarm


def test_a_slip_that_was_foreseen_is_a_transition_and_not_an_alarm():
    verdicts = watch(monitor(), noisy(poses(SLIP)))
    assert not verdicts[-1].alarm
    assert verdicts[-1].transition
    assert verdicts[-1].outcomes["slipped"] > 0.99
    assert "slipped" in verdicts[-1].message
    unforeseen = watch(monitor(imagined(slips=0.01)), noisy(poses(SLIP)))
    assert unforeseen[-1].alarm


def test_the_object_frame_does_not_matter():
    T_com_object = pose_to_matrix(
        np.array([0.03, -0.02, 0.01, *rotation_vector_to_quaternion(np.array([0.2, 0.5, 2.0]))])
    )
    plain, other = (watch(monitor(), poses(SLIP, T))[-1] for T in (None, T_com_object))
    assert plain.score == pytest.approx(other.score, abs=1e-5)


def test_poses_in_the_table_frame():
    T_table_action = pose_to_matrix(
        np.array([0.5, 0.2, 0.0, *rotation_vector_to_quaternion(np.array([0, 0, 1.1]))])
    )
    tracked = matrix_to_pose(T_table_action @ pose_to_matrix(noisy(poses(LIFT))))
    inside = watch(monitor(T_table_action=T_table_action), tracked)[-1]
    assert inside.score == pytest.approx(watch(monitor(), noisy(poses(LIFT)))[-1].score, abs=1e-6)
    with pytest.raises(MonitoringError, match=r"the first pose lies 5\d\.\d cm from the centre of mass"):
        watch(monitor(), tracked)


def test_other_sampling_rates_and_gaps():
    fine = np.arange(0, 2.95, 0.01)
    dense = np.column_stack([np.interp(fine, TIMES, each) for each in LIFT.T])
    assert watch(monitor(), noisy(poses(dense)), fine)[-1].score < 1
    gaps = [None if 20 <= k < 28 else pose for k, pose in enumerate(noisy(poses(LIFT)))]
    assert not watch(monitor(), gaps)[-1].alarm
    lost = [None if k >= 20 else pose for k, pose in enumerate(noisy(poses(LIFT)))]
    verdicts = watch(monitor(), lost)
    assert verdicts[-1].cause == LOST
    assert not verdicts[28].alarm


def test_a_late_start_needs_the_pose_at_rest():
    tracked = noisy(poses(LIFT))
    with pytest.raises(MonitoringError, match="give the pose at rest"):
        watch(monitor(), tracked[30:], TIMES[30:])
    verdicts = watch(monitor(rest=poses(LIFT)[0]), tracked[30:], TIMES[30:])
    assert not verdicts[-1].alarm
    with pytest.raises(MonitoringError, match=r"the first pose is 3\.0 cm and 0 degrees away"):
        watch(monitor(rest=poses(LIFT)[0] + [0.03, 0, 0, 0, 0, 0, 0]), tracked)


def test_clocks_that_differ():
    late = np.column_stack([np.interp(TIMES - 0.2, TIMES, each) for each in LIFT.T])
    told, untold = (watch(monitor(clock_error=each), noisy(poses(late)))[-1] for each in (0.25, 0.0))
    assert told.score < 0.5 * untold.score


def test_a_frozen_tracker_is_named():
    frozen = noisy(poses(LIFT))
    frozen[25:] = frozen[25]
    verdicts = watch(monitor(), frozen)
    first = next(k for k, each in enumerate(verdicts) if each.cause == FROZEN)
    assert first <= 30
    resting = np.tile(noisy(poses(LIFT))[:1], (8, 1))  # equal poses at rest are no fault
    assert not watch(monitor(), resting, TIMES[:8])[-1].alarm


BAD = {
    "NaN": (1.0, [np.nan, 0, 0, 1, 0, 0, 0], "not finite"),
    "off unit": (1.0, [*COM, 1.0, 0.5, 0, 0], "length 1.118, not 1"),
    "millimetres": (1.0, [105.0, 0, 20.0, 1000.0, 0, 0, 0], "the position lies 106.9 m from the origin"),
    "back in time": (0.2, [*COM, 1.0, 0, 0, 0], "times must rise: 0.2 s follows 0.45 s"),
    "no time": (np.nan, [*COM, 1.0, 0, 0, 0], "the time is nan"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_pose_alarms_for_good(name):
    watched = monitor()
    watch(watched, noisy(poses(LIFT))[:10], TIMES[:10])
    t, pose, words = BAD[name]
    verdict = watched.update(t, pose)
    assert verdict.alarm
    assert verdict.cause == BAD_INPUT
    assert words in verdict.message
    assert "\n" not in verdict.message
    assert watched.update(2.0, noisy(poses(LIFT))[40]).alarm


WRONG = {
    "pose": lambda: monitor().update(0.0, "here"),
    "six numbers": lambda: monitor().update(0.0, np.zeros(6)),
    "effect": lambda: ft.Monitor(3),
    "false alarms": lambda: ft.Monitor(imagined(), 0.0),
    "missing": lambda: ft.Monitor(imagined(), calibration="/nowhere/calibration.json"),
    "transform": lambda: monitor(T_table_action=np.ones((4, 4))),
    "clock": lambda: monitor(clock_error=-1.0),
    "rest": lambda: monitor(rest=[0] * 7),
    "positions": lambda: monitor(
        replace(imagined(), futures=Futures.point(LIFT[None, :, :3], None, "levered"))
    ),
    "scores": lambda: MonitorCalibration.of([np.nan]),
    "few": lambda: ft.Monitor(imagined(), 0.01, calibration=MonitorCalibration.of([1.0] * 20)),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_used_is_refused_in_a_line(name):
    with pytest.raises(MonitoringError) as caught:
        WRONG[name]()
    assert "\n" not in str(caught.value)
    assert ":" in str(caught.value)


def test_a_plan_is_watched_by_what_it_imagined():
    class Plan:
        imagined = imagined()

    assert watch(monitor(Plan()), noisy(poses(LIFT)))[-1].score < 1


def test_the_rest_keeps_an_offset_and_has_regions():
    off = LIFT.copy()
    off[:, 0] += 0.002 * np.clip((TIMES - 0.5) / 0.3, 0, 1)
    calibration = MonitorCalibration.of(np.linspace(0.1, 5, 200), np.linspace(0.1, 3, 200))
    watched = ft.Monitor(imagined(), calibration=calibration)
    verdict = watch(watched, poses(off)[:30], TIMES[:30])[-1]
    rest = verdict.rest
    assert rest is not None
    np.testing.assert_allclose(rest.times, TIMES[30:])
    np.testing.assert_allclose(rest.com_trajectory, off[30:, :3], atol=2e-4)
    assert np.isfinite(rest.futures.radius(0.9)[0, 0]).all()
    futures = verdict.futures
    assert futures is not None
    assert futures.probability.sum() == pytest.approx(1)


@pytest.mark.parametrize("false_alarms", [0.05, 0.2])
def test_thresholds_keep_their_promise_on_average(false_alarms):
    rng = np.random.default_rng(0)
    rates = [
        np.mean(
            rng.exponential(size=200)
            > MonitorCalibration.of(rng.exponential(size=200)).threshold(false_alarms)
        )
        for _ in range(400)
    ]
    assert false_alarms - 0.012 < np.mean(rates) <= false_alarms + 0.003


def test_a_calibration_is_kept(tmp_path):
    kept = MonitorCalibration.of(np.linspace(0, 2, 30), np.linspace(0, 1, 30), "mine")
    kept.save(tmp_path / "mine.json")
    again = MonitorCalibration.load(tmp_path / "mine.json")
    np.testing.assert_allclose(again.quantiles, kept.quantiles, atol=1e-6)
    np.testing.assert_allclose(again.rest, kept.rest, atol=1e-6)
    assert (again.executions, again.about) == (30, "mine")
    (tmp_path / "mine.json").write_text("{}")
    with pytest.raises(MonitoringError, match="does not describe"):
        MonitorCalibration.load(tmp_path / "mine.json")


def test_causes_are_learned_from_evidence():
    rng = np.random.default_rng(2)
    labels = ["slipped", "held"] * 50
    found = rng.normal(size=(100, 3)) + np.array(
        [[2.0, 0, 0] if each == "held" else [-2.0, 0, 0] for each in labels]
    )
    model = CauseModel.of_entries(CauseModel.fit(found, labels).entries())
    named = [max((chance := model.probabilities(each)), key=lambda name: chance[name]) for each in found]
    assert np.mean([a == b for a, b in zip(named, labels, strict=True)]) > 0.9


def test_displacement_of_points():
    rest, pose = (
        np.array([0.1, 0, 0, *rotation_vector_to_quaternion(np.array([0, 0, a]))])
        for a in (0.3, 0.3 + np.pi / 2)
    )
    np.testing.assert_allclose(place_of(pose, rest, np.array([[0.2, 0, 0]])), [[-0.1, 0.1, 0]], atol=1e-12)
    motions = motions_of(imagined())
    assert (motions.width >= 1e-3).all()
    assert (
        motions.width[1, -1] > 3 * motions.width[0, -1]
    )  # where it comes to rest after a fall is less certain


# --- beliefs and their worlds ---------------------------------------------------------------------------------


def test_draws_of_a_belief():
    belief = ft.Belief({"friction": (0.6, 1.0), "com_x": (0.0, 0.01)})
    drawn = belief.sample(500)
    assert belief.mean["friction"] == pytest.approx(0.8, abs=1e-3)
    assert belief.std["friction"] == pytest.approx(0.4 / np.sqrt(12), abs=1e-3)
    assert drawn["friction"].min() >= 0.6
    assert drawn["friction"].mean() == pytest.approx(0.8, abs=0.02)
    assert (drawn["com_y"] == 0).all()
    heavy = belief.updated(belief.values, np.where(belief.values[:, 0] < 0.65, 1.0, 0.0))
    assert heavy.learned == ("friction",)
    assert heavy.sample(500)["friction"].mean() == pytest.approx(0.625, abs=0.01)
    assert "density" in repr(heavy)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"ranges": {"colour": (0.0, 1.0)}}, "'colour' is no constant"),
        ({"ranges": {"friction": (1.0, 0.0)}}, "give a least and a greatest"),
        ({"worlds": 1}, "worlds is 1"),
        ({"particles": 0}, "particles is 0"),
    ],
)
def test_beliefs_that_are_none(arguments, words):
    with pytest.raises(PredictionError, match=words):
        ft.Belief(**arguments)


@pytest.fixture(scope="module")
def predictor():
    return ft.load_predictor()


FIXED = {
    **NOMINAL_BEVEL,
    "friction": (0.9, 0.9),
    "tool_friction": (0.3, 0.3),
    "density": (600.0, 600.0),
    "contact_ahead": (0.0, 0.0),
    "contact_left": (0.0, 0.0),
    "contact_turn": (0.0, 0.0),
}
TOLD = {"friction": 0.9, "tool_friction": 0.3, "density": 600.0, "contact_error": 0.0}
TOLD |= {"bevel_width": 0.009, "bevel_height": 0.003}


def test_a_belief_without_doubt_is_a_context(predictor):
    view = ft.TopDownView.of(PRISM, ACTION)
    com = [0.075, 0.003, 0.01]
    told = predictor.imagine(view, ACTION, context=TOLD, com=com)
    belief = ft.Belief(FIXED, worlds=4)
    sure = predictor.imagine(view, ACTION, context=belief, com=com)
    np.testing.assert_allclose(sure.com_trajectory, told.com_trajectory, atol=2e-6)
    np.testing.assert_allclose(sure.futures.probability, told.futures.probability, atol=1e-4)
    shifted = predictor.imagine(
        view, ACTION, context=ft.Belief(FIXED | {"com_x": (0.01, 0.01)}, worlds=4), com=com
    )
    there = com + 0.01 * np.append(ACTION.T_action_object[:2, 0], 0)
    again = predictor.imagine(view, ACTION, context=TOLD, com=there)
    # Of the same object with its centre of mass elsewhere, the same point as before is followed.
    np.testing.assert_allclose(shifted.com_trajectory[-1, 2], again.com_trajectory[-1, 2], atol=0.01)
    world = shifted.worlds.futures.states[0, 0]
    np.testing.assert_allclose(world[:, :3], again.futures.states[0, 0, :, :3], atol=2e-5)


def test_worlds_of_a_belief(predictor):
    view = ft.TopDownView.of(PRISM, ACTION)
    effect = predictor.imagine(view, ACTION, context=ft.Belief(worlds=64))
    worlds = effect.worlds
    assert {"", "missed contact", "other physics", "other object"} == set(worlds.causes)
    believed = np.array(worlds.causes) == ""
    assert worlds.futures.probability[0, believed].sum() == pytest.approx(1)
    untold = predictor.imagine(view, ACTION, context="unknown")
    assert np.abs(effect.com_trajectory - untold.com_trajectory).max() < 0.02
    assert sum(float(each[0]) for each in effect.futures.outcomes().values()) == pytest.approx(1)
    tracked = [*effect.pose_trajectory[:5]]
    assert not watch(ft.Monitor(effect), tracked, effect.times[:5])[-1].alarm
    many = predictor.imagine_candidates(
        ft.TopDownView.of(PRISM, ft.LeverUp((0, 0), (1, 0))), [ACTION], context=ft.Belief()
    )
    assert np.abs(many.com[0] - effect.com_trajectory).max() < 0.01
    motion = ft.ObservedMotion(effect.times[:5], effect.pose_trajectory[:5])
    with pytest.raises(PredictionError, match="a belief is given as context"):
        predictor.imagine(view, ACTION, context=ft.Belief(), observed=motion)


# --- the command ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_draws_what_a_monitor_would_have_said(tmp_path, capsys):
    simulation = SimulationConfig(embodiment="tool")
    collect(CollectConfig(1, 1, 0, simulation), tmp_path / "data", 1)
    out = tmp_path / "watched.png"
    arguments = ["monitor", str(tmp_path / "data"), "0", "--out", str(out), "--worlds", "32"]
    assert main(arguments) == 0
    told = capsys.readouterr().out
    assert "alarm" in told
    assert str(out) in told
    assert out.stat().st_size > 10_000
    assert main([*arguments[:2], "99", *arguments[3:]]) == 2
    assert "has no interaction 99" in capsys.readouterr().err
    film = tmp_path / "watched.gif"
    assert main([*arguments[:4], str(film), *arguments[5:]]) == 0
    with Image.open(film) as moving:
        assert moving.n_frames == len(Dataset.open(tmp_path / "data")[0].effect.times)
    assert sorted(tmp_path.iterdir()) == [tmp_path / "data", film, out]
    assert main([*arguments[:4], "watched.tiff"]) == 2
    assert "choose a name that ends in" in capsys.readouterr().err


def test_a_film_says_so_from_the_alarm_on(tmp_path):
    """Before the alarm the title stands there, from it on the cause; the expected edges are drawn beside the object."""
    prism = ft.sample_prism(np.random.default_rng(0), 5)
    action = ft.LeverUp.at_edge(prism, 0)
    effect = ft.simulate(prism, action, embodiment="tool")
    imagined = ft.load_predictor().imagine(ft.TopDownView.of(prism, action), action)
    verdict = Verdict(0.0, False, None, 0.5, 3.0, False, {"levered": 1.0}, {}, "")
    verdicts = [
        replace(verdict, time=float(t), alarm=bool(t > 1), cause="held" if t > 1 else None)
        for t in effect.effect.times
    ]
    given = []
    pictures = monitor_film(Scene.observed(effect), imagined, verdicts, tmp_path / "film.gif")
    with Image.open(pictures) as moving:
        for frame in range(moving.n_frames):
            moving.seek(frame)
            given.append(np.asarray(moving.convert("RGB"))[:28, :480])
    first = int((effect.effect.times > 1).argmax())
    assert (given[0] == given[first - 1]).all()
    assert (given[first] == given[-1]).all()
    assert (given[first] != given[first - 1]).any()


def test_the_picture_marks_when_another_outcome_takes_over():
    verdict = Verdict(0.0, False, None, 0.5, 3.0, False, {"levered": 1.0, "slipped": 0.0}, {}, "")
    slipped = replace(verdict, transition=True, outcomes={"levered": 0.2, "slipped": 0.8})
    verdicts = [replace(slipped if t >= 0.5 else verdict, time=float(t)) for t in TIMES]
    imagined = ft.load_predictor().imagine(ft.TopDownView.of(PRISM, ACTION), ACTION)
    com = np.tile(COM, (len(TIMES), 1))
    figure = monitor_figure(imagined, verdicts, com, "a slip", "simulated")
    marks = [text.get_text() for ax in figure.axes for text in ax.texts]
    assert marks == ["0.50 s: slipped takes over"]
    legend = figure.axes[2].get_legend()
    assert legend is not None
    assert "simulated" in [text.get_text() for text in legend.get_texts()]


def test_a_film_runs_in_real_time_however_often_the_object_was_tracked():
    scene = Scene.imagined(PRISM, ACTION, np.sort(np.append(np.arange(0.0, 2.0, 0.004), 1.0011)), {})
    even = _evenly(replace(scene, com=np.column_stack([scene.times] * 3)))
    np.testing.assert_allclose(np.diff(even.times), 0.05)
    assert even.com is not None
    assert len(even.pose) == len(even.com) == len(even.times)
    np.testing.assert_allclose(even.com[:, 0], even.times, atol=0.004)
    assert even.times[-1] == pytest.approx(scene.times[-1], abs=0.03)
    assert len(_evenly(replace(scene, times=100 * scene.times)).times) == MOST


# --- drift --------------------------------------------------------------------------------------------------------


def executions_until(scores, seed: int) -> int | None:
    drift = Drift(CALIBRATION, 0.01, seed)
    return next((k for k, score in enumerate(scores, 1) if drift.update(float(score))), None)


def test_drift_is_not_seen_where_there_is_none():
    rng = np.random.default_rng(4)
    found = [executions_until(rng.uniform(0.1, 2.0, 200), seed) for seed in range(200)]
    assert np.mean([each is not None for each in found]) <= 0.03


def test_drift_is_seen_within_thirty_executions():
    rng = np.random.default_rng(5)
    found = []
    for seed in range(100):
        before, after = rng.uniform(0.1, 2.0, 60), rng.uniform(1.2, 3.0, 60)
        found.append(executions_until([*before, *after], seed))
    late = [each - 60 if each is not None else 999 for each in found]
    assert np.quantile(late, 0.95) <= 30


def test_recalibration_from_the_last_scores():
    drift = Drift(CALIBRATION)
    for score in np.linspace(1, 3, 40):
        drift.update(float(score))
    assert drift.drifted
    again = drift.recalibrate(20)
    assert again.executions == 20
    assert again.threshold(0.2) > CALIBRATION.threshold(0.2)
    with pytest.raises(MonitoringError, match="there are 40 scores"):
        drift.recalibrate(41)
    with pytest.raises(MonitoringError, match="score is -1"):
        drift.update(-1.0)


# --- executions that nothing was fitted to ------------------------------------------------------------------------


@pytest.mark.slow
def test_faults_are_seen_and_normal_executions_hardly_ever():
    def alarms(fault: str, number: int) -> list[ft.Verdict]:
        execution = make_execution(402, number, fault)
        watched = ft.Monitor(imagine(execution, "worlds"))
        return watch(watched, execution.tracked, execution.times)

    assert sum(alarms("", number)[-1].alarm for number in range(6)) <= 1
    pushed = [alarms("pushed", number) for number in range(3)]
    assert all(each[-1].alarm for each in pushed)
    frozen = alarms("freeze", 0)
    assert frozen[-1].cause == FROZEN
    assert frozen[-1].rest is None or frozen[-1].rest.times[0] > frozen[-1].time
    slipped = next(each for each in (alarms("slip", number) for number in range(4)) if each[-1].alarm)
    first = next(each for each in slipped if each.alarm)
    assert first.rest is not None
    assert first.rest.com_trajectory[-1, 2] < 0.02  # back on the table


def test_executions_are_decided_by_their_seed_and_differ_by_their_fault():
    one, again, fault = make_execution(403, 0), make_execution(403, 0), make_execution(403, 0, "jump")
    np.testing.assert_array_equal(one.poses, again.poses)
    assert one.deviation.max() == 0
    assert [each is None for each in one.tracked] == [each is None for each in again.tracked]
    assert 0.004 < fault.deviation[-1] < 0.03
    np.testing.assert_array_equal(fault.poses, fault.normal)


@pytest.mark.parametrize("fault", ["fixed", "pushed", "slip"])
def test_another_engine_plays_the_same_executions_and_faults(fault):
    pytest.importorskip("pybullet", reason="pybullet is not installed")
    one, other = (make_execution(402, 1, fault, engine=engine) for engine in ("mujoco", "bullet"))
    np.testing.assert_array_equal(one.object.corners, other.object.corners)
    assert one.physics == other.physics
    assert 1e-4 < np.abs(one.normal - other.normal).max() < 0.05
    assert other.deviation[-1] > 0.005


@pytest.mark.slow
def test_plans_average_over_beliefs():
    config = ft.PlanConfig(spacing=0.05, directions=1, refine=0, check=0)
    plan = ft.plan(PRISM, ft.goals.Lift(), context=ft.Belief(worlds=4), config=config)
    assert plan.imagined.com_trajectory[-1, 2] > 0.02
    assert ft.Monitor(plan).imagined is plan.imagined


def test_the_calibration_that_comes_along():
    worlds, futures = (MonitorCalibration.shipped(kind) for kind in ("worlds", "futures"))
    assert worlds.executions >= 100
    assert 1 < worlds.threshold(0.05) < futures.threshold(0.05)
    with pytest.raises(MonitoringError, match="only for worlds, futures, push worlds"):
        MonitorCalibration.shipped("plans")
