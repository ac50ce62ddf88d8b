"""The twin: imagines an action's effect by simulating it on the object that it sees."""

from foretrace.imagined import IMAGINERS
from foretrace.objects import Prism
from foretrace.twin.calibration import TwinCalibration
from foretrace.twin.imaginer import TwinConfig, TwinImaginer

__all__ = ["TwinCalibration", "TwinConfig", "TwinImaginer"]


# A prism's outline is found in the view as exactly as its place would be, and sooner.
IMAGINERS.add("twin", lambda obj: TwinImaginer(object=None if type(obj) is Prism else obj))
IMAGINERS.add(
    "twin-to-rest",
    lambda obj: TwinImaginer(config=TwinConfig(set_down=True), object=None if type(obj) is Prism else obj),
)
