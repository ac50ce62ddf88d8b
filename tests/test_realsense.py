"""RealSense recordings and cameras: the maker's library, with a virtual camera in place of a real one."""

import builtins
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from foretrace.cli import main
from foretrace.errors import PerceptionError
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception import realsense
from foretrace.perception.recordings import open_recording

WIDTH, HEIGHT, FRAMES = 64, 48, 24
LENS = (0.05, -0.1, 0.001, -0.001, 0.02)
COLOUR_CAMERA = PinholeCamera(WIDTH, HEIGHT, 60.0, 61.0, 32.0, 24.0, LENS)
START = 1000.0
"""Time stamp of the first frame [ms]."""


def colour_of(number: int) -> np.ndarray:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[...] = [5, 9 * number, 200]
    image[:, number : number + 4] = 255
    return image


def record(path: Path, depth: bool = True, colour: bool = True, model: str = "brown_conrady") -> Path:
    """A recording that the library itself makes, of a camera that exists in its memory alone."""
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
    device = rs.software_device()
    device.register_info(rs.camera_info.name, "virtual")
    kinds = [
        ("Depth", rs.stream.depth, rs.format.z16, 2, depth),
        ("Color", rs.stream.color, rs.format.bgr8, 3, colour),
    ]
    sensors, profiles = {}, {}
    for uid, (name, stream, layout, size, wanted) in enumerate(kinds):
        if not wanted:
            continue
        sensors[name], video = device.add_sensor(name), rs.video_stream()
        video.type, video.index, video.uid, video.fmt, video.bpp = stream, 0, uid, layout, size
        video.width, video.height, video.fps = WIDTH, HEIGHT, 30
        video.intrinsics = _intrinsics(rs, model)
        profiles[name] = sensors[name].add_video_stream(video)
    if depth:
        sensors["Depth"].add_read_only_option(rs.option.depth_units, 0.001)
    if depth and colour:
        beside = rs.extrinsics()
        beside.rotation, beside.translation = np.eye(3).ravel().tolist(), [0.0, 0.0, 0.0]
        profiles["Depth"].as_video_stream_profile().register_extrinsics_to(profiles["Color"], beside)
    recorder = rs.recorder(str(path), device)
    outlets, queue = recorder.query_sensors(), rs.frame_queue(4 * FRAMES, True)
    for outlet in outlets:
        outlet.open(outlet.get_stream_profiles())
        outlet.start(queue)
    kept = []  # the library reads pixels in threads of its own
    for number in range(FRAMES):
        steps = np.full((HEIGHT, WIDTH), 500 + number, np.uint16)
        for name, size, pixels in (("Depth", 2, steps), ("Color", 3, colour_of(number))):
            if name not in sensors:
                continue
            kept.append(pixels)
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp, frame.frame_number = pixels, size * WIDTH, size, number
            frame.timestamp = START + 1000 / 30 * number
            frame.domain, frame.profile = (
                rs.timestamp_domain.hardware_clock,
                profiles[name].as_video_stream_profile(),
            )
            if name == "Depth":
                frame.depth_units = 0.001
            sensors[name].on_video_frame(frame)
            time.sleep(0.003)
    for outlet in outlets:
        outlet.stop()
        outlet.close()
    return path


def _intrinsics(rs: Any, model: str) -> Any:
    found = rs.intrinsics()
    found.width, found.height = WIDTH, HEIGHT
    found.fx, found.fy, found.ppx, found.ppy = 60.0, 61.0, 32.0, 24.0
    found.model, found.coeffs = getattr(rs.distortion, model), list(LENS)
    return found


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("realsense") / "film.db3")


def close_to(camera: PinholeCamera | None) -> bool:
    assert camera is not None
    return np.allclose(camera.matrix, COLOUR_CAMERA.matrix) and np.allclose(camera.distortion, LENS)


def test_a_recording_is_a_film(recording: Path) -> None:
    film = open_recording(recording)
    assert close_to(film.camera)
    frames = list(film.frames())
    np.testing.assert_allclose([one.time for one in frames], 1 + np.arange(FRAMES) / 30, atol=1e-6)
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, colour_of(number))
        assert frame.depth is not None
        seen = frame.depth[frame.depth > 0]
        assert len(seen) > 0.8 * frame.depth.size
        np.testing.assert_allclose(seen, 0.5 + 0.001 * number, atol=1e-6)
    assert len(list(film.frames())) == FRAMES, "a film can be read again"


def test_no_frame_is_lost_whenever_reading_begins_and_ends(recording: Path) -> None:
    """Streams open one after the other, and nobody reads yet: what the library plays meanwhile would be gone."""
    for number in range(12):
        with realsense._Playing(recording) as playing:
            time.sleep(0.1 * (number % 3))
            if number % 2:
                next(playing.frames())
                continue
            frames = list(playing.frames())
        assert [round(30 * (frame.time - 1)) for frame in frames] == list(range(FRAMES)), number
        assert all(frame.depth is not None for frame in frames), number


def test_recordings_that_lack_something(tmp_path: Path, recording: Path) -> None:
    frames = list(open_recording(record(tmp_path / "flat.db3", depth=False)).frames())
    assert len(frames) == FRAMES
    assert all(frame.depth is None for frame in frames)
    with pytest.raises(PerceptionError, match="has no colour stream"):
        open_recording(record(tmp_path / "grey.db3", colour=False))
    assert open_recording(record(tmp_path / "inverse.db3", model="inverse_brown_conrady")).camera is None
    content = recording.read_bytes()
    (tmp_path / "half.db3").write_bytes(content[: len(content) // 2])
    with pytest.raises(PerceptionError, match=r"half.db3 cannot be read .* it is cut off"):
        open_recording(tmp_path / "half.db3")


def test_without_the_library(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    load = builtins.__import__

    def missing(name: str, *rest: Any, **more: Any) -> Any:
        if name == "pyrealsense2":
            raise ImportError("No module named 'pyrealsense2'")
        return load(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", missing)
    for attempt in (lambda: open_recording(recording), realsense.LiveCamera):
        with pytest.raises(PerceptionError, match=r"pip install foretrace\[realsense\]"):
            attempt()


def test_without_a_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The real library looks for a camera on this machine."""
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
    if len(rs.context().query_devices()):
        pytest.skip("a camera is plugged in")
    assert main(["capture", str(tmp_path / "film")]) == 2
    error = capsys.readouterr().err
    assert "no RealSense camera is connected: plug it into a USB 3 port" in error


@pytest.fixture
def plugged_in(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The recording takes the place of a camera: frames and profiles are the library's, the pipeline starts it."""
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
    pipeline, config = rs.pipeline, rs.config

    class Pipeline:
        def start(self, asked: Any) -> Any:
            self._pipeline, played = pipeline(), config()
            played.enable_device_from_file(str(recording), repeat_playback=False)
            realsense.hold(played.resolve(rs.pipeline_wrapper(self._pipeline)).get_device().as_playback())
            profile = self._pipeline.start(played)
            realsense.release(profile.get_device().as_playback())
            return profile

        def wait_for_frames(self, timeout: int) -> Any:
            return self._pipeline.wait_for_frames(timeout)

        def stop(self) -> None:
            self._pipeline.stop()

    monkeypatch.setattr(rs, "pipeline", Pipeline)
    monkeypatch.setattr(rs, "context", Connected)
    monkeypatch.setattr(realsense, "WARM_UP", 2)


class Connected:
    def query_devices(self) -> list[str]:
        return ["a camera"]


@pytest.mark.usefixtures("plugged_in")
def test_filming(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "film"
    assert main(["capture", str(out), "--background"]) == 0
    assert main(["capture", str(out), "--seconds", "0.15", "--depth-every", "2"]) == 0
    said = capsys.readouterr()
    assert "lost" in said.out
    assert "maker's calibration" in said.err
    film = open_recording(out)
    assert close_to(film.camera)
    assert film.background() is not None
    frames = list(film.frames())
    assert 3 <= len(frames) <= 6
    assert [frame.depth is not None for frame in frames] == [k % 2 == 0 for k in range(len(frames))]
    assert frames[0].depth is not None
    assert 0.49 < np.median(frames[0].depth) < 0.52
    assert json.loads((out / "film.json").read_text())["action_start"] is None
    for again in (["capture", str(out)], ["capture", str(out), "--background"]):
        assert main(again) == 2
        assert "is there already" in capsys.readouterr().err


def test_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)

    class Silent:
        def start(self, _: Any) -> Any:
            profile = type("Profile", (), {})()
            stream = type("Stream", (), {"stream_type": lambda self: rs.stream.color})()
            stream.as_video_stream_profile = lambda: stream
            stream.get_intrinsics = lambda: _intrinsics(rs, "brown_conrady")
            profile.get_streams = lambda: [stream]
            return profile

        def wait_for_frames(self, timeout: int) -> Any:
            raise RuntimeError(f"Frame didn't arrive within {timeout}")

        def stop(self) -> None:
            pass

    monkeypatch.setattr(rs, "pipeline", Silent)
    monkeypatch.setattr(rs, "context", Connected)
    with (
        realsense.LiveCamera() as camera,
        pytest.raises(PerceptionError, match=r"gives no images .*arrive within 5000.*plug it in again"),
    ):
        next(camera.frames(lambda _: False))
    with pytest.raises(PerceptionError, match="frames_per_second = 0 is outside 1 to 1000"):
        realsense.CaptureConfig(frames_per_second=0)
