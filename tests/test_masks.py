"""Masks of painted objects, and the objects that they show."""

import cv2
import numpy as np
import pytest

from foretrace.errors import PerceptionError
from foretrace.geometry import invert_transform, rotation_angle
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.interactions.topdown import TopDownView
from foretrace.objects import Prism
from foretrace.perception import masks
from foretrace.perception.views import (
    PlacedObject,
    contact_at_pixel,
    fit_object,
    observe,
    place_object,
    view_of_depth,
)

CAMERA = PinholeCamera(640, 480, 560.0, 560.0, 322.0, 238.0, (0.05, -0.1, 0.0, 0.0, 0.0))
DEPTH_CAMERA = PinholeCamera(320, 240, 280.0, 280.0, 161.0, 119.0)
PRISM = Prism([(0.07, -0.03), (0.05, 0.06), (-0.04, 0.07), (-0.08, -0.02), (-0.01, -0.07)], height=0.03)

BLUNT = Prism([(0.07, -0.01), (0.07, 0.01), (0.02, 0.07), (-0.07, 0.03), (-0.05, -0.06), (0.03, -0.05)])
"""Its first side is short."""


def camera_pose() -> np.ndarray:
    """T_table_camera: 0.6 m away, 35 degrees from the vertical."""
    slant = np.deg2rad(35)
    T = np.eye(4)
    T[:3, 1], T[:3, 2] = [0, -np.cos(slant), -np.sin(slant)], [0, np.sin(slant), -np.cos(slant)]
    T[:3, 3] = -0.6 * T[:3, 2] + [0.0, 0.0, 0.0]
    return T


def placed() -> PlacedObject:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]]
    T[:2, 3] = [0.03, -0.02]
    return PlacedObject(PRISM, T)


def silhouette(here: PlacedObject, scale: int = 4) -> np.ndarray:
    """A prism as the camera sees it, each pixel's share of it."""
    T, prism = invert_transform(camera_pose()), here.object
    canvas = np.zeros((480 * scale, 640 * scale), np.uint8)
    for height in np.linspace(0.003, prism.height, 24):
        pixels = CAMERA.project(here.outline(height), T)
        cv2.fillPoly(canvas, [np.rint(((pixels + 0.5) * scale - 0.5) * 16).astype(np.int32)], 255, shift=4)
    return cv2.resize(canvas, (640, 480), interpolation=cv2.INTER_AREA) / 255.0


@pytest.fixture(scope="module")
def share() -> np.ndarray:
    return silhouette(placed())


def image(share: np.ndarray, light: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    table, colour = np.array([200.0, 208, 214]), np.array([150.0, 90, 20])
    slope = np.linspace(1.0, 0.85, 640)[None, :, None]
    background = np.broadcast_to(table, (480, 640, 3)) * slope
    scene = (background * (1 - share[..., None]) + colour * slope * share[..., None]) * light
    noisy = [
        np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
        for image in (scene, background)
    ]
    return noisy[0], noisy[1]


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


def test_a_background_of_several_colours_leaves_no_dent(share: np.ndarray) -> None:
    """Something dark stands behind the rim, which hides part of it: less contrast is no less object."""
    columns = np.nonzero(share.max(axis=0) > 0)[0]
    behind = np.zeros(share.shape, bool)
    behind[:, columns[len(columns) // 3] : columns[len(columns) // 3] + 14] = True
    background = np.where(behind[..., None], np.array([95.0, 75, 65]), np.array([200.0, 208, 214]))
    scene = background * (1 - share[..., None]) + np.array([150.0, 90, 20]) * share[..., None]
    blurred = [cv2.GaussianBlur(image, (0, 0), 1.0) for image in (scene, background)]
    rng = np.random.default_rng(0)
    noisy = [np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8) for image in blurred]
    found = masks.find_by_background(noisy[0], noisy[1]) > 0.5
    assert iou(found, share > 0.5) > 0.995


@pytest.mark.parametrize("way", ["background", "threshold", "colour", "grabcut"])
def test_ways_to_find_an_object(share: np.ndarray, way: str) -> None:
    scene, background = image(share, light=0.9)
    found = {
        "background": lambda: masks.cover_by_background(scene, background) > 0.5,
        "threshold": lambda: masks.mask_by_threshold(scene),
        "colour": lambda: masks.mask_by_colour(scene, (335.0, 235.0)),
        "grabcut": lambda: masks.mask_by_grabcut(scene, (200, 120, 260, 240)),
    }[way]()
    assert iou(masks.pick_object(found, (335.0, 235.0)), share >= 0.5) > 0.98


def test_a_mask_becomes_the_object_where_it_lies(share: np.ndarray) -> None:
    seen = place_object(share >= 0.5, CAMERA, camera_pose(), PRISM.height)
    fitted = fit_object(seen, PRISM)
    away = invert_transform(placed().T_table_object) @ fitted.T_table_object
    assert np.linalg.norm(away[:3, 3]) < 0.0007
    assert rotation_angle(away[:3, :3], np.eye(3)) < np.deg2rad(0.5)
    contact = 0.5 * (PRISM.corners[1] + PRISM.corners[2])
    rim = placed().T_table_object @ [*contact, PRISM.height, 1.0]
    pixel = CAMERA.project(rim[None, :3], invert_transform(camera_pose()))[0]
    sight = observe(seen, contact_at_pixel(seen, (pixel[0], pixel[1]), CAMERA, camera_pose()))
    exact = observe(placed(), contact)
    assert iou(sight.view.mask, exact.view.mask) > 0.98
    np.testing.assert_allclose(sight.com_in_action, exact.com_in_action, atol=0.001)
    np.testing.assert_allclose(sight.T_table_action, exact.T_table_action, atol=0.01)


def test_without_parallax_undone_the_object_would_be_too_large(share: np.ndarray) -> None:
    seen = place_object(share >= 0.5, CAMERA, camera_pose(), 0.004)
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(
            np.ptp(seen.object.corners, axis=0), np.ptp(placed().outline()[:, :2], axis=0), atol=0.004
        )


def depth_image() -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(320), np.arange(240))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(float)
    T = camera_pose()
    rays = DEPTH_CAMERA.rays(pixels)
    depth = -T[2, 3] / (rays @ T[:3, :3].T)[:, 2]
    for height in np.linspace(0.0, PRISM.height, 30):
        points = DEPTH_CAMERA.on_plane(pixels, T, height) - placed().T_table_object[:2, 3]
        inside = PRISM.height_at(points @ placed().T_table_object[:2, :2]) > 0
        depth = np.where(inside, (height - T[2, 3]) / (rays @ T[:3, :3].T)[:, 2], depth)
    noise = np.random.default_rng(0).normal(0, 0.001, depth.shape)
    return (depth + noise).reshape(240, 320)


def test_depth_tells_table_object_and_height() -> None:
    depth = depth_image()
    depth[::7, ::5] = 0.0
    table = masks.find_table(depth, DEPTH_CAMERA)
    T = camera_pose()
    assert table[2, 3] == pytest.approx(T[2, 3], abs=0.001)
    normal = table[:3, :3].T[:, 2]
    assert np.arccos(normal @ T[:3, :3].T[:, 2]) < np.deg2rad(0.3)
    heights = masks.heights_above_table(depth, DEPTH_CAMERA, T)
    mask = masks.find_by_height(heights)
    assert masks.object_height(heights, mask) == pytest.approx(PRISM.height, abs=0.001)
    exact = observe(placed(), 0.5 * (PRISM.corners[1] + PRISM.corners[2]))
    view = view_of_depth(depth, mask, DEPTH_CAMERA, invert_transform(exact.T_table_action) @ T)
    assert isinstance(view, TopDownView)
    assert view.height[view.mask].max() == pytest.approx(PRISM.height, abs=0.004)
    assert iou(view.mask, exact.view.mask) > 0.8


def test_bad_input_is_refused_with_a_reason(share: np.ndarray) -> None:
    scene, background = image(share)
    mask = share >= 0.5
    with pytest.raises(PerceptionError, match="take both with one camera"):
        masks.cover_by_background(scene, background[:100])
    with pytest.raises(PerceptionError, match="was the camera moved"):
        masks.cover_by_background(
            np.random.default_rng(0).integers(0, 255, scene.shape).astype(np.uint8), background
        )
    with pytest.raises(PerceptionError, match="the mask is empty"):
        masks.pick_object(np.zeros((480, 640), bool))
    with pytest.raises(PerceptionError, match="cut off by the right border"):
        masks.pick_object(np.roll(mask, 250, axis=1) & (np.arange(640) > 300))
    with pytest.raises(PerceptionError, match="pixels from the nearest of 1 objects"):
        masks.pick_object(mask, (20.0, 20.0))
    with pytest.raises(PerceptionError, match="lies outside an image of 640 x 480"):
        masks.mask_by_colour(scene, (700.0, 20.0))
    with pytest.raises(PerceptionError, match=r"point \(nan, 20\) is no pixel"):
        masks.pick_object(mask, (float("nan"), 20.0))
    with pytest.raises(PerceptionError, match="give left, top, width and height"):
        masks.mask_by_grabcut(scene, (600, 10, 100, 100))
    with pytest.raises(PerceptionError, match="the depth image is empty"):
        masks.find_table(np.zeros((480, 640)), CAMERA)
    with pytest.raises(PerceptionError, match="was calibrated for 640 x 480"):
        masks.find_table(np.ones((240, 320)), CAMERA)
    with pytest.raises(PerceptionError, match="no table"):
        masks.find_table(np.random.default_rng(0).uniform(0.4, 2.0, (480, 640)), CAMERA)
    with pytest.raises(PerceptionError, match="check both"):
        place_object(mask, CAMERA, camera_pose(), 0.9)
    with pytest.raises(PerceptionError, match="from the outline"):
        observe(placed(), np.array([0.2, 0.2]))
    seen = place_object(mask, CAMERA, camera_pose(), PRISM.height)
    with pytest.raises(PerceptionError, match="overlaps the given object's"):
        fit_object(seen, Prism(0.5 * PRISM.corners))
    square = PlacedObject(Prism([(0.05, -0.05), (0.05, 0.05), (-0.05, 0.05), (-0.05, -0.05)]), np.eye(4))
    with pytest.raises(PerceptionError, match="in several ways"):
        fit_object(square, square.object)


def test_cover_tells_a_short_sides_direction_better_than_whole_pixels() -> None:
    """A side of 2 cm has some 20 pixels: their steps alone turn it by a degree."""
    errors = {"mask": [], "cover": []}
    for angle in np.linspace(0.1, 0.9, 9):
        T = np.eye(4)
        T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        truth = PlacedObject(BLUNT, T)
        start, stop = truth.outline()[:2, :2]
        share = silhouette(truth)
        for name, seen in (("mask", share >= 0.5), ("cover", share)):
            corners = place_object(seen, CAMERA, camera_pose(), BLUNT.height).outline()[:, :2]
            assert len(corners) == len(BLUNT.corners)
            found = [corners[np.linalg.norm(corners - end, axis=1).argmin()] for end in (start, stop)]
            turns = [np.arctan2(*(b - a)[::-1]) for a, b in ((start, stop), found)]
            errors[name].append(np.rad2deg(abs(turns[1] - turns[0])))
    assert np.mean(errors["cover"]) < 0.7 * np.mean(errors["mask"])
