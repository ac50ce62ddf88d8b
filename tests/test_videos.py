"""Videos as phones, browsers, screen recorders and editors write them are whole; files that are cut off are refused."""

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from foretrace.errors import PerceptionError
from foretrace.perception.recordings import open_recording

STEADY = [Fraction(k, 25) for k in range(30)]
CHANGING = STEADY[:10] + STEADY[10::4]
HELD = [*STEADY[:10], Fraction(9)]
KINDS = [
    ("mp4", "mpeg4", {}),
    ("mp4", "libx264", {"bf": "3"}),
    ("mov", "mjpeg", {}),
    ("mkv", "libx264", {"bf": "3"}),
    ("webm", "libvpx", {}),
    ("avi", "mjpeg", {}),
    ("avi", "mpeg4", {"bf": "2"}),
]
SIZE = (96, 64)


def film(
    path: Path,
    times: Sequence[Fraction] = STEADY,
    codec: str = "mpeg4",
    options: dict[str, str] | None = None,
    container: dict[str, str] | None = None,
    sound: float = 0.0,
) -> Path:
    """A video with a bar whose column tells the number of the frame, and a corner that tells what is up."""
    with av.open(str(path), "w", options=container or {}) as video:
        stream = video.add_stream(codec, rate=25, options=options or {})
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        heard = video.add_stream("pcm_s16le", rate=8000) if sound else None
        stream.codec_context.time_base = Fraction(1, 25)
        for number, time in enumerate(times):
            image = np.zeros((*SIZE[::-1], 3), np.uint8)
            image[:, 2 * number : 2 * number + 8] = 255
            image[:16, 80:] = (0, 0, 200)
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts, frame.time_base = int(time * 25), Fraction(1, 25)
            video.mux(stream.encode(frame))
        video.mux(stream.encode(None))
        if heard is not None:
            samples = av.AudioFrame.from_ndarray(np.zeros((1, int(8000 * sound)), np.int16), layout="mono")
            samples.sample_rate, samples.pts = 8000, 0
            video.mux(heard.encode(samples))
            video.mux(heard.encode(None))
    return path


def read(path: Path) -> tuple[list[float], list[int]]:
    """Time of each frame [s], and its number as the image tells it."""
    frames = list(open_recording(path).frames())
    bars = [np.flatnonzero(frame.image[20:, :76].mean(axis=(0, 2)) > 128) for frame in frames]
    return [frame.time for frame in frames], [round((bar[0] - 0.5) / 2) for bar in bars]


@pytest.mark.parametrize(("kind", "codec", "options"), KINDS)
@pytest.mark.parametrize("times", [STEADY, CHANGING, HELD], ids=["steady", "changing", "held"])
def test_every_frame_is_read_at_its_time(
    tmp_path: Path, kind: str, codec: str, options: dict[str, str], times: Sequence[Fraction]
) -> None:
    if kind == "avi" and (times is HELD or options):
        times = STEADY  # its frames have no times of their own
    found, numbers = read(film(tmp_path / f"film.{kind}", times, codec, options))
    np.testing.assert_allclose(np.array(found) - found[0], [float(time) for time in times], atol=0.0011)
    assert numbers == list(range(len(times)))


@pytest.mark.parametrize("kind", ["mkv", "mov"])
def test_sound_may_be_longer(tmp_path: Path, kind: str) -> None:
    assert len(read(film(tmp_path / f"film.{kind}", sound=4.0))[0]) == 30


def test_what_an_edit_list_leaves_out_is_left_out(tmp_path: Path) -> None:
    """As a cut without encoding anew leaves it: the first frames are there to be decoded, and not shown."""
    shifted = [time - Fraction(12, 25) for time in STEADY]
    found, numbers = read(film(tmp_path / "film.mp4", shifted, "libx264", {"bf": "0"}))
    np.testing.assert_allclose(found, np.arange(18) / 25, atol=1e-6)
    assert numbers == list(range(12, 30))


def test_a_browser_s_recording_states_no_duration(tmp_path: Path) -> None:
    path = film(tmp_path / "film.webm", codec="libvpx", container={"live": "1"})
    assert len(read(path)[0]) == 30


@pytest.mark.parametrize("turn", [(0, 1, -1, 0), (-1, 0, 0, -1)], ids=["90", "180"])
def test_pixels_are_the_sensor_s_whatever_way_up_it_was_held(tmp_path: Path, turn: tuple[int, ...]) -> None:
    path = film(tmp_path / "film.mp4")
    upright = next(open_recording(path).frames()).image
    content = bytearray(path.read_bytes())
    a, b, c, d = (one << 16 for one in turn)
    place = content.index(b"tkhd") + 44
    content[place : place + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    assert not np.array_equal(cv2.VideoCapture(str(path)).read()[1], upright)  # which turns it
    np.testing.assert_array_equal(next(open_recording(path).frames()).image, upright)


@pytest.mark.parametrize(("kind", "codec", "options"), [*KINDS, ("webm", "libvpx", {"live": "1"})])
@pytest.mark.parametrize("share", [0.05, 0.4, 0.97])
def test_videos_that_are_cut_off(
    tmp_path: Path, kind: str, codec: str, options: dict[str, str], share: float
) -> None:
    path = film(tmp_path / f"film.{kind}", codec=codec, container=options if "live" in options else {})
    content = path.read_bytes()
    path.write_bytes(content[: round(share * len(content))])
    with pytest.raises(PerceptionError, match=rf"video .*film.{kind} is cut off: .* bytes are missing"):
        open_recording(path)


@pytest.mark.parametrize(
    "start", [b"", b"no video", bytes(4000), b"RIFF" + bytes(40), b"\x1a\x45\xdf\xa3" + bytes(99)]
)
def test_files_that_are_no_videos(tmp_path: Path, start: bytes) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(start)
    with pytest.raises(PerceptionError, match=r"cannot be opened|is cut off"):
        list(open_recording(path).frames())


def test_damage_in_the_middle_is_told(tmp_path: Path) -> None:
    path = film(tmp_path / "film.mkv", [Fraction(k, 25) for k in range(200)], codec="mjpeg")
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 4000] = bytes(4000)
    path.write_bytes(content)
    with pytest.raises(PerceptionError, match=r"is damaged after 3\.\d+ s"):
        list(open_recording(path).frames())


def test_sound_alone_is_no_video(tmp_path: Path) -> None:
    path = tmp_path / "film.mkv"
    with av.open(str(path), "w") as video:
        heard = video.add_stream("pcm_s16le", rate=8000)
        samples = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), layout="mono")
        samples.sample_rate = 8000
        video.mux(heard.encode(samples))
    with pytest.raises(PerceptionError, match="has no moving images"):
        list(open_recording(path).frames())
