"""Dictionaries of square markers, and how a marker looks.

An ArUco marker stands as OpenCV draws it. An AprilTag stands as its project publishes and prints it (Olson, 2011; Wang
and Olson, 2016), whichever way up the installed OpenCV has it.
"""

from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import UInt8

from foretrace.errors import PerceptionError, shown

DICTIONARIES: dict[str, int] = {
    **{
        f"{bits}x{bits}_{count}": getattr(cv2.aruco, f"DICT_{bits}X{bits}_{count}")
        for bits in (4, 5, 6, 7)
        for count in (50, 100, 250, 1000)
    },
    "aruco_original": cv2.aruco.DICT_ARUCO_ORIGINAL,
    "apriltag_16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "apriltag_25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "apriltag_36h10": cv2.aruco.DICT_APRILTAG_36h10,
    "apriltag_36h11": cv2.aruco.DICT_APRILTAG_36h11,
}
"""OpenCV's dictionaries by the names that users give."""
PUBLISHED = {
    "apriltag_16h5": 0x231B,
    "apriltag_25h9": 0x155CBF1,
    "apriltag_36h10": 0x1CA92A687,
    "apriltag_36h11": 0xD5D628584,
}
"""The published tag 0 of each family: its modules row by row from the upper left, white is 1.

OpenCV 4 holds the tags turned by 180 degrees.
"""


@lru_cache(maxsize=len(DICTIONARIES))
def dictionary(name: str) -> cv2.aruco.Dictionary:
    """A dictionary of markers.

    Raises:
        PerceptionError: There is none of that name.
    """
    name = name.lower()
    if name not in DICTIONARIES:
        raise PerceptionError(
            f"marker dictionary {shown(name)} is unknown: choose one of {', '.join(DICTIONARIES)}"
        )
    found = cv2.aruco.getPredefinedDictionary(DICTIONARIES[name])
    if name not in PUBLISHED:
        return found
    # A marker's bytes are those of its pattern, then of the pattern turned by 90, 180 and 270 degrees.
    turned = found.bytesList.reshape(len(found.bytesList), 4, -1)
    side = found.markerSize
    published = f"{PUBLISHED[name]:0{side * side}b}"
    for turns in range(4):
        rolled = np.ascontiguousarray(np.roll(turned, turns, axis=1).reshape(found.bytesList.shape))
        bits = cv2.aruco.Dictionary.getBitsFromByteList(rolled[:1], side)
        if "".join(map(str, bits.ravel())) == published:
            return cv2.aruco.Dictionary(rolled, side, found.maxCorrectionBits)
    raise PerceptionError(f"OpenCV {cv2.__version__} has other tags of {name}: install one from 4.13 to 5")


def draw_marker(name: str, id: int, pixels: int = 1) -> UInt8[np.ndarray, "side side"]:
    """A marker without its white margin, upright.

    Args:
        name: Its dictionary.
        id: Its number.
        pixels: Pixels along a module.

    Raises:
        PerceptionError: There is no such dictionary, or no such marker in it.
    """
    found = dictionary(name)
    if not 0 <= id < len(found.bytesList):
        raise PerceptionError(f"marker {id} is not in {name}: choose 0 to {len(found.bytesList) - 1}")
    return cv2.aruco.generateImageMarker(found, id, pixels * (found.markerSize + 2), borderBits=1)
