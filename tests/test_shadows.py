"""Shadows are told from objects, or the image is refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from foretrace.actions import LeverUp, ToolPath
from foretrace.errors import PerceptionError, SimulationError
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.objects import Prism
from foretrace.perception import masks
from foretrace.simulation.lens import Faults
from foretrace.simulation.recording import RecordingConfig, record_lever_up
from foretrace.simulation.stage import table_pattern

TABLE = np.array([200.0, 208, 214])
BLUE, GREY = np.array([150.0, 90, 20]), 0.65 * TABLE
LAMP = np.array([0.58, 0.56, 0.54])
"""What a shadow leaves: a little bluer than the rest."""


def region(corners: list[tuple[int, int]], blur: float = 0.7) -> np.ndarray:
    """A polygon's share of each pixel."""
    canvas = cv2.fillPoly(np.zeros((480, 640), np.float32), [np.array(corners, np.int32)], 1.0)
    return cv2.GaussianBlur(canvas, (0, 0), blur)[..., None]


THING = region([(220, 140), (400, 160), (420, 300), (300, 340), (200, 260)])
SHADOW = region([(240, 160), (420, 180), (440, 320), (320, 360), (220, 280)], blur=2.0)
MARKER = region([(280, 200), (340, 200), (340, 260), (280, 260)])


def pattern(kind: str) -> np.ndarray:
    if kind == "plain":
        return np.broadcast_to(TABLE, (480, 640, 3))
    return table_pattern("speckled", np.random.default_rng(0))[:480, :640].astype(float)


def photograph(
    table: np.ndarray, colour: np.ndarray, shadow: np.ndarray = SHADOW, marker: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Image and background."""
    lit = table * (1 - shadow * (1 - LAMP))
    scene = lit * (1 - THING) + colour * THING
    scene = scene * (1 - MARKER) if marker else scene
    rng = np.random.default_rng(0)
    noisy = [np.clip(i + rng.normal(0, 2, i.shape), 0, 255).astype(np.uint8) for i in (scene, table)]
    return noisy[0], noisy[1]


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize("kind", ["plain", "speckled"])
def test_a_shadow_is_no_object(kind: str) -> None:
    table = pattern(kind)
    truth = THING[..., 0] > 0.5
    found = masks.find_by_background(*photograph(table, BLUE)) > 0.5
    assert iou(found, truth) > 0.99
    # All that differs: what the object was taken for before shadows were told from it.
    assert iou(truth | (SHADOW[..., 0] > 0.5), truth) < 0.9


def test_a_thin_shadow_does_not_shift_the_outline() -> None:
    """Beside the object no pixel shows shadow alone."""
    thin = np.roll(THING, (3, 2), axis=(0, 1))
    image, background = photograph(pattern("plain"), BLUE, thin)
    found = masks.find_by_background(image, background) > 0.5
    assert iou(found, THING[..., 0] > 0.5) > 0.99


def test_without_a_shadow_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    for colour in (BLUE, np.array([30.0, 30, 30]), np.array([255.0, 255, 255])):
        image, background = photograph(pattern("plain"), colour, np.zeros_like(SHADOW))
        seen = masks.cover_by_background(image, background)
        with monkeypatch.context() as patch:
            patch.setattr(masks, "find_shadow", lambda *_: None)
            np.testing.assert_array_equal(seen, masks.cover_by_background(image, background))


@pytest.mark.parametrize("marker", [True, False])
def test_what_may_be_shadow_or_object_is_refused(marker: bool) -> None:
    image, background = photograph(pattern("plain"), GREY, marker=marker)
    with pytest.raises(PerceptionError, match="find the object by depth"):
        masks.cover_by_background(image, background)


def test_who_has_no_shadows_says_so() -> None:
    image, background = photograph(pattern("plain"), GREY, np.zeros_like(SHADOW))
    with pytest.raises(PerceptionError, match="say --no-shadows"):
        masks.cover_by_background(image, background)
    found = masks.pick_object(masks.cover_by_background(image, background, shadows=False) > 0.5)
    assert iou(found, THING[..., 0] > 0.5) > 0.99


def test_white_objects_are_refused_with_shadows_alone() -> None:
    """Their sides may be as dark as a shadow."""
    table = 0.7 * pattern("plain")
    image, background = photograph(table, TABLE, marker=False)
    with pytest.raises(PerceptionError, match="lay a sheet of another colour on the table"):
        masks.cover_by_background(image, background)
    image, background = photograph(table, TABLE, np.zeros_like(SHADOW), marker=False)
    assert iou(masks.cover_by_background(image, background) > 0.5, THING[..., 0] > 0.5) > 0.98


def test_an_object_that_hides_the_tables_pattern_is_no_shadow() -> None:
    table = pattern("speckled")
    mean = 0.65 * table.mean(axis=(0, 1))
    image, background = photograph(table, mean, np.zeros_like(SHADOW), marker=False)
    found = masks.find_by_background(image, background) > 0.5
    assert iou(found, THING[..., 0] > 0.5) > 0.98
    image, background = photograph(table, mean, marker=False)
    with pytest.raises(PerceptionError, match="cannot be told apart"):
        masks.cover_by_background(image, background)


CAMERA = PinholeCamera(480, 270, 345.0, 345.0, 240.0, 135.0)
PRISM = Prism([(0.09, -0.02), (0.05, 0.07), (-0.03, 0.08), (-0.09, 0.0), (-0.02, -0.08)])


def film_first_frame(folder: Path, shadows: bool) -> tuple[np.ndarray, np.ndarray]:
    """Image and background."""
    usual = RecordingConfig()
    short = 1.5 / usual.frames_per_second - usual.lead_time - ToolPath().duration
    faults = Faults(0.0, 0.0, 0.0)
    config = RecordingConfig(
        CAMERA, exposures=1, depth_every=0, tail_time=short, faults=faults, shadows=shadows, table="wooden"
    )
    try:
        record_lever_up(PRISM, LeverUp.at_edge(PRISM, 2, 0.5), folder, config, seed=3)
    except SimulationError as error:
        pytest.skip(str(error))
    image, background = (cv2.imread(str(folder / name)) for name in ("colour-00000.jpg", "background.png"))
    assert image is not None
    assert background is not None
    return image, background


def test_filmed_shadows_are_soft_and_leave_most_of_the_light(tmp_path: Path) -> None:
    image, background = film_first_frame(tmp_path / "plain", shadows=False)
    table = np.abs(image.astype(float) - background).max(axis=2) < 10
    image, background = film_first_frame(tmp_path / "shaded", shadows=True)
    left = (image.sum(axis=2) / np.maximum(background.sum(axis=2), 1.0))[
        table & (background.min(axis=2) > 30)
    ]
    umbra, penumbra = (left < 0.72).sum(), ((left > 0.72) & (left < 0.92)).sum()
    assert umbra > 20
    assert penumbra > 0.3 * umbra
    assert left.min() > 0.55


def test_a_pattern_has_no_seam_and_is_its_seeds() -> None:
    for kind in ("wooden", "speckled"):
        first, again, other = (table_pattern(kind, np.random.default_rng(seed)) for seed in (0, 0, 1))
        np.testing.assert_array_equal(first, again)
        assert (first != other).any()
        steps = np.abs(np.diff(first.astype(int), axis=0)).mean(axis=(1, 2))
        seam = np.abs(first[0].astype(int) - first[-1]).mean()
        assert seam < steps.max() * 1.2
        assert first.std(axis=(0, 1)).min() > 5
