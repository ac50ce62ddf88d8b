"""A results folder: one JSON file a trial, the table of all rows, and the summary that says what they are of."""

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np
import pandas as pd

from foretrace.errors import ResultsError, shown
from foretrace.evaluation.experiment import EXPERIMENTS, Experiment, Plain, Trial, trial_of
from foretrace.files import (
    as_json,
    atomic_folder,
    first_difference,
    make_folder,
    read_text,
    read_versioned,
    short_hash,
    write_json,
    write_text,
)

TRIALS, ROWS, SUMMARY, REPORT = "trials", "rows.csv", "summary.json", "report.md"
TRIAL_FORMAT, SUMMARY_FORMAT = "foretrace-trial", "foretrace-results"
TRIAL_VERSION, SUMMARY_VERSION = 1, 2
REMEDY = "choose another folder, the same data and options, or remove the folder"

INFINITE = ("inf", "-inf")
"""What JSON has no number for."""

Rows = list[dict[str, Plain]]


class TrialEntries(TypedDict):
    """Schema of a trial's file."""

    identity: dict[str, Any]
    trial: dict[str, Plain]
    rows: list[dict[str, Plain]]
    checksum: NotRequired[str]


class SummaryEntries(TypedDict):
    """Schema of the summary, as far as it is read back."""

    identity: dict[str, Any]
    machines: NotRequired[list[dict[str, Any]]]


@dataclass(frozen=True)
class Store:
    """The results folder of one experiment.

    A trial is done if its file is there and has the same identity. Files are atomic, so that several processes may
    share a folder: the later one wins. Without a folder of trials, those in the table of rows count.
    """

    folder: Path
    """The results folder; it need not exist."""
    experiment: Experiment
    """Whose results it holds."""
    identity: Mapping[str, Any]
    """What decides them, as JSON gives it back."""

    def done(self) -> dict[Trial, Rows]:
        """Rows of every finished trial.

        Raises:
            ResultsError: The folder holds results of another identity or version, or they are damaged.
        """
        if not (self.folder / TRIALS).is_dir():
            return self._archived()
        found = {}
        for file in sorted((self.folder / TRIALS).glob("*.json")):
            content = read_versioned(
                file, TrialEntries, TRIAL_FORMAT, TRIAL_VERSION, ResultsError, "remove it", key="version"
            )
            self._check(content["identity"])
            try:
                trial = trial_of(self.experiment.trial, content["trial"])
            except (KeyError, ValueError) as reason:
                raise ResultsError(f"{file}: its trial is none ({shown(reason)}): remove it") from reason
            if content.get("checksum", wanted := _checksum(content["trial"], content["rows"])) != wanted:
                raise ResultsError(f"{file}: its rows or its trial differ from what was written: remove it")
            found[trial] = [
                {name: _value(value) if value in INFINITE else value for name, value in row.items()}
                for row in content["rows"]
            ]
        return found

    def save(self, trial: Trial, rows: Iterable[Mapping[str, Any]], seconds: float) -> None:
        """Write a finished trial; it is on the disk when this returns."""
        content = self._content(trial, [plain(row) for row in rows]) | {"seconds": round(seconds, 3)}
        write_json(self.folder / TRIALS / f"{trial.key}.json", content)

    def prepare(self, done: Mapping[Trial, Rows]) -> None:
        """Make the folder of trials, with a file for each trial that so far is in the table alone."""
        target = self.folder / TRIALS
        if target.is_dir():
            return
        make_folder(self.folder, ResultsError)
        try:
            with atomic_folder(
                target
            ) as partial:  # all at once: half of them would hide the table's other half
                for trial, rows in done.items():
                    (partial / f"{trial.key}.json").write_text(
                        json.dumps(self._content(trial, rows)), encoding="utf-8"
                    )
        except OSError:
            if not target.is_dir():  # where another process was faster
                raise

    def write(self, done: Mapping[Trial, Rows], summary: Mapping[str, Any], report: str) -> list[Path]:
        """Write table, summary and report; returns their paths."""
        files = [self.folder / name for name in (ROWS, SUMMARY, REPORT)]
        self.folder.mkdir(parents=True, exist_ok=True)
        write_text(files[0], format_rows(done))
        write_json(files[1], summary_content(self.identity, summary))
        write_text(files[2], report)
        return files

    def machines(self) -> list[dict[str, Any]]:
        """What the results were computed on so far, one entry for each run that added to them."""
        if not (self.folder / SUMMARY).is_file():
            return []
        return _read_summary(self.folder).get("machines", [])

    def _content(self, trial: Trial, rows: Rows) -> dict[str, Any]:
        start = {"format": TRIAL_FORMAT, "version": TRIAL_VERSION, "identity": self.identity}
        written = [
            {name: str(value) if str(value) in INFINITE else value for name, value in row.items()}
            for row in rows
        ]
        checksum = _checksum(trial.settings, written)
        return {**start, "trial": trial.settings, "rows": written, "checksum": checksum}

    def _check(self, found: Mapping[str, Any]) -> None:
        if difference := first_difference(found, self.identity):
            name, there, wanted = difference
            raise ResultsError(
                f"{self.folder} holds results with {name} = {shown(there)}, asked for is {shown(wanted)}: {REMEDY}"
            )

    def _archived(self) -> dict[Trial, Rows]:
        if not (self.folder / ROWS).is_file():
            if (self.folder / SUMMARY).is_file():
                self._check(_read_summary(self.folder)["identity"])
            return {}
        self._check(_read_summary(self.folder)["identity"])
        return parse_rows(self.folder / ROWS, self.experiment.trial)


def kept_identity(folder: Path, label: str) -> dict[str, Any]:
    """Identity of the results in a folder.

    Raises:
        ResultsError: It holds none, or those of another experiment.
    """
    if not (folder / SUMMARY).is_file():
        raise ResultsError(f"{folder} holds no results to draw: name the data to run the experiment on")
    identity = _read_summary(folder)["identity"]
    if identity.get("experiment") != label:
        raise ResultsError(
            f"{folder} holds results of {shown(identity.get('experiment'))}, not {shown(label)}: choose another"
        )
    return identity


def summary_content(identity: Mapping[str, Any], summary: Mapping[str, Any]) -> dict[str, Any]:
    """All of ``summary.json``; numbers that are not finite are null."""
    start = {"format": SUMMARY_FORMAT, "version": SUMMARY_VERSION, "identity": identity}
    return _finite(as_json({**start, **summary}))


def read_rows(folder: str | Path, trial: type[Trial] | None = None) -> pd.DataFrame:
    """All rows of a results folder; the folder may be written to at the same time.

    Args:
        folder: Where ``foretrace evaluate NAME --out`` wrote to.
        trial: Class of the trials; by default that of the experiment that the folder's summary names.

    Returns:
        A row each; the first columns are the fields of the trials.

    Raises:
        ResultsError: There are no results, or they are damaged or of another version.
    """
    folder = Path(folder)
    if not (folder / ROWS).is_file():
        raise ResultsError(
            f"{folder / ROWS} is missing: give a folder that `foretrace evaluate NAME --out` has made"
        )
    if trial is None:
        trial = EXPERIMENTS.find(_read_summary(folder)["identity"].get("experiment")).trial
    return table_of(parse_rows(folder / ROWS, trial))


def table_of(done: Mapping[Trial, Sequence[Mapping[str, Plain]]]) -> pd.DataFrame:
    """Rows of trials as one table."""
    return pd.DataFrame([{**trial.settings, **row} for trial, rows in done.items() for row in rows])


def format_rows(done: Mapping[Trial, Sequence[Mapping[str, Plain]]]) -> str:
    """Rows as CSV; numbers are read back to the last bit, and what a row lacks is empty."""
    lines = [{**trial.settings, **row} for trial, rows in done.items() for row in rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, dict.fromkeys(name for line in lines for name in line), lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def parse_rows(file: Path, kind: type[Trial]) -> dict[Trial, Rows]:
    """The trials in a table of rows.

    Raises:
        ResultsError: The file is no such table.
    """
    names = [each.name for each in fields(kind)]
    done: dict[Trial, Rows] = {}
    text = read_text(file, ResultsError, "restore it, or remove the folder")
    reader = csv.DictReader(io.StringIO(text, newline=""))
    try:
        head = reader.fieldnames or []
        if missing := [name for name in names if name not in head]:
            raise ResultsError(
                f"{file} lacks the columns {', '.join(missing)}: restore it, or remove the folder"
            )
        for line in reader:
            if None in line or None in line.values():
                raise ValueError
            row = {name: _value(text) for name, text in line.items() if name not in names and text != ""}
            done.setdefault(trial_of(kind, line), []).append(row)
    except (ValueError, csv.Error):
        raise ResultsError(
            f"{file}, line {reader.line_num} is no row of results: restore the file, or remove that line"
        ) from None
    return done


def plain(row: Mapping[str, Any]) -> dict[str, Plain]:
    """A row as it is kept: without NaN and None, and numpy's numbers as Python's.

    Raises:
        TypeError: A value is neither text nor number, or a text would be read back as a number.
    """
    kept: dict[str, Plain] = {}
    for name, value in row.items():
        value = value.item() if isinstance(value, np.generic) else value
        if value is None or value != value:
            continue
        if not isinstance(value, str | int | float | bool):
            raise TypeError(f"column {name} holds {value!r}: give a text or a number")
        if isinstance(value, str) and (value == "" or not isinstance(_value(value), str)):
            raise TypeError(
                f"column {name} holds the text {shown(value)}, which reads like a number: word it otherwise"
            )
        kept[name] = str(value) if isinstance(value, str) else value
    return kept


def _checksum(trial: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    """A row that has lost an entry cannot be told from one that never had it otherwise."""
    return short_hash([json.dumps([trial, rows], sort_keys=True).encode()])


def _value(text: str) -> Plain:
    if text in ("True", "False"):
        return text == "True"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _read_summary(folder: Path) -> SummaryEntries:
    remedy = "restore it, or remove the folder"
    return read_versioned(
        folder / SUMMARY, SummaryEntries, SUMMARY_FORMAT, SUMMARY_VERSION, ResultsError, remedy, key="version"
    )


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {name: _finite(value) for name, value in content.items()}
    if isinstance(content, list):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not np.isfinite(content) else content
