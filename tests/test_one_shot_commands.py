"""What the command line says of several futures, the model card, and the predictor that comes with the package."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import torch

import factories
import foretrace as ft
from export_samples import write_data
from factories import besides_doubt
from foretrace import cli
from foretrace.cli.futures import say_futures
from foretrace.errors import CheckpointError
from foretrace.imagined import LEVELS, STARTS, conformal_scores
from foretrace.imagined.shown import radius_of
from foretrace.interactions.dataset import Dataset
from foretrace.pictures.prediction import prediction_band
from foretrace.pictures.scene import Scene, legend_of, scene_figure
from foretrace.predictor import (
    Futures,
    ImaginedEffect,
    LstmConfig,
    OneShotConfig,
    TrainConfig,
    loading,
    part_of,
    train_predictor,
)

SAMPLES = 24
CONFIG = OneShotConfig(hidden=8, components=6, outcomes=("levered", "slipped"))
TRAINING = replace(OneShotConfig.training, epochs=2, min_steps=1, split=None, device="cpu")
SHIPPED = Path(ft.__file__).parent / "predictor" / "default"


@pytest.fixture(autouse=True, scope="module")
def _one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    interactions = factories.fake_interactions(np.random.default_rng(0), 40, num_samples=SAMPLES)
    return write_data(tmp_path_factory.mktemp("one-shot") / "data", interactions)


@pytest.fixture(scope="module")
def run(data: Path) -> Path:
    return train_predictor(Dataset.open(data), CONFIG, data.parent / "run", TRAINING, progress=False)


@pytest.fixture(scope="module")
def card(run: Path, data: Path) -> str:
    assert cli.main(["train", "--data", str(data), "--out", str(run), "--card"]) == 0
    return (run / "MODEL_CARD.md").read_text()


@pytest.fixture(scope="module")
def picture(tmp_path_factory) -> Path:
    silhouette = np.zeros((200, 200), np.uint8)
    cv2.fillPoly(silhouette, [np.array([[40, 60], [150, 50], [170, 120], [100, 160], [50, 130]])], 255)
    file = tmp_path_factory.mktemp("shape") / "shape.png"
    cv2.imwrite(str(file), silhouette)
    return file


def imagined_effect(probability=(0.7, 0.25, 0.045, 0.005)) -> ImaginedEffect:
    """Four straight paths; the first is the most probable one."""
    n, times = len(probability), np.linspace(0, 1, 5)
    com = np.zeros((1, n, 5, 3))
    com[0, :, :, 0] = 0.05 + np.linspace(0, 0.04, 5)
    com[0, :, :, 2] = 0.01 * np.arange(n)[:, None] + np.linspace(0, 0.05, 5)
    spread = np.linspace(0, 0.0099, 5)
    ends = np.broadcast_to([[0.1, -0.05], [0.1, 0.04]], (1, n, 2, 2))
    pose = np.concatenate([com, np.broadcast_to([1.0, 0, 0, 0], (1, n, 5, 4))], axis=-1)
    futures = Futures(
        np.array([probability]), ("levered", "slipped") * (n // 2), np.concatenate([com, 0 * com], axis=-1),
        np.broadcast_to(spread, (1, n, 5)), ends, 2 * np.ones(len(LEVELS)),
    )  # fmt: skip
    return ImaginedEffect(times, com[0, 0], pose[0, 0], futures, ("height 9 cm is unusual",))


def test_futures_are_told_in_words(capsys):
    say_futures(imagined_effect())
    said = capsys.readouterr()
    assert said.out.splitlines() == [
        "outcome: levered 74.5%, slipped 25.5%",
        "turns about the edge from x 10.0, y -5.0 to x 10.0, y 4.0 cm in the action frame",
        "radius of the 90% region at the end: 2.00 cm",
    ]
    assert said.err.strip() == "foretrace: warning: height 9 cm is unusual"


def test_an_object_that_turns_about_no_edge_is_told_without_one(capsys):
    effect = imagined_effect()
    nowhere = np.full_like(effect.futures.support_points, np.nan)
    say_futures(replace(effect, futures=replace(effect.futures, support_points=nowhere)))
    assert "edge" not in capsys.readouterr().out


def test_nobody_says_more_than_is_known(capsys):
    effect = imagined_effect()
    unsure = replace(
        effect, futures=replace(effect.futures, quantiles=np.full(len(LEVELS), np.inf)), warnings=()
    )
    say_futures(unsure)
    assert "not known" in capsys.readouterr().out
    assert radius_of(unsure) is None
    assert unsure.to_dict()["futures"][0]["radius"] is None
    assert prediction_band(unsure).radius is None
    com = unsure.com_trajectory[None]
    single = replace(unsure, futures=Futures.point(com, None, "levered"))
    say_futures(single)
    assert capsys.readouterr() == ("", "")
    assert single.to_dict() == {"warnings": []}


def test_futures_are_written_in_the_order_of_their_probability():
    effect = imagined_effect()
    order = replace(effect, futures=replace(effect.futures, probability=effect.futures.probability[:, ::-1]))
    content = json.loads(json.dumps(order.to_dict()))
    assert [future["probability"] for future in content["futures"]] == [0.7, 0.25, 0.045, 0.005]
    assert content["futures"][0]["com_trajectory"] == effect.futures.com[0, 3].tolist()
    # No region holds what is hardly probable.
    assert [future["radius"] is None for future in content["futures"]] == [False, False, True, True]
    assert sum(content["outcomes"].values()) == pytest.approx(1)


def test_less_probable_futures_and_the_region_are_drawn():
    effect = imagined_effect()
    band = prediction_band(effect)
    assert [name for name, _ in band.others] == ["slipped 25.0%", "levered 4.5%"]
    np.testing.assert_allclose(band.radius[-1], 0.02)
    prism = ft.Prism([(0, -0.06), (0.12, -0.06), (0.12, 0.06), (0, 0.06)])
    action = ft.LeverUp.at_edge(prism, 3)
    scene = Scene.imagined(prism, action, effect.times, {"one-shot": effect.com_trajectory})
    plain, drawn = scene_figure(scene), scene_figure(replace(scene, band=band))
    for before, after in zip(plain.axes, drawn.axes, strict=True):
        assert len(after.lines) == len(before.lines) + 2
        assert (
            len(after.patches) + len(after.collections) == len(before.patches) + len(before.collections) + 1
        )
    labels = [handle.get_label() for handle in legend_of(replace(scene, band=band))]
    assert labels[1:] == ["region of 90%", "less probable: slipped 25.0%, levered 4.5%"]
    # The region is as wide as its radius says, and in sight.
    above = drawn.axes[0]
    band = max((patch.get_path().vertices for patch in above.patches), key=lambda ring: ring[:, 1].max())
    assert np.ptp(band[:, 0]) >= 3.9
    assert above.get_ylim()[1] > 11


def test_predict_tells_of_futures(run: Path, picture: Path, tmp_path: Path, capsys) -> None:
    command = ["predict", str(run), "--image", str(picture), "--scale", "0.0014", "--edge", "2"]
    assert cli.main([*command, "--no-animation", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"^outcome: (levered|slipped) (over )?\d+\.\d%, ", printed)
    content = json.loads((tmp_path / "trajectory.json").read_text())
    assert content["com_trajectory"] == content["futures"][0]["com_trajectory"]
    assert len(content["futures"]) == 4
    assert besides_doubt(content["warnings"]) == ()
    assert (tmp_path / "prediction.png").stat().st_size > 10_000


def test_without_a_run_the_shipped_predictor_is_used(
    run: Path, picture: Path, tmp_path: Path, monkeypatch, capsys
):
    monkeypatch.setattr(loading, "DEFAULT", "nothing-here")
    with pytest.raises(
        CheckpointError, match="comes without a trained predictor: name the folder of a training"
    ):
        ft.load_predictor()
    command = ["predict", "--image", str(picture), "--scale", "0.0014", "--edge", "2", "--no-animation"]
    assert cli.main([*command, "--out", str(tmp_path)]) == 2
    assert "comes without a trained predictor" in capsys.readouterr().err
    monkeypatch.setattr(loading, "DEFAULT", str(run))
    assert cli.main([*command, "--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "trajectory.json").read_text())["predictor"] == "default"


@pytest.mark.parametrize(("edge", "outcome"), [(0, "slipped"), (1, "levered")])
def test_the_shipped_predictor_tells_what_becomes_of_a_box(edge: int, outcome: str) -> None:
    # What the simulator makes of it, too: wide in front of the blade it slips, along its length it is levered.
    predictor = ft.load_predictor()
    box = ft.Box(0.14, 0.1, 0.02)
    imagined = predictor.imagine(ft.TopDownView.of(box, ft.LeverUp.at_edge(box, edge)))
    assert besides_doubt(imagined.warnings) == ()
    assert imagined.futures is not None
    probability = {name: float(p[0]) for name, p in imagined.futures.outcomes().items()}
    assert max(probability, key=lambda name: probability[name]) == outcome
    assert 0.002 < np.ptp(imagined.com_trajectory[:, 2]) < 0.1
    assert (SHIPPED / "MODEL_CARD.md").read_text().startswith("# Model card")


def rows_of(card: str, section: str) -> list[list[str]]:
    """Cells of the table in a section."""
    text = card.split(f"## {section}\n")[1].split("\n## ")[0]
    return [
        [c.strip() for c in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")
    ][2:]


def test_the_card_counts_the_data(card: str, run: Path) -> None:
    rows = rows_of(card, "Data")
    parts = json.loads((run / "split.json").read_text())
    assert rows[-1] == ["all", "", *(str(len(parts[part])) for part in ("train", "validation", "test"))]
    counts = np.array([row[2:] for row in rows[:-1]], dtype=int)
    assert counts.sum(axis=0).tolist() == [len(parts[part]) for part in ("train", "validation", "test")]
    assert {row[0] for row in rows[:-1]} == {"levered", "slipped"}
    assert all(re.fullmatch(r"prism, \d+ corners", row[1]) for row in rows[:-1])


def test_the_card_has_the_errors_of_the_test_part(card: str, run: Path, data: Path, tmp_path: Path) -> None:
    first, *_, last = rows_of(card, "Errors on the test part")
    test, predictor = part_of(run, Dataset.open(data)), ft.load_predictor(run)
    imagined = predictor.imagine_batch(test)
    apart = np.linalg.norm(imagined.com - test.com, axis=-1)
    assert first[:3] == ["all", "observed", str(len(test))]
    assert float(first[3]) == pytest.approx(100 * np.nanmean(np.nanmean(apart, axis=1)), abs=6e-4)
    ends = 100 * apart[np.arange(len(test)), test.length - 1]
    assert float(first[7]) == pytest.approx(np.median(ends), abs=6e-4)
    assert last[:2] == ["all", "estimated"]
    scores = conformal_scores(imagined.futures, test.com, test.length)
    held = np.mean(scores <= imagined.futures.quantiles[49])
    assert rows_of(card, "Outcomes and regions on the test part")[0][:2] == ["50%", f"{held:.1%}"]
    table = pd.DataFrame(rows_of(card, "Objects that it was trained on"))
    assert table[0].tolist() == ["area", "length", "width", "height", "distance", "corners"]


def test_the_command_on_the_card_asks_for_the_same_training(card: str, run: Path, monkeypatch) -> None:
    asked = []
    monkeypatch.setattr(
        "foretrace.predictor.train_predictor",
        lambda data, config, out, training, **_: asked.append((config, training)) or out,
    )
    command = re.search(r"^\$ foretrace (train .*)$", card, re.MULTILINE)
    assert command is not None
    assert cli.main(command[1].split()) == 0
    # What is no option of the command was made small for this test.
    config, training = asked[0]
    assert config == CONFIG
    assert replace(training, min_steps=1, device="cpu", outcomes=None) == TRAINING
    assert json.loads((run / "environment.json").read_text())["versions"]["torch"] in card


def test_recalibrated_regions_hold_on_the_new_data(card: str, run: Path, tmp_path: Path, capsys) -> None:
    again = tmp_path / "run"
    shutil.copytree(run, again)
    interactions = factories.fake_interactions(np.random.default_rng(1), 200, num_samples=SAMPLES)
    other = write_data(tmp_path / "other", interactions)
    assert cli.main(["recalibrate", "--run", str(again), "--data", str(other)]) == 0
    assert "start estimated" in capsys.readouterr().out
    batch = Dataset.open(other).batch()
    before, after = (ft.load_predictor(folder) for folder in (run, again))
    torch.testing.assert_close(before.state_dict()["motions"], after.state_dict()["motions"])
    same = before.imagine_batch(batch).com, after.imagine_batch(batch).com
    np.testing.assert_allclose(*same, atol=1e-6)
    for start in STARTS:
        futures = after.imagine_batch(batch, start).futures
        scores = conformal_scores(futures, batch.com, batch.length)
        assert np.mean(scores <= futures.width(0.8)) == pytest.approx(0.8, abs=0.02)
    text = (again / "MODEL_CARD.md").read_text()
    assert text.startswith(card.rstrip())
    assert "## Recalibration" in text
    assert cli.main(["recalibrate", "--run", str(again), "--data", str(other)]) == 0
    assert (again / "MODEL_CARD.md").read_text().count("## Recalibration") == 1
    # The training counts as it did before.
    assert cli.main(["train", "--data", str(other), "--out", str(again), "--predictor", "one-shot"]) == 2
    assert "calibration" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("few", "40 interactions have an outcome that the predictor distinguishes: give at least 200"),
        ("own", "the predictor was trained on these data"),
        ("sampled", "the data are sampled every"),
        ("lstm", "predictor 'lstm' has no regions to calibrate: take one-shot"),
        ("none", "config.json"),
    ],
)
def test_recalibration_refuses(
    kind: str, message: str, run: Path, data: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    rng = np.random.default_rng(2)
    found = tmp_path / "data" if kind in ("few", "sampled", "lstm") else data
    if found != data:
        samples = SAMPLES + 3 * (kind == "sampled")
        write_data(found, factories.fake_interactions(rng, 40, num_samples=samples))
    folder = tmp_path / "run"
    if kind == "lstm":
        config = LstmConfig(features="none", hidden=4)
        training = TrainConfig(epochs=1, min_steps=1, split=None)
        train_predictor(Dataset.open(data), config, folder, training, progress=False)
    elif kind != "none":
        shutil.copytree(run, folder)
    before = {file.name: file.read_bytes() for file in folder.glob("*.*")}
    if kind != "few":
        monkeypatch.setattr("foretrace.predictor.recalibration.FEWEST", 10)
    assert cli.main(["recalibrate", "--run", str(folder), "--data", str(found)]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert {file.name: file.read_bytes() for file in folder.glob("*.*")} == before


def test_a_card_needs_the_data_of_the_run(run: Path, tmp_path: Path, capsys) -> None:
    other = write_data(
        tmp_path / "data", factories.fake_interactions(np.random.default_rng(1), 4, num_samples=SAMPLES)
    )
    assert cli.main(["train", "--data", str(other), "--out", str(run), "--card"]) == 2
    assert "give the data set that it was trained on" in capsys.readouterr().err
