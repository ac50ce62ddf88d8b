"""Recorded motions: the format's every doubt, and how far simulations stray from them."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import trimesh

from engines_at_hand import every_engine
from foretrace.cli import main
from foretrace.errors import DatasetError
from foretrace.experiments.replay import estimate_velocity, replay
from foretrace.interactions.motions import ContactParameters, Recording, read_recordings
from foretrace.objects.body import Body
from foretrace.simulation.free_motion import simulate_free_motion

EXAMPLE = Path(__file__).parents[1] / "examples" / "replay_recording" / "recordings.json"
TIMES = np.arange(31) / 30
BOX = {"kind": "box", "size": [0.1, 0.08, 0.04]}


def entry(**changes: Any) -> dict[str, Any]:
    """A box that slides, as an entry of a file."""
    motion = simulate_free_motion(
        Body.box(BOX["size"], 0.3),
        [0, 0, 0.02, 1, 0, 0, 0],
        1.0,
        velocity=[0.7, 0, 0, 0, 0, 0],
        contact_parameters=ContactParameters(0.4, restitution=0.0),
        timestep=0.001,
    ).at(TIMES)
    values = {
        "name": "slide",
        "source": "test",
        "object": BOX,
        "mass": 0.3,
        "friction": 0.4,
        "linear_velocity": [0.7, 0, 0],
        "angular_velocity": [0, 0, 0],
        "times": TIMES.tolist(),
        "poses": motion.poses.tolist(),
    }
    return {key: value for key, value in (values | changes).items() if value is not None}


def written(folder: Path, *entries: dict[str, Any], **changes: Any) -> Path:
    content = {"format": "foretrace-motion", "version": 1, "units": "m, kg, s", "recordings": list(entries)}
    file = folder / "motion.json"
    file.write_text(json.dumps(content | changes), encoding="utf-8")
    return file


def one(folder: Path, **changes: Any) -> Recording:
    return read_recordings(written(folder, entry(**changes)))[0]


def test_its_own_motion_is_replayed_exactly(tmp_path: Path) -> None:
    found = replay(one(tmp_path))
    assert found.position_error.max() < 1e-9
    assert found.rotation_error.max() < 1e-6
    assert found.right_face


@every_engine
def test_errors_grow_with_a_wrong_friction(engine: str, tmp_path: Path) -> None:
    """0.7 m/s: 6.2 cm at a friction of 0.4, 8.3 cm at 0.3."""
    found = replay(one(tmp_path, friction=0.3), engine)
    assert found.position_error[0] == 0
    assert found.position_error[-1] == pytest.approx(0.7**2 / 2 / 9.81 * (1 / 0.3 - 1 / 0.4), rel=0.1)
    assert found.right_face


def test_the_wrong_side_is_noticed(tmp_path: Path) -> None:
    values = entry()
    poses = np.array(values["poses"])
    poses[20:, 3:] = [np.sqrt(0.5), 0, np.sqrt(0.5), 0]
    found = replay(one(tmp_path, poses=poses.tolist()))
    assert not found.right_face
    assert np.rad2deg(found.down_error) == pytest.approx(90, abs=1)


def test_a_cylinder_may_rest_on_any_line_of_its_side(tmp_path: Path) -> None:
    half = float(np.sqrt(0.5))
    lying = {"object": {"kind": "cylinder", "radius": 0.03, "length": 0.1}, "friction": 0.8}
    poses = np.tile([0, 0, 0.03, half, half, 0, 0], (31, 1))
    recording = one(tmp_path, **lying, poses=poses.tolist())
    assert recording.is_round
    found = replay(recording)  # starts at 0.7 m/s, slips, and rolls on
    assert found.rotation_error[-1] > 0.5
    assert found.right_face


def test_velocities_are_estimated_from_the_first_frames(tmp_path: Path) -> None:
    times = np.arange(60) / 120
    body = Body.box(BOX["size"], 0.3)
    velocity = [0.4, -0.2, 1.5, 1.0, 5.0, -2.0]
    motion = simulate_free_motion(body, [0, 0, 0.5, 0.8, 0, 0.6, 0], 0.5, velocity=velocity, timestep=0.0005)
    poses = motion.at(times).poses.tolist()
    recording = one(tmp_path, times=times.tolist(), poses=poses, linear_velocity=None, angular_velocity=None)
    assert recording.velocity is None
    np.testing.assert_allclose(estimate_velocity(recording), velocity, rtol=0.05, atol=0.05)
    assert replay(recording).position_error.max() < 0.05
    two = one(tmp_path, times=[0, 0.01], poses=poses[:2], linear_velocity=None, angular_velocity=None)
    assert np.isfinite(estimate_velocity(two)).all()


@pytest.mark.parametrize("height", [0.08, 0.1, 0.5])
@pytest.mark.parametrize("uneven", [False, True])
def test_velocities_come_from_before_the_first_contact(height: float, uneven: bool, tmp_path: Path) -> None:
    """Dropped from low enough, the box meets the table within the frames that are looked at, and turns over."""
    times, velocity = np.arange(60) / 148, np.array([0.4, -0.2, -0.6, 1.0, 5.0, -2.0])
    gravity = (1.5, 0.0, -9.7) if uneven else (0.0, 0.0, -9.81)
    surface = ContactParameters(0.4, restitution=0.1, gravity=gravity)
    start = [0, 0, height, 0.8, 0, 0.6, 0]
    motion = simulate_free_motion(
        Body.box(BOX["size"], 0.3), start, 0.5, velocity=velocity, contact_parameters=surface, timestep=0.0005
    )
    found = one(
        tmp_path,
        times=times.tolist(),
        poses=motion.at(times).poses.tolist(),
        restitution=0.1,
        linear_velocity=None,
        angular_velocity=None,
        gravity=gravity,
    )
    np.testing.assert_allclose(estimate_velocity(found), velocity, rtol=0.02, atol=0.02)


@pytest.mark.parametrize("kind", ["prism", "hull", "mesh"])
def test_every_geometry_weighs_and_stands_as_a_box(kind: str, tmp_path: Path) -> None:
    corners = np.array([[-0.05, -0.04], [0.05, -0.04], [0.05, 0.04], [-0.05, 0.04]])
    vertices = np.array([[*corner, z] for corner in corners for z in (0.0, 0.04)])
    trimesh.Trimesh(1e3 * vertices).convex_hull.export(tmp_path / "box.stl")
    shapes = {
        "prism": {"corners": corners.tolist(), "height": 0.04},
        "hull": {"vertices": vertices.tolist()},
        "mesh": {"file": "box.stl", "scale": 0.001},
    }
    recording = one(tmp_path, object={"kind": kind, **shapes[kind]})
    expected = Body.box(BOX["size"], 0.3).mass
    np.testing.assert_allclose(recording.body.mass.inertia, expected.inertia, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(recording.body.mass.com, [0, 0, 0.02], atol=1e-8)
    assert recording.body.lowest(np.array([0, 0, 0, 1.0, 0, 0, 0])) == pytest.approx(0, abs=1e-9)


def test_mass_properties_may_be_given(tmp_path: Path) -> None:
    inertia = np.diag([2e-4, 3e-4, 4e-4])
    recording = one(tmp_path, com=[0.01, 0, -0.005], inertia=inertia.tolist())
    np.testing.assert_array_equal(recording.body.mass.com, [0.01, 0, -0.005])
    np.testing.assert_array_equal(recording.body.mass.inertia, inertia)


def frames(change: Any) -> list[list[float]]:
    poses = np.tile([0, 0, 0.02, 1.0, 0, 0, 0], (31, 1))
    change(poses)
    return poses.tolist()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": None}, "entry mass is missing"),
        ({"friction": None}, "entry friction is missing"),
        ({"poses": None}, "entry poses is missing"),
        ({"angular_velocity": None}, "give both, or none"),
        ({"mass": -1.0}, "entry mass is -1.0, a finite number above 0.0"),
        ({"mass": "heavy"}, "entry mass is 'heavy', a finite number"),
        ({"friction": -0.1}, "friction coefficient -0.1"),
        (
            {"object": {"kind": "sphere"}},
            "object of kind 'sphere' is unknown: choose one of box, cylinder, hull",
        ),
        ({"object": "box"}, "entry object is 'box', an object is expected"),
        (
            {"object": {"kind": "box", "size": [0.1, 0.1]}},
            "entry object.size is [0.1, 0.1], a list of at least 3",
        ),
        ({"object": {"kind": "box", "size": [0.1, 0.0, 0.1]}}, "lengths in metres must be above 0"),
        ({"object": {"kind": "mesh", "file": "gone.stl"}}, "gone.stl does not exist"),
        ({"object": {"kind": "hull", "vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0]]}}, "enclose no volume"),
        ({"inertia": np.diag([1.0, 1.0, 3.0]).tolist()}, "no body has the principal inertia"),
        ({"times": TIMES[::-1].tolist()}, "times must rise: 0.966667 s follows 1 s"),
        ({"times": TIMES[:-1].tolist()}, "30 times and 31 poses"),
        ({"times": [0.0], "poses": frames(lambda poses: None)[:1]}, "at least two frames"),
        ({"poses": frames(lambda poses: poses.__setitem__((3, 3), 0.9))}, "of pose 3 has length 0.9, not 1"),
        (
            {"poses": frames(lambda poses: poses.__setitem__((0, 2), 0.005))},
            "the object is 15.0 mm deep in the table",
        ),
    ],
)
def test_bad_recordings_are_refused_in_one_line(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(DatasetError, match=re.escape(message)) as caught:
        one(tmp_path, **changes)
    assert "motion.json: recording slide: " in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "other"}, "does not describe a foretrace-motion"),
        ({"version": 2}, "has format version 2, this foretrace reads version 1"),
        ({"units": "mm"}, "has units 'mm': convert it to \"m, kg, s\""),
        ({"recordings": []}, "entry recordings is [], a list of at least 1"),
        ({"recordings": [3]}, "entry recordings[0] is 3, an object is expected"),
    ],
)
def test_bad_files_are_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=re.escape(message)):
        read_recordings(written(tmp_path, entry(), **changes))


def test_files_that_are_none_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "broken.json").write_text("{", encoding="utf-8")
    assert main(["evaluate", "replay", str(tmp_path / "broken.json")]) == 2
    assert "broken.json cannot be read" in capsys.readouterr().err
    assert main(["evaluate", "replay", str(tmp_path / "none.json")]) == 2
    assert "does not exist" in capsys.readouterr().err
    written(tmp_path, entry() | {"poses": frames(lambda poses: poses.__setitem__((3, 0), np.nan))})
    assert main(["evaluate", "replay", str(tmp_path / "motion.json")]) == 2
    assert "entry recordings[0].poses[3][0] is nan, a finite number" in capsys.readouterr().err
    file = str(written(tmp_path, entry(), entry()))
    assert main(["evaluate", "replay", file]) == 2
    assert "two recordings are called slide" in capsys.readouterr().err


def test_a_start_that_noise_put_into_the_table_is_lifted_out(tmp_path: Path) -> None:
    poses = frames(lambda poses: poses.__setitem__((0, 2), 0.018))
    found = replay(one(tmp_path, poses=poses, linear_velocity=[0, 0, 0]))
    assert found.poses[0, 2] == pytest.approx(0.02)
    np.testing.assert_allclose(found.poses[:, 2], 0.02, atol=1e-3)


@every_engine
def test_the_example_is_replayed(engine: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "replay"
    assert main(["evaluate", "replay", str(EXAMPLE), "--engine", engine, "--out", str(out)]) == 0
    assert "right" in capsys.readouterr().out
    errors = pd.read_csv(out / "rows.csv")
    assert set(errors["recording"]) == {"box tipped over", "cylinder rolled"}
    assert list(errors.columns)[:4] == ["recording", "time", "position_error_m", "rotation_error_deg"]
    content = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert content["identity"]["engine"] == engine
    summary = content["summary"]
    assert summary["share_right_face"] == 1.0
    box, cylinder = summary["recordings"]
    assert (box["start_velocity"], cylinder["start_velocity"]) == ("recorded", "estimated")
    # 1 cm and 3 degrees over a second: noise of the recording and, in Bullet, another engine.
    assert box["final_position_error_m"] < 0.01
    assert box["final_rotation_error_deg"] < 3
    assert cylinder["mean_position_error_m"] < 0.01
