"""The command that watches a recorded action as a monitor would have watched it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from foretrace.errors import DatasetError, MonitoringError
from foretrace.files import atomic_path
from foretrace.imagined import Belief
from foretrace.interactions.dataset import Dataset
from foretrace.monitoring import Monitor
from foretrace.pictures.scene import Scene
from foretrace.pictures.watched import monitor_figure, monitor_film
from foretrace.predictor import load_imaginer

PICTURES, FILMS = (".png", ".svg", ".pdf"), (".gif", ".mp4")


def monitor(
    data: Positional[Path],
    id: Positional[int],
    out: Path,
    run: Path | None = None,
    false_alarms: float = 0.05,
    calibration: Path | None = None,
    worlds: int = Belief().worlds,
) -> None:
    """Watch a recorded or simulated action, sample by sample, as a monitor would have watched it under way.

    Writes an image of the score over time with its threshold, of the outcomes' probabilities, and of the height as
    imagined and observed, or a film in which the object moves beside them, with its expected edges; and prints when
    there was an alarm, and why.

    Args:
        data: Folder of the data set.
        id: Number of the interaction.
        out: The image to write: .png, .svg or .pdf; or the film: .gif or .mp4.
        run: Folder of the training; by default the predictor that comes with foretrace.
        false_alarms: Share of whole normal executions that may alarm.
        calibration: File of another calibration than the one that comes with foretrace.
        worlds: Number of worlds in which the action is imagined.
    """
    if out.suffix.lower() not in PICTURES + FILMS:
        raise MonitoringError(
            f"cannot draw into {out}: choose a name that ends in {', '.join(PICTURES + FILMS)}"
        )
    dataset = Dataset.open(data)
    rows = np.flatnonzero(dataset.index["id"].to_numpy() == id)
    if len(rows) == 0:
        raise DatasetError(f"{data} has no interaction {id}: choose one of `foretrace show {data}`")
    interaction = dataset[int(rows[0])]
    effect = interaction.effect
    if len(effect.times) == 0:
        raise MonitoringError(f"interaction {id} has no samples: choose one that did not fail")
    imagined = load_imaginer(run).imagine(interaction.view, interaction.action, context=Belief(worlds=worlds))
    watched = Monitor(imagined, false_alarms, calibration=calibration)
    verdicts = [
        watched.update(float(t), pose) for t, pose in zip(effect.times, effect.pose_trajectory, strict=True)
    ]
    alarm = next((each for each in verdicts if each.alarm), None)
    title = f"Interaction {id}: {effect.outcome}"
    with atomic_path(out) as temporary:
        if out.suffix.lower() in FILMS:
            film = temporary.with_name(f"{temporary.name}{out.suffix}")
            scene = replace(Scene.observed(interaction), title=title)
            monitor_film(scene, imagined, verdicts, film).replace(temporary)
        else:
            figure = monitor_figure(imagined, verdicts, effect.com_trajectory, title)
            figure.savefig(temporary, format=out.suffix[1:].lower())
    last = verdicts[-1]
    if alarm is None:
        print(f"no alarm: score {last.score:.2f} of {last.threshold:.2f}; {last.message}")
    else:
        print(f"alarm at {alarm.time:.2f} s: {alarm.cause}; in the end: {last.message}")
    print(out)
