"""foretrace: predict how an object will move before the robot touches it.

The names below are the public interface. They are imported on first use, so that ``import foretrace`` is quick and
simulation never loads the learning libraries.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from foretrace.actions import Action, LeverUp, Push, PushPath, ToolPath
    from foretrace.errors import ForetraceError
    from foretrace.features import FeatureExtractor
    from foretrace.imagined import Belief, ObservedMotion
    from foretrace.interactions.batch import InteractionBatch
    from foretrace.interactions.dataset import Dataset
    from foretrace.interactions.record import Effect, Interaction, Outcome, Physics
    from foretrace.interactions.topdown import TopDownView
    from foretrace.monitoring import Drift, Monitor, MonitorCalibration, Verdict, identify, information_gain
    from foretrace.objects import (
        Bevel,
        Box,
        Cylinder,
        MeshObject,
        Prism,
        Weighted,
        paper_objects,
        sample_prism,
    )
    from foretrace.planning import Plan, PlanConfig, execute_sequence, goals, plan, plan_sequence
    from foretrace.predictor import (
        EffectPredictor,
        LstmConfig,
        OneShotConfig,
        PredictorConfig,
        TrainConfig,
        load_predictor,
        train_predictor,
    )
    from foretrace.simulation.collect import CollectConfig, collect
    from foretrace.simulation.lever_up import SimulationConfig, replay, simulate, simulate_lever_up
    from foretrace.twin import TwinConfig, TwinImaginer
    from foretrace.twin.sliding import SlidingTwin

__version__ = "0.1.0"

_HOMES = {
    "foretrace.actions": ("Action", "LeverUp", "Push", "PushPath", "ToolPath"),
    "foretrace.errors": ("ForetraceError",),
    "foretrace.imagined": ("Belief", "ObservedMotion"),
    "foretrace.interactions.batch": ("InteractionBatch",),
    "foretrace.interactions.dataset": ("Dataset",),
    "foretrace.interactions.record": ("Effect", "Interaction", "Outcome", "Physics"),
    "foretrace.interactions.topdown": ("TopDownView",),
    "foretrace.monitoring": (
        *("Drift", "Monitor", "MonitorCalibration", "Verdict"),
        *("identify", "information_gain"),
    ),
    "foretrace.objects": (
        *("Bevel", "Box", "Cylinder", "MeshObject", "Prism", "Weighted"),
        *("paper_objects", "sample_prism"),
    ),
    "foretrace.features": ("FeatureExtractor",),
    "foretrace.planning": ("Plan", "PlanConfig", "execute_sequence", "goals", "plan", "plan_sequence"),
    "foretrace.predictor": (
        *(
            "EffectPredictor",
            "LstmConfig",
            "OneShotConfig",
            "PredictorConfig",
            "TrainConfig",
        ),
        *("load_predictor", "train_predictor"),
    ),
    "foretrace.simulation.collect": ("CollectConfig", "collect"),
    "foretrace.simulation.lever_up": ("SimulationConfig", "replay", "simulate", "simulate_lever_up"),
    "foretrace.twin": ("TwinConfig", "TwinImaginer"),
    "foretrace.twin.sliding": ("SlidingTwin",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Action",
    "Belief",
    "Bevel",
    "Box",
    "CollectConfig",
    "Cylinder",
    "Dataset",
    "Drift",
    "Effect",
    "EffectPredictor",
    "FeatureExtractor",
    "ForetraceError",
    "Interaction",
    "InteractionBatch",
    "LeverUp",
    "LstmConfig",
    "MeshObject",
    "Monitor",
    "MonitorCalibration",
    "ObservedMotion",
    "OneShotConfig",
    "Outcome",
    "Physics",
    "Plan",
    "PlanConfig",
    "PredictorConfig",
    "Prism",
    "Push",
    "PushPath",
    "SimulationConfig",
    "SlidingTwin",
    "ToolPath",
    "TopDownView",
    "TrainConfig",
    "TwinConfig",
    "TwinImaginer",
    "Verdict",
    "Weighted",
    "collect",
    "execute_sequence",
    "goals",
    "identify",
    "information_gain",
    "load_predictor",
    "paper_objects",
    "plan",
    "plan_sequence",
    "replay",
    "sample_prism",
    "simulate",
    "simulate_lever_up",
    "train_predictor",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'foretrace' has no attribute {name!r}; it offers {', '.join(__all__)}")
    from foretrace.extras import named_extras

    with named_extras():
        value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
