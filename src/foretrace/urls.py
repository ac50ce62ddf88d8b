"""Folders and files in object stores: what data sets use of `pathlib.Path`, for URLs such as ``s3://bucket/set``.

pyarrow reaches S3, Google Cloud Storage, Azure and HDFS itself; fsspec, where it is installed, whatever else it knows.
An object appears when all of it was sent, and replaces another one whole: as atomic as a file that is written aside and
renamed. There are no locks, no renamed folders, and nothing is mapped into memory.
"""

import errno
import os
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, TypeVar

from foretrace.errors import DatasetError, ForetraceError, shown, wrong_type
from foretrace.extras import named_extras

Item = TypeVar("Item")
Result = TypeVar("Result")

READERS = 16
"""Objects that are read at once."""
OF_PYARROW = ("s3", "gs", "gcs", "abfs", "abfss", "hdfs", "hf")
"""Schemes of URLs that pyarrow itself reads; for ``hf`` it needs fsspec and huggingface_hub."""
PATTERN = re.compile(r"([a-z][a-z0-9+.-]+):/+([^?]*)(\?.*)?", re.DOTALL)
"""Scheme, place and settings of a URL. A `Path` of a URL has lost a slash; ``C:/`` is a drive."""
REASONS = {
    r"NO_SUCH_BUCKET|bucket does not exist|Bucket '[^']*' not found": "there is no such bucket: make it first",
    r"ACCESS_DENIED|INVALID_ACCESS_KEY|INVALID_CLIENT_TOKEN|SIGNATURE_DOES_NOT_MATCH|HTTP status 40[13]|"
    r"PERMISSION_DENIED|UNAUTHENTICATED|access token|[Cc]redential": "access is denied: give credentials that have it, "
    "for S3 in AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
    r"NETWORK_CONNECTION|REQUEST_TIMEOUT|UNAVAILABLE|[Cc]ould not connect|[Cc]ouldn't (connect|resolve)|"
    r"[Cc]onnection refused": "the server does not answer: check the network, and for S3 AWS_ENDPOINT_URL",
}
"""Message and remedy for an error, by what the library's own message contains."""
LONGEST_REASON = 200
WAIT = {"gs": "retry_limit_seconds=10", "gcs": "retry_limit_seconds=10"}
"""Settings that bound how long a library tries again, where that is a quarter of an hour."""


def is_url(path: Any) -> bool:
    """Whether a path is a URL."""
    return isinstance(path, Url) or PATTERN.fullmatch(_text(path)) is not None


def as_place(path: Any, error: type[ForetraceError]) -> "Path | Url":
    """A folder or file that a caller gives by its path or URL; ``file://`` is a path, too.

    Raises:
        ForetraceError: Of the given class: it is neither, or nothing installed reads such URLs.
    """
    if isinstance(path, Url):
        return path
    if not isinstance(path, str | os.PathLike):
        raise wrong_type(error)(f"{shown(path)} is no path: give the name of a file or folder, or a URL")
    if (parts := PATTERN.fullmatch(_text(path))) is None:
        return Path(path)
    kind, place, settings = parts.groups(default="")
    if kind == "file":
        return Path("/" + place)
    if re.match("[^/]*:[^/]*@", place):
        raise error(
            f"a URL {kind}://... with a password would be written into files: leave it out, and set the variables of "
            "the store instead, such as AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
        )
    if kind not in OF_PYARROW and kind not in _other_kinds():
        raise error(
            f"{kind}:// is no URL of an object store: choose from {', '.join(OF_PYARROW)}, or give a folder"
        )
    return Url(kind, "/".join(filter(None, place.split("/"))), settings)


@dataclass(frozen=True)
class Url:
    """A folder or file in an object store, by its URL.

    Every method raises `FileNotFoundError` where there is nothing, and `DatasetError` where the store refuses or does
    not answer.
    """

    kind: str
    """Scheme: ``s3``."""
    place: str
    """Bucket and key, without slashes around them."""
    settings: str = ""
    """The rest from ``?`` on: ``?endpoint_override=localhost:9000&scheme=http``."""

    def __str__(self) -> str:
        return f"{self.kind}://{self.place}{self.settings}"

    def __truediv__(self, name: str) -> "Url":
        return Url(self.kind, f"{self.place}/{name}", self.settings)

    @property
    def name(self) -> str:
        """Its last part."""
        return self.place.rpartition("/")[2]

    def resolve(self) -> "Url":
        """Itself: a URL is the same from everywhere."""
        return self

    def exists(self) -> bool:
        """Whether there is a file of that name, or one below it."""
        return self._type() != "NotFound"

    def is_dir(self) -> bool:
        """Whether there is a file below it."""
        return self._type() == "Directory"

    def is_file(self) -> bool:
        """Whether it is a file."""
        return self._type() == "File"

    def names(self) -> list[str]:
        """Names of the files and folders in it, sorted; none where there is no such folder."""
        from pyarrow.fs import FileSelector

        with self._opened() as (store, path):
            found = store.get_file_info(FileSelector(path, allow_not_found=True))
        return sorted(each.base_name for each in found if each.base_name)

    def read_bytes(self) -> bytes:
        """All bytes of a file."""
        with self._opened() as (store, path), store.open_input_file(path) as file:
            return file.read()

    def write_bytes(self, content: bytes) -> None:
        """Write a file, which appears whole or not at all."""
        with self._opened() as (store, path):
            file = store.open_output_stream(path)
            file.write(content)
            file.close()  # not after an error, which would make a file of what there is

    def open(self, mode: Literal["rb"] = "rb") -> BytesIO:
        """A file in memory, to be read."""
        return BytesIO(self.read_bytes())

    @contextmanager
    def opened(self) -> "Iterator[Any]":
        """A file of pyarrow, of which parts are read."""
        with self._opened() as (store, path), store.open_input_file(path) as file:
            yield file

    def _type(self) -> str:
        with self._opened() as (store, path):
            return store.get_file_info(path).type.name

    @contextmanager
    def _opened(self) -> "Iterator[tuple[Any, str]]":
        """The store and the path within it; errors of libraries become errors of foretrace in one line."""
        try:
            bucket, _, key = self.place.partition("/")
            store, root = _store(self.kind, bucket, self.settings)
            yield store, f"{root}{key}".rstrip("/")
        except FileNotFoundError as reason:
            raise FileNotFoundError(errno.ENOENT, "there is no such object", str(self)) from reason
        except ForetraceError:
            raise
        except Exception as reason:  # each library has errors of its own
            raise DatasetError(f"{self} cannot be used: {_in_words(reason)}") from reason


@lru_cache(maxsize=64)
def _store(kind: str, bucket: str, settings: str) -> tuple[Any, str]:
    """A connection, and what stands before a key in its paths."""
    with named_extras():
        from pyarrow import fs
    if kind in OF_PYARROW:
        if kind in WAIT and WAIT[kind].partition("=")[0] not in settings:
            settings = f"{settings}&{WAIT[kind]}" if settings else f"?{WAIT[kind]}"
        store, path = fs.FileSystem.from_uri(f"{kind}://{bucket}/x{settings}")
    else:
        from fsspec.core import url_to_fs

        found, path = url_to_fs(f"{kind}://{bucket}/x{settings}")
        store = fs.PyFileSystem(fs.FSSpecHandler(found))
    return store, path.removesuffix("x")


def names_in(folder: "Path | Url") -> list[str]:
    """Names of the files and folders in a folder, sorted; none where there is no such folder."""
    if isinstance(folder, Url):
        return folder.names()
    return sorted(os.listdir(folder)) if folder.is_dir() else []


def read_each(read: Callable[[Item], Result], items: Sequence[Item], folder: "Path | Url") -> list[Result]:
    """What a function reads in a folder for each item, in their order; several at once where each takes its time."""
    if isinstance(folder, Path):
        return [read(item) for item in items]
    pool = ThreadPoolExecutor(READERS)
    try:
        return list(pool.map(read, items))
    finally:
        pool.shutdown(cancel_futures=True)


def _other_kinds() -> list[str]:
    try:
        import fsspec
    except ModuleNotFoundError:
        return []
    return fsspec.available_protocols()


def _text(path: Any) -> str:
    if not isinstance(path, str | os.PathLike):
        return ""
    return path.as_posix() if isinstance(path, Path) else str(os.fspath(path))


def _in_words(reason: Exception) -> str:
    text = " ".join(str(reason).split())
    known = (words for pattern, words in REASONS.items() if re.search(pattern, text))
    return next(known, text[:LONGEST_REASON] or type(reason).__name__)
