"""The command that trains predictors. Its options are the settings of the chosen predictor and of the training loop."""

from collections.abc import Callable, Sequence
from dataclasses import field, fields, make_dataclass, replace
from inspect import Parameter, getdoc, signature
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import docstring_parser
from tyro.conf import OmitArgPrefixes, arg

from foretrace import predictor as learned
from foretrace.cli.console import when_interrupted
from foretrace.cli.parsing import adapt
from foretrace.errors import DatasetError
from foretrace.features import FEATURES, FeatureExtractor
from foretrace.files import write_text
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import Outcome
from foretrace.interactions.splits import PAPER_SIZES
from foretrace.predictor import PREDICTORS, PredictorConfig, TrainConfig
from foretrace.predictor.config import feature_option
from foretrace.predictor.model_card import RECALIBRATED, model_card, recalibration_section
from foretrace.predictor.recalibration import SHOWN_LEVELS
from foretrace.predictor.run_folder import RunFolder
from foretrace.urls import Url, as_place

CARD = "MODEL_CARD.md"


def train_command(words: Sequence[str]) -> Callable[..., None]:
    """The command with the options of the predictor and the features that words name.

    Args:
        words: What follows ``foretrace train``.

    Raises:
        TrainingError: There is no such predictor, or there are no such features.
    """
    label = _value("--predictor", words) or "lstm"
    config_class = PREDICTORS.find(label).config_class
    settings = [each.name for each in fields(config_class)]
    features = FEATURES.find(_value("--features", words) or config_class().features)
    shared = [each.name for each in fields(TrainConfig) if each.name in settings]

    @adapt((config_class, ("feature_options",)), (TrainConfig, ("split", *shared)))
    def train(
        *,
        data: Path,
        out: Path,
        config: Any,
        extractor: Any,
        training: Any = config_class.training,
        predictor: str = "lstm",
        split: tuple[int, int, int] | None = None,
        fresh: bool = False,
        card: bool = False,
    ) -> None:
        values = [(each, getattr(extractor, each.name)) for each in fields(extractor)]
        given = {each.metadata["name"]: value for each, value in values if value != each.default}
        place = as_place(data, DatasetError)
        named = {word.partition("=")[0] for word in words if word.startswith("--")}
        if not (named <= {"--data", "--out", "--card"} and card and RunFolder(out).finished):
            if "--epochs" in named and "--min-steps" not in named:
                training = replace(training, min_steps=1)  # who asks for one epoch gets one
            _train(place, out, replace(config, feature_options=given), training, split, fresh)
        if card:
            write_text(out / CARD, model_card(out, place))
            print(out / CARD)

    train.__doc__ = f"""Train a predictor on a data set.

    The same command continues an interrupted training. Options depend on the predictor and its features: `foretrace
    train --predictor one-shot --help` lists those of another one.

    Args:
        data: Folder or URL of the data set.
        out: Folder of the training: model, settings, metrics, split, TensorBoard events.
        config: Settings of the predictor.
        extractor: Settings of the features {features.label}; those of the predictor's --features are listed.
        training: Settings of the training loop.
        predictor: Kind of predictor: {", ".join(PREDICTORS)}.
        split: Sizes of the training, validation and test parts; by default the paper's 1400 100 300, or in the same
            proportions where there are fewer interactions.
        fresh: Discard the training in the folder instead of continuing it.
        card: Write a model card to the folder, too: data, errors and calibration on the test part, limits. A finished
            training needs no other options than --data and --out.
    """
    train.__annotations__ |= {
        "config": Annotated[OmitArgPrefixes[config_class], arg(name=label)],
        "extractor": Annotated[
            OmitArgPrefixes[feature_settings(features, config_class)], arg(name=features.label)
        ],
        "training": Annotated[OmitArgPrefixes[TrainConfig], arg(name="training")],
    }
    return train


def recalibrate(run: Path, data: Path) -> None:
    """Fit the probabilities and prediction regions of a trained predictor to data that it has not learned from.

    Its motions stay the same. Data like the lever-ups that it will be used for make regions hold for these.

    Args:
        run: Folder of the training.
        data: Folder or URL of the data set; its predictions are tried first, with the regions as they were.
    """
    place = as_place(data, DatasetError)
    found = Dataset.open(place)
    held = learned.recalibrate(run, found)
    levels = [f"{level:.0%}" for level in SHOWN_LEVELS]
    print(f"{'motions in regions before':28s}" + "".join(f"{level:>8s}" for level in levels))
    for start, shares in held.items():
        print(f"{'start ' + start:28s}" + "".join(f"{share:>8.1%}" for share in shares))
    card = run / CARD
    if card.is_file():
        text = card.read_text(encoding="utf-8").partition(RECALIBRATED)[0].rstrip()
        write_text(card, f"{text}\n\n{recalibration_section(run, place, held)}")
    print(run)


def feature_settings(features: type[FeatureExtractor], config_class: type[PredictorConfig]) -> type:
    """Settings of a feature extractor as a dataclass of options; None or the extractor's default: not given."""
    documented = [docstring_parser.parse(getdoc(each) or "").params for each in features.__mro__]
    about = {entry.arg_name: entry.description for entry in next(filter(None, documented), [])}
    hints = get_type_hints(features.__init__)
    settings = []
    for name, parameter in signature(features.__init__).parameters.items():
        if name == "self" or parameter.kind is Parameter.VAR_KEYWORD:
            continue
        text = " ".join((about.get(name) or "").split())
        if isinstance(parameter.default, bool):
            kind, default = bool, parameter.default
        else:
            kind, default = hints[name] | None, None
            text = f"{text} (default: {parameter.default})".lstrip()
        option = feature_option(name, config_class)
        settings.append((option, kind, field(default=default, metadata={"help": text, "name": name})))
    return make_dataclass("FeatureSettings", settings, frozen=True)


def _value(option: str, words: Sequence[str]) -> str | None:
    """The last value of an option that is written ``--option value`` or ``--option=value``."""
    value = None
    for word, following in zip(words, [*words[1:], None], strict=False):
        name, equals, inside = word.partition("=")
        if name == option:
            value = inside if equals else following
    return value


def _train(
    data: Path | Url,
    out: Path,
    config: PredictorConfig,
    training: TrainConfig,
    split: tuple[int, int, int] | None,
    fresh: bool,
) -> None:
    outcomes = training.outcomes or getattr(config, "outcomes", None) or (str(Outcome.LEVERED),)
    everything = Dataset.open(data)
    # Without any of them the training itself says which outcomes there are.
    dataset = everything.where(outcome=outcomes) or everything
    if split is None:
        split = PAPER_SIZES if len(dataset) >= sum(PAPER_SIZES) else None
    with when_interrupted(f"the best model so far is in {out}, the same command goes on from there"):
        learned.train_predictor(dataset, config, out, replace(training, split=split), resume=not fresh)
    print(f"predictor: {out}")
