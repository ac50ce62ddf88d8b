"""What an experiment is: trials, each of which gives rows, and summary, report and figures as functions of the rows.

An experiment is a frozen dataclass: its fields are its options, on the command line too, where their docstrings are
the help. How trials are run, kept and resumed is the same for all of them: `foretrace.evaluation.run`.
"""

import json
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, get_type_hints

from foretrace.errors import ResultsError, shown
from foretrace.files import short_hash
from foretrace.registry import Registry

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Plain = str | int | float | bool
Row = Mapping[str, Plain]
"""One line of an experiment's table: plain values by column. A text must not look like a number."""

EXPERIMENTS: Registry[type["Experiment"]] = Registry("experiment", "foretrace.experiments", ResultsError)
"""Every experiment by its label."""
SUMMARIES = {
    "predictor": "Errors of one trained predictor.",
    "paper": "The paper's comparisons, claims and figures.",
    "randomisation": "What randomised data and known physics add to transfer.",
    "reconstruction": "What the codes of autoencoders retain of masks.",
    "replay": "Deviation of simulated motions from recorded ones.",
    "transfer": "Predictions against recordings, or a stand-in for the robot.",
    "twin": "The twin, which simulates what it sees, and what is learned.",
    "shipped": "The predictor of the package on lever-ups new to it.",
    "identification": "What a few lever-ups tell of an object and the table.",
    "monitoring": "The monitor on normal executions and injected faults.",
    "pushes": "Where recorded pushes leave their objects.",
    "novel-families": "Families of objects that are new to the predictor.",
    "other-world": "Few lever-ups of another world, alone or over a twin.",
    "identified-world": "What lever-ups in another world tell for its other objects.",
    "active": "Active learning: selected lever-ups beside random ones.",
    "non-flat": "Masks against height maps of objects that are not flat.",
    "planning": "Plans beside simple rules and an oracle that simulates all.",
    "sequences": "Goals by several actions, planned again or blind.",
    "uncertainty": "Calibration of probabilities, regions and samples.",
}
"""Experiments that come with foretrace, each in a line; their modules are imported when they are looked up."""
for _label in SUMMARIES:
    EXPERIMENTS.declare(_label, f"foretrace.experiments.{_label.replace('-', '_')}")


@dataclass(frozen=True)
class Trial:
    """The smallest piece of an experiment. Subclasses are frozen dataclasses whose fields are texts and whole numbers.

    The fields are the first columns of the experiment's table.
    """

    @property
    def settings(self) -> dict[str, Plain]:
        """The fields by name."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @property
    def key(self) -> str:
        """Name of the trial's file: readable, safe in every file system, and unique."""
        words = "-".join(re.sub(r"[^A-Za-z0-9.]+", "_", str(value)) for value in self.settings.values())
        return f"{words[:80]}.{short_hash([json.dumps(self.settings).encode()])[:8]}"

    def __str__(self) -> str:
        return ", ".join(f"{name} {value}" for name, value in self.settings.items())


TrialType = TypeVar("TrialType", bound=Trial)


def trial_of(kind: type[TrialType], settings: Mapping[str, Any]) -> TrialType:
    """A trial of the given class from values of its fields, which may be texts.

    Raises:
        KeyError: A field is missing.
        ValueError: A whole number is none.
    """
    types = get_type_hints(kind)
    return kind(**{each.name: types[each.name](settings[each.name]) for each in fields(kind)})


class Experiment(ABC):
    """Base of all experiments; a subclass with a ``label`` is a frozen dataclass of its options, and registers itself.

    What a trial gives depends on the trial and on `identity` alone: neither on the number of processes nor on the
    other trials. Instances travel to worker processes as their fields; whatever is worked out from them, such as a
    ``cached_property`` that reads a data set, is worked out once in each process.
    """

    label: ClassVar[str] = ""
    """Name on the command line; empty for a base class, or an experiment that is run from Python only."""
    summary: ClassVar[str]
    """What it answers, in a line."""
    trial: ClassVar[type[Trial]]
    """Class of the trials."""
    workers: ClassVar[int | None] = 1
    """Processes, by default; None: one for each core."""
    needs_folder: ClassVar[bool] = True
    """Whether results have to be kept; otherwise it is quick, and may be run without a folder."""
    formats: ClassVar[tuple[str, ...]] = ("png",)
    """File formats of the figures."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "label" in cls.__dict__:
            for name in ("summary", "trial"):
                if not hasattr(cls, name):
                    raise TypeError(f"experiment {cls.__name__} has a label and no {name}: give it one")
            EXPERIMENTS.add(cls.label, cls)

    def __getstate__(self) -> dict[str, Any]:
        return {each.name: getattr(self, each.name) for each in fields(self)}  # pyright: ignore[reportArgumentType]

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)

    @abstractmethod
    def trials(self) -> Sequence[Trial]:
        """All that is asked for, in the order in which it is begun; each trial once.

        Raises:
            ForetraceError: The options do not go together.
        """

    @abstractmethod
    def run(self, trial: Any, folder: Path) -> Iterable[Row]:
        """Carry out one trial, in whatever process; returns its rows.

        Args:
            trial: The trial.
            folder: Folder of the results, where `kept_folder` makes a place for what is to stay beside them.

        Raises:
            ForetraceError: The trial failed; the others go on.
        """

    @abstractmethod
    def identity(self) -> dict[str, Any] | None:
        """What decides the results beside a trial, JSON-able: fingerprints of data, settings.

        None if the options name no data: then no trial is asked for, and any results of the experiment will do.

        Raises:
            ForetraceError: The data are missing or cannot be used.
        """

    @abstractmethod
    def summarise(self, rows: "pd.DataFrame") -> dict[str, Any]:
        """The numbers that matter, JSON-able, from the rows of all trials that there are."""

    @abstractmethod
    def report(self, summary: Mapping[str, Any], rows: "pd.DataFrame") -> str:
        """Summary as Markdown."""

    def figures(self, rows: "pd.DataFrame") -> "dict[str, Figure]":
        """Pictures by the name of their file, without its ending; what there are no rows for is left out."""
        return {}

    def judge(self, rows: "pd.DataFrame") -> list[dict[str, Any]]:
        """Which sentences hold, JSON-able; as from `foretrace.evaluation.claims.Claim.evaluate`."""
        return []


def kept_folder(folder: Path, name: str) -> Path:
    """A folder beside the results for what trials leave, such as trainings; version control passes it over."""
    kept = folder / name
    kept.mkdir(parents=True, exist_ok=True)
    if not (kept / ".gitignore").is_file():
        (kept / ".gitignore").write_text("*\n", encoding="utf-8")
    return kept


def chosen(kind: str, wanted: Sequence[str], known: Sequence[str]) -> list[str]:
    """Names that are asked for, each once; all that are known if none is.

    Raises:
        ResultsError: One of them is unknown.
    """
    names = list(dict.fromkeys(wanted or known))
    if unknown := [name for name in names if name not in known]:
        raise ResultsError(
            f"{kind} {shown(unknown[0])} is unknown: choose from {', '.join(dict.fromkeys(known))}"
        )
    return names


def checked_seeds(seeds: Sequence[int]) -> list[int]:
    """Seeds, each once.

    Raises:
        ResultsError: There is none, or one is negative.
    """
    if not seeds:
        raise ResultsError("no seed is given: give at least one, from 0")
    if wrong := [seed for seed in seeds if seed < 0]:
        raise ResultsError(f"seed {wrong[0]} is negative: choose seeds from 0")
    return list(dict.fromkeys(seeds))
