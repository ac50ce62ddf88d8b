"""Settings of the direct (non-autoregressive) trajectory predictor."""

from dataclasses import dataclass

from foretrace.actions import LeverUp
from foretrace.errors import TrainingError, check_ranges, shown
from foretrace.imagined.context import first_action
from foretrace.predictor.config import (
    PredictorConfig,
    TrainConfig,
    check_choice,
    check_count,
    check_flag,
    check_outcomes,
)

SPEED = "speed"
"""Name of the parameter of a lever-up's path that phases depend on."""


@dataclass(frozen=True, kw_only=True)
class OneShotConfig(PredictorConfig):
    """Settings of the direct (non-autoregressive) trajectory predictor."""

    training = TrainConfig(epochs=150, learning_rate=4e-3)
    added = (*PredictorConfig.added, "error_weighting", "phase_time")

    features: str = "outline"
    """Features of the object that the predictor is given: outline alone fits."""
    hidden: int = 128
    """Units of each hidden layer."""
    layers: int = 3
    """Hidden layers."""
    ensemble: int = 5
    """Size of the ensemble: networks that learn side by side and are averaged."""
    components: int = 32
    """Components of the PCA basis of trajectories, found in the training part."""
    pivot_edges: int = 2
    """Candidate pivot edges: the one ahead of the centre of mass, and its neighbour."""
    mirrored: bool = True
    """Whether every lever-up is also seen in the mirror."""
    outcomes: tuple[str, ...] = ("levered",)
    """Outcomes that it distinguishes; each has a future of its own."""
    error_weighting: float = 0.0
    """How little motions count in the loss that can hardly be predicted: each by the inverse of its predicted error
    scale to this power. 0: all the same; 1: as in the likelihood of a Laplace distribution."""

    phase_time: bool = False
    """Whether motions are compared at equal phases of the tool's path, not at equal times: for lever-ups, with their
    speed in the context."""

    def __post_init__(self) -> None:
        super().__post_init__()
        limits = {"hidden": 4096, "layers": 32, "ensemble": 100, "components": 1024}
        for name, most in limits.items():
            check_count(name, getattr(self, name), most)
        check_choice("pivot_edges", self.pivot_edges, (1, 2))
        check_flag("mirrored", self.mirrored)
        check_ranges(TrainingError, "predictor", self, {"error_weighting": (0.0, 1.0)}, "give a power")
        check_outcomes(self.outcomes)
        object.__setattr__(self, "outcomes", tuple(self.outcomes))
        check_flag("phase_time", self.phase_time)
        if self.phase_time and (SPEED not in self.context or first_action(self.outcomes) is not LeverUp):
            raise TrainingError(
                f"phase_time is True, the context is {shown(self.context)}: leave it out, or learn from lever-ups, "
                f"conditioned on their {SPEED}"
            )
