"""The command that films with a RealSense camera."""

from pathlib import Path

from tyro.conf import Positional

from foretrace.cli.console import say


def capture(
    out: Positional[Path],
    seconds: float = 8.0,
    background: bool = False,
    width: int = 1280,
    height: int = 720,
    fps: int = 30,
    depth_every: int = 10,
    serial: str | None = None,
) -> None:
    """Film with a RealSense camera into a folder that `import` reads. Ctrl-C ends the film. NEVER TRIED ON A CAMERA.

    Film the empty table with --background first, then put the object there and film the lever-up into the same folder.
    Needs foretrace[realsense].

    Args:
        out: Folder for the film.
        seconds: How long to film [s].
        background: Take a picture of the empty table instead: the mean of half a second.
        width: Columns of the pictures.
        height: Rows of the pictures.
        fps: Frames per second.
        depth_every: Keep depth, aligned with colour, with every so many pictures; 0: never.
        serial: Serial number of the camera, if there are several.
    """
    import signal
    import threading

    import numpy as np

    from foretrace.errors import PerceptionError
    from foretrace.interactions import film_folder
    from foretrace.interactions.film_folder import FilmNotes, write_film
    from foretrace.perception.realsense import CaptureConfig, LiveCamera

    if not 0 < seconds < float("inf"):
        raise PerceptionError(f"--seconds is {seconds}: give a number above 0; Ctrl-C ends the film earlier")
    taken = out / (film_folder.BACKGROUND if background else film_folder.TIMES)
    if taken.exists():
        raise PerceptionError(f"{taken} is there already: choose another folder")
    out.mkdir(parents=True, exist_ok=True)
    with LiveCamera(CaptureConfig(width, height, fps, 0 if background else depth_every, serial)) as camera:
        if background:
            pictures = [frame.picture for frame in camera.frames(lambda time: time > 0.5)]
            film_folder.write_picture(taken, np.rint(np.mean(pictures, axis=0)).astype(np.uint8))
            print(taken)
            return
        stop = threading.Event()
        before = signal.signal(signal.SIGINT, lambda *_: stop.set())
        try:
            frames = camera.frames(lambda time: stop.is_set() or time > seconds)
            count = write_film(out, frames, FilmNotes())
        finally:
            signal.signal(signal.SIGINT, before)
    intrinsics = out / film_folder.CAMERA
    if camera.camera is None:
        say(
            f"the lens is described in a way that cannot be used: make {intrinsics} with `foretrace calibrate`"
        )
    elif not intrinsics.exists():
        camera.camera.save(intrinsics)
        say(f"{intrinsics} is the maker's calibration; `foretrace calibrate` makes a better one")
    print(f"{count} frames, {camera.lost} lost: {out}")
