"""The command that trains predictors. Its options are the settings of the chosen predictor and of the training loop."""

import warnings
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field, fields, make_dataclass, replace
from functools import partial
from inspect import Parameter, getdoc, signature
from pathlib import Path
from typing import Annotated, Any, cast, get_type_hints

import docstring_parser
from tyro.conf import OmitArgPrefixes, arg

from foretrace import predictor as learned
from foretrace.cli.console import say, when_interrupted
from foretrace.cli.parsing import adapt
from foretrace.errors import DatasetError, TrainingError
from foretrace.features import FEATURES, FeatureExtractor
from foretrace.files import write_text
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import Outcome
from foretrace.interactions.splits import PAPER_SIZES
from foretrace.predictor import PREDICTORS, EffectPredictor, PredictorConfig, TrainConfig
from foretrace.predictor.checkpoint import read_config, read_predictor
from foretrace.predictor.config import FINE_TUNING, feature_option
from foretrace.predictor.loading import default_checkpoint
from foretrace.predictor.model_card import RECALIBRATED, model_card, recalibration_section
from foretrace.predictor.recalibration import SHOWN_LEVELS
from foretrace.predictor.run_folder import RunFolder, first_of
from foretrace.urls import Url, as_place
from foretrace.workers import ProgressReport, count_workers, on_cluster, run_jobs

CARD = "MODEL_CARD.md"
DEFAULT = "default"
"""Stands for the predictor that comes with foretrace."""


@dataclass(frozen=True)
class SeedOptions:
    """Trainings that differ in their seed."""

    seeds: tuple[int, ...] = ()
    """A training for each of these seeds, in folders seed-N of --out, in place of --seed; the same models as one by
    one with --threads 1."""
    workers: int | None = None
    """Trainings at the same time, with --seeds; by default one for each core."""
    cluster: str | None = None
    """Address of a Ray cluster that trains, with --seeds: HOST:PORT, ray://HOST:PORT, or local:N."""

    def check(self, named: Container[str]) -> None:
        """Refuse options that do not go together.

        Args:
            named: Options that were given.

        Raises:
            TrainingError: Naming them.
        """
        if self.seeds and "--seed" in named:
            raise TrainingError("--seed and --seeds do not go together: leave one out")
        if not self.seeds and (idle := [name for name in ("--workers", "--cluster") if name in named]):
            raise TrainingError(
                f"{' and '.join(idle)} without --seeds: one training is one process, leave it out"
            )


def train_command(words: Sequence[str]) -> Callable[..., None]:
    """The command with the options of the predictor and the features that words name.

    Args:
        words: What follows ``foretrace train``.

    Raises:
        TrainingError: There is no such predictor, or there are no such features.
    """
    initial = _value("--initial", words)
    begun = None if initial is None else read_config(folder_of(initial))
    label = begun["predictor"] if begun else _value("--predictor", words) or "lstm"
    config_class = PREDICTORS.find(label).config_class
    settings = [each.name for each in fields(config_class)]
    features = FEATURES.find(_value("--features", words) or config_class().features)
    recommended = FINE_TUNING if begun else config_class.training
    shared = [each.name for each in fields(TrainConfig) if each.name in settings]

    @adapt((config_class, ("feature_options",)), (TrainConfig, ("split", *shared)))
    def train(
        *,
        data: Path,
        out: Path,
        config: Any,
        extractor: Any,
        training: Any = recommended,
        predictor: str = "lstm",
        initial: str | None = None,
        split: tuple[int, int, int] | None = None,
        fresh: bool = False,
        card: bool = False,
        several: Annotated[OmitArgPrefixes[SeedOptions], arg(name="several seeds")] = SeedOptions(),
    ) -> None:
        values = [(each, getattr(extractor, each.name)) for each in fields(extractor)]
        given = {each.metadata["name"]: value for each, value in values if value != each.default}
        place = as_place(data, DatasetError)
        named = {word.partition("=")[0] for word in words if word.startswith("--")}
        several.check(named)
        if initial is not None:
            fixed = ["predictor", *settings, *(each.name for each in fields(extractor))]
            options = [f"--{name.replace('_', '-')}" for name in fixed]
            if given_twice := [name for name in options if {name, f"--no-{name[2:]}"} & named]:
                raise TrainingError(
                    f"{given_twice[0]} and --initial do not go together: the predictor stays as {initial} has it"
                )
        folders = [out]
        if initial is not None and folder_of(initial).resolve() in {
            each.resolve() for each in (out, *(out / f"seed-{seed}" for seed in several.seeds))
        }:
            raise TrainingError(f"--initial {initial} is where the training is to go: give another --out")
        if not (named <= {"--data", "--out", "--card"} and card and RunFolder(out).finished):
            if "--epochs" in named and "--min-steps" not in named:
                training = replace(training, min_steps=1)  # who asks for one epoch gets one
            start = replace(config, feature_options=given) if initial is None else folder_of(initial)
            if several.seeds:
                folders = _train_seeds(place, out, start, training, split, fresh, several)
            else:
                _train(place, out, start, training, split, fresh)
        for folder in folders if card else ():
            write_text(folder / CARD, model_card(folder, place))
            print(folder / CARD)

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
        initial: Fine-tune a trained predictor: the folder of its training, or `default` for the one that comes with
            foretrace. Its settings stay.
        split: Sizes of the training, validation and test parts; by default the paper's 1400 100 300, or in the same
            proportions where there are fewer interactions.
        fresh: Discard the training in the folder instead of continuing it.
        card: Write a model card to the folder, too: data, errors and calibration on the test part, limits. A finished
            training needs no other options than --data and --out.
        several: Trainings with several seeds.
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


def folder_of(initial: str) -> Path:
    """Folder of the predictor that a training starts from."""
    return default_checkpoint() if initial == DEFAULT else Path(initial)


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
    start: PredictorConfig | Path,
    training: TrainConfig,
    split: tuple[int, int, int] | None,
    fresh: bool,
) -> None:
    """Train one predictor, from its settings or from the folder of one that was trained before."""
    training = replace(training, first=_first(data, [out], training, fresh))
    with when_interrupted(f"the best model so far is in {out}, the same command goes on from there"):
        _train_one(data, start, split, fresh, True, (out, training))
    print(f"predictor: {out}")


def _train_seeds(
    data: Path | Url,
    out: Path,
    start: PredictorConfig | Path,
    training: TrainConfig,
    split: tuple[int, int, int] | None,
    fresh: bool,
    several: "SeedOptions",
) -> list[Path]:
    """Train a predictor for each seed, in a folder each; the folders."""
    folders = [out / f"seed-{seed}" for seed in several.seeds]
    if len(set(folders)) < len(folders):
        raise TrainingError(f"--seeds {' '.join(map(str, several.seeds))} names a seed twice: name each once")
    threads = training.threads or 1
    training = replace(training, first=_first(data, folders, training, fresh), threads=threads)
    jobs = [
        (folder, replace(training, seed=seed)) for folder, seed in zip(folders, several.seeds, strict=True)
    ]
    function = partial(_train_one, data, start, split, fresh, False)
    with (
        when_interrupted(f"the best models so far are in {out}, the same command goes on from there"),
        on_cluster(several.cluster),
        ProgressReport("trainings", len(jobs), period=0.0) as report,
    ):
        workers = count_workers(several.workers, TrainingError)
        for folder in run_jobs(function, jobs, workers, error=TrainingError, threads=threads, ahead="n_jobs"):
            report.add(1, str(folder))
    for folder in folders:
        print(f"predictor: {folder}")
    return folders


def _train_one(
    data: Path | Url,
    start: PredictorConfig | Path,
    split: tuple[int, int, int] | None,
    fresh: bool,
    progress: bool,
    job: tuple[Path, TrainConfig],
) -> Path:
    """Train into a folder, in any process; the folder."""
    out, training = job
    predictor = read_predictor(start) if isinstance(start, Path) else start
    config = predictor.config if isinstance(predictor, EffectPredictor) else predictor
    outcomes = training.outcomes or getattr(config, "outcomes", None) or (str(Outcome.LEVERED),)
    everything = cast(Dataset, first_of(_open(data), training.first))
    if isinstance(start, Path) and not {*outcomes} & {*(there := everything.outcomes())}:
        raise TrainingError(
            f"{data} has the outcomes {', '.join(there) or 'of nothing'}, the predictor to start from learns "
            f"{', '.join(outcomes)}: give data of its action, or train anew, without --initial"
        )
    # Without any of them the training itself says which outcomes there are.
    dataset = everything.where(outcome=outcomes) or everything
    if split is None:
        split = PAPER_SIZES if len(dataset) >= sum(PAPER_SIZES) else None
    training = replace(training, split=split)
    return learned.train_predictor(dataset, predictor, out, training, resume=not fresh, progress=progress)


def _open(data: Path | Url) -> Dataset:
    """A data set, without a word on what is missing, which `_first` has."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* is not finished: ")
        return Dataset.open(data)


def _first(data: Path | Url, folders: Sequence[Path], training: TrainConfig, fresh: bool) -> int | None:
    """Number below which interactions are looked at.

    As asked for; or as when the training began; or, of a data set that is still being written, up to where it is
    complete.

    Raises:
        DatasetError: It has no complete shard at its beginning.
    """
    if training.first is not None:
        return training.first
    noted = (None if fresh else RunFolder(folder).first for folder in folders)
    if (first := next(filter(None, noted), None)) is not None:
        return first
    dataset = _open(data)
    if (first := dataset.complete_until) is None:
        return None
    total = dataset.manifest["num_trials"]
    if first == 0:
        raise DatasetError(
            f"{data} has no complete shard at its beginning yet: wait, or finish the simulation"
        )
    say(
        f"{data} has its first {first} of {total} interactions so far: trained on these, as with --first {first}"
    )
    return first
