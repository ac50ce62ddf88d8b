"""The picture of objects that look alike from above and move differently."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from foretrace.actions import LeverUp
from foretrace.errors import DatasetError
from foretrace.geometry import polygon_area
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.description import describe_dataset
from foretrace.interactions.record import Interaction, Physics
from foretrace.objects import Cylinder, look_alikes
from foretrace.objects.surface import faces_of
from foretrace.pictures.animation import frames
from foretrace.pictures.look_alikes import non_flat_figure
from foretrace.pictures.scene import Scene, interaction_figure
from foretrace.simulation.collect import CollectConfig, collect
from foretrace.simulation.lever_up import SimulationConfig, simulate_lever_up

WATCHED = SimulationConfig(embodiment="tool", watch_time=1.5)


@pytest.fixture(scope="module")
def pair() -> dict[str, Interaction]:
    cylinder, box, _ = look_alikes(Cylinder(0.025, 0.12))
    lever = {"box": box, "cylinder": cylinder}
    return {
        name: simulate_lever_up(obj, LeverUp.at_edge(obj, 0, 0.4), WATCHED) for name, obj in lever.items()
    }


def titles_of(figure: Figure) -> list[str]:
    return [ax.get_title(loc="left") for ax in figure.axes]


def test_figure_16_shows_equal_masks_and_different_fates(pair, tmp_path: Path):
    figure = non_flat_figure(pair)
    figure.savefig(tmp_path / "figure.png")
    assert Image.open(tmp_path / "figure.png").width > 1500
    assert "equal in every pixel" in figure.get_suptitle()
    titles = titles_of(figure)
    assert titles[0] == "Box: mask"
    assert titles[3] == "Cylinder: mask"
    assert titles[2].startswith("From the side: tumbled")
    assert titles[5].startswith("From the side: rolled")
    masks = [np.asarray(figure.axes[k].images[0].get_array()) for k in (0, 3)]
    heights = [np.ma.filled(figure.axes[k].images[0].get_array(), 0) for k in (1, 4)]
    np.testing.assert_array_equal(*masks)
    assert np.nanmax(np.abs(heights[0] - heights[1])) > 1.5  # cm
    labels = [ax.get_xlabel() for ax in figure.axes[3:6]]
    assert all(label.endswith("[cm]") for label in labels)


def test_masks_that_differ_are_not_called_equal(pair):
    short = Cylinder(0.025, 0.10)
    other = simulate_lever_up(short, LeverUp.at_edge(short, 0), WATCHED)
    assert "masks differ in" in non_flat_figure({**pair, "other": other}).get_suptitle()


def test_what_cannot_be_drawn_is_refused(pair):
    with pytest.raises(DatasetError, match="no interaction"):
        non_flat_figure({})
    effect = pair["box"].effect
    series = [f.name for f in fields(effect) if f.name == "times" or f.name.endswith("trajectory")]
    empty = replace(effect, **{name: getattr(effect, name)[:0] for name in series})
    with pytest.raises(DatasetError, match="box: interaction 0 failed"):
        non_flat_figure({"box": replace(pair["box"], effect=empty)})


def test_a_drawn_cylinder_is_closed_and_faces_outwards():
    cylinder = Cylinder(0.03, 0.1)
    faces = faces_of(cylinder, every=4)
    middle = np.array([0, 0, 0.03])
    for face in faces:
        normal = np.cross(face[1] - face[0], face[2] - face[1])
        assert normal @ (face.mean(axis=0) - middle) > 0
    assert len(faces) == 2 + 16
    assert polygon_area(faces[1][:, 1:]) == pytest.approx(np.pi * 0.03**2, rel=0.03)


def test_a_fall_is_drawn_to_its_end():
    cylinder = Cylinder(0.025, 0.12)
    config = replace(WATCHED, physics=Physics(table_edge=0.1))
    fallen = simulate_lever_up(cylinder, LeverUp.at_edge(cylinder, 0), config)
    lowest = 100 * fallen.effect.com_trajectory[:, 2].min()
    assert lowest < -10
    side = interaction_figure(fallen).axes[1]
    assert side.get_ylim()[0] < lowest
    assert next(frames(Scene.observed(fallen))).shape == (450, 960, 3)


def test_solids_are_described_by_kind(tmp_path: Path):
    config = CollectConfig(objects=3, contacts_per_edge=1, simulation=WATCHED, recipe="solids")
    counts = collect(config, tmp_path, workers=1)
    figures = describe_dataset(Dataset.open(tmp_path))
    assert set(figures["outcomes_by_kind"]) == {"box", "cylinder", "prism"}
    assert sum(sum(kind.values()) for kind in figures["outcomes_by_kind"].values()) == 12
    assert figures["outcomes_by_kind"]["cylinder"].get("rolled", 0) >= 2
    assert figures["fell_off_the_table"] == 0
    assert figures["median_rolled_cm"] > 3
    assert sum(counts.values()) == 12
