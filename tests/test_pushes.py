"""Planar pushes: the action, feet, the quasi-static model and its constants, recorded pushes."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import foretrace as ft
from factories import write_push_table
from foretrace.actions import sample_pushes
from foretrace.cli import main
from foretrace.errors import (
    ActionError,
    DatasetError,
    ForetraceError,
    PredictionError,
    ResultsError,
    ShapeError,
)
from foretrace.experiments import pushes_views
from foretrace.experiments.pushes import repetitions, split_pushes
from foretrace.experiments.pushes_views import OUTCOMES, VIEWED, answer_from_views
from foretrace.features.action_frame import PROBES, RAYS, find_action_frame
from foretrace.geometry import quaternion_to_matrix
from foretrace.interactions.pushes import RecordedPushes, read_pushes
from foretrace.interactions.pushes_data import push_interaction
from foretrace.interactions.splits import split_by_seed
from foretrace.objects import FOOTINGS, NO_BEVEL, Footed, HullShape, Prism, object_from_dict
from foretrace.predictor import TrainConfig, fit_predictor
from foretrace.simulation.sliding import Footprint, slide
from foretrace.twin import sliding_constants, sliding_residual
from foretrace.twin.sliding import SlidingTwin
from foretrace.twin.sliding_constants import Change
from foretrace.twin.sliding_residual import PushRegions, PushResidual, push_errors

SIDE = 0.09
SQUARE = SIDE / 2 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
PLATE = Prism(SQUARE, 0.013, NO_BEVEL)
RADIUS = ft.Push.at_edge(PLATE, 0).tool.radius
REAL = Path(__file__).parents[2] / "shared" / "data" / "pushes"


def footprint(footing: str = "uniform") -> Footprint:
    return Footprint(SQUARE, Footed(PLATE, footing).feet)


def slid(start, motion, friction=0.2, **settings):
    found = slide(footprint(**settings), np.array([start]), np.array([motion]), RADIUS, friction)
    return found[0][0], found[1][0]


@pytest.mark.parametrize("embodiment", ["tool"])
@pytest.mark.parametrize("engine", ["mujoco", "bullet"])
def test_a_push_through_the_middle_moves_the_object_straight(engine, embodiment):
    if engine == "bullet":
        pytest.importorskip("pybullet")
    push = ft.Push.at_edge(PLATE, 0, path=ft.PushPath(distance=0.03, speed=0.05))
    effect = ft.simulate(Footed(PLATE), push, engine=engine, embodiment=embodiment).effect
    assert effect.outcome == "pushed"
    moved = effect.com_trajectory[-1] - effect.com_trajectory[0]
    np.testing.assert_allclose(moved, [0.03, 0, 0], atol=0.001)
    assert np.abs(quaternion_to_matrix(effect.pose_trajectory[-1, 3:])[2, :2]).max() < 0.01


def test_outcomes_of_pushes():
    def outcome(obj, push):
        return ft.simulate(obj, push, embodiment="tool").effect.outcome

    path = ft.PushPath(distance=0.06, speed=0.06)
    far = ft.PushPath(distance=0.12, speed=0.12)
    assert outcome(Footed(PLATE), ft.Push.at_edge(PLATE, 0, 0.95, path=far)) == "turned away"
    assert outcome(Footed(PLATE), ft.Push.at_edge(PLATE, 0, 0.6, path=path)) == "pushed"
    short = ft.PushPath(distance=0.001, approach=0.005, speed=0.06)
    assert outcome(Footed(PLATE), ft.Push.at_edge(PLATE, 0, path=ft.PushPath(0.001, 0.06, 0.02))) == "missed"
    assert short.duration == pytest.approx(0.1 + 0.1 + 0.05 + 0.1)
    tower = ft.Box(0.05, 0.05, 0.3)
    high = ft.PushPath(distance=0.06, speed=0.06, clearance=0.1)
    assert outcome(tower, ft.Push.at_edge(tower, 0, path=high)) == "tipped"


def test_sampled_pushes_start_free_and_within_the_cone():
    pushes = sample_pushes(PLATE, np.random.default_rng(0), 40)
    assert len(pushes) == 40
    normals = [ft.Push.nearest(PLATE, push.contact).direction for push in pushes]
    angles = [np.arccos(np.clip(p.direction @ n, -1, 1)) for p, n in zip(pushes, normals, strict=True)]
    assert 0.5 < max(angles) <= np.deg2rad(50.001)


@pytest.mark.parametrize("footing", FOOTINGS)
def test_feet_lie_inside_balanced_and_come_back_from_a_description(footing):
    footed = Footed(PLATE, footing)
    assert np.abs(footed.feet).max() < SIDE / 2
    np.testing.assert_allclose(footed.feet.mean(axis=0), 0, atol=1e-9)
    again = object_from_dict(json.loads(json.dumps(footed.to_dict())))
    assert isinstance(again, Footed)
    np.testing.assert_array_equal(again.feet, footed.feet)
    lowest = [s.vertices[:, 2].min() for s in footed.collision_shapes() if isinstance(s, HullShape)]
    assert lowest[0] > 0
    assert np.allclose(lowest[1:], 0)
    still = ft.simulate(
        footed, ft.Push.at_edge(PLATE, 0, path=ft.PushPath(0.001, 0.06, 0.03)), embodiment="tool"
    )
    assert np.abs(still.effect.pose_trajectory[-1, 2]) < 1e-4


def test_feet_and_pushes_that_cannot_be_are_refused():
    with pytest.raises(ShapeError, match="footing 'toes': choose one of corners, rim, uniform"):
        Footed(PLATE, "toes")
    with pytest.raises(ShapeError, match="type Footed: give Prism"):
        Footed(Footed(PLATE))
    with pytest.raises(ShapeError, match="a lying cylinder has no face"):
        Footed(ft.Cylinder(0.03, 0.12))
    with pytest.raises(ActionError, match=r"speed = 20\.0 is outside"):
        ft.PushPath(speed=20.0)


def test_quasi_static_pushes_agree_with_what_mechanics_demand():
    straight, turn = slid((-SIDE / 2 - RADIUS, 0.0), (0.03, 0.0))
    np.testing.assert_allclose(straight, [0.03, 0], atol=1e-4)
    assert abs(turn) < 1e-6
    # A push beside the centre turns the object away from the rod; its mirror image turns it the other way.
    left, one = slid((-SIDE / 2 - RADIUS, 0.02), (0.03, 0.0))
    right, other = slid((-SIDE / 2 - RADIUS, -0.02), (0.03, 0.0))
    assert one < -0.1
    np.testing.assert_allclose([other, *right], [-one, left[0], -left[1]], atol=1e-6)
    # Weight at the corners resists turning more than weight over the whole face.
    assert abs(slid((-SIDE / 2 - RADIUS, 0.02), (0.03, 0.0), footing="corners")[1]) < abs(one)
    # Without friction the force is normal to the edge: a slanting push moves the object along the normal alone.
    frictionless, _ = slid((-SIDE / 2 - RADIUS, 0.0), (0.003, 0.0015), friction=0.0)
    assert abs(frictionless[1]) < 0.05 * frictionless[0]
    assert slid((-SIDE, 0.0), (0.02, 0.0)) == (pytest.approx([0, 0]), 0)


def test_quasi_static_pushes_agree_with_mujoco():
    # A slippery rod: where it sticks, MuJoCo lets it creep a little.
    start = np.array([[-SIDE / 2 - RADIUS, y] for y in (-0.03, 0.015)])
    motion = np.tile([0.02, 0.0], (2, 1))
    position, angle = slide(footprint(), start, motion, RADIUS, 0.02)
    path = ft.PushPath(distance=0.02, speed=0.01, approach=0.0)
    for k, (_, y) in enumerate(start):
        push = ft.Push((-SIDE / 2, y), (1, 0), path)
        effect = ft.simulate(
            Footed(PLATE), push, embodiment="tool", physics=ft.Physics(7900.0, 0.3, 0.02)
        ).effect
        first, last = effect.pose_trajectory[[0, -1]]
        np.testing.assert_allclose(last[:2] - first[:2], position[k], atol=0.001)
        assert 2 * np.arctan2(last[6], last[3]) == pytest.approx(angle[k], rel=0.08)


def test_constants_are_identified_from_pushes(tmp_path, monkeypatch):
    monkeypatch.setattr(sliding_constants, "ITERATIONS", 3)
    monkeypatch.setattr(sliding_constants, "STEPS", 15)
    truth = np.array([0.4, -0.4, -0.4, 0, 0, 0, 0, 1.0, 0.0])
    pushes = read_pushes(*write_push_table(tmp_path, 30, constants=truth, noise=1e-4))[0]
    found = SlidingTwin.identified(pushes)
    nominal, fitted = (
        push_errors(twin.predict(pushes), pushes.displacement()).mean(axis=0)
        for twin in (SlidingTwin(), found)
    )
    assert (fitted < 0.4 * nominal).all()
    assert found.shared[0] == pytest.approx(truth[0], abs=0.2)
    assert found.shared[1] == 0
    assert all(own[1] == pytest.approx(truth[1], abs=0.25) for own in found.own.values())
    with pytest.raises(PredictionError, match="give at least one"):
        SlidingTwin.identified(pushes[:0])


def test_a_change_of_circumstances_changes_a_push(tmp_path):
    pushes = read_pushes(*write_push_table(tmp_path, 12))[0]
    twin = SlidingTwin()
    for change in (Change(friction=2.0), Change(spread=0.5), Change(left=0.003), Change(turn=0.2)):
        assert np.abs(twin.predict(pushes, change) - twin.predict(pushes)).max() > 1e-4


def test_corrections_are_learned_and_their_regions_hold(tmp_path, monkeypatch):
    monkeypatch.setattr(sliding_residual, "FOLDS", 3)
    # The world pushes everything 3 mm farther than the twin says.
    pushes = read_pushes(*write_push_table(tmp_path, 260, farther=0.003, noise=2e-4))[0]
    learn, test = pushes[:160], pushes[160:]
    model = PushResidual(SlidingTwin()).fit(learn)
    found, scale = model.predict(test)
    errors = push_errors(found, test.displacement())
    plain = push_errors(SlidingTwin().predict(test), test.displacement())
    assert errors[:, 0].mean() < 0.7 * plain[:, 0].mean()
    inside = (errors <= model.regions.radius(0.8, scale)).mean(axis=0)
    assert ((inside > 0.65) & (inside < 0.95)).all()
    np.testing.assert_array_equal(
        errors <= model.regions.radius(0.8, scale), model.regions.level(errors, scale) < 0.8
    )
    with pytest.raises(PredictionError, match="10 pushes are too few"):
        PushResidual(None).fit(learn[:10])


def test_conformal_levels_are_ranks():
    regions = PushRegions(np.tile(np.arange(1.0, 10.0)[:, None], 2))
    np.testing.assert_allclose(regions.radius(0.5, np.ones((1, 2))), 5.0)
    np.testing.assert_allclose(regions.level(np.array([[5.0, 5.5]]), np.ones((1, 2))), [[0.4, 0.5]])
    assert np.isinf(regions.radius(0.95, np.ones((1, 2)))).all()


def test_splits_share_no_push_and_keep_their_test_part(tmp_path):
    pushes = read_pushes(*write_push_table(tmp_path, 120))[0]
    few, many = (split_pushes(pushes, count, None, 3) for count in (30, 60))
    assert set(few.test.line) == set(many.test.line)
    assert set(few.learn.line) < set(many.learn.line)
    assert not set(many.learn.line) & set(many.test.line)
    apart = split_pushes(pushes, None, "square", 0)
    assert {apart.test.shapes[k].name for k in apart.test.shape} == {"square"}
    assert {apart.learn.shapes[k].name for k in apart.learn.shape} == {"triangle"}
    with pytest.raises(ResultsError, match="held_out = 'disc': choose one of square, triangle"):
        split_pushes(pushes, None, "disc", 0)
    with pytest.raises(ResultsError, match="train = 100: give 30 to 60"):
        split_pushes(pushes, 100, None, 0)


def test_repeated_pushes_tell_the_floor(tmp_path):
    table, shapes = write_push_table(tmp_path, 10)
    rows = list(csv.DictReader(table.read_text().splitlines()))
    again = [dict(row, x1=float(row["x1"]) + 0.002) for row in rows]
    with open(table, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows([*rows, *again])
    found = repetitions(read_pushes(table, shapes)[0])
    assert found["pairs"] == 10
    assert found["position_mm"] == pytest.approx(2.0, abs=1e-6)


CHANGED = {
    "shape 'disc' is not in shapes.json, which has square, triangle": {"shape": "disc"},
    "x0 is 'nan': give a finite number": {"x0": "nan"},
    "theta1 is '': give a finite number": {"theta1": ""},
    "these look like millimetres": {"x1": "331.5"},
    "these look like degrees": {"theta0": "56.3"},
    "inside the object: are its poses in another frame?": {"tip_x0": None, "tip_y0": None},
    "from the object: are its poses in another frame?": {"tip_x0": "2.0"},
    "speed_mm_s is 0: give 0.5 to 1000 mm/s": {"speed_mm_s": "0"},
}


@pytest.mark.parametrize("message", CHANGED)
def test_one_bad_row_is_named_and_can_be_left_out(tmp_path, message):
    table, shapes = write_push_table(tmp_path, 20)
    rows = list(csv.DictReader(table.read_text().splitlines()))
    for name, value in CHANGED[message].items():
        rows[4][name] = rows[4]["x0" if name == "tip_x0" else "y0"] if value is None else value
    with open(table, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    with pytest.raises(DatasetError) as caught:
        read_pushes(table, shapes)
    assert message in str(caught.value)
    assert "1 of 20 rows are wrong: line 6:" in str(caught.value)
    assert "--skip-bad" in str(caught.value)
    pushes, faults = read_pushes(table, shapes, skip_bad=True)
    assert len(pushes) == 19
    assert len(faults) == 1


def test_files_that_are_no_pushes_are_refused(tmp_path):
    table, shapes = write_push_table(tmp_path, 5)
    text = table.read_text()
    refused = {
        "does not exist": (tmp_path / "none.csv", shapes),
        "no column theta0": (_file(tmp_path / "a.csv", text.replace("theta0", "angle", 1)), shapes),
        "has no pushes": (_file(tmp_path / "b.csv", text.splitlines()[0] + "\n"), shapes),
        "cannot be read": (_file(tmp_path / "c.csv", b"\xff\xfe\x00"), shapes),
        "has no shapes": (table, _file(tmp_path / "d.json", "{}")),
        "outline": (table, _file(tmp_path / "e.json", '{"square": {"thickness": 0.01, "mass": 1}}')),
        "shape 'square' of f.json": (
            table,
            _file(
                tmp_path / "f.json",
                json.dumps({"square": {"outline": [[0, 0], [1, 1], [2, 2]], "thickness": 0.01, "mass": 1}}),
            ),
        ),
    }
    for message, files in refused.items():
        with pytest.raises(ForetraceError, match=message):
            read_pushes(*files)


def _file(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_semicolons_and_decimal_commas_are_read(tmp_path):
    table, shapes = write_push_table(tmp_path, 5)
    other = _file(tmp_path / "other.csv", "\ufeff" + table.read_text().replace(",", ";").replace(".", ","))
    one, two = (read_pushes(path, shapes)[0] for path in (table, other))
    np.testing.assert_array_equal(one.rod, two.rod)


def test_a_table_becomes_a_data_set(tmp_path, capsys):
    table, shapes = write_push_table(tmp_path, 30)
    out = tmp_path / "data"
    assert main(["import", "pushes", str(table), "--shapes", str(shapes), "--out", str(out)]) == 0
    assert "2 shapes" in capsys.readouterr().out
    pushes = read_pushes(table, shapes)[0]
    dataset = ft.Dataset.open(out)
    assert len(dataset.times) == 2
    stored = dataset.with_id(0)
    assert stored.action.label == "push"
    assert stored.provenance.source == "recorded"
    row = next(k for k in range(len(pushes)) if pushes.action(k) is not None)
    turn = pushes.displacement()[row, 2]
    last = quaternion_to_matrix(stored.effect.pose_trajectory[:, 3:])
    seen = last[0].T @ last[1]
    assert np.arctan2(seen[1, 0], seen[0, 0]) == pytest.approx(turn)
    assert main(["data", str(out)]) == 0
    assert main(["import", "pushes", str(table), "--shapes", str(shapes), "--out", str(out)]) == 2


@pytest.mark.skipif(not (REAL / "pushes.csv").is_file(), reason="the recorded pushes are not here")
def test_the_recorded_pushes_are_read_and_the_twin_is_as_good_as_before():
    pushes, _ = read_pushes(REAL / "pushes.csv", REAL / "shapes.json")
    assert len(pushes) == 5598
    test = split_pushes(pushes, None, None, 0).test[:300]
    truth = test.displacement()
    peer = push_errors(test.displacement(test.peers["poly4"]), truth).mean(axis=0)
    own = push_errors(SlidingTwin().predict(test), truth).mean(axis=0)
    assert (own < 1.25 * peer).all()


def test_imaginers_of_lever_ups_refuse_pushes():
    push = ft.Push.at_edge(PLATE, 0)
    view = ft.TopDownView.of(PLATE, push)
    effect = ft.simulate(PLATE, push, embodiment="tool").effect
    for imagine in (
        lambda: ft.load_predictor().imagine(view, push),
        lambda: ft.TwinImaginer().imagine(view, push),
        lambda: ft.TwinImaginer().imagine_candidates(view, [push]),
        lambda: ft.identify(view, push, effect),
    ):
        with pytest.raises(
            PredictionError, match=r"imagines a lever-up, not a push: .* such as ft.SlidingTwin\(\)"
        ):
            imagine()


def test_a_rod_that_starts_inside_the_object_is_refused():
    with pytest.raises(
        ActionError, match=r"the rod starts \d+\.\d mm inside the object: give a direction into it"
    ):
        ft.simulate(PLATE, ft.Push((-SIDE / 2, 0), (-1, 0)), embodiment="tool")


def test_pushes_that_cannot_be_are_refused_or_left_out(tmp_path):
    with pytest.raises(ActionError, match=r"the rod moves by 0 m: give 0\.0005 m or more"):
        ft.PushPath(distance=0.05, approach=-0.05)
    for settings in ({"steps": 0}, {"seed": -1}, {"shared": np.full(9, np.nan)}):
        with pytest.raises(PredictionError, match="give whole numbers from 1 and from 0"):
            SlidingTwin(**settings)
    with pytest.raises(DatasetError, match="give at least one push"):
        RecordedPushes.of([])
    table, shapes = write_push_table(tmp_path, 30)
    pushes = read_pushes(table, shapes)[0]
    ahead = pushes.motion / np.linalg.norm(pushes.motion, axis=1)[:, None]
    far = replace(pushes, rod=pushes.rod + np.stack([-0.15 * ahead, 0 * ahead], axis=1))
    assert far.action(0) is None  # it starts 15 cm away
    assert push_interaction(replace(pushes, speed=np.full(30, 0.0005)), 0, 100.0, 0) is None
    text = table.read_text().splitlines()
    cells, names = text[1].split(","), text[0].split(",")
    cells[names.index("x1")] = "5.0"
    thrown = _file(tmp_path / "thrown.csv", "\n".join([text[0], ",".join(cells), *text[2:]]))
    with pytest.raises(DatasetError, match=r"line 2: the object moves by 4\.9 m, the rod by 0\.0\d+ m"):
        read_pushes(thrown, shapes)


def test_regions_are_those_of_the_constants_that_are_played(tmp_path):
    """Constants of a shape count in a twin of that shape alone."""
    truth = np.array([0.4, -0.4, -0.4, 0, 0, 0, 0, 1.0, 0.0])
    pushes = read_pushes(*write_push_table(tmp_path, 30, constants=truth, noise=1e-4))[0]
    shape = pushes.shapes[pushes.shape[0]].name
    own = pushes[np.flatnonzero(pushes.shape == pushes.shape[0])]
    twin = SlidingTwin(own={(pushes.surface[0], shape): truth})
    shared, exact = (
        twin.calibrated(own).errors,
        twin.of_shape(pushes.surface[0], shape).calibrated(own).errors,
    )
    assert shared is not None
    assert exact is not None
    assert np.median(exact) < 0.3 * np.median(shared)
    coarse = replace(SlidingTwin(), steps=2).calibrated(own).errors
    assert np.abs(coarse - SlidingTwin().calibrated(own).errors).max() > 1e-5


def test_names_that_look_like_numbers_and_strange_tables(tmp_path):
    table, shapes = write_push_table(tmp_path, 90)
    text = table.read_text()
    for name, number in (("square", "1"), ("triangle", "2")):
        text = text.replace(name, number)
    _file(shapes, shapes.read_text().replace("square", "1").replace("triangle", "2"))
    table = _file(table, text)
    options = ["--pushes", str(table), "--shapes", str(shapes), "--methods", "simulation"]  # without regions
    assert main(["evaluate", "pushes", *options, "--out", str(tmp_path / "alone")]) == 0
    options.append("stays")
    assert main(["evaluate", "pushes", *options, "--out", str(tmp_path / "out")]) == 0
    assert "shape 1" in (tmp_path / "out" / "report.md").read_text()
    doubled = _file(tmp_path / "twice.csv", table.read_text().replace("surface,", "x0,", 1))
    with pytest.raises(DatasetError, match="has the column 'x0' twice"):
        read_pushes(doubled, shapes)
    with pytest.raises(DatasetError, match=r"rod_radius = 4\.75 m: give 0\.0005 to 0\.1 m"):
        read_pushes(table, shapes, radius=4.75)


def test_options_of_a_lever_ups_path_are_refused_for_pushes(tmp_path, capsys):
    command = [
        "simulate",
        "--recipe",
        "pushes",
        "--embodiment",
        "tool",
        "--objects",
        "1",
        "--contacts-per-edge",
        "1",
    ]
    assert main([*command, "--workers", "1", "--out", str(tmp_path / "out"), "--insertion", "0.03"]) == 2
    told = "insertion = 0.03 is of a lever-up's path, and recipe 'pushes' has a push"
    assert told in capsys.readouterr().err


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A data set of pushes that are known at their ends alone."""
    folder = tmp_path_factory.mktemp("recorded")
    table, shapes = write_push_table(folder, 40)
    assert main(["import", "pushes", str(table), "--shapes", str(shapes), "--out", str(folder / "data")]) == 0
    return ft.Dataset.open(folder / "data").batch()


@pytest.mark.parametrize("name", sorted(VIEWED))
def test_predictors_learn_from_pushes_that_are_known_at_their_ends(recorded, name, tmp_path, capsys):
    split = split_by_seed(len(recorded), 0, None)
    training = TrainConfig(epochs=3, min_steps=1, outcomes=OUTCOMES, split=None)
    predictor, _ = fit_predictor(recorded, VIEWED[name], split, training)
    assert predictor.action is ft.Push
    imagined = predictor.imagine_batch(recorded)
    assert imagined.com.shape == (len(recorded), 2, 3)
    mirrored = predictor.imagine_batch(recorded.mirrored())
    np.testing.assert_allclose(mirrored.com, imagined.com * [1, -1, 1], atol=2e-6)
    twice = recorded.parameters | {"distance": 2 * recorded.parameters["distance"]}
    farther = predictor.imagine_batch(replace(recorded, parameters=twice))
    assert np.abs(farther.com - imagined.com).max() > 1e-5
    view = ft.TopDownView.of(PLATE, ft.Push.at_edge(PLATE, 1))
    slow = ft.Push.at_edge(PLATE, 1, path=ft.PushPath(distance=0.03))
    assert predictor.imagine(view, slow).com_trajectory.shape == (2, 3)
    predictor.save_pretrained(tmp_path / "run")
    assert main(["predict", str(tmp_path / "run"), "--photo", "a.jpg", "--contact-px", "1", "1"]) == 2
    assert "--photo goes with lever-ups" in capsys.readouterr().err


def test_an_object_relative_to_an_action():
    corners = torch.tensor(np.add(SQUARE, [SIDE / 2, 0.01]))[None].float()
    corners = torch.cat([corners, corners[:, :1]], dim=1)  # the first corner fills the row
    values = find_action_frame(corners, torch.tensor([[SIDE / 2, 0.01, 0.0065]])).values
    com, radii, front = values[0, 0, 0].split([3, RAYS, PROBES])
    np.testing.assert_allclose(com, [0.45, 0.1, 0.065], atol=1e-6)
    angles = 2 * np.pi * np.arange(RAYS) / RAYS
    expected = SIDE / 2 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    np.testing.assert_allclose(radii, 10 * expected, atol=1e-5)
    np.testing.assert_allclose(front, 0.0, atol=1e-6)  # its side is straight and across the path


def test_views_answer_for_recorded_pushes(tmp_path, monkeypatch):
    monkeypatch.setattr(pushes_views, "EPOCHS", 8)
    pushes = read_pushes(*write_push_table(tmp_path, 100))[0]
    config = replace(VIEWED["one-shot"], ensemble=1)
    found, regions, scale = answer_from_views(config, pushes[:60], pushes[60:], 0)
    errors = push_errors(found, pushes[60:].displacement())
    stays = push_errors(np.zeros_like(found), pushes[60:].displacement())
    assert (errors.mean(axis=0) < 0.5 * stays.mean(axis=0)).all()
    assert regions.radius(0.5, scale).shape == errors.shape
