"""Videos: every frame at the time that the file states, as the sensor gave it; files that are cut off are refused.

A frame's time is its presentation time stamp, so that variable rates, edit lists and reordered frames come out right.
The number of frames and the duration that a file states are estimates in most containers. Whether it is whole is seen
from its structure: no part of it ends behind the end of the file.
"""

import os
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import av
import av.error
from av.stream import Disposition

from foretrace.errors import PerceptionError
from foretrace.interactions.recording_folder import Frame

VIDEOS = (".mp4", ".m4v", ".mov", ".3gp", ".avi", ".mkv", ".webm")
BOXES = b"ftyp styp moov moof mfra mdat sidx ssix free skip wide uuid udta meta emsg prft pnot PICT".split()
"""Boxes on the upper level of an MP4 or QuickTime file (ISO/IEC 14496-12)."""
EBML, SEGMENT, CLUSTER = 0x1A45DFA3, 0x18538067, 0x1F43B675
"""Elements of Matroska and WebM (RFC 8794, RFC 9559)."""
SLACK = 0.5
"""Images may end so much earlier than stated [s]."""
UNKNOWN_ELEMENT, UNKNOWN_RIFF = -1, 0xFFFFFFFF
"""Sizes that were not known when they were written."""


def check_whole(path: Path) -> None:
    """Refuse a video whose end is missing.

    Raises:
        PerceptionError: It is cut off, or cannot be read.
    """
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            start = file.read(12)
            if start[:4] == b"RIFF":
                end = _riff_end(file, size)
            elif int.from_bytes(start[:4]) == EBML:
                end = _matroska_end(file, size)
            else:
                end = _boxes_end(file, size)
    except OSError as error:
        raise PerceptionError(
            f"video {path} cannot be read ({error.strerror}): check its permissions"
        ) from error
    if end > size:
        raise PerceptionError(
            f"video {path} is cut off: {end - size} of {end} bytes are missing; copy it again"
        )


def video_frames(path: Path) -> Iterator[Frame]:
    """The frames of a video, in the order in which they are shown.

    Raises:
        PerceptionError: It is damaged, of an unknown kind, or has no image.
    """
    time, end = None, 0.0
    try:
        with open(path, "rb") as file, av.open(file, mode="r", metadata_errors="replace") as video:
            streams = [one for one in video.streams.video if not one.disposition & Disposition.attached_pic]
            if not streams:
                raise PerceptionError(f"video {path} has no moving images: give the file that has them")
            # AVI states when frames are decoded; reordered ones are shown at the same times, in their own order.
            in_order: deque[int | None] | None = deque() if video.format.name == "avi" else None
            for packet in video.demux(streams[0]):
                if packet.is_corrupt:
                    raise _damaged(path, time, "incomplete data")
                if in_order is not None and packet.size:
                    in_order.append(packet.dts)
                for frame in _decoded(packet, first=time is None):
                    stamp = in_order.popleft() if in_order else frame.pts
                    if stamp is None or frame.time_base is None:
                        raise PerceptionError(f"video {path} has no time stamps: save it as .mp4 or .mkv")
                    time = float(stamp * frame.time_base)
                    end = max(end, time + float((frame.duration or 0) * frame.time_base))
                    yield Frame(time, frame.to_ndarray(format="bgr24"))
            if time is not None and end < _stated_end(streams[0].metadata) - SLACK:
                raise _damaged(path, time, "the images after that are missing")
    except (OSError, ValueError, av.error.FFmpegError) as error:
        raise _damaged(path, time, getattr(error, "strerror", None) or str(error)) from error
    if time is None:
        raise _damaged(path, time, "no image")


def _stated_end(notes: Mapping[str, str]) -> float:
    """End of a stream of images as Matroska and WebM note it beside the stream itself [s]; 0 where they do not."""
    try:
        hours, minutes, seconds = notes.get("DURATION", "").split(":")
        return 3600 * int(hours) + 60 * int(minutes) + float(seconds)
    except ValueError:
        return 0.0


def _decoded(packet: Any, first: bool) -> list[Any]:
    """The frames that a packet completes; before the first, those that need what was cut away are left out."""
    try:
        return packet.decode()
    except av.error.InvalidDataError:
        if first:
            return []
        raise


def _damaged(path: Path, time: float | None, reason: str) -> PerceptionError:
    if time is None:
        return PerceptionError(
            f"video {path} cannot be opened ({reason[:80]}): it is damaged or of an unknown kind; copy it again"
        )
    return PerceptionError(f"video {path} is damaged after {time:.2f} s ({reason[:80]}): copy it again")


def _riff_end(file: BinaryIO, size: int) -> int:
    """Where the last of the parts ends that an AVI file has on its upper level."""
    end = 0
    while end + 8 <= size:
        file.seek(end)
        name, length = file.read(4), int.from_bytes(file.read(4), "little")
        if name not in (b"RIFF", b"JUNK", b"LIST", b"idx1") or length in (0, UNKNOWN_RIFF):
            break
        end += 8 + length + length % 2
    return end - 1 if end == size + 1 else end  # the last byte may be left out


def _boxes_end(file: BinaryIO, size: int) -> int:
    """Where the last box of an MP4 or QuickTime file ends."""
    end = 0
    while end + 8 <= size:
        file.seek(end)
        length, name = int.from_bytes(file.read(4)), file.read(4)
        if length == 1:
            length = int.from_bytes(file.read(8))
        if length < 8 or name not in BOXES:  # 0: to the end of the file
            break
        end += length
    return end


def _matroska_end(file: BinaryIO, size: int) -> int:
    """Where the last element of a Matroska or WebM file ends; those of unknown size are entered."""
    end = 0
    while end + 2 <= size:
        file.seek(end)
        name, length = _vint(file, marked=True), _vint(file, marked=False)
        if name is None or length is None:
            break
        if length == UNKNOWN_ELEMENT and name not in (SEGMENT, CLUSTER):
            break
        end = file.tell() + max(length, 0)
    return end


def _vint(file: BinaryIO, marked: bool) -> int | None:
    """An EBML number (RFC 8794, section 4), with or without the bit that tells its length; -1: unknown."""
    first = file.read(1)
    if not first or not first[0]:
        return None
    more = 8 - first[0].bit_length()
    value = int.from_bytes(first + file.read(more))
    bits = 7 * (more + 1)
    if marked:
        return value
    value &= (1 << bits) - 1
    return UNKNOWN_ELEMENT if value == (1 << bits) - 1 else value
