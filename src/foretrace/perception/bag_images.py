"""Images in the messages of ROS 1 and ROS 2: raw and compressed, colour and depth."""

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from foretrace.errors import PerceptionError, shown
from foretrace.images import decode_image

TO_BGR = {
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "mono8": cv2.COLOR_GRAY2BGR,
}
COLOURS = {"bgr8": ("u1", 3), "rgb8": ("u1", 3), "rgba8": ("u1", 4), "bgra8": ("u1", 4), "mono8": ("u1", 1)}
DEPTHS = {"16UC1": ("u2", 1), "mono16": ("u2", 1), "32FC1": ("f4", 1)}
"""Type of a value, and values of a pixel."""
MILLIMETRE = 0.001
"""Unit of depth in whole numbers (REP 118) [m]."""
COMPRESSED_DEPTH = "compressedDepth"
HEADER = struct.Struct("<iff")
"""Before a compressed depth image: its kind, and two numbers that tell depth from its steps."""


def is_depth(message: Any) -> bool:
    """Whether a message holds depth."""
    if hasattr(message, "encoding"):
        return message.encoding in DEPTHS
    return COMPRESSED_DEPTH in message.format or message.format.split(";")[0].strip() in DEPTHS


def read_colour(message: Any, path: Path) -> UInt8[np.ndarray, "rows columns 3"]:
    """The image in a message (blue, green, red).

    Args:
        message: An Image or CompressedImage.
        path: The bag that it is from, for errors.

    Raises:
        PerceptionError: It is damaged or of an unknown kind.
    """
    if not hasattr(message, "encoding"):
        source = f"compressed image ({message.format}) in bag {path}"
        return decode_image(bytes(message.data), source, PerceptionError).bgr(source, PerceptionError)
    image = _raw(message, COLOURS, path)
    code = TO_BGR.get(message.encoding)
    return image if code is None else cv2.cvtColor(image, code)


def read_depth(message: Any, path: Path) -> Float[np.ndarray, "rows columns"]:
    """The depth in a message [m]; 0 where nothing was seen.

    Whole numbers are millimetres, fractions metres (REP 118).

    Args:
        message: An Image or CompressedImage.
        path: The bag that it is from, for errors.

    Raises:
        PerceptionError: It is damaged or of an unknown kind.
    """
    if hasattr(message, "encoding"):
        values = _raw(message, DEPTHS, path)[..., 0]
        metres = values.astype(float) * (1.0 if message.encoding == "32FC1" else MILLIMETRE)
    else:
        metres = _compressed_depth(message, path)
    return np.where(np.isfinite(metres) & (metres > 0), metres, 0.0)


def _compressed_depth(message: Any, path: Path) -> Float[np.ndarray, "rows columns"]:
    """Depth as ROS's plugins compress it: as PNG, fractions turned into steps of inverse depth."""
    data, encoding, a, b = bytes(message.data), message.format.split(";")[0].strip(), 0.0, 0.0
    if COMPRESSED_DEPTH in message.format:
        if "rvl" in message.format:
            raise PerceptionError(f"bag {path} has depth compressed as RVL: record it raw or as PNG")
        if len(data) < HEADER.size:
            raise PerceptionError(
                f"bag {path} holds a depth image of {len(data)} bytes: record or copy it again"
            )
        _, a, b = HEADER.unpack_from(data)
        data = data[HEADER.size :]
    steps = decode_image(data, f"depth image ({message.format}) in bag {path}", PerceptionError).values
    if steps.dtype != np.uint16 or steps.ndim != 2:
        raise PerceptionError(
            f"bag {path} has depth of {steps.dtype} in {shown(message.format)}: 16UC1 and 32FC1 can be read"
        )
    if encoding != "32FC1":
        return steps.astype(float) * MILLIMETRE
    with np.errstate(divide="ignore"):
        return np.where(steps > 0, a / (steps.astype(float) - b), 0.0)


def _raw(message: Any, known: dict[str, tuple[str, int]], path: Path) -> Any:
    """The values of an Image: rows, columns, channels."""
    if message.encoding not in known:
        raise PerceptionError(
            f"bag {path} has images of encoding {message.encoding}: {', '.join(known)} can be read"
        )
    kind, channels = known[message.encoding]
    data = np.asarray(message.data, dtype=np.uint8)
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    width = message.width * channels * dtype.itemsize
    if len(data) < message.height * message.step or message.step < width:
        raise PerceptionError(f"bag {path} holds an image of {len(data)} bytes, too few for its size")
    rows = data[: message.height * message.step].reshape(message.height, message.step)[:, :width]
    values = np.ascontiguousarray(rows).view(dtype)
    return values.reshape(message.height, message.width, channels)
