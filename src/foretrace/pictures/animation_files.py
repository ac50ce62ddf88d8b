"""Pictures in order as files that move: GIF and MP4."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from foretrace.errors import PredictionError
from foretrace.files import atomic_path

LAST_FRAME_TIME = 1.2
"""How long an animation rests on its end before it repeats [s]."""
COLORS = 128
"""Colours of a GIF."""


def write_animation(path: Path, pictures: Iterator[np.ndarray], period: float) -> Path:
    """Write pictures (rows, columns, 3), uint8, as a GIF or MP4.

    Args:
        path: The file to write; its ending decides between ``.gif`` and ``.mp4``.
        pictures: The pictures in order.
        period: Time between them [s].

    Raises:
        PredictionError: The ending is unknown, or MP4 cannot be written here.
    """
    writers = {".gif": _write_gif, ".mp4": _write_mp4}
    if path.suffix.lower() not in writers:
        raise PredictionError(f"cannot write an animation to {path}: choose a name ending in .gif or .mp4")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as draft:
        writers[path.suffix.lower()](draft, pictures, period)
    return path


def _write_gif(path: Path, pictures: Iterator[np.ndarray], period: float) -> None:
    images = [Image.fromarray(picture) for picture in pictures]
    palette = images[len(images) // 2].quantize(COLORS, dither=Image.Dither.NONE)
    found = np.reshape(palette.getpalette() or [], (-1, 3))
    found[(found > 245).all(axis=1)] = 255  # white was averaged with what is nearly white
    palette.putpalette(found.ravel().tolist())
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    durations = [round(1000 * period)] * (len(images) - 1) + [round(1000 * LAST_FRAME_TIME)]
    first, *others = images
    first.save(path, "GIF", save_all=True, append_images=others, duration=durations, loop=0, optimize=False)


def _write_mp4(path: Path, pictures: Iterator[np.ndarray], period: float) -> None:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise PredictionError(
            "cannot write MP4: it needs `pip install foretrace[video]`; or choose a .gif"
        ) from error
    shown = list(pictures)
    height, width, _ = shown[0].shape
    options: Any = {
        "fps": 1 / period,
        "macro_block_size": 2,
        "output_params": ["-f", "mp4"],
    }  # whatever the name
    writer: Any = imageio_ffmpeg.write_frames(str(path), (width, height), **options)
    writer.send(None)
    for picture in [*shown, *[shown[-1]] * round(LAST_FRAME_TIME / period)]:
        writer.send(np.ascontiguousarray(picture))
    writer.close()
