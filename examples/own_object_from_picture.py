"""From the silhouette of an object to a simulated lever-up and a picture of it.

    python examples/own_object_from_picture.py [OUT.png]

The silhouette is drawn here; your own comes from
``foretrace.objects.shape_files.read_silhouette_image(file)``.
"""

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

import foretrace as ft
from foretrace.pictures.scene import interaction_figure

METRES_PER_PIXEL = 0.0005
HEIGHT = 0.015
"""Thickness of the object [m]; a silhouette does not tell it."""


def silhouette() -> np.ndarray:
    """A spanner-like shape, white on black: a bar with a wider head."""
    picture = np.zeros((260, 460), dtype=np.uint8)
    cv2.rectangle(picture, (40, 90), (330, 170), color=255, thickness=-1)
    cv2.circle(picture, (340, 130), radius=85, color=255, thickness=-1)
    return picture


def main() -> None:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp()) / "lever-up.png"
    mask = silhouette()
    obj = ft.Prism.from_mask(mask, METRES_PER_PIXEL, HEIGHT)
    print(f"outline: {len(obj.corners)} corners, {100 * obj.size:.1f} cm across")

    # The object frame has its origin at the silhouette's centroid, x to the right and y up in the picture.
    action = ft.LeverUp.nearest(obj, (-0.12, 0.0))  # the bar's end
    print(f"contact: {np.round(action.contact, 4)}, pushing along {np.round(action.direction, 3)}")

    # What a predictor is given when only the picture is known.
    view = ft.TopDownView.from_mask(mask, METRES_PER_PIXEL, action.contact, action.direction, HEIGHT)
    exact = ft.TopDownView.of(obj, action)
    print(f"pixels that differ between picture and polygon: {(view.mask != exact.mask).sum()}")

    interaction = ft.simulate(obj, action, embodiment="tool")
    print(f"outcome: {interaction.effect.outcome}")
    interaction_figure(interaction).savefig(out)
    print(f"picture: {out}")


if __name__ == "__main__":
    main()
