"""The snippets of README and of the pages in docs run as they stand, or the page says why not.

Python blocks of a page run in order and share their names. Of console blocks the ``foretrace`` commands run. A block
after ``<!-- not run: why -->`` is only read: its Python must compile, its ``foretrace`` commands must have valid
options. A block after ``<!-- needs: module -->`` runs where the module is installed.
"""

import importlib.util
import json
import re
import shlex
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import pytest
import trimesh

from foretrace import cli
from foretrace.extras import MissingExtraError
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.motions import read_recordings
from foretrace.objects import object_from_dict
from foretrace.perception.markers import MarkerLayout
from foretrace.pictures import animation
from foretrace.predictor import LstmConfig, TrainConfig, train_predictor
from foretrace.robot.path import read_base_pose
from foretrace.simulation.collect import CollectConfig, collect
from foretrace.simulation.lever_up import SimulationConfig

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(
    r"(?:^<!-- (not run|needs): ([^>]+) -->\s+)?^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL
)
LANGUAGES = {"python", "console", "bash"}
ALL_FRAMES = animation.frames
SHELL = re.compile(r"[$|]|&&|^(for|done)\b")


@dataclass(frozen=True)
class Snippet:
    """A fenced block of a page."""

    page: Path
    line: int
    language: str
    text: str
    reason: str | None
    needs: str | None

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"

    def code(self):
        """Its Python, with the page's line numbers in tracebacks."""
        return compile("\n" * self.line + self.text, str(self.page), "exec")

    def commands(self) -> list[list[str]]:
        """Its commands, as words; lines with variables, loops or pipes of a shell are left out."""
        lines = self.text.replace("\\\n", " ").splitlines()
        words = [shlex.split(line.removeprefix("$ "), comments=True) for line in lines]
        return [line for line in words if line and not SHELL.search(" ".join(line))]


def snippets(page: Path) -> list[Snippet]:
    text = page.read_text(encoding="utf-8")
    found = []
    for match in BLOCK.finditer(text):
        mark, words, language, content = match.groups()
        line = text.count("\n", 0, match.start(4))
        if language in LANGUAGES:
            reason, needs = (words if mark == name else None for name in ("not run", "needs"))
            found.append(Snippet(page, line, language, content, reason, needs))
    return found


def block(page: str, start: str) -> str:
    """The content of a page's block that begins like this, to be written into a file."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return next(content for *_, content in BLOCK.findall(text) if content.startswith(start))


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the snippets read: data sets, a training, an outline, a silhouette, a mesh."""
    folder = tmp_path_factory.mktemp("docs")
    config = CollectConfig(objects=4, contacts_per_edge=1, simulation=SimulationConfig(embodiment="tool"))
    collect(config, folder / "data/paper", workers=1)
    shutil.copytree(folder / "data/paper", folder / "data/small")
    data = Dataset.open(folder / "data/paper").where(outcome="levered")
    training = TrainConfig(epochs=1, min_steps=1, split=None, threads=1)
    train_predictor(data, LstmConfig(features="none", hidden=8), folder / "runs/im-cnn", training)
    (folder / "pentagon.txt").write_text(block("getting-started.md", "# pentagon.txt"), encoding="utf-8")
    shutil.copy(ROOT / "src/foretrace/assets/racket.png", folder / "mask.png")
    trimesh.creation.box((140, 90, 20)).apply_translation((0, 0, 10)).export(folder / "part.stl")
    return folder


def run(arguments: list[str]) -> int:
    try:
        return cli.main(arguments)
    except SystemExit as end:  # --help, or options that cannot be read
        return int(end.code or 0)


@pytest.mark.parametrize("page", [page for page in PAGES if snippets(page)], ids=lambda page: page.name)
def test_snippets_run(page: Path, samples: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if page.name != "README.md":  # whose commands need no file that is not there
        shutil.copytree(samples, tmp_path, dirs_exist_ok=True)
        (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(animation, "frames", lambda scene: islice(ALL_FRAMES(scene), 2))  # saves seconds
    names: dict[str, object] = {}
    for snippet in snippets(page):
        if snippet.reason or (snippet.needs and not importlib.util.find_spec(snippet.needs)):
            continue
        if snippet.language == "python":
            exec(snippet.code(), names)
            continue
        for program, *arguments in snippet.commands():
            assert program == "foretrace", f"{snippet}: mark {program} with <!-- not run: why -->"
            assert run(arguments) == 0, f"{snippet}: foretrace {shlex.join(arguments)}"


@pytest.mark.parametrize("page", [page for page in PAGES if snippets(page)], ids=lambda page: page.name)
def test_snippets_that_are_not_run_can_be_read(page: Path) -> None:
    for snippet in snippets(page):
        if snippet.reason and snippet.language == "python":
            snippet.code()
        elif snippet.reason:
            for program, *arguments in snippet.commands():
                if program == "foretrace":
                    with suppress(MissingExtraError):  # warp is in no development environment
                        cli.read(arguments)


@pytest.mark.parametrize(
    ("page", "start", "read"),
    [
        ("robot.md", '{\n  "format": "foretrace-base-pose"', read_base_pose),
        ("perception.md", '{\n  "format": "foretrace-markers"', MarkerLayout.load),
        ("replay.md", '{\n  "format": "foretrace-motion"', read_recordings),
        ("data-set.md", '{"kind": "prism"', lambda file: object_from_dict(json.loads(file.read_text()))),
    ],
)
def test_files_shown_can_be_read(
    page: str, start: str, read: Callable[[Path], object], tmp_path: Path
) -> None:
    (tmp_path / "shown.json").write_text(block(page, start), encoding="utf-8")
    assert read(tmp_path / "shown.json") is not None
