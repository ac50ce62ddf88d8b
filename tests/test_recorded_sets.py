"""From a data set through a camera to a data set: films of `foretrace film`, imported, learned from and judged by."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from foretrace.cli import main
from foretrace.errors import DatasetError
from foretrace.experiments.transfer import levered_edge
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.description import describe_dataset
from foretrace.interactions.recorded import NOTES_FOLDER, add_recorded, read_notes
from foretrace.perception.recordings import open_recording
from foretrace.predictor import LstmConfig, TrainConfig, load_predictor, train_predictor
from foretrace.trajectories import mean_distance

pytestmark = pytest.mark.slow

QUICK = ["--width", "640", "--fps", "10", "--distance", "0.5", "--depth-every", "40"]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "simulated"
    options = ["--objects", "4", "--contacts-per-edge", "1", "--embodiment", "tool", "--workers", "1"]
    assert main(["simulate", "--out", str(folder), *options]) == 0
    return folder


@pytest.fixture(scope="module")
def recorded(simulated: Path) -> Path:
    """Two recordings, the first of them twice in the data set."""
    out = simulated.parent / "recorded"
    data = Dataset.open(simulated)
    levered = np.flatnonzero(data.batch().outcome == "levered")[[2, -1]]
    for number, row in enumerate(levered.tolist()):
        film = simulated.parent / f"film-{number}"
        if main(["film", str(simulated), str(data[row].id), "--out", str(film), *QUICK]):
            pytest.skip("this machine cannot render")
        x, y = data[row].action.contact
        command = ["import", str(film), "--object", str(film / "object.json"), "--contact", str(x), str(y)]
        assert main([*command, "--out", str(out)]) == 0
        if number == 0:
            assert add_recorded(out, Dataset.open(out)[0], read_notes(out, 0)) == 1
    return out


def test_films_of_a_data_set_come_back_as_they_were(simulated: Path, recorded: Path) -> None:
    data, found = Dataset.open(simulated), Dataset.open(recorded)
    levered = np.flatnonzero(data.batch().outcome == "levered")[[2, -1]]
    assert len(found) == 3
    assert not {"two_support_corners", "rule_agreement"} & describe_dataset(found).keys()
    assert {"two_support_corners", "rule_agreement"} <= describe_dataset(data).keys()
    for row, at in ((0, 0), (1, 0), (2, 1)):
        truth, effect = data[int(levered[at])].effect, found[row].effect
        assert effect.outcome == "levered"
        np.testing.assert_allclose(np.diff(effect.times), 0.05, atol=1e-9)  # recorded 10 times a second
        n = len(effect.times)
        assert mean_distance(effect.com_trajectory, truth.com_trajectory[:n]) < 0.004
    film = open_recording(simulated.parent / "film-0")
    assert film.camera is not None
    assert [frame.depth is not None for frame in film.frames()][:2] == [True, False]


def test_recordings_are_learned_from_and_judged_like_simulations(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    training = TrainConfig(epochs=1, min_steps=1, split=(1, 1, 1), threads=1)
    train_predictor(Dataset.open(recorded), LstmConfig(features="none"), tmp_path / "run", training)
    assert main(["evaluate", "predictor", str(tmp_path / "run"), "--data", str(recorded)]) == 0
    assert "levered" in capsys.readouterr().out
    imagined = load_predictor(tmp_path / "run").imagine_batch(Dataset.open(recorded).batch())
    assert all(np.isfinite(one.com_trajectory).all() for one in imagined)
    pytest.importorskip("imageio_ffmpeg")
    video = tmp_path / "overlay.mp4"
    assert main(["overlay", str(recorded), "0", "--run", str(tmp_path / "run"), "--out", str(video)]) == 0
    shown, film = (
        list(open_recording(video).frames()),
        list(open_recording(recorded.parent / "film-0").frames()),
    )
    assert len(shown) == len(film)
    assert (tmp_path / "overlay-side.png").stat().st_size > 1000
    changed = np.abs(shown[-1].image.astype(int) - film[-1].image).max(axis=2) > 80
    assert 100 < changed.sum() < 0.1 * changed.size
    assert main(["overlay", str(recorded), "9", "--out", str(video)]) == 2
    assert "has no recording 9" in capsys.readouterr().err
    assert main(["show", str(recorded), "--out", str(tmp_path / "all.png")]) == 0
    assert (tmp_path / "all.png").stat().st_size > 1000


def test_a_film_of_nothing(simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["film", str(simulated), "99999", "--out", str(tmp_path / "film")]) == 2
    assert "has no interaction 99999 among" in capsys.readouterr().err
    assert main(["film", str(simulated), "0", "--out", str(simulated)]) == 2
    assert "is in use: choose another folder" in capsys.readouterr().err


def test_recordings_get_the_tables_of_the_paper(
    recorded: Path, simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["evaluate", "transfer", "--recorded", str(recorded), "--out", str(tmp_path / "out")]
    assert main(command) == 0
    assert "| Recorded vs simulation, mean |" in capsys.readouterr().out
    rows = pd.read_csv(tmp_path / "out" / "rows.csv")
    assert rows["interaction"].tolist() == [0, 1, 2]
    assert rows["repetition"].tolist() == [0, 1, 0]
    edges = [levered_edge(each) + 1 for each in Dataset.open(recorded)]
    assert rows["contact"].tolist() == edges
    # The film shows what the simulator does, but for how well it was seen.
    assert rows["distance_simulated_cm"].between(1e-3, 0.2).all()
    assert rows["distance_predicted_cm"].between(1e-3, 1.0).all()
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())["summary"]
    assert [sum(entry["outcomes"].values()) for entry in summary["edges"]] == [2, 1]
    assert {entry["group"] for entry in summary["edges"]} == {"recorded"}
    assert (tmp_path / "out" / "figure-14.png").stat().st_size > 1000
    assert main([*command, "--repeats", "3"]) == 2
    assert "--repeats is about the stand-in" in capsys.readouterr().err
    command[3] = str(simulated)
    assert main(command) == 2
    assert "is simulated: give a data set that" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "cannot be read"),
        ("[]", "holds a list"),
        ('{"recording": 3}', "entry recording is 3, a text is expected"),
    ],
)
def test_damaged_notes_are_refused(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / NOTES_FOLDER).mkdir()
    (tmp_path / NOTES_FOLDER / "00000.json").write_text(content)
    with pytest.raises(DatasetError, match=message):
        read_notes(tmp_path, 0)
