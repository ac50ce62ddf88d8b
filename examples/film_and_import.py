"""Film a simulated lever-up, look at the film as if it were real, and compare what was found with what was there."""

import sys
import tempfile
from pathlib import Path

import numpy as np

import foretrace as ft
from foretrace.interactions.pinhole import PinholeCamera
from foretrace.perception.importing import Contact, import_recording
from foretrace.perception.markers import MarkerLayout
from foretrace.perception.recordings import open_recording
from foretrace.simulation.recording import RecordingConfig, record_lever_up

CAMERA = PinholeCamera(800, 450, 580.0, 581.0, 402.0, 223.0)
FILM = RecordingConfig(CAMERA, distance=0.6, frames_per_second=10.0, exposures=1, depth_every=0)


def main(folder: Path) -> None:
    prism = ft.Prism([(0.09, -0.02), (0.05, 0.07), (-0.03, 0.08), (-0.09, 0.0), (-0.02, -0.08)])
    truth = record_lever_up(prism, ft.LeverUp.at_edge(prism, 2), folder, FILM, seed=0)
    layout = MarkerLayout.load(folder / "markers.json")
    found = import_recording(open_recording(folder), CAMERA, layout, Contact(edge=(2, 0.5)), prism)
    apart = np.linalg.norm(found.T_table_object[:, :3, 3] - truth.T_table_object[:, :3, 3], axis=1)
    print(f"{len(truth.times)} frames in {folder}")
    print(f"outcome: {found.interaction.effect.outcome}, in truth {truth.interaction.effect.outcome}")
    print(f"position error: {1000 * np.median(apart):.2f} mm (median)")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as scratch:
            main(Path(scratch))
