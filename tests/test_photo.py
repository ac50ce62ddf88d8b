"""A photograph, with or without depth, markers and background, becomes a view that a predictor can use."""

import json
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from foretrace.cli import main
from foretrace.errors import PerceptionError, ViewError
from foretrace.geometry import invert_transform, transform_points
from foretrace.interactions.recording_folder import read_depth, read_image
from foretrace.interactions.topdown import TopDownView
from foretrace.perception.markers import MarkerBody, MarkerLayout
from foretrace.perception.photo import PhotoConfig, PhotoView, observe_photo, open_photo
from foretrace.simulation.recording import RecordingTruth
from recorded_scene import ACTION, CAMERA, PRISM, contact_pixel

Recorded = tuple[Path, RecordingTruth]
BY_GRABCUT = {"mask": "grabcut", "box": (250, 100, 300, 250)}


@pytest.fixture(scope="module")
def images(recorded: Recorded) -> dict:
    """The first frame, its depth, the background and the layout."""
    folder = recorded[0]
    return {
        "image": read_image(folder / "colour-00000.jpg"),
        "depth": read_depth(folder / "depth-00000.png"),
        "background": read_image(folder / "background.png"),
        "layout": MarkerLayout.load(folder / "markers.json"),
    }


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


def check(found: PhotoView, truth: RecordingTruth, least_overlap: float, height_error: float) -> None:
    """The view, the height and the camera are the true ones; the outline is drawn where the object is seen."""
    exact = TopDownView.of(PRISM, ACTION)
    assert overlap(found.view.mask, exact.mask) > least_overlap
    assert found.height == pytest.approx(PRISM.height, abs=height_error)
    T_action_camera = invert_transform(truth.T_table_action) @ truth.T_table_camera
    np.testing.assert_allclose(found.T_action_camera, T_action_camera, atol=0.03)
    assert found.outline[:, 2] == pytest.approx(found.height, abs=1e-9)
    com = transform_points(ACTION.T_action_object, PRISM.mass_properties(1.0).com[None])[0]
    assert found.com is not None
    np.testing.assert_allclose(found.com[:2], com[:2], atol=0.004)
    drawn = np.abs(found.overlay().astype(int) - found.image).max(axis=2) > 60
    rows, columns = np.nonzero(drawn)
    upper = (
        truth.T_table_object[0]
        @ np.column_stack([PRISM.corners, np.full((len(PRISM.corners), 2), [PRISM.height, 1.0])]).T
    )
    pixels = CAMERA.project(upper[:3].T, invert_transform(truth.T_table_camera))
    assert abs(columns.min() - pixels[:, 0].min()) < 8
    assert abs(rows.max() - pixels[:, 1].max()) < 8


@pytest.mark.parametrize("given", ["layout", "pose", "depth"])
@pytest.mark.parametrize("mask", ["background", "depth"])
def test_every_way_to_place_the_camera_and_to_find_the_object(
    recorded: Recorded, images: dict, given: str, mask: str
) -> None:
    truth = recorded[1]
    found = observe_photo(
        images["image"],
        CAMERA,
        contact_pixel(truth),
        layout=images["layout"] if given == "layout" else None,
        T_table_camera=truth.T_table_camera if given == "pose" else None,
        depth=images["depth"],
        background=images["background"] if mask == "background" else None,
    )
    check(found, truth, 0.97 if mask == "background" else 0.95, 0.0015)
    if given == "depth":  # a frame of its own, with the camera above its origin
        np.testing.assert_allclose(found.T_table_camera[:2, 3], 0.0, atol=1e-9)


def test_without_depth_the_height_is_given_or_the_default(recorded: Recorded, images: dict) -> None:
    truth = recorded[1]

    def height_of(**settings) -> float:
        here = (images["image"], CAMERA, contact_pixel(truth))
        chosen = PhotoConfig(shadows=False, **settings)
        layout, background = images["layout"], images["background"]
        return observe_photo(*here, layout=layout, background=background, config=chosen).height

    assert height_of() == 0.02
    assert height_of(height=0.024) == 0.024
    with pytest.raises(PerceptionError, match=r"height is 0\.0: give metres, above 0"):
        height_of(height=0.0)


def test_depth_measures_the_height_whatever_finds_the_object(recorded: Recorded, images: dict) -> None:
    truth = recorded[1]
    # Depth of an object that stands 8 mm higher than its default.
    nearer = 0.008 / truth.T_table_camera[2, 2]  # the optical axis looks down, aslant
    lifted = np.where(mask_of(truth), images["depth"] + nearer, images["depth"])
    here = (images["image"], CAMERA, contact_pixel(truth))
    found = observe_photo(
        *here, layout=images["layout"], depth=lifted, background=images["background"], config=PhotoConfig()
    )
    assert found.height == pytest.approx(PRISM.height + 0.008, abs=0.0015)
    fixed = observe_photo(*here, layout=images["layout"], depth=lifted, config=PhotoConfig(height=0.02))
    assert fixed.height == 0.02


def mask_of(truth: RecordingTruth) -> np.ndarray:
    """The upper face in the first frame."""
    upper = np.column_stack([PRISM.corners, np.full((len(PRISM.corners), 1), PRISM.height)])
    seen = transform_points(truth.T_table_object[0], upper)
    pixels = CAMERA.project(seen, invert_transform(truth.T_table_camera))
    canvas = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    return cv2.fillPoly(canvas, [np.rint(pixels).astype(np.int32)], 1) > 0


def test_objects_that_are_not_flat_keep_the_measured_heights(recorded: Recorded, images: dict) -> None:
    truth = recorded[1]
    here = {"layout": images["layout"], "depth": images["depth"]}
    call = (images["image"], CAMERA, contact_pixel(truth))
    flat, solid = (observe_photo(*call, **here, config=PhotoConfig(flat=flat)) for flat in (True, False))
    assert np.unique(flat.view.height[flat.view.mask]).size < 3
    measured = solid.view.height[solid.view.mask]
    assert measured.std() > 1e-4
    assert np.median(measured) == pytest.approx(PRISM.height, abs=0.002)
    assert overlap(solid.view.mask, flat.view.mask) > 0.85
    assert solid.com is None
    with pytest.raises(PerceptionError, match="needs a depth image"):
        observe_photo(*call, layout=images["layout"], config=PhotoConfig(flat=False))


def test_depth_takes_over_where_no_marker_is_seen(recorded: Recorded, images: dict) -> None:
    truth, layout = recorded[1], images["layout"]
    smooth = cv2.GaussianBlur(images["image"], (0, 0), 6)
    smooth[mask_of(truth)] = images["image"][mask_of(truth)]
    here = (smooth, CAMERA, contact_pixel(truth))
    with pytest.warns(UserWarning, match="the table is found by depth, since by markers: .* not seen"):
        found = observe_photo(*here, layout=layout, depth=images["depth"])
    check(found, truth, 0.95, 0.0015)
    with pytest.raises(PerceptionError, match="not seen"):
        observe_photo(*here, layout=layout, background=images["background"])
    with pytest.raises(PerceptionError, match="neither a marker layout nor a depth image"):
        observe_photo(*here, background=images["background"])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mask": "background"}, "needs --background"),
        ({"mask": "depth"}, "needs --depth"),
        ({}, "give --box LEFT TOP WIDTH HEIGHT round it, --background, --depth"),
    ],
)
def test_what_a_method_needs_is_named(recorded: Recorded, images: dict, settings: dict, message: str) -> None:
    here = (images["image"], CAMERA, contact_pixel(recorded[1]))
    with pytest.raises(PerceptionError, match=message):
        observe_photo(*here, layout=images["layout"], config=PhotoConfig(**settings))
    with pytest.raises(PerceptionError, match="depth image has 400 x 450 pixels"):
        observe_photo(*here, layout=images["layout"], depth=images["depth"][:, :400])


def test_depth_images_are_read_in_their_units(tmp_path: Path) -> None:
    metres = np.array([[0.5, 0.0], [np.nan, 1.25]])
    np.save(tmp_path / "depth.npy", metres)
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.npy"), [[0.5, 0.0], [0.0, 1.25]])
    cv2.imwrite(str(tmp_path / "depth.png"), np.array([[500, 0], [0, 1250]], np.uint16))
    np.testing.assert_allclose(read_depth(tmp_path / "depth.png"), [[0.5, 0.0], [0.0, 1.25]])
    (tmp_path / "film.json").write_text(json.dumps({"depth_unit": 0.0001}))
    np.testing.assert_allclose(read_depth(tmp_path / "depth.png"), [[0.05, 0.0], [0.0, 0.125]])


def test_depth_images_of_other_kinds(tmp_path: Path) -> None:
    metres = np.array([[0.5, 0.0], [np.nan, 1.25]], np.float32)
    cv2.imwrite(str(tmp_path / "depth.tif"), metres)
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.tif"), [[0.5, 0.0], [0.0, 1.25]])
    np.save(tmp_path / "depth.npy", np.array([[500, 0], [0, 1250]], np.uint16).T)
    np.testing.assert_allclose(read_depth(tmp_path / "depth.npy"), [[0.5, 0.0], [0.0, 1.25]])
    for values in (metres * 1000, metres / 1000):
        np.save(tmp_path / "depth.npy", values)
        with pytest.raises(
            PerceptionError, match=r"median depth of \S+ m, in units of 1 m: write fractions in m"
        ):
            read_depth(tmp_path / "depth.npy")


@pytest.mark.parametrize("content", [None, b"", "eight bits", "three numbers", "objects"])
def test_what_is_no_depth_image_is_refused(tmp_path: Path, content: str | bytes | None) -> None:
    file = tmp_path / ("depth.npy" if content in ("three numbers", "objects") else "depth.png")
    if content == "eight bits":
        cv2.imwrite(str(file), np.zeros((4, 4), np.uint8))
    elif content == "three numbers":
        np.save(file, np.zeros(3))
    elif content == "objects":
        np.save(file, np.array([{}], dtype=object), allow_pickle=True)
    elif isinstance(content, bytes):
        file.write_bytes(content)
    with pytest.raises(PerceptionError, match="depth") as refused:
        read_depth(file)
    assert str(file) in str(refused.value)
    assert "16 bits per pixel" in str(refused.value)


def test_the_command_reaches_all_of_it(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, truth = recorded
    column, row = (f"{value:.1f}" for value in contact_pixel(truth))
    alone = tmp_path / "alone"
    alone.mkdir()
    for name in ("colour-00000.jpg", "depth-00000.png", "camera.json", "film.json"):
        shutil.copy(folder / name, alone)
    out = tmp_path / "out"
    command = ["predict", "--photo", str(alone / "colour-00000.jpg"), "--contact-px", column, row]
    command += ["--no-animation", "--out", str(out)]
    assert main(command) == 2
    assert "markers.json does not exist" in capsys.readouterr().err
    with_depth = [*command, "--depth", str(alone / "depth-00000.png")]
    assert main(with_depth) == 0
    content = json.loads((out / "trajectory.json").read_text())
    assert content["object"]["height"] == pytest.approx(PRISM.height, abs=0.0015)
    drawn, photo = read_image(out / "overlay.png"), read_image(alone / "colour-00000.jpg")
    assert (np.abs(drawn.astype(int) - photo).max(axis=2) > 60).sum() > 200
    assert main([*with_depth, "--no-flat"]) == 0
    measured = json.loads((out / "trajectory.json").read_text())
    assert measured["com_trajectory"] != content["com_trajectory"]
    assert main(["predict", "--depth", str(alone / "depth-00000.png"), "--out", str(out)]) == 2
    assert "--depth goes with --photo" in capsys.readouterr().err


def test_files_and_arrays_give_the_same(recorded: Recorded, images: dict) -> None:
    folder, truth = recorded
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = open_photo(
            folder / "colour-00000.jpg",
            contact_pixel(truth),
            depth=folder / "depth-00000.png",
            background=folder / "background.png",
        )
    others = {name: image for name, image in images.items() if name != "image"}
    same = observe_photo(images["image"], CAMERA, contact_pixel(truth), **others)
    np.testing.assert_array_equal(found.view.mask, same.view.mask)
    np.testing.assert_array_equal(found.T_table_camera, same.T_table_camera)


def test_a_photograph_taken_too_flat_is_refused_as_that(recorded: Recorded, images: dict) -> None:
    flat = np.eye(4)
    flat[:3, 1], flat[:3, 2] = [0, 0, -1], [0, 1, 0]  # looks along the table
    flat[:3, :3] = cv2.Rodrigues(np.array([np.deg2rad(-10.0), 0, 0]))[0] @ flat[:3, :3]
    flat[:3, 3] = [0.0, -0.6, 0.1]
    middle = (CAMERA.cx, CAMERA.cy)
    with pytest.raises(
        PerceptionError, match="from 10 degrees above the table, 15 are needed: take it from higher"
    ):
        observe_photo(images["image"], CAMERA, middle, T_table_camera=flat, background=images["background"])


def test_markers_of_another_size_than_stated_are_pointed_out(recorded: Recorded, images: dict) -> None:
    def seen(times: float) -> PhotoView:
        body = images["layout"].table
        farther = np.array([[1, 1, 1, times]] * 3 + [[1, 1, 1, 1]])
        poses = {id: farther * pose for id, pose in body.placements.items()}
        table = MarkerBody({id: times * side for id, side in body.sides.items()}, poses)
        here = (images["image"], CAMERA, contact_pixel(recorded[1]))
        layout = replace(images["layout"], table=table)
        return observe_photo(*here, layout=layout, background=images["background"])

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert seen(1.0).placed.object.size == pytest.approx(PRISM.size, abs=0.004)
    told = r"the object is 5\d\.?\d? cm long on the table: check the sides of the markers as printed"
    with pytest.warns(UserWarning, match=told), pytest.raises(ViewError, match="check the scale"):
        seen(3.0)
    with pytest.raises(PerceptionError, match=r"over a metre of table: .*; check the sides of the markers"):
        seen(10.0)
