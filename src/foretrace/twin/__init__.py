"""The twin: imagines an action's effect by simulating it on the object that it sees."""

from foretrace.twin.calibration import TwinCalibration
from foretrace.twin.imaginer import TwinConfig, TwinImaginer

__all__ = ["TwinCalibration", "TwinConfig", "TwinImaginer"]
