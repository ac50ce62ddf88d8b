"""Commands that write interactions for other tools, and predictors: export rosbag, rerun, lerobot, onnx."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

ROS, RERUN = ("rosbags", "ros"), ("rerun", "rerun")
"""Libraries that are not installed by default, and the extras that bring them."""


def export_rosbag(
    data: Path,
    ids: tuple[int, ...],
    out: Path,
    run: Path | None = None,
    ros: Literal[1, 2] = 2,
    camera: bool = True,
) -> None:
    """Write interactions as ROS bags, one each, and the RViz configuration that shows them. Needs foretrace[ros].

    Args:
        data: Folder of the data set.
        ids: Numbers of the interactions.
        out: Folder to make for the bags.
        run: Folder of a training, whose predictor's imagined motion is written beside the observed one.
        ros: Version of ROS. 2: MCAP. 1: a .bag file.
        camera: Whether simulated interactions get the images of a camera beside the table.
    """
    from foretrace.export.delivery import require
    from foretrace.export.episodes import choose

    require(*ROS)
    from foretrace.export.rosbag import export_rosbags

    export_rosbags(choose(data, ids, run), out, ros, camera)
    _say_what_is_in(out)


def export_rerun(
    data: Path, ids: tuple[int, ...], out: Path, run: Path | None = None, camera: bool = True
) -> None:
    """Write interactions as Rerun recordings, one each. Needs foretrace[rerun].

    Args:
        data: Folder of the data set.
        ids: Numbers of the interactions.
        out: Folder to make for the recordings.
        run: Folder of a training, whose predictor's imagined motion is written beside the observed one.
        camera: Whether simulated interactions get the images of a camera beside the table.
    """
    from foretrace.export.delivery import require
    from foretrace.export.episodes import choose

    require(*RERUN)
    from foretrace.export import rerun

    rerun.export_rerun(choose(data, ids, run), out, camera)
    _say_what_is_in(out)


def export_lerobot(
    data: Path,
    out: Path,
    ids: tuple[int, ...] | None = None,
    run: Path | None = None,
    fps: int | None = None,
    camera: bool = False,
) -> None:
    """Write interactions as one LeRobotDataset v3.0, an episode each.

    Args:
        data: Folder of the data set.
        out: Folder to make.
        ids: Numbers of the interactions; by default all that have a motion.
        run: Folder of a training, whose predictor's imagined motion is written beside the observed one. If it was
            trained on this data set, episodes are ordered and split by its parts.
        fps: Frames per second, to which all are resampled; by default the rate at which they were sampled.
        camera: Render the images of a camera beside the table; for simulated interactions only.
    """
    from foretrace.export.episodes import choose_by_part
    from foretrace.export.lerobot import export_lerobot

    episodes, splits = choose_by_part(data, ids, run)
    export_lerobot(episodes, out, fps, camera, splits)
    print(out)


def export_onnx(run: Positional[Path | None] = None, out: Path = Path("model.onnx")) -> None:
    """Write a predictor's network as an ONNX file, and compare it with PyTorch. Needs foretrace[onnx].

    Args:
        run: Folder of the training; by default the predictor that comes with foretrace.
        out: File to write.
    """
    from foretrace.export.onnx import export_onnx
    from foretrace.predictor import load_predictor

    written = export_onnx(load_predictor(run), out)
    for name, meaning in written.inputs.items():
        print(f"reads {name}: {meaning}")
    for name, meaning in written.outputs.items():
        print(f"returns {name}: {meaning}; at most {written.differences[name]:.1e} from PyTorch")
    print(written.path)


def _say_what_is_in(out: Path) -> None:
    for path in sorted(out.iterdir()):
        print(path)
