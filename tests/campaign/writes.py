"""Crash points: a command ends at its k-th write, or the disk is full there; the same command then goes on.

Writes are what Python audits (files opened for writing, renamed, removed, folders made) and what a few libraries write
by themselves, below the trial's folder.
"""

import csv
import errno
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from campaign import FAULT, OK, REFUSED, Outcome, end_with_parent, one_line

STOP, HALF, FULL = "stop", "half", "full"
WAYS = (STOP, HALF, FULL)
"""The process is killed before the write; after half of it; or the disk is full."""
TIMES = ("seconds", "started", "hours", "machines", "created")
"""Entries of JSON files that tell when, where or how fast they were made; not compared."""
CHANGES = ("os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.truncate", "os.link", "os.symlink")
"""Events that change a folder."""
LOADED = (
    *("foretrace.cli.calibrate", "foretrace.cli.data", "foretrace.cli.demo", "foretrace.cli.evaluation"),
    *("foretrace.cli.export", "foretrace.cli.film", "foretrace.cli.prediction", "foretrace.cli.recordings"),
    *(
        "foretrace.cli.robot",
        "foretrace.cli.simulation",
        "foretrace.cli.training",
        "foretrace.evaluation.run",
    ),
    *("foretrace.experiments.predictor", "foretrace.export.lerobot", "foretrace.export.rosbag"),
    *(
        "foretrace.cli.plan_many",
        "foretrace.cli.planning",
        "foretrace.export.rerun",
        "foretrace.pictures.animation",
    ),
    *("foretrace.pictures.contact_sheet", "foretrace.pictures.prediction", "foretrace.pictures.scene"),
    *("foretrace.predictor.display", "foretrace.predictor.runtime", "foretrace.predictor.training"),
    "foretrace.simulation.recording",
    *(
        "matplotlib.pyplot",
        "pandas",
        "torch._dynamo",
        "torch.utils.tensorboard",
        "torch.onnx",
        "onnx",
        "onnxscript",
        "onnxruntime",
    ),
    *("markdown_it", "rerun", "rich.markdown", "rosbags.rosbag1", "rosbags.rosbag2", "typeguard", "tyro"),
)
"""Modules that commands load."""
ANY = "any"
"""Checksum of a file that differs between two uninterrupted runs: it has to be there."""
KILLED = 137
GOLDEN = Path(__file__).parents[1] / "golden"
VARIES = ("environment.json", "events.out.tfevents", ".lock", ".gitignore")
"""Files that say when or where they were written, by how their names begin; not compared."""


@dataclass(frozen=True)
class Job:
    """A command that writes. ``{m}`` stands for the folder of materials; it runs in the trial's folder."""

    arguments: str
    start: "Callable[[Path, Path], None]" = lambda here, materials: None
    """Puts what the command changes into the trial's folder: it is given that folder and the materials."""
    costly: bool = False
    """Takes more than about a second."""
    slow: bool = False
    """Takes so long that the tests leave it out."""


def _copied(*names: str) -> Callable[[Path, Path], None]:
    def start(here: Path, materials: Path) -> None:
        for name in names:
            shutil.copytree(materials / name, here / name)

    return start


def _damaged(here: Path, materials: Path) -> None:
    _copied("data")(here, materials)
    (here / "data" / "shards" / ".shard-00000.parquet.1.partial").write_bytes(b"half")
    manifest = json.loads((here / "data" / "manifest.json").read_text())
    (here / "data" / "manifest.json").write_text(json.dumps(manifest | {"shards": {}}))


def _old(here: Path, materials: Path) -> None:
    shutil.copytree(GOLDEN / "version-1", here / "old")


TRAIN = "train --data {m}/data --out out --epochs 2 --min-steps 1 --threads 1"
IMPORT = "import {m}/recording --object {m}/object.json --contact-px"
JOBS: dict[str, Job] = {
    "simulate": Job("simulate --objects 1 --contacts-per-edge 1 --embodiment tool --workers 1 --out out"),
    "train lstm": Job(TRAIN + " --features none --hidden 4", costly=True),
    "train one-shot": Job(TRAIN + " --predictor one-shot --hidden 8", costly=True),
    "import": Job(IMPORT + " 466.3 178.1 --out out", costly=True),
    "import more": Job(IMPORT + " 470.0 181.0 --out imported", _copied("imported"), costly=True),
    "film": Job("film {m}/data 0 --out out --width 320 --fps 4 --exposures 1 --depth-every 8"),
    "evaluate": Job("evaluate predictor {m}/lstm --data {m}/data --out out"),
    "export rosbag": Job("export rosbag --data {m}/data --ids 0 1 --no-camera --out out"),
    "export rosbag 1": Job("export rosbag --data {m}/data --ids 0 --ros 1 --no-camera --out out"),
    "export rerun": Job("export rerun --data {m}/data --ids 0 1 --no-camera --out out"),
    "export lerobot": Job("export lerobot --data {m}/data --out out"),
    "export onnx": Job("export onnx {m}/lstm --out out.onnx", slow=True),
    "data --repair": Job("data data --repair --out description.json", _damaged),
    "data --upgrade": Job("data old --upgrade", _old),
    "calibrate": Job("calibrate {m}/board --out camera.json"),
    "calibrate --print-board": Job("calibrate --print-board board.png"),
    "predict": Job("predict {m}/lstm --polygon {m}/outline.txt --edge 0 --out out --no-animation"),
    "plan": Job(
        "plan {m}/lstm --polygon {m}/outline.txt --goal move --direction 1 0 --refine 0 --check 0 --out out"
    ),
    "show": Job("show {m}/data --out sheet.png"),
    "robot": Job("robot --base {m}/base.json --contact 0 0 --direction 1 0 --speed 1 --no-retreat --out out"),
    "demo": Job(
        "demo --out out --objects 8 --contacts-per-edge 1 --epochs 1 --min-steps 1 --workers 1", slow=True
    ),
}
"""Every command that writes."""


def load(materials: Path) -> None:
    """Load what commands load, before the first trial is forked; no thread is started."""
    import torch

    torch.set_num_threads(1)
    for module in LOADED:
        with suppress(ImportError):
            import_module(module)


def count(name: str, folder: Path, materials: Path) -> int:
    """Number of writes of a command; what it writes stays in the folder."""
    JOBS[name].start(folder, materials)
    status, told = _in_fork(name, folder, materials, None)
    assert status == 0, told
    return int((folder.parent / "writes").read_text())


def run(request: Any, folder: Path, materials: Path) -> Outcome:
    """One crash point: ``{"job": name, "at": k, "how": way}``; the reference is made beside the materials once."""
    name, at, how = request["job"], request["at"], request["how"]
    reference = reference_of(name, materials)
    if at >= reference["writes"]:
        return Outcome(OK, "no such write")
    JOBS[name].start(folder, materials)
    status, told = _in_fork(name, folder, materials, (at, how))
    if (fault := _unclean(status, told, how)) is not None:
        return Outcome(FAULT, fault)
    return gone_on(lambda: _in_fork(name, folder, materials, None), folder, reference["contents"])


def gone_on(command: Callable[[], tuple[int, str]], folder: Path, wanted: dict[str, str]) -> Outcome:
    """The outcome of a command after an interruption: it goes on, or its remedy helps; the end is as without one.

    Args:
        command: Runs it; exit status, and what it says on standard error.
        folder: Where it works.
        wanted: Contents of the folder after an uninterrupted run.
    """
    if not difference(contents_of(folder), wanted):
        return Outcome(OK, "was done")
    status, told = command()
    ending, refusal = OK, ""
    if status == 2 and "Traceback" not in told:
        if fault := one_line(told):
            return Outcome(FAULT, f"the same command again: {fault}: {told[-300:]}")
        ending, refusal = REFUSED, told.strip()
        for rest in folder.glob("out*"):  # what it says: another folder, or this one removed
            if rest.is_dir():
                shutil.rmtree(rest)
            else:
                rest.unlink()
        status, told = command()
    if status != 0:
        return Outcome(FAULT, f"the same command again ends with {status}: {refusal} {told[-300:]}")
    if odd := difference(contents_of(folder), wanted):
        return Outcome(FAULT, f"afterwards {odd}")
    return Outcome(ending, refusal[-200:])


def _unclean(status: int, told: str, how: str) -> str | None:
    """What is wrong with how a run ended at a write."""
    if how != FULL:
        return None if status in (0, KILLED) else f"ends with {status}: {told[-300:]}"
    if "Traceback" in told or status not in (0, 1, 2):
        return f"a full disk: ends with {status}: {told[-400:]}"
    return None if status != 2 else _form(told)


def _form(told: str) -> str | None:
    errors = [line for line in told.splitlines() if "error:" in line]
    return None if len(errors) == 1 else f"a full disk: {told[-300:]}"


def reference_of(name: str, materials: Path) -> dict[str, Any]:
    """Number of writes and contents of an uninterrupted run."""
    file = materials / "references" / f"{name}.json"
    if not file.is_file():
        file.parent.mkdir(exist_ok=True)
        folder = Path(f"reference-{os.getpid()}").absolute()
        (folder / "work").mkdir(parents=True)
        writes = count(name, folder / "work", materials)
        contents = contents_of(folder / "work")
        (folder / "again").mkdir()
        count(name, folder / "again", materials)
        again = contents_of(folder / "again")
        contents = {file: sum if again[file] == sum else ANY for file, sum in contents.items()}
        content = json.dumps({"writes": writes, "contents": contents})
        shutil.rmtree(folder)
        draft = file.with_suffix(f".{os.getpid()}")
        draft.write_text(content)
        draft.replace(file)
    return json.loads(file.read_text())


def _in_fork(name: str, folder: Path, materials: Path, crash: tuple[int, str] | None) -> tuple[int, str]:
    """Run a job in a process of its own; exit status, and what it said on standard error."""
    child = os.fork()
    if child == 0:
        status = 70
        end_with_parent()
        try:
            said = os.open(folder.parent / "said", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
            os.dup2(said, 2)
            os.chdir(folder)
            writes = Writes(folder, crash)
            from foretrace.cli import main

            status = main(JOBS[name].arguments.format(m=materials).split())
            writes.end()
        except BaseException:
            import traceback

            traceback.print_exc()
        sys.stderr.flush()
        os._exit(status)
    _, status = os.waitpid(child, 0)
    said = (folder.parent / "said").read_text(errors="replace")
    return os.waitstatus_to_exitcode(status), said


class Writes:
    """Counts the writes of this process below a folder, and ends it at one of them.

    Args:
        folder: The folder.
        crash: Number of the write and what happens there; None: writes are counted alone.
    """

    def __init__(self, folder: Path, crash: tuple[int, str] | None):
        self._folder, self._crash = str(folder), crash
        self._count, self._open, self._on = 0, "", True
        sys.addaudithook(self._hear)
        sync = os.fsync
        os.fsync = lambda file: (self._point(""), sync(file))[1]
        self._watch("cv2", "imwrite", 0)
        self._watch("safetensors.torch", "serialize_file", 1)

    def end(self) -> None:
        """Note how many writes there were; half of the last one is lost, if that was asked for."""
        self._lose()
        self._on = False
        Path(self._folder, "..", "writes").write_text(str(self._count))

    def _watch(self, module: str, name: str, place: int) -> None:
        """Functions of compiled libraries that open files by themselves."""
        __import__(module)
        original = getattr(sys.modules[module], name)

        def write(*arguments: Any, **more: Any) -> Any:
            path = str(arguments[place] if len(arguments) > place else more["filename"])
            self._point(os.path.abspath(path))
            return original(*arguments, **more)

        setattr(sys.modules[module], name, write)

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._on:
            return
        if event == "open":
            path, _, flags = arguments
            if isinstance(path, str | bytes) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC):
                self._note(os.path.abspath(os.fsdecode(path)), True)
        elif event in CHANGES and isinstance(arguments[0], str | bytes | os.PathLike):
            self._note(os.path.abspath(os.fsdecode(arguments[0])), False)

    def _note(self, path: str, opened: bool) -> None:
        if path.startswith(self._folder):
            self._point(path if opened else "")

    def _point(self, opened: str) -> None:
        self._lose()
        at, how = self._crash or (-1, "")
        if self._count == at:
            if how == STOP:
                os._exit(KILLED)
            if how == FULL:
                self._count += 1
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), opened or None)
            self._open = opened or "nothing"
        self._count += 1

    def _lose(self) -> None:
        """After the write at which half is lost: the file keeps half of its content, and the process ends."""
        if self._open:
            self._on = False
            with suppress(OSError):
                os.truncate(self._open, os.path.getsize(self._open) // 2)
            os._exit(KILLED)


def contents_of(folder: Path) -> dict[str, str]:
    """Checksum of every file, but for what says when it was written."""
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    return {
        str(file.relative_to(folder)): hashlib.sha256(_timeless(file)).hexdigest()[:16]
        for file in files
        if not file.name.startswith(VARIES)
    }


def _timeless(file: Path) -> bytes:
    """The content without the entries that tell time or place."""
    content = file.read_bytes()
    if file.name == "metrics.csv":
        rows = list(csv.DictReader(content.decode().splitlines()))
        return repr(
            [{name: value for name, value in row.items() if name != "seconds"} for row in rows]
        ).encode()
    if file.suffix == ".json":
        with suppress(ValueError):
            return repr(_without_times(json.loads(content))).encode()
    return content


def _without_times(content: Any) -> Any:
    if isinstance(content, dict):
        return {name: _without_times(value) for name, value in content.items() if name not in TIMES}
    if isinstance(content, str) and content.startswith("../"):
        return content.rpartition("/")[2]  # the way from the trial's folder to the materials
    return [_without_times(each) for each in content] if isinstance(content, list) else content


def difference(found: dict[str, str], wanted: dict[str, str]) -> str:
    """What is missing, is left or differs."""
    missing = sorted(wanted.keys() - found.keys())
    left = sorted(found.keys() - wanted.keys())
    both = wanted.keys() & found.keys()
    other = sorted(name for name in both if wanted[name] not in (ANY, found[name]))
    parts = {"lacks": missing, "has left": left, "differs in": other}
    return "; ".join(f"{what} {', '.join(names[:3])}" for what, names in parts.items() if names)
