"""Libraries that come with extras: one line says which extra is missing."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec

from foretrace.errors import ForetraceError

EXTRA_OF = {
    **dict.fromkeys(("joblib", "mujoco", "OpenGL", "pyarrow"), "sim"),
    **dict.fromkeys(("safetensors", "tensorboard", "torch"), "train"),
    **dict.fromkeys(("dtaidistance", "pandas", "scoringrules"), "eval"),
    **dict.fromkeys(("av", "imageio_ffmpeg"), "video"),
    **dict.fromkeys(("onnx", "onnxscript"), "onnx"),
    **dict.fromkeys(("fastapi", "uvicorn", "viser"), "studio"),
    **dict.fromkeys(("mujoco_warp", "warp"), "warp"),
    "gymnasium": "gym",
    "ray": "ray",
}
"""The extra that brings each optional library, by the name under which that is imported."""


class MissingExtraError(ForetraceError, ModuleNotFoundError):
    """A library of an extra is needed that is not installed."""


def missing_extra(error: ImportError, needed: Sequence[str] = ()) -> MissingExtraError | None:
    """What to say where a library of an extra is not installed; None where the import failed for another reason.

    Args:
        error: What failed.
        needed: Extras that the work as a whole needs: those that are not installed are named, too.
    """
    library = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or library not in EXTRA_OF:
        return None
    absent = {EXTRA_OF[name] for name in EXTRA_OF if EXTRA_OF[name] in needed and find_spec(name) is None}
    extras = ",".join(sorted({EXTRA_OF[library], *absent}))
    return MissingExtraError(
        f"this needs {library}, which is not installed: pip install 'foretrace[{extras}]'",
        name=library,
    )


@contextmanager
def named_extras() -> Iterator[None]:
    """Let a failed import within a block say which extra is missing.

    Raises:
        MissingExtraError: A library of an extra is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if isinstance(error, MissingExtraError) or (found := missing_extra(error)) is None:
            raise
        raise found from error
