"""How an export reaches its folder: whole or not at all."""

import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from foretrace.errors import ExportError
from foretrace.files import atomic_folder, make_folder
from foretrace.workers import ProgressReport

T = TypeVar("T")


def require(module: str, extra: str) -> None:
    """Make sure that an optional library is there.

    Raises:
        ExportError: It is not installed.
    """
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise ExportError(
            f"cannot export: {module} is not installed; install it with `pip install 'foretrace[{extra}]'`"
        ) from error


@contextmanager
def delivered(out: Path) -> Iterator[Path]:
    """An empty folder to write to, which takes its final name when everything in it is done.

    Args:
        out: The final name.

    Raises:
        ExportError: Something has that name already.
    """
    if out.exists() or out.is_symlink():
        raise ExportError(f"{out} exists already and is not overwritten: choose another --out, or remove it")
    make_folder(out.parent, ExportError)
    with atomic_folder(out) as draft:
        yield draft


def watched(items: Sequence[T], noun: str) -> Iterator[T]:
    """The items one by one, with progress on the console."""
    with ProgressReport(noun, len(items)) as report:
        for item in items:
            yield item
            report.add()
