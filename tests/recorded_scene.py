"""One lever-up recorded by a simulated camera, which several test files look at."""

import json
from pathlib import Path

from foretrace.actions import LeverUp
from foretrace.geometry import invert_transform
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.objects import Prism
from foretrace.simulation.lens import Faults
from foretrace.simulation.recording import RecordingConfig, RecordingTruth, record_lever_up

CAMERA = PinholeCamera(800, 450, 580.0, 581.0, 402.0, 223.0, (0.05, -0.1, 0.0005, -0.0005, 0.02))
PRISM = Prism([(0.09, -0.02), (0.05, 0.07), (-0.03, 0.08), (-0.09, 0.0), (-0.02, -0.08)])
ACTION = LeverUp.at_edge(PRISM, 2, 0.5)
CONFIG = RecordingConfig(
    CAMERA, distance=0.6, frames_per_second=10.0, exposures=1, depth_every=40, faults=Faults(blur=0.5)
)


def record(folder: Path) -> RecordingTruth:
    """Write the recording, with camera.json and object.json, and give the truth."""
    truth = record_lever_up(PRISM, ACTION, folder, CONFIG, seed=3)
    CAMERA.save(folder / "camera.json")
    (folder / "object.json").write_text(json.dumps(PRISM.to_dict()))
    return truth


def contact_pixel(truth: RecordingTruth) -> tuple[float, float]:
    """Column and row of the contact in the first frame, on the upper rim."""
    rim = truth.T_table_object[0] @ [*ACTION.contact, PRISM.height, 1.0]
    column, row = CAMERA.project(rim[None, :3], invert_transform(truth.T_table_camera))[0]
    return float(column), float(row)
