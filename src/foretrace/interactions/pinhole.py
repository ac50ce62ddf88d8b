"""The pinhole camera: from a depth image to points in space."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from foretrace.geometry import transform_points


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of a camera without distortion (camera frame: x right, y down, z forward)."""

    width: int = 640
    """Columns of the image."""
    height: int = 480
    """Rows of the image."""
    fx: float = 579.4
    """Focal length along the columns [pixel]."""
    fy: float = 579.4
    """Focal length along the rows [pixel]."""
    cx: float = 319.5
    """Column of the optical axis; pixel centres are whole numbers [pixel]."""
    cy: float = 239.5
    """Row of the optical axis [pixel]."""

    def deproject(
        self, depth: Float[np.ndarray, "rows columns"], T_frame_camera: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "points 3"]:
        """Points seen in a depth image.

        Args:
            depth: Distance along the optical axis [m]; pixels at 0, NaN or infinity saw nothing and are left out.
            T_frame_camera: Pose of the camera in the frame that the points are wanted in.
        """
        rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
        z = depth[rows, columns].astype(float)
        points = np.stack([(columns - self.cx) / self.fx * z, (rows - self.cy) / self.fy * z, z], axis=-1)
        return transform_points(T_frame_camera, points)
