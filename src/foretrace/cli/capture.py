"""The command that records with a RealSense camera."""

import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from foretrace.cli.console import say
from foretrace.cli.parsing import adapt
from foretrace.errors import PerceptionError
from foretrace.interactions import recording_folder
from foretrace.interactions.recording_folder import RecordingNotes, write_recording
from foretrace.perception.realsense import CaptureConfig, LiveCamera


@adapt(frames_per_second="fps")
def capture(
    out: Positional[Path],
    config: Annotated[OmitArgPrefixes[CaptureConfig], arg(name="")],
    seconds: float = 8.0,
    background: bool = False,
) -> None:
    """Record with a RealSense camera into a folder that `import` reads (experimental).

    NEVER TRIED ON A CAMERA. Record the empty table with --background first, then put the object there and record the
    lever-up into the same folder. Ctrl-C ends the recording. Needs foretrace[realsense].

    Args:
        out: Folder for the recording.
        config: Settings of the camera.
        seconds: Duration of the recording [s].
        background: Take an image of the empty table instead: the mean of half a second.
    """
    if not 0 < seconds < float("inf"):
        raise PerceptionError(
            f"--seconds is {seconds}: give a number above 0; Ctrl-C ends the recording earlier"
        )
    taken = out / (recording_folder.BACKGROUND if background else recording_folder.TIMES)
    if taken.exists():
        raise PerceptionError(f"{taken} is there already: choose another folder")
    out.mkdir(parents=True, exist_ok=True)
    with LiveCamera(replace(config, depth_every=0) if background else config) as camera:
        if background:
            images = [frame.image for frame in camera.frames(lambda time: time > 0.5)]
            recording_folder.write_image(taken, np.rint(np.mean(images, axis=0)).astype(np.uint8))
            print(taken)
            return
        stop = threading.Event()
        before = signal.signal(signal.SIGINT, lambda *_: stop.set())
        try:
            frames = camera.frames(lambda time: stop.is_set() or time > seconds)
            count = write_recording(out, frames, RecordingNotes())
        finally:
            signal.signal(signal.SIGINT, before)
    intrinsics = out / recording_folder.CAMERA
    if camera.camera is None:
        say(
            f"the lens is described in a way that cannot be used: make {intrinsics} with `foretrace calibrate`"
        )
    elif not intrinsics.exists():
        camera.camera.save(intrinsics)
        say(f"{intrinsics} is the maker's calibration; `foretrace calibrate` makes a better one")
    print(f"{count} frames, {camera.lost} lost: {out}")
