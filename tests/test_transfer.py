"""The stand-in for the real robot, and predictions compared with it."""

import json
import sys
from dataclasses import asdict, fields, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from foretrace.actions import LeverUp
from foretrace.cli import main
from foretrace.errors import PredictionError, ShapeError, SimulationError, ViewError
from foretrace.evaluation.run import run_experiment
from foretrace.experiments import transfer
from foretrace.experiments.transfer import Transfer, compare_played, distance_until_slip, own_error
from foretrace.experiments.transfer_objects import (
    HEPTAGON,
    PENTAGON,
    Subject,
    contacts_around,
    everyday_objects,
    play,
    printed_shapes,
    read_prisms,
    read_silhouettes,
)
from foretrace.experiments.transfer_report import DISTANCES, PAPER_PREDICTED, bar_lines, report, summarise
from foretrace.geometry import convex_hull, transform_points
from foretrace.interactions.record import Outcome
from foretrace.interactions.topdown import METRES_PER_PIXEL, TopDownView
from foretrace.objects import Prism
from foretrace.predictor import Futures, ImaginedEffect, LstmConfig, save_checkpoint
from foretrace.simulation import bullet_world, lever_up
from foretrace.simulation.stand_in import Observation, Perturbation, StandIn, hull_of

DATA = Path(__file__).parents[1].parent / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="real data are not here")
needs_bullet = pytest.mark.skipif(find_spec("pybullet") is None, reason="pybullet is not installed")

NOTHING = StandIn.undisturbed("mujoco", "tool").draw(np.random.default_rng(0))
NOISY = StandIn(engine="mujoco", embodiment="tool", sample_rate=25.0)
"""The usual stand-in, but for engine and rate."""
L_SHAPE = Prism([[0.0, 0.0], [0.16, 0.0], [0.16, 0.07], [0.07, 0.07], [0.07, 0.16], [0.0, 0.16]])
PENTAGON_EDGE = Subject("pentagon", "printed", PENTAGON, (LeverUp.at_edge(PENTAGON, 1),))


def observe(stand_in: StandIn, seed: int) -> Observation:
    drawn = stand_in.draw(np.random.default_rng(seed))
    return stand_in.observe(PENTAGON, PENTAGON_EDGE.actions[0], drawn)


def imagined_path(times: np.ndarray, com: np.ndarray) -> ImaginedEffect:
    return ImaginedEffect(times, com, None, Futures.point(com[None], None, "levered"))


@pytest.fixture
def predictor():
    made = LstmConfig(features="none", hidden=8).make(60)
    made.times.copy_(0.05 * torch.arange(60))
    return made


# --- the stand-in ---------------------------------------------------------------------------------------------


def test_the_seed_decides_what_is_observed() -> None:
    first, again, other = observe(NOISY, 3), observe(NOISY, 3), observe(NOISY, 4)
    np.testing.assert_array_equal(first.com, again.com)
    np.testing.assert_array_equal(first.view.mask, again.view.mask)
    assert first.perturbation == again.perturbation
    assert first.perturbation != other.perturbation
    assert (first.view.mask != other.view.mask).any()
    size = min(len(first.com), len(other.com))
    assert np.abs(first.com[:size] - other.com[:size]).max() > 1e-4


def test_without_differences_the_stand_in_is_the_simulator(predictor) -> None:
    played = play(PENTAGON_EDGE, 0, StandIn.undisturbed(), 1, 0)
    row = compare_played(predictor, played)[0]
    assert row["distance_simulated_cm"] == pytest.approx(0.0, abs=1e-9)
    assert row["distance_predicted_cm"] > 0.1
    assert row["distance_simulated_predicted_cm"] == pytest.approx(row["distance_predicted_cm"])
    np.testing.assert_array_equal(played.observed[0].view.mask, played.simulated.view.mask)


def test_the_view_is_had_without_playing_the_lever_up() -> None:
    action = PENTAGON_EDGE.actions[0]
    drawn = NOISY.draw(np.random.default_rng(3))
    np.testing.assert_array_equal(NOISY.see(PENTAGON, action, drawn).mask, observe(NOISY, 3).view.mask)


def test_perturbations_fill_their_ranges_and_stay_within() -> None:
    drawn = [asdict(NOISY.draw(np.random.default_rng(seed))) for seed in range(300)]
    limits = {name: getattr(NOISY, name) for name in ("friction", "tool_friction", "density_factor")}
    limits["thickness_error"] = NOISY.thickness_error
    limits |= {name: (-0.003, 0.003) for name in ("contact_along", "contact_across")}
    limits["direction_error"] = (-np.deg2rad(3), np.deg2rad(3))
    limits |= {name: (-NOISY.view_shift, NOISY.view_shift) for name in ("view_shift_x", "view_shift_y")}
    limits["view_turn"] = (-NOISY.view_turn, NOISY.view_turn)
    assert limits.keys() | {"noise_seed"} == {field.name for field in fields(Perturbation)}
    for name, (low, high) in limits.items():
        values = np.array([each[name] for each in drawn])
        margin = 0.05 * (high - low)
        assert low <= values.min() < low + margin, name
        assert high - margin < values.max() <= high, name
    assert len({each["noise_seed"] for each in drawn}) == 300


def test_the_blade_errs_but_what_is_seen_stays_in_the_told_frame() -> None:
    """However wrong the contact, the object lies where the camera sees it."""
    stand_in, action = StandIn.undisturbed("mujoco", "tool"), PENTAGON_EDGE.actions[0]
    wrong = replace(NOTHING, contact_along=0.003, contact_across=-0.002, direction_error=0.05)
    right, erring = (stand_in.observe(PENTAGON, action, drawn) for drawn in (NOTHING, wrong))
    told = transform_points(action.T_action_object, PENTAGON.mass_properties(1.0).com[None])[0]
    np.testing.assert_allclose(erring.com[0], told, atol=1e-4)
    np.testing.assert_array_equal(right.view.mask, erring.view.mask)
    size = min(len(right.com), len(erring.com))
    assert np.linalg.norm(right.com[:size] - erring.com[:size], axis=1).max() > 5e-4


def test_the_mask_is_shifted_and_frayed_by_as_much_as_told() -> None:
    stand_in, action = StandIn.undisturbed("mujoco", "tool"), PENTAGON_EDGE.actions[0]
    exact = TopDownView.of(PENTAGON, action).mask
    drawn = replace(NOTHING, view_shift_x=2 * METRES_PER_PIXEL, view_shift_y=-METRES_PER_PIXEL)
    shifted = stand_in.observe(PENTAGON, action, drawn).view.mask
    # Up in the picture is ahead, right is to the right. Rounding may decide on a pixel of an edge.
    assert (shifted != np.roll(exact, (-2, 1), axis=(0, 1))).sum() <= 2
    frayed = replace(stand_in, frayed=0.5).observe(PENTAGON, action, NOTHING).view.mask
    outline = (np.roll(exact, 1, 0) ^ exact).sum() + (np.roll(exact, 1, 1) ^ exact).sum()
    assert 0.2 * outline < (frayed ^ exact).sum() < 1.2 * outline


def test_marker_noise_has_its_size() -> None:
    still = StandIn.undisturbed("mujoco", "tool")
    exact = still.observe(PENTAGON, PENTAGON_EDGE.actions[0], NOTHING).com
    noisy = replace(still, marker_position=0.0005, marker_rotation=0.005)
    observed = noisy.observe(PENTAGON, PENTAGON_EDGE.actions[0], NOTHING).com
    assert 0.0004 < (observed - exact).std() < 0.0006


def test_samples_come_at_the_stand_ins_rate() -> None:
    assert np.diff(observe(NOISY, 0).times) == pytest.approx(1 / 25)


@pytest.mark.parametrize(
    ("setting", "value"),
    [("friction", (1.0, 0.5)), ("density_factor", (0.0, 1.0)), ("contact_error", 0.02), ("sample_rate", 0.0)],
)
def test_impossible_stand_ins_are_refused(setting, value) -> None:
    with pytest.raises(SimulationError, match=f"stand-in: {setting}"):
        replace(NOISY, **{setting: value})


# --- masks, distances -----------------------------------------------------------------------------------------


def test_the_hull_closes_notches_and_leaves_convex_masks_alone() -> None:
    view = TopDownView.of(L_SHAPE, LeverUp.at_edge(L_SHAPE, 0))
    hull = hull_of(view)
    expected = TopDownView.of(Prism(convex_hull(L_SHAPE.corners)), LeverUp.at_edge(L_SHAPE, 0)).mask
    assert (expected & ~view.mask).sum() > 300
    assert (hull.mask != expected).sum() < 0.02 * expected.sum()
    assert (hull.mask | view.mask == hull.mask).all()
    np.testing.assert_array_equal(hull_of(hull).mask, hull.mask)
    assert (hull.height > 0).sum() == hull.mask.sum()
    for edge in range(5):
        convex = TopDownView.of(PENTAGON, LeverUp.at_edge(PENTAGON, edge))
        np.testing.assert_array_equal(hull_of(convex).mask, convex.mask)
    with pytest.raises(ViewError, match="empty"):
        hull_of(TopDownView(np.zeros((128, 128), dtype=bool), np.zeros((128, 128))))


@pytest.mark.parametrize("hull", [True, False])
def test_the_predictor_sees_the_hull_where_it_should(predictor, monkeypatch, hull) -> None:
    seen = []

    def imagine(view, *, context=None, com=None):
        seen.append(view)
        return imagined_path(0.05 * np.arange(60), np.zeros((60, 3)))

    monkeypatch.setattr(predictor, "imagine", imagine)
    action = LeverUp.at_edge(L_SHAPE, 0)
    subject = Subject("L", "everyday", L_SHAPE, (action,), hull=hull)
    played = play(subject, 0, StandIn.undisturbed("mujoco", "tool"), 1, 0)
    compare_played(predictor, played, subject.hull)
    exact = TopDownView.of(L_SHAPE, action)
    expected = hull_of(exact) if hull else exact
    assert len(seen) == 3
    for view in seen:
        np.testing.assert_array_equal(view.mask, expected.mask)


def test_what_the_simulator_says_is_no_error(predictor, monkeypatch) -> None:
    simulated = play(PENTAGON_EDGE, 0, NOISY, 1, 0).simulated
    path = simulated.effect.com_trajectory
    seen = imagined_path(simulated.effect.times, path + np.array([0, 0, 0.01]))
    monkeypatch.setattr(predictor, "imagine", lambda view, context, com: seen)
    assert own_error(predictor, simulated.view, simulated) == pytest.approx(1.0, abs=0.2)
    monkeypatch.setattr(predictor, "imagine", lambda view, context, com: simulated.effect)
    assert own_error(predictor, simulated.view, simulated) == 0


def test_paths_are_compared_up_to_the_slip() -> None:
    times = 0.05 * np.arange(40)
    rising = np.column_stack([0 * times, 0 * times, 0.02 * times])
    falling = rising.copy()
    falling[20:, 2] -= 0.05 * np.arange(20)
    view = TopDownView.of(PENTAGON, PENTAGON_EDGE.actions[0])
    whole = Observation(view, times, rising, None, Outcome.LEVERED, NOTHING)
    slipped = Observation(view, times[:20], rising[:20], float(times[20]), Outcome.SLIPPED, NOTHING)
    assert distance_until_slip(slipped, times, falling) == pytest.approx(0, abs=1e-9)
    assert distance_until_slip(whole, times, falling) > 1
    assert distance_until_slip(whole, times, falling, float(times[20])) == pytest.approx(0, abs=1e-9)
    assert distance_until_slip(whole, times, falling, float(times[22])) > 0.01
    # Another rate is no difference, an offset is one.
    finer = np.column_stack([np.zeros(391), np.zeros(391), 0.02 * np.linspace(0, times[-1], 391)])
    assert distance_until_slip(whole, np.linspace(0, times[-1], 391), finer) < 0.03
    assert distance_until_slip(whole, times, rising + np.array([0, 0.01, 0])) == pytest.approx(1.0)


def test_slips_are_counted_and_end_the_record() -> None:
    """A short object slips off a slippery blade in every engine."""
    square = Prism(0.05 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    stand_in = replace(StandIn.undisturbed("mujoco", "tool"), tool_friction=(0.05, 0.05))
    played = play(Subject("square", "prisms", square, (LeverUp.at_edge(square, 0),)), 0, stand_in, 1, 0)
    observed = played.observed[0]
    assert observed.outcome == Outcome.SLIPPED
    assert observed.slip_time is not None
    assert observed.times[-1] < observed.slip_time < 2.9


# --- objects --------------------------------------------------------------------------------------------------


def test_the_shapes_are_the_papers_size() -> None:
    assert [(subject.name, len(subject.actions)) for subject in printed_shapes()] == [
        ("pentagon", 5),
        ("heptagon", 7),
    ]
    for shape in (PENTAGON, HEPTAGON):
        np.testing.assert_allclose(np.linalg.norm(shape.corners, axis=1), 0.1)
        lengths = np.linalg.norm(np.roll(shape.corners, -1, axis=0) - shape.corners, axis=1)
        assert len(set(lengths.round(3))) >= len(lengths) - 1


def test_everyday_objects_have_their_size_and_mass() -> None:
    sizes = {"HDD": (147, 101.6), "PCB": (170, 170), "book": (210, 148), "racket": (256.6, 150)}
    masses = {"HDD": 0.7, "PCB": 0.35, "book": 0.37, "racket": 0.18}
    for subject in everyday_objects():
        np.testing.assert_allclose(1e3 * np.ptp(subject.obj.corners, axis=0), sizes[subject.name], atol=1.5)
        assert subject.obj.mass_properties(subject.density).mass == pytest.approx(masses[subject.name])
        assert len(subject.actions) == 5
        assert subject.hull


@pytest.mark.parametrize("subject", everyday_objects(), ids=lambda subject: subject.name)
def test_contacts_lie_on_outline_and_hull_and_fit_in_the_view(subject) -> None:
    hull = Prism(convex_hull(subject.obj.corners), subject.obj.height, subject.obj.bevel)
    for action in subject.actions:
        action.check_contact(subject.obj)
        action.check_contact(hull)
        TopDownView.of(subject.obj, action)


def test_contacts_do_not_mirror_each_other_on_a_rectangle() -> None:
    book = everyday_objects()[2].obj
    contacts = np.array([action.contact for action in contacts_around(book, 5)])
    for turned in (-contacts, contacts * [1, -1], contacts * [-1, 1]):
        assert np.linalg.norm(turned[:, None] - contacts, axis=-1).min() > 0.005


@needs_data
def test_real_silhouettes_and_prisms() -> None:
    silhouettes = read_silhouettes(DATA / "silhouettes")
    assert len(silhouettes) == 20
    for subject in silhouettes:
        assert np.ptp(subject.obj.corners, axis=0).max() == pytest.approx(0.18, abs=0.005)
        for action in subject.actions:
            action.check_contact(subject.obj)
    masses = {
        name: values["mass_kg"] for name, values in json.loads((DATA / "prisms.json").read_text()).items()
    }
    for subject in read_prisms(DATA / "prisms.json"):
        assert subject.obj.mass_properties(subject.density).mass == pytest.approx(masses[subject.name])
    concave = next(subject for subject in silhouettes if subject.name == "jar-3")
    observed = play(concave, 1, NOISY, 1, 0).observed[0]
    assert (hull_of(observed.view).mask & ~observed.view.mask).sum() > 50


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "holds a list where"),
        ("{}", "names no prism"),
        ('{"a": {}}', "entry a.corners_m is missing"),
        ('{"a": {"corners_m": [[0, 0], [1, 1]]}}', "a: polygon with 2 corners"),
        (
            '{"a": {"corners_m": [[0, 0], [0.1, 0], [0, 0.1]], "mass_kg": -1}}',
            "entry a.mass_kg is -1, a finite number",
        ),
        ("{", "cannot be read as JSON"),
    ],
)
def test_bad_prisms_are_named(tmp_path, content, message) -> None:
    file = tmp_path / "prisms.json"
    file.write_text(content)
    with pytest.raises(ShapeError, match=message):
        read_prisms(file)


# --- summary --------------------------------------------------------------------------------------------------


def table_of(means: dict[str, list[float]], outcome: str = "levered") -> pd.DataFrame:
    """Two repetitions, 0.1 cm above and below each mean."""
    names = DISTANCES.values()
    return pd.DataFrame(
        [
            {"object": name, "group": "printed", "contact": edge, "repetition": k, "outcome": outcome}
            | dict.fromkeys(names, mean + 0.1 * (2 * k - 1))
            for name, values in means.items()
            for edge, mean in enumerate(values, 1)
            for k in range(2)
        ]
    )


def test_the_summary_has_the_papers_numbers_beside_ours() -> None:
    table = table_of({"pentagon": [0.2, 0.3, 0.4, 0.45, 0.55]})
    summary = summarise(table)
    assert [edge["paper"]["predicted"] for edge in summary["edges"]] == list(PAPER_PREDICTED["pentagon"])
    assert summary["edges"][4]["predicted"] == {"mean": 0.55, "sd": 0.1414, "max": 0.65}
    paper, goal = summary["bars"]
    assert paper["below_cm"] == 1
    assert paper["predicted"]["holds"]
    assert goal["below_cm"] == 0.5
    assert not goal["predicted"]["holds"]
    assert goal["predicted"]["means_below"] == 4
    assert goal["predicted"]["share_of_lever_ups"] == pytest.approx(0.7)
    assert "under 1 cm on average, stand-in against predicted: yes (5 of 5; 100 %" in bar_lines(summary)[0]
    lines = report(summary, table).splitlines()
    assert "| Paper: real vs predicted | 0.981 | 0.446 | 0.480 | 0.611 | 0.401 |" in lines
    assert "| Stand-in vs predicted, mean | 0.200 | 0.300 | 0.400 | 0.450 | 0.550 |" in lines


def test_what_has_no_distance_is_below_no_bar() -> None:
    table = table_of({"pentagon": [0.2, np.nan]}, outcome="failed")
    summary = summarise(table)
    assert not summary["bars"][0]["predicted"]["holds"]
    assert summary["edges"][1]["predicted"] == {"mean": None, "sd": None, "max": None}
    assert "| Not levered | 2 failed | 2 failed |" in report(summary, table)
    json.dumps(summary, allow_nan=False)


# --- the command ----------------------------------------------------------------------------------------------


@pytest.fixture
def run(tmp_path, predictor) -> Path:
    save_checkpoint(tmp_path / "run", predictor)
    return tmp_path / "run"


@needs_bullet
def test_the_command_writes_table_summary_and_pictures(run, tmp_path, monkeypatch, capsys) -> None:
    chosen = [*printed_shapes(), everyday_objects()[3]]
    few = [replace(subject, actions=subject.actions[:1]) for subject in chosen]
    monkeypatch.setattr(transfer, "printed_shapes", lambda: few[:2])
    monkeypatch.setattr(transfer, "everyday_objects", lambda: few[2:])
    prisms = tmp_path / "prisms.json"
    corners = [[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]]
    prisms.write_text(json.dumps({"square": {"corners_m": corners, "mass_kg": 0.2}}))
    out = tmp_path / "out"
    command = ["evaluate", "transfer", str(run), "--out", str(out), "--repeats", "1", "--prisms", str(prisms)]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "Table 1: pentagon, 1 lever-ups" in printed.out
    assert "stand-in" in printed.out
    table = pd.read_csv(out / "rows.csv")
    assert table.groupby(["group", "object"]).size().to_dict() == {
        ("everyday", "racket"): 1,
        ("printed", "heptagon"): 1,
        ("printed", "pentagon"): 1,
        ("prisms", "square"): 5,
    }
    assert {field.name for field in fields(Perturbation)} <= set(table.columns)
    assert table["distance_simulated_cm"].between(0.001, 3).all()
    paths = json.loads(table["paths_cm"].dropna().iloc[0])
    assert set(paths) == {"observed", "predicted", "simulated"}
    content = json.loads((out / "summary.json").read_text())
    assert content["identity"]["stand_in"]["engine"] == "bullet"
    assert sum(content["summary"]["outcomes"].values()) == 8
    for name in ("figure-14.png", "figure-15.png", "prisms.png", "report.md"):
        assert (out / name).stat().st_size > 1000


def test_more_objects_leave_the_others_as_they_are(run, tmp_path) -> None:
    """What is drawn for one contact depends neither on the other objects nor on the number of repetitions."""
    other = replace(PENTAGON_EDGE, name="other")
    options = {"predictor": run, "seed": 5, "stand_in": NOISY}
    alone = run_experiment(Transfer(**options, subjects=(PENTAGON_EDGE,), repeats=1), tmp_path / "a").rows
    more = run_experiment(
        Transfer(**options, subjects=(other, PENTAGON_EDGE), repeats=2), tmp_path / "b"
    ).rows
    same = more.loc[more["object"].eq("pentagon") & more["repetition"].eq(0)].reset_index(drop=True)
    pd.testing.assert_frame_equal(alone, same)
    assert len(set(more["noise_seed"])) == 4


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--repeats", "0"], "--repeats is 0"),
        (["--seed", "-1"], "--seed is -1"),
        (["--workers", "0"], "workers is 0"),
        (["--silhouettes", "{tmp}"], "has no silhouettes"),
        (["--silhouettes", "{tmp}/nowhere"], "is no folder"),
        (["--prisms", "{tmp}/none.json"], "none.json does not exist"),
        (["--size", "0"], "--size is 0"),
        (["--height", "inf"], "--height is inf"),
        (["--out", "{tmp}/run/config.json"], "is a file"),
    ],
)
@needs_bullet
def test_bad_input_is_one_line(run, tmp_path, capsys, options, message) -> None:
    arguments = [option.format(tmp=tmp_path) for option in options]
    out = [] if "--out" in options else ["--out", str(tmp_path / "out")]
    assert main(["evaluate", "transfer", str(run), *out, *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_run_that_is_not_there_is_one_line(tmp_path, capsys) -> None:
    assert main(["evaluate", "transfer", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert "config.json" in capsys.readouterr().err


def test_oracles_are_refused(tmp_path) -> None:
    save_checkpoint(tmp_path, LstmConfig(features="sp-truth", hidden=8).make(60))
    with pytest.raises(PredictionError, match="observed during the action"):
        run_experiment(Transfer(tmp_path, stand_in=NOISY, subjects=(PENTAGON_EDGE,)), tmp_path / "out")


def test_equal_names_are_refused(run) -> None:
    with pytest.raises(ShapeError, match="two of the printed are called 'pentagon'"):
        Transfer(run, stand_in=NOISY, subjects=(PENTAGON_EDGE, PENTAGON_EDGE)).trials()


def test_what_does_not_fit_is_named_and_the_others_go_on(run, tmp_path) -> None:
    long = Prism([[0.0, 0.0], [0.4, 0.0], [0.4, 0.1], [0.0, 0.1]])
    subject = Subject("plank", "prisms", long, (LeverUp.at_edge(long, 3),))
    experiment = Transfer(run, stand_in=NOISY, subjects=(subject, PENTAGON_EDGE), repeats=1)
    found = run_experiment(experiment, tmp_path / "out")
    assert found.rows["object"].tolist() == ["pentagon"]
    assert found.failures[0].message.startswith("plank, contact 1: object reaches")


def test_without_pybullet_the_command_says_what_to_install(run, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    for cached in (bullet_world.connect, lever_up.make_engine):
        cached.cache_clear()
    try:
        assert main(["evaluate", "transfer", str(run), "--out", str(tmp_path / "out")]) == 2
    finally:
        for cached in (bullet_world.connect, lever_up.make_engine):
            cached.cache_clear()
    error = capsys.readouterr().err
    assert "pip install 'foretrace[bullet]'" in error
    assert error.count("\n") == 1
