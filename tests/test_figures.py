import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

import factories
from foretrace.actions import LeverUp
from foretrace.errors import DatasetError, PredictionError
from foretrace.interactions import storage
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import Interaction, Outcome
from foretrace.objects import Prism
from foretrace.objects.surface import faces_of
from foretrace.pictures import animation
from foretrace.pictures.contact_sheet import contact_sheet
from foretrace.pictures.scene import Scene, interaction_figure, scene_figure, silhouette
from foretrace.pictures.style import PREDICTION_COLORS, TRUTH_COLOR


@pytest.fixture(scope="module")
def interaction() -> Interaction:
    return factories.fake_interaction(np.random.default_rng(0), 4, outcome=Outcome.SLIPPED)


@pytest.fixture
def short(interaction) -> Interaction:
    """Four samples only, so that animations are quick."""
    effect = interaction.effect
    names = ("times", "pose_trajectory", "com_trajectory", "tool_trajectory", "joint_trajectory")
    chosen = {name: getattr(effect, name)[10:50:10] for name in names}
    return replace(interaction, effect=replace(effect, **chosen, slip_index=3))


def texts(fig: Figure) -> list[str]:
    fig.canvas.draw()
    axes_texts = [
        text.get_text() for ax in fig.axes for text in [ax.title, ax.xaxis.label, ax.yaxis.label, *ax.texts]
    ]
    left_titles = [ax.get_title(loc="left") for ax in fig.axes]
    legends = [t.get_text() for legend in fig.legends for t in legend.get_texts()]
    return axes_texts + left_titles + legends + ([fig.get_suptitle()] if fig.get_suptitle() else [])


def paths_drawn(fig: Figure, axis: int, color: str) -> list[np.ndarray]:
    """Curves of one colour in one of the figure's axes."""
    lines = [line for line in fig.axes[axis].get_lines() if line.get_color() == color]
    return [np.column_stack(line.get_data()) for line in lines if len(line.get_xdata()) > 2]


def test_interaction_figure_shows_truth_and_predictions_in_cm(interaction):
    com = interaction.effect.com_trajectory
    fig = interaction_figure(interaction, {"im-cnn": com + np.array([0, 0, 0.005]), "none": com[:40]})
    shown = texts(fig)
    for wanted in ("x, along the action [cm]", "y, to the left [cm]", "z, up [cm]", "time [s]", "slip"):
        assert any(wanted in text for text in shown), wanted
    assert "Interaction 4: 7 corners, slipped" in shown
    assert "centre of mass, simulated" in shown
    recorded = replace(interaction, provenance=replace(interaction.provenance, source="recorded"))
    assert "centre of mass, observed" in texts(interaction_figure(recorded))
    assert any("im-cnn (mean error 0.50 cm, at the end 0.50 cm)" in text for text in shown)
    assert any("none (mean error 0.00 cm" in text for text in shown)
    from_above, truth = paths_drawn(fig, 0, TRUTH_COLOR), com[:, [1, 0]] * 100
    np.testing.assert_allclose(from_above[0], truth)
    heights = paths_drawn(fig, 4, PREDICTION_COLORS[0])
    np.testing.assert_allclose(heights[0], np.column_stack([interaction.effect.times, com[:, 2] * 100 + 0.5]))
    left, right = fig.axes[0].get_xlim()
    assert left > right, "left is left: y grows to the left"


def test_interaction_figure_without_support_points_or_predictions(interaction, tmp_path):
    unseen = replace(interaction, effect=replace(interaction.effect, support_points=np.full((2, 2), np.nan)))
    fig = interaction_figure(unseen)
    assert not any("support" in text for text in texts(fig))
    fig.savefig(tmp_path / "one.png")
    assert Image.open(tmp_path / "one.png").size[0] > 1500


def test_predictions_may_be_longer_than_the_truth(interaction):
    com = interaction.effect.com_trajectory
    longer = np.concatenate([com, com[-1:], com[-1:]])
    heights = paths_drawn(interaction_figure(interaction, {"a": longer}), 4, PREDICTION_COLORS[0])
    assert heights[0][-1, 0] == pytest.approx(interaction.effect.times[-1] + 2 * factories.SAMPLE_PERIOD)


def test_what_cannot_be_drawn_is_refused(interaction):
    with pytest.raises(PredictionError, match=r"path of flat has shape \(60, 2\)"):
        interaction_figure(interaction, {"flat": np.zeros((60, 2))})
    row = storage.encode(replace(interaction, effect=replace(interaction.effect, outcome=Outcome.FAILED)), 0)
    with pytest.raises(DatasetError, match="interaction 4 failed"):
        interaction_figure(storage.decode(storage.to_table([row]).to_pylist()[0]))


def test_an_imagined_lever_up_needs_no_truth(interaction, tmp_path):
    times, com = interaction.effect.times, interaction.effect.com_trajectory
    scene = Scene.imagined(interaction.object, interaction.action, times, {"im-cnn": com})
    np.testing.assert_allclose(scene.pose, np.tile(interaction.effect.pose_trajectory[0], (60, 1)), atol=1e-9)
    shown = texts(scene_figure(scene))
    assert "Predicted path of a lever-up; object at rest, 7 corners" in shown
    assert "centre of mass, im-cnn" in shown
    few = Scene.imagined(interaction.object, interaction.action, times[:2], {"im-cnn": com})
    assert animation.scene_animation(few, tmp_path / "imagined.gif").exists()


def test_silhouette_spans_the_object():
    square = Prism(np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]]), height=0.03)
    (ring,) = silhouette(square, np.array([0.2, 0, 0.1, 1, 0, 0, 0]))
    np.testing.assert_allclose(ring.min(axis=0), [0.15, 0.10], atol=1e-4)
    np.testing.assert_allclose(ring.max(axis=0), [0.25, 0.13], atol=1e-4)


def test_contact_sheet_shows_every_outcome(tmp_path):
    dataset = Dataset.open(factories.fake_data_set(tmp_path, objects=4))
    fig = contact_sheet(dataset, columns=4, rows=3)
    assert len(fig.axes) == 12
    shown = texts(fig)
    assert "18 interactions, 12 shown; the bar is 10 cm" in shown
    assert "levered: 16" in shown
    assert "slipped: 2" in shown
    with pytest.raises(DatasetError, match="no interaction to show"):
        contact_sheet(dataset.where(outcome="missed"))


def test_faces_close_around_a_prism(interaction):
    obj = interaction.object
    faces = faces_of(obj)
    assert len(faces) == 2 + 2 * len(obj.corners)
    # The divergence theorem: outward faces of a closed surface sum up to its volume.
    volume = 0.0
    for face in faces:
        for k in range(1, len(face) - 1):
            volume += np.linalg.det(np.stack([face[0], face[k], face[k + 1]])) / 6
    assert volume == pytest.approx(obj.mass_properties(1.0).mass, rel=1e-6)


def test_projection_keeps_lengths_and_handedness():
    axes = animation.project(np.eye(3))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert axes[2, 1] > 0, "up is up"


def test_animation_as_gif_moves_in_real_time(short, tmp_path):
    path = animation.interaction_animation(short, tmp_path / "a.gif", {"x": short.effect.com_trajectory})
    with Image.open(path) as image:
        assert image.n_frames == 4
        assert image.info["duration"] == 500, "samples ten periods of 50 ms apart"
        first = np.asarray(image.convert("RGB"), dtype=int)
        image.seek(3)
        assert image.info["duration"] == 1200
        assert np.abs(np.asarray(image.convert("RGB"), dtype=int) - first).max() > 50


def test_animation_as_mp4(short, tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the video extra is not installed")
    path = animation.interaction_animation(short, tmp_path / "a.mp4")
    reader = imageio_ffmpeg.read_frames(str(path))
    assert next(reader)["size"] == (960, 450)
    reader.close()


def test_animation_says_what_it_needs(short, tmp_path, monkeypatch):
    with pytest.raises(PredictionError, match=r"choose a name ending in \.gif or \.mp4"):
        animation.interaction_animation(short, tmp_path / "a.avi")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(PredictionError, match=r"pip install foretrace\[video\]"):
        animation.interaction_animation(short, tmp_path / "a.mp4")
    assert not (tmp_path / "a.mp4").exists()


def test_an_action_on_an_own_object_can_be_drawn():
    prism = Prism(np.array([[0.0, 0], [0.1, 0], [0.1, 0.03], [0.04, 0.03], [0.04, 0.1], [0, 0.1]]))
    made = factories.fake_interaction(np.random.default_rng(0), 0)
    scene = Scene.imagined(prism, LeverUp.at_edge(prism, 0), made.effect.times[:1], {"p": np.zeros((1, 3))})
    assert next(animation.frames(scene)).shape == (450, 960, 3)
