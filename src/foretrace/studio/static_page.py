"""The studio's static page: the predictor that comes with foretrace, in the browser, without a server."""

import gzip
import hashlib
import json
import shutil
import subprocess
import tarfile
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb

from foretrace.actions import ToolPath
from foretrace.actions.base import CORNER_MARGIN
from foretrace.actions.lever_up import APPROACH, SCREWDRIVER, VARIED_ACTION
from foretrace.errors import StudioError, shown
from foretrace.files import as_path, make_folder, write_bytes, write_text
from foretrace.imagined import FLOOR, LEVELS
from foretrace.imagined.domain import RELEVANT_SHARE
from foretrace.imagined.futures import MIN_PROBABILITY
from foretrace.imagined.shown import SUREST
from foretrace.interactions import hull
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, VIEW_SIZE
from foretrace.objects import BEVEL, Prism
from foretrace.objects.model import SIZE_LIMITS
from foretrace.pictures.style import OBJECT_EDGE, OUTCOME_COLORS, SUPPORT_COLOR
from foretrace.predictor.portable import OnnxPredictor
from foretrace.studio import stage
from foretrace.studio.choices import FIRST, LIMITS, PHYSICS, Choices
from foretrace.studio.controls import KNOBS
from foretrace.studio.scenery import LEAST_PROBABLE, MOST_FUTURES, MOST_UPRIGHTS
from foretrace.studio.session import LEVEL, Session, learned
from foretrace.studio.shapes import EXAMPLES, MOST_CORNERS
from foretrace.studio.texts import LEAST_SHOWN

RUNTIME = "onnxruntime-web@1.30.0"
"""The package of npm that runs the network in a browser (MIT licence)."""
RUNTIME_SHA256 = "d2228df7e4616bc3348bf504ee888f3bec43789a273f0a63f3e68d203ce3bf71"
"""Checksum of its archive."""
SCRIPT, WASM = "ort.wasm.bundle.min.mjs", "ort-wasm-simd-threaded.wasm"
"""Its two files that are needed."""
ABOUT = "The same predictor as in Python; what the page lacks of it: twin, plans, monitors. Runs in ONNX Runtime Web."


def write_static_page(out: Path, runtime: Path | None = None) -> Path:
    """Write a page that imagines lever-ups in the browser, without a server.

    Args:
        out: Folder to write; its ``index.html`` can be opened as a file, or served by any web server.
        runtime: Folder of the unpacked package onnxruntime-web; by default it is fetched with npm.

    Returns:
        The page.

    Raises:
        StudioError: The folder cannot be made or has another page, or onnxruntime-web cannot be had.
    """
    page = as_path(out, StudioError) / "index.html"
    if page.is_file() and b"foretrace" not in page.read_bytes():
        raise StudioError(f"{page} is another page: choose another --export")
    predictor = learned()
    assert isinstance(predictor, OnnxPredictor)
    script, wasm = fetched_runtime() if runtime is None else read_runtime(runtime)
    make_folder(out, StudioError)
    packed = {"runtime": script, "wasm": wasm, "model": optimised(predictor.file)}
    write_text(out / "packed.js", _script("PACKED", {name: _packed(each) for name, each in packed.items()}))
    write_text(out / "facts.js", _script("FACTS", page_facts(predictor)))
    for file in files("foretrace.studio").joinpath("static").iterdir():
        write_bytes(out / file.name, file.read_bytes())
    return page


def fetched_runtime() -> tuple[bytes, bytes]:
    """Script and WebAssembly of ONNX Runtime, fetched with npm.

    Raises:
        StudioError: npm is missing or fails, or its archive is another one than was tested.
    """
    remedy = f"install npm, or fetch {RUNTIME} elsewhere, unpack it, and give its folder as --onnxruntime-web"
    if (npm := shutil.which("npm")) is None:
        raise StudioError(f"the page needs {RUNTIME}, and npm, which fetches it, is not installed: {remedy}")
    with TemporaryDirectory(prefix="foretrace-") as folder:
        command = [npm, "pack", RUNTIME, "--silent", "--ignore-scripts"]
        try:
            done = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, timeout=300, check=False
            )
        except subprocess.TimeoutExpired:
            raise StudioError(f"npm has not fetched {RUNTIME} within 5 minutes: {remedy}") from None
        archives = list(Path(folder).glob("*.tgz"))
        if done.returncode != 0 or not archives:
            why = done.stderr.strip().splitlines() or ["no reason given"]
            raise StudioError(f"npm cannot fetch {RUNTIME} ({shown(why[0])}): {remedy}")
        if (found := hashlib.sha256(archives[0].read_bytes()).hexdigest()) != RUNTIME_SHA256:
            raise StudioError(f"npm fetched another {RUNTIME} than was tested (sha256 {found}): {remedy}")
        with tarfile.open(archives[0]) as archive:
            archive.extractall(folder, filter="data")
        return read_runtime(Path(folder) / "package")


def read_runtime(folder: Path) -> tuple[bytes, bytes]:
    """Script and WebAssembly of ONNX Runtime from the folder of its package.

    Raises:
        StudioError: They are not there.
    """
    found = []
    for name in (SCRIPT, WASM):
        try:
            found.append((as_path(folder, StudioError) / "dist" / name).read_bytes())
        except OSError:
            raise StudioError(
                f"{folder} has no dist/{name}: give the folder of the unpacked package {RUNTIME}"
            ) from None
    return found[0], found[1]


def optimised(file: Path) -> bytes:
    """A network with the constants worked out, so that a browser is spared that."""
    import onnxruntime

    with TemporaryDirectory(prefix="foretrace-") as folder:
        options = onnxruntime.SessionOptions()
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
        options.optimized_model_filepath = str(Path(folder) / file.name)
        options.log_severity_level = 3
        onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
        return Path(options.optimized_model_filepath).read_bytes()


def first_outputs() -> dict[str, list[float]]:
    """What the network returns for the first choices, flat, so that the page need not wait for it."""
    found = Session(Choices()).imagined.futures
    outputs = {
        "probability": found.probability,
        "com_trajectory": found.states[..., :3],
        "rotation_vector": found.states[..., 3:],
        "spread": found.spread,
    }
    return {name: [float(f"{each:.9g}") for each in np.ravel(values)] for name, values in outputs.items()}


def page_facts(predictor: OnnxPredictor) -> dict[str, Any]:
    """All that the page's scripts know beside the network: limits, constants, examples, colours; JSON-able."""
    choices = Choices()
    level = int(np.abs(LEVELS - LEVEL).argmin())
    widths = [float(row[level]) for row in predictor.quantiles[0]]
    examples = {name: each for name, each in EXAMPLES.items() if type(each) is Prism}
    parameters = tuple(VARIED_ACTION)
    knobs = {
        name: asdict(KNOBS[name]) | {"limits": LIMITS[name]}
        for name in ("along", "turn", *PHYSICS, *parameters)
    }
    network = {
        "context": predictor.context,
        "optional": [predictor.context[k] for k in predictor.optional],
        "futures": predictor.outcome,
        "times": predictor.sample_times.tolist(),
        "widths": [each if np.isfinite(each) else None for each in widths],
        "floor": FLOOR,
        "leastCounted": MIN_PROBABILITY,
    }
    view = {
        "viewSize": VIEW_SIZE,
        "metresPerPixel": METRES_PER_PIXEL,
        "contactPixel": CONTACT_PIXEL.tolist(),
        "relevantShare": RELEVANT_SHARE,
        "hullMargin": hull.HULL_MARGIN,
        "cornerPenalty": hull.CORNER_PENALTY,
        "maxCorners": hull.MAX_CORNERS,
        "farthestCorner": hull.FARTHEST_CORNER,
        "heightCells": hull.HEIGHT_CELLS,
        "unit": hull.UNIT,
    }
    action = {
        "path": asdict(ToolPath()),
        "tool": [asdict(part) for part in SCREWDRIVER.parts()],
        "cornerMargin": CORNER_MARGIN,
        "blade": APPROACH[0],
        "parameters": parameters,
        "physics": PHYSICS,
    }
    shapes = {
        "examples": {name: _prism(each) for name, each in examples.items()},
        "first": FIRST,
        "firstOutputs": first_outputs(),
        "bevel": asdict(BEVEL),
        "smallest": SIZE_LIMITS[0],
        "largest": SIZE_LIMITS[1],
        "mostCorners": MOST_CORNERS,
    }
    shown_names = ("along", "turn", *parameters, *PHYSICS, "exact")
    page = {
        "choices": {name: getattr(choices, name) for name in shown_names},
        "knobs": knobs,
        "colours": {
            "table": _colour(stage.TABLE),
            "grid": _colour((160, 165, 172)),
            "object": _colour(stage.OBJECT),
            "edge": to_rgb(OBJECT_EDGE),
            "grip": _colour(stage.GRIP),
            "drawing": to_rgb(SUPPORT_COLOR),
        },
        "outcomeColours": {str(name): to_rgb(colour) for name, colour in OUTCOME_COLORS.items()},
        "mostFutures": MOST_FUTURES,
        "leastShown": LEAST_PROBABLE,
        "leastListed": LEAST_SHOWN,
        "surest": SUREST,
        "mostUprights": MOST_UPRIGHTS,
        "wide": stage.WIDE,
        "gripBehind": stage.GRIP_BEHIND,
        "gripRadius": stage.GRIP_RADIUS,
        "about": ABOUT,
    }
    return network | view | action | shapes | page


def _script(name: str, content: Mapping[str, Any]) -> str:
    return f"const {name} = {json.dumps(content)};\n"


def _packed(content: bytes) -> str:
    return b64encode(gzip.compress(content, 9, mtime=0)).decode()


def _prism(prism: Prism) -> dict[str, Any]:
    return {"corners": prism.corners.tolist(), "height": prism.height, "bevel": asdict(prism.bevel)}


def _colour(values: tuple[int, int, int]) -> list[float]:
    return [value / 255 for value in values]
