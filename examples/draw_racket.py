"""Draw the silhouette of a table-tennis racket from its usual dimensions: blade 157 x 150 mm, handle 100 x 28 mm."""

from pathlib import Path

import cv2
import numpy as np
import shapely

METRES_PER_PIXEL = 0.0005
ASSET = Path(__file__).parents[1] / "src" / "foretrace" / "assets" / "racket.png"


def racket() -> shapely.Polygon:
    """Outline in metres, handle down."""
    angle = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    blade = shapely.Polygon(np.column_stack([0.075 * np.cos(angle), 0.0785 * np.sin(angle)]))
    neck = shapely.Polygon([(-0.045, -0.06), (0.045, -0.06), (0.014, -0.105), (-0.014, -0.105)])
    handle = shapely.box(-0.014, -0.175, 0.014, -0.07).buffer(0.004).buffer(-0.004)
    return shapely.union_all([blade, neck, handle]).buffer(-0.006).buffer(0.006)


def draw(path: Path = ASSET) -> None:
    outline = np.array(racket().exterior.coords)
    low, high = outline.min(axis=0) - 0.02, outline.max(axis=0) + 0.02
    columns, rows = np.ceil((high - low) / METRES_PER_PIXEL).astype(int)
    pixels = np.column_stack([outline[:, 0] - low[0], high[1] - outline[:, 1]]) / METRES_PER_PIXEL
    picture = np.zeros((rows, columns), dtype=np.uint8)
    cv2.fillPoly(picture, [np.rint(pixels * 16).astype(np.int32)], 255, shift=4)
    cv2.imwrite(str(path), picture)


if __name__ == "__main__":
    draw()
    print(ASSET)
