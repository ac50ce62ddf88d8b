"""Files that are either whole or absent, JSON with a format and a version, folders with one writer."""

import errno
import hashlib
import itertools
import json
import os
import platform
import re
import shutil
import time
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

from foretrace.errors import ForetraceError, shown, wrong_type
from foretrace.schema import conform, parse_json
from foretrace.urls import Url, is_url, names_in

T = TypeVar("T")

LOCK = ".lock"
LARGEST_TEXT = 2**28
"""Bytes of text that are read; what is longer, or never ends, is no file that foretrace reads."""
PARTIAL = ".partial"
"""Ending of a file or folder that is being written."""
DRAFT = re.compile(rf"\..*\.(?P<here>[0-9a-f]{{6}})-(?P<process>\d+)-\d+{re.escape(PARTIAL)}", re.DOTALL)
"""Names of such files and folders, with the machine and the process that write them."""
OLD = 24 * 3600.0
"""A draft last touched longer ago is the rest of an interrupted run, whoever has its process number now [s]."""
_numbers = itertools.count()
_drafts: set[str] = set()
"""What this process is writing."""


def as_path(path: Any, error: type[ForetraceError]) -> Path:
    """A path that a caller gives.

    Raises:
        ForetraceError: Of the given class: it is no path.
    """
    if not isinstance(path, str | os.PathLike):
        raise wrong_type(error)(f"{shown(path)} is no path: give the name of a file or folder")
    if is_url(path):
        raise error(f"{path} is a URL, and only data sets are read from and simulated to URLs: give a folder")
    return Path(path)


def cache_folder(name: str) -> Path:
    """Where the user's cache keeps files of a kind; it may be deleted at any time."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(home) if os.path.isabs(home) else Path.home() / ".cache") / "foretrace" / name


def make_folder(folder: Path, error: type[ForetraceError]) -> None:
    """Make a folder and those above it, unless they exist.

    Raises:
        ForetraceError: Of the given class: the system refuses it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as reason:
        raise error(
            f"folder {folder} cannot be made ({reason.strerror or reason}): choose another one"
        ) from None


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A name to write to; the file gets its own name at the end of the block, or is removed after an error.

    Every write has a name of its own, so that several may write the same file at once: the last one stays. Where the
    name is a link, the file that it leads to is written.

    Raises:
        OSError: The system refuses to write the file, whose name it has; or the name is that of a device or a pipe.
    """
    path = path.resolve() if path.is_symlink() else path
    if path.exists() and not path.is_file() and not path.is_dir():
        raise OSError(errno.EINVAL, "it is a device or a pipe, no file", str(path))
    with _draft(path) as draft:
        try:
            yield draft
            with open(draft, "rb") as file:
                os.fsync(file.fileno())
            os.replace(draft, path)
        except OSError as error:
            if error.filename in (None, str(draft)) and error.errno:
                raise OSError(error.errno, error.strerror, str(path)) from error
            raise
    if os.name == "posix":  # the new name itself must reach the disk, too
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """An empty folder to write to, which gets its own name at the end of the block, or is removed after an error.

    Raises:
        OSError: The system refuses it, or something that is no empty folder has that name.
    """
    with _draft(path) as draft:
        draft.mkdir(parents=True)
        yield draft
        if path.is_dir():
            path.rmdir()  # which refuses one that is not empty
        os.replace(draft, path)


@contextmanager
def _draft(path: Path) -> Iterator[Path]:
    """A name beside a path that nothing else has; what has it at the end of the block is removed."""
    _sweep_once(path.parent)
    draft = path.with_name(f".{path.name[:40]}.{_here()}-{os.getpid()}-{next(_numbers)}{PARTIAL}")
    _drafts.add(str(draft))
    try:
        yield draft
    finally:
        _remove(draft)
        _drafts.discard(str(draft))


@lru_cache(maxsize=1)
def _here() -> str:
    """This machine in the name of a draft: its process numbers are its own."""
    return short_hash([platform.node().encode()])[:6]


@lru_cache(maxsize=4096)
def _sweep_once(folder: Path) -> None:
    """Remove drafts that killed processes left in a folder, when this process first writes there."""
    if folder.is_dir():
        for file in folder.glob(f".*{PARTIAL}"):
            if DRAFT.fullmatch(file.name) and _is_left(file):
                _remove(file)


def _is_left(file: Path) -> bool:
    """Whether no living process writes a draft."""
    if not (made := DRAFT.fullmatch(file.name)):
        return True
    try:
        if time.time() - file.stat().st_mtime > OLD:
            return True
        here, process = made["here"], int(made["process"])
        if here != _here():
            return False
        if process == os.getpid():
            return str(file) not in _drafts
        os.kill(process, 0)
    except (FileNotFoundError, ProcessLookupError):
        return True
    except OSError:
        pass  # it lives, and is another user's
    return False


def _remove(file: Path) -> None:
    if file.is_dir() and not file.is_symlink():
        shutil.rmtree(file, ignore_errors=True)
    else:
        with suppress(OSError):
            file.unlink(missing_ok=True)


def write_bytes(path: Path | Url, content: bytes) -> None:
    """Write a file so that it is either whole or absent, even after a loss of power."""
    if isinstance(path, Url):
        path.write_bytes(content)
        return
    with atomic_path(path) as partial:
        partial.write_bytes(content)


def write_text(path: Path | Url, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    write_bytes(path, text.encode())


def write_json(path: Path | Url, content: Any, indent: int = 1) -> None:
    """Write a JSON file atomically."""
    write_text(path, json.dumps(content, indent=indent, ensure_ascii=False) + "\n")


def read_text(path: Path | Url, error: type[ForetraceError], remedy: str, fallback: str | None = None) -> str:
    """The text in a file, as editors and spreadsheets write it; line ends stay as they are.

    It is UTF-8, UTF-16 or UTF-32, with or without a byte order mark.

    Args:
        path: The file.
        error: The class to raise.
        remedy: What to do about a file that cannot be read; ends the message.
        fallback: Encoding of what is none of these, where a letter read wrongly does no harm.

    Raises:
        ForetraceError: Of the given class: the file is missing, too large, or no text.
    """
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_TEXT + 1)
    except FileNotFoundError:
        raise error(f"{path} does not exist: {remedy}") from None
    except (OSError, ValueError) as reason:  # a ValueError for a name that no file can have
        raise error(f"{path} cannot be read ({getattr(reason, 'strerror', reason)}): {remedy}") from reason
    if len(content) > LARGEST_TEXT:
        raise error(f"{path} is longer than {LARGEST_TEXT >> 20} MB: {remedy}")
    encoding = json.detect_encoding(content)
    try:
        return content.decode(encoding).removeprefix("\ufeff")
    except UnicodeDecodeError as reason:
        if fallback is None or b"\0" in content:
            raise error(
                f"{path} is no text in {encoding.removesuffix('-sig').upper()} "
                f"(byte {content[reason.start]:#04x} at {reason.start}): save it as UTF-8, or {remedy}"
            ) from reason
        return content.decode(fallback)


def read_json(path: Path | Url, schema: type[T] | Any, error: type[ForetraceError], remedy: str) -> T:
    """The object in a JSON file.

    Args:
        path: The file.
        schema: What it must hold; see `foretrace.schema`.
        error: The class to raise.
        remedy: What to do about a file that cannot be read; ends the message.

    Raises:
        ForetraceError: Of the given class: the file is missing, is no text or JSON, holds no object, or an entry is
            missing or another than the schema's.
    """
    return conform(_json_object(path, error, remedy), schema, str(path), error, remedy)


def read_versioned(
    path: Path | Url,
    schema: type[T] | Any,
    format: str,
    version: int,
    error: type[ForetraceError],
    remedy: str,
    key: str = "format_version",
    older: tuple[int, ...] = (),
) -> T:
    """The object in a JSON file that names its format and version.

    Args:
        path: The file.
        schema: What it must hold; see `foretrace.schema`.
        format: Name that its entry ``format`` must have.
        version: Version that is written today.
        error: The class to raise.
        remedy: What to do about a file that cannot be read; ends the message.
        key: Entry that holds the version.
        older: Older versions that can be read as well.

    Raises:
        ForetraceError: Of the given class: as `read_json`, or the format or its version is another one.
    """
    content = _json_object(path, error, remedy)
    if content.get("format") != format:
        raise error(f"{path} does not describe a {format}: {remedy}")
    if isinstance(content.get(key), bool) or content.get(key) not in (version, *older):
        raise error(
            f"{path} has format version {shown(content.get(key))}, this foretrace reads version {version}: "
            f"use the foretrace that wrote it, or {remedy}"
        )
    return conform(content, schema, str(path), error, remedy)


def _json_object(path: Path | Url, error: type[ForetraceError], remedy: str) -> dict[str, Any]:
    text = read_text(path, error, remedy)
    try:
        content = parse_json(text)
    except ValueError as reason:
        raise error(f"{path} cannot be read as JSON ({reason}): {remedy}") from reason
    if not isinstance(content, dict):
        raise error(f"{path} holds a {type(content).__name__} where a JSON object is expected: {remedy}")
    return content


@contextmanager
def sole_writer(folder: Path, error: type[ForetraceError] = ForetraceError) -> Iterator[None]:
    """Hold a folder's lock, which the system releases even when the process is killed.

    Args:
        folder: The folder; it must exist.
        error: The class to raise.

    Raises:
        ForetraceError: Of the given class: another process is writing there.
    """
    with open(folder / LOCK, "w") as lock:
        if os.name == "posix":
            import fcntl

            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as reason:
                raise error(f"another foretrace writes to {folder}; wait until it is done") from reason
        yield


def remove_partial(folder: Path, everywhere: bool = False) -> list[Path]:
    """Remove what interrupted writes left in a folder; returns what was removed.

    Args:
        folder: The folder.
        everywhere: Remove what other processes and machines write, too: they must be known to have ended.
    """
    leftovers = sorted(folder.glob(f"*{PARTIAL}")) if everywhere else partial_files(folder)
    for file in leftovers:
        _remove(file)
    return leftovers


def partial_files(folder: Path) -> list[Path]:
    """What interrupted writes left in a folder, in order of their names; not what a living process writes."""
    return sorted(file for file in folder.glob(f"*{PARTIAL}") if _is_left(file))


def first_stranger(folder: Path | Url, own: Container[str] = ()) -> str | None:
    """Name of the first entry in a folder that is not the beginning of something whose entries have given names.

    Args:
        folder: The folder; it need not exist.
        own: Names that its entries may have, beside the lock and drafts.
    """
    mine = (
        name for name in names_in(folder) if name != LOCK and not (name[0] == "." and name.endswith(PARTIAL))
    )
    return next((name for name in mine if name not in own), None)


def flatten(nested: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings on one level, names joined by dots."""
    flat: dict[str, Any] = {}
    for name, value in nested.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def first_difference(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> tuple[str, Any, Any] | None:
    """Name, value found and value wanted of the first setting, by name, in which two configurations differ."""
    flat_found, flat_wanted = flatten(found), flatten(wanted)
    for name in sorted(flat_found.keys() | flat_wanted.keys()):
        if flat_found.get(name) != flat_wanted.get(name):
            return name, flat_found.get(name), flat_wanted.get(name)
    return None


def as_json(content: Any) -> Any:
    """What a JSON file gives back of something: tuples are lists, keys are strings."""
    return json.loads(json.dumps(content))


def short_hash(parts: Iterable[bytes]) -> str:
    """First 16 hexadecimal digits of the SHA-256 checksum of all parts, one after the other."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()[:16]


@lru_cache(maxsize=16)
def versions_of(*distributions: str) -> dict[str, str]:
    """Installed versions of distributions; ``not installed`` where one is missing."""
    found = {}
    for name in distributions:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
