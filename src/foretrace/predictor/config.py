"""Settings of a predictor and of its training, checked when they are made."""

import math
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

from foretrace.actions import ACTIONS
from foretrace.errors import TrainingError, check_ranges, check_type, fault, shown, wrong_type
from foretrace.features import FEATURES, FeatureExtractor, Option, make_features
from foretrace.imagined.context import check_names
from foretrace.interactions.record import Outcome
from foretrace.interactions.splits import PAPER_SIZES

if TYPE_CHECKING:
    from foretrace.predictor.base import EffectPredictor

Device = Literal["auto", "cpu", "cuda"]
"""Where to compute."""
TrainingPrecision = Literal["auto", "float32", "bfloat16"]
"""Number format of convolutions in training."""
FASTEST = 1000.0
"""Highest learning rate."""


def check_count(name: str, value: Any, most: int, least: int = 1) -> None:
    """Refuse what is no whole number within limits.

    Raises:
        TrainingError: Naming the setting, its value and the limits.
    """
    is_int = isinstance(value, int) and not isinstance(value, bool)
    if not is_int or not least <= value <= most:
        raise fault(TrainingError, is_int)(f"{name} is {shown(value)}: give a number from {least} to {most}")


def check_choice(name: str, value: Any, choices: Any) -> None:
    """Refuse what is none of some choices.

    Raises:
        TrainingError: Naming the setting, its value and the choices.
    """
    plain = isinstance(value, str | int | float)
    if not plain or value not in tuple(choices):
        raise fault(TrainingError, plain)(
            f"{name} is {shown(value)}: choose from {', '.join(map(str, choices))}"
        )


def known_outcomes() -> list[str]:
    """Outcomes of all actions, those of the lever-up first."""
    others = (name for kind in ACTIONS for name in ACTIONS[kind].outcomes)
    return list(dict.fromkeys([*map(str, Outcome), *others]))


def check_outcomes(outcomes: Any) -> None:
    """Refuse what is not one or more names of outcomes.

    Raises:
        TrainingError: There is none, or one is unknown.
    """
    several = isinstance(outcomes, tuple | list)
    if not several or not outcomes:
        raise fault(TrainingError, several)(
            f"outcomes is {shown(outcomes)}: name at least one, of {', '.join(known_outcomes())}"
        )
    for name in outcomes:
        if name not in known_outcomes():
            raise TrainingError(f"unknown outcome {shown(name)}; choose from {', '.join(known_outcomes())}")
        if list(outcomes).count(name) > 1:
            raise TrainingError(f"outcome {shown(name)} is named twice: name it once")


def check_flag(name: str, value: Any) -> None:
    """Refuse what is neither True nor False.

    Raises:
        TrainingError: Naming the setting and its value.
    """
    if not isinstance(value, bool):
        raise wrong_type(TrainingError)(f"{name} is {shown(value)}: give True or False")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Settings of a training loop; the defaults are the paper's where the paper says (section 4)."""

    epochs: int = 15
    """Passes over the training part, unless ``min_steps`` asks for more."""
    min_steps: int = 300
    """Optimiser steps, at least: a small training part is passed over more often. On the command line --epochs alone
    means exactly that number of epochs."""
    batch_size: int = 32
    """Trajectories per optimiser step."""
    learning_rate: float = 8e-3
    """Adam's largest learning rate: it is reached after a tenth of the steps and falls to 0 along a cosine."""
    outcomes: tuple[str, ...] | None = None
    """Outcomes of the interactions to learn from; None: those that the predictor distinguishes, else levered."""
    split: tuple[int, int, int] | None = PAPER_SIZES
    """Sizes of the training, validation and test parts; None: in the paper's proportions."""
    first: int | None = None
    """Number below which interactions are looked at, the first ones of the data set; None: all of them, or of a data
    set that is not finished those up to its first missing shard."""
    seed: int = 0
    """Seed of the split, the first weights, the order and the dropout."""
    device: Device = "auto"
    """Where to compute; auto takes a CUDA device if there is one."""
    precision: TrainingPrecision = "auto"
    """Number format of the convolutions in training; auto takes what the device multiplies fastest."""
    threads: int | None = None
    """Threads of PyTorch on the CPU; None: one without convolutions, else as many as there are idle physical cores."""

    def __post_init__(self) -> None:
        for name in ("epochs", "min_steps", "batch_size"):
            check_count(name, getattr(self, name), 1_000_000)
        if self.threads is not None:
            check_count("threads", self.threads, 1024)
        rate = self.learning_rate
        if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0 < rate <= FASTEST:
            raise TrainingError(
                f"learning_rate is {shown(rate)}: give a number above 0 and at most {FASTEST:g}"
            )
        if self.outcomes is not None:
            check_outcomes(self.outcomes)
        if self.split is not None:
            if not isinstance(self.split, tuple | list) or len(self.split) != 3:
                raise TrainingError(f"split is {shown(self.split)}: give the sizes of three parts")
            for size in self.split:
                check_count("a part of the split", size, 1_000_000_000)
        if self.first is not None:
            check_count("first", self.first, 10**12)
        check_count("seed", self.seed, 2**63 - 1, least=0)
        check_choice("device", self.device, get_args(Device))
        check_choice("precision", self.precision, get_args(TrainingPrecision))

    def num_epochs(self, size: int) -> int:
        """Passes over a training part of a number of interactions."""
        return max(self.epochs, math.ceil(self.min_steps / math.ceil(size / self.batch_size)))


FINE_TUNING = TrainConfig(epochs=40, learning_rate=1e-3)
"""Recommended settings for a predictor that was trained before, whatever it is."""


@dataclass(frozen=True, kw_only=True)
class PredictorConfig:
    """Settings that every predictor has; a subclass beside each predictor class adds its own."""

    predictor_class: ClassVar[type[Any]]
    """The class that is made; set when that is defined."""
    training: ClassVar[TrainConfig] = TrainConfig()
    """Recommended settings of its training."""
    added: ClassVar[tuple[str, ...]] = ("hidden_share",)
    """Settings that earlier checkpoints and results do not have; they had what is the default."""

    features: str = "none"
    """Features of the object that the predictor is given, by their label."""
    feature_options: dict[str, Option] = field(default_factory=dict)
    """Settings of the feature extractor, by name."""
    context: tuple[str, ...] = ()
    """Conditioning variables beside the view: friction, tool_friction, density, contact_error, bevel_width,
    bevel_height; parameters of the action's path."""
    hidden_share: float = 0.0
    """Share of the lever-ups of which training hides constants of the context: of half of them all, of the others some.
    The predictor can then do without any. 0: all must be told."""

    def __post_init__(self) -> None:
        if not isinstance(self.context, tuple | list):
            raise TrainingError(f"context is {shown(self.context)}: give the names in a tuple")
        object.__setattr__(self, "context", tuple(self.context))
        check_type("feature_options", self.feature_options, dict, TrainingError)
        check_names(self.context)
        check_ranges(TrainingError, "predictor", self, {"hidden_share": (0.0, 1.0)}, "give a share")
        FEATURES.find(self.features)

    def make(self, num_samples: int) -> "EffectPredictor":
        """The untrained predictor; its first weights are drawn from PyTorch's random numbers.

        Args:
            num_samples: Samples of a trajectory.
        """
        check_count("num_samples", num_samples, 1_000_000, least=2)
        if not hasattr(self, "predictor_class"):
            raise TrainingError(
                f"{type(self).__name__} makes no predictor: take the config of one, as LstmConfig"
            )
        return self.predictor_class(self, num_samples)

    def make_features(self) -> FeatureExtractor:
        """The feature extractor."""
        return make_features(self.features, **self.feature_options)


def feature_option(name: str, config_class: type[PredictorConfig]) -> str:
    """Name of a feature extractor's setting beside the settings of a predictor and of its training."""
    taken = {each.name for each in (*fields(config_class), *fields(TrainConfig))}
    return f"feature_{name}" if name in taken else name
