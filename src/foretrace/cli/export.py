"""Commands that write interactions for other tools, and predictors: export rosbag, rerun, lerobot, onnx."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

ROS, RERUN = ("rosbags", "ros"), ("rerun", "rerun")
"""Libraries that are not installed by default, and the extras that bring them."""


@dataclass(frozen=True)
class Source:
    """What is written, and where."""

    data: Path
    """Folder of the data set."""
    out: Path
    """Folder to make."""
    run: Path | None = None
    """Folder of a training, whose predictor's imagined motion is written beside the observed one."""


Ids = tuple[int, ...]
Options = Annotated[OmitArgPrefixes[Source], arg(name="")]


def export_rosbag(source: Options, ids: Ids, ros: Literal[1, 2] = 2, camera: bool = True) -> None:
    """Write interactions as ROS bags, one each, and the RViz configuration that shows them. Needs foretrace[ros].

    Args:
        source: Data and folder.
        ids: Numbers of the interactions.
        ros: Version of ROS. 2: MCAP. 1: a .bag file.
        camera: Whether simulated interactions get the images of a camera beside the table.
    """
    from foretrace.export.delivery import require
    from foretrace.export.episodes import choose

    require(*ROS)
    from foretrace.export.rosbag import export_rosbags

    export_rosbags(choose(source.data, ids, source.run), source.out, ros, camera)
    _list_files(source.out)


def export_rerun(source: Options, ids: Ids, camera: bool = True) -> None:
    """Write interactions as Rerun recordings, one each. Needs foretrace[rerun].

    Args:
        source: Data and folder.
        ids: Numbers of the interactions.
        camera: Whether simulated interactions get the images of a camera beside the table.
    """
    from foretrace.export.delivery import require
    from foretrace.export.episodes import choose

    require(*RERUN)
    from foretrace.export import rerun

    rerun.export_rerun(choose(source.data, ids, source.run), source.out, camera)
    _list_files(source.out)


def export_lerobot(
    source: Options, ids: Ids | None = None, fps: int | None = None, camera: bool = False
) -> None:
    """Write interactions as one LeRobotDataset v3.0, an episode each.

    Episodes are ordered and split by the parts of a --run that was trained on this data set.

    Args:
        source: Data and folder.
        ids: Numbers of the interactions; by default all that have a motion.
        fps: Frames per second, to which all are resampled; by default the rate at which they were sampled.
        camera: Render the images of a camera beside the table; for simulated interactions only.
    """
    from foretrace.export.episodes import choose_by_part
    from foretrace.export.lerobot import export_lerobot

    episodes, splits = choose_by_part(source.data, ids, source.run)
    export_lerobot(episodes, source.out, fps, camera, splits)
    print(source.out)


def export_onnx(run: Positional[Path | None] = None, out: Path = Path("model.onnx")) -> None:
    """Write a predictor's network as an ONNX file, and compare its outputs with float64. Needs foretrace[onnx].

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
        file, pytorch = written.differences[name]
        print(f"returns {name}: {meaning}; at most {file:.1e} from float64, PyTorch's float32 {pytorch:.1e}")
    print(written.path)


def _list_files(out: Path) -> None:
    for path in sorted(out.iterdir()):
        print(path)
