"""Model card of a predictor: a page in Markdown, made from its run and its data."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from foretrace.errors import TrainingError
from foretrace.files import as_json, flatten, read_json
from foretrace.imagined import STARTS, conformal_scores
from foretrace.imagined.domain import MEASURES, QUANTILES
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.objects import CORNER_COUNTS
from foretrace.predictor import EffectPredictor, TrainConfig, load_predictor, part_of
from foretrace.predictor.checkpoint import CALIBRATION, CONFIG, read_config
from foretrace.predictor.config import feature_option
from foretrace.predictor.recalibration import SHOWN_LEVELS
from foretrace.predictor.run_folder import ENVIRONMENT, INITIAL, RunFolder
from foretrace.predictor.states import valid_samples
from foretrace.trajectories import final_distance, mean_distance
from foretrace.urls import Url


class Environment(TypedDict):
    """Schema of what is noted about the run."""

    commit: str | None
    device: str
    precision: str
    versions: dict[str, str]


PARTS = ("train", "validation", "test")
RECALIBRATED = "## Recalibration"
"""Heading of the section that follows a recalibration."""
CM = 100.0
RUNTIME_OPTIONS = ("min_steps", "device", "precision", "threads")
"""Settings of a training that the card's command leaves at their defaults."""
LIMITS = """\
- It imagines lever-ups with tool paths like those of its data, on rigid objects that lie alone on a flat table.
- It has learned from simulation. How far a real object is from it is not part of this card.
- Probabilities and regions hold for lever-ups like those in the data: an object that is unlike them is pointed out, an
  unlike friction, density, rim or tool is not. From a view alone they are those of objects of uniform density.
- A view that shows several objects, none, or no contact at the object's rim is refused."""


def model_card(run: Path, data: Path | Url) -> str:
    """The card of a training.

    Args:
        run: Folder of the training.
        data: The data set that it was trained on. Errors and coverage are those of the test part.

    Raises:
        CheckpointError: There is no finished predictor.
        TrainingError: The data set is another one, or the folder lacks a part of the training.
    """
    predictor, dataset = load_predictor(run), Dataset.open(data)
    parts = {part: part_of(run, dataset, part) for part in PARTS}
    test, families = parts["test"], _families(dataset)
    sections = {
        f"Model card: {predictor.label} predictor with features {predictor.features.label}": _about(
            predictor
        ),
        "Data": _data(dataset, data, parts, families, RunFolder(run).first),
        "Training": _training(run, data),
        "Errors on the test part": _errors(predictor, test, families),
        "Outcomes and regions on the test part": _calibration(predictor, test),
        "Objects that it was trained on": _ranges(predictor),
        "Limits": LIMITS,
    }
    return "\n\n".join(
        f"{'#' if k == 0 else '##'} {title}\n\n{text}" for k, (title, text) in enumerate(sections.items()) if text
    ) + "\n"  # fmt: skip


def _about(predictor: EffectPredictor) -> str:
    times = predictor.times.tolist()
    context = f", is conditioned on {', '.join(predictor.context)}" if predictor.context else ""
    outcomes = f", distinguishes {', '.join(predictor.outcomes)}" if predictor.outcomes else ""
    imagined = "the centre of mass" if predictor.state == "position" else "the pose"
    return (
        f"Imagines {imagined} of a levered object from the view from above: {len(times)} samples in "
        f"{times[-1]:.2f} s, in the action frame, SI units{context}{outcomes}. "
        f"{sum(p.numel() for p in predictor.parameters())} weights."
    )


def _data(
    dataset: Dataset,
    data: Path | Url,
    parts: Mapping[str, InteractionBatch],
    families: Mapping[int, str],
    first: int | None,
) -> str:
    chosen = ", ".join(_settings(dataset.manifest["configuration"]))
    rows = []
    for outcome in sorted({str(name) for batch in parts.values() for name in batch.outcome}):
        for family in sorted(set(families.values())):
            counts = [int(_mask(batch, families, outcome, family).sum()) for batch in parts.values()]
            if any(counts):
                rows.append([outcome, family, *map(str, counts)])
    rows.append(["all", "", *(str(len(batch)) for batch in parts.values())])
    looked_at = "" if first is None else f", the first {first} interactions"
    return f"`{data.name}`{looked_at}, simulated with: {chosen}.\n\n" + _table(
        ["Outcome", "Objects", *PARTS], rows
    )


def _training(run: Path, data: Path | Url) -> str:
    content, predictor = read_config(run), load_predictor(run)
    training = content.get("training", {})
    if "data" not in training:
        raise TrainingError(
            f"{run / CONFIG} does not say how it was trained: give the whole folder of a training"
        )
    nominal = as_json(asdict(type(predictor.config)()))
    options = {name: value for name, value in content["config"].items() if value != nominal.get(name)}
    given = options.pop("feature_options", {})
    options |= {feature_option(name, type(predictor.config)): value for name, value in given.items()}
    initial = training.get(INITIAL)
    start = f"--predictor {predictor.label}" if initial is None else "--initial INITIAL"
    options = options if initial is None else {}
    options |= {f.name: training[f.name] for f in fields(TrainConfig) if f.name in training}
    command = [f"foretrace train --data {data} --out {run} {start}"]
    for name, value in options.items():
        if name in RUNTIME_OPTIONS or value is None:
            continue
        values = [] if isinstance(value, bool) else value if isinstance(value, list) else [value]
        option = f"--{'no-' if value is False else ''}{name.replace('_', '-')}"
        command.append(" ".join([option, *map(str, values)]))
    remedy = "give the whole folder of a training"
    environment = read_json(run / ENVIRONMENT, Environment, TrainingError, remedy)
    versions = ", ".join(f"{name} {version}" for name, version in environment["versions"].items())
    tuned = (
        f"The tensors of INITIAL, which it started from, have the checksum `{initial}`. " if initial else ""
    )
    return (
        f"```console\n$ {' '.join(command)}\n```\n\n{tuned}Commit {environment['commit'] or 'unknown'}; {versions}; on "
        f"{environment['device']} in {environment['precision']}. The data's fingerprint is `{training['data']}`."
    )


def recalibration_section(run: Path, data: Path | Url, held: Mapping[str, Sequence[float]]) -> str:
    """The section about a `recalibrate` that followed the training.

    Args:
        run: Folder of the training.
        data: Folder of the data that the predictor was calibrated on.
        held: As from `recalibrate`.
    """
    facts = read_config(run).get(CALIBRATION, {})
    chosen = ", ".join(_settings(Dataset.open(data).manifest["configuration"]))
    rows = [[start, *(f"{share:.1%}" for share in shares)] for start, shares in held.items()]
    return (
        f"{RECALIBRATED}\n\nProbabilities and regions were then fitted to {facts['interactions']} other interactions, "
        f"which the predictor had not learned from: `foretrace recalibrate --run {run} --data {data}`. "
        f"They were simulated with: {chosen}. The data's fingerprint is `{facts['data']}`. Shares of their motions in "
        f"the regions as they were before, which the sections above are about:\n\n"
        + _table(["Start", *(f"{level:.0%}" for level in SHOWN_LEVELS)], rows)
        + "\n"
    )


def _errors(predictor: EffectPredictor, test: InteractionBatch, families: Mapping[int, str]) -> str:
    valid = valid_samples(test, predictor.lengths(test))
    truth = np.where(valid[..., None], test.com, np.nan)
    rows = []
    for start in STARTS:
        imagined = predictor.imagine_batch(test, start).com[:, : truth.shape[1]]
        full, final = (
            CM * np.asarray(measure(imagined, truth)) for measure in (mean_distance, final_distance)
        )
        for name, mine in (
            _groups(test, families) if start == STARTS[0] else [("all", np.ones(len(test), bool))]
        ):
            numbers = [f"{f(e[mine]):.3f}" for e in (full, final) for f in (np.nanmean, np.nanmedian, _p95)]
            rows.append([name, start, str(int(mine.sum())), *numbers])
    head = [
        "Interactions",
        "Start",
        "Count",
        *(f"{w}, {m}" for w in ("full", "final") for m in ("mean", "median", "p95")),
    ]
    until = "the whole record" if predictor.outcomes else "the record up to where the object slipped"
    return (
        f"Distance of the imagined centre of mass from where it was [cm], over {until} and at its end. `observed`: the "
        f"first centre of mass was given; `estimated`: it was estimated from the view.\n\n{_table(head, rows)}"
    )


def _calibration(predictor: EffectPredictor, test: InteractionBatch) -> str:
    futures = predictor.imagine_batch(test).futures
    if futures.is_point:
        return ""
    names = list(futures.outcomes())
    expected = np.array(names)[np.argmax(list(futures.outcomes().values()), axis=0)]
    common = max(float(np.mean(test.outcome == name)) for name in names)
    lengths = predictor.lengths(test)
    scores = conformal_scores(futures, test.com, lengths)
    rows = []
    for level in SHOWN_LEVELS:
        held = scores <= futures.width(level)
        radius = futures.radius(level)[np.arange(len(test)), futures.probability.argmax(axis=1)]
        end = CM * float(np.median(radius[np.arange(len(test)), lengths - 1]))
        rows.append([f"{level:.0%}", f"{held.mean():.1%}", f"{end:.2f}" if np.isfinite(end) else "unknown"])
    right = np.mean(expected == test.outcome)
    return (
        f"The most probable outcome is what happened in {right:.1%} of {len(test)} interactions; "
        f"the most common outcome occurs in {common:.1%}. A region holds whole motions.\n\n"
        + _table(["Region", "Held", "Median radius at the end [cm]"], rows)
    )


def _ranges(predictor: EffectPredictor) -> str:
    rows = []
    for name, (low, high) in predictor.ranges.items():
        factor, unit = MEASURES[name]
        rows.append([name, f"{factor * low:.3g}", f"{factor * high:.3g}", unit])
    if not rows:
        return ""
    low, high = (f"{q:.0%}" for q in QUANTILES)
    return (
        "What `imagine` warns of is far outside these. Length and width are along and across the action, the distance "
        f"is from contact to centre of mass.\n\n{_table(['Measure', low, high, 'Unit'], rows)}"
    )


def _families(dataset: Dataset) -> dict[int, str]:
    """Kind of object of each interaction, by id; the corners of flat ones are counted, unless they form a curve."""
    kinds = (obj["kind"] for obj in dataset.objects())
    corners, ids = (dataset.index[name].to_pylist() for name in ("num_corners", "id"))
    return {
        id: kind
        if kind != "prism"
        else f"prism, {number} corners"
        if number in CORNER_COUNTS
        else "round outline"
        for id, kind, number in zip(ids, kinds, corners, strict=True)
    }


def _mask(batch: InteractionBatch, families: Mapping[int, str], outcome: str, family: str) -> np.ndarray:
    return (batch.outcome == outcome) & np.array(
        [families[int(id)] == family for id in batch.ids], dtype=bool
    )


def _groups(batch: InteractionBatch, families: Mapping[int, str]) -> Iterator[tuple[str, np.ndarray]]:
    """Name and rows of each group: all, those of each outcome, those of each family."""
    yield "all", np.ones(len(batch), dtype=bool)
    for name in np.unique(batch.outcome):
        yield str(name), batch.outcome == name
    kinds = np.array([families[int(id)] for id in batch.ids])
    for name in np.unique(kinds):
        yield str(name), kinds == name


def _p95(values: np.ndarray) -> float:
    return float(np.nanpercentile(values, 95))


def _settings(configuration: Mapping[str, Any]) -> Iterator[str]:
    """Settings without those of the tool and its path, which every data set has."""
    for name, value in flatten(configuration).items():
        *parents, own = name.split(".")
        if value is not None and not {"path", "tool"} & set(parents):
            yield f"{own.replace('_', ' ')} {value}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
