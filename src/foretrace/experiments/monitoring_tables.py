"""Numbers of the monitor's experiment from its rows: scores by method, detections, delays, causes, rests."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from foretrace.evaluation.tables import markdown_table, number
from foretrace.experiments.executions import CAUSES, FAULTS, MOVED
from foretrace.monitoring import Drift, MonitorCalibration

CM = 100.0
NORMAL, CALIBRATION, RECORDED = "normal", "calibration", "recorded"
BEFORE, LONGEST, ORDERS = 50, 200, 200
"""Normal executions before a drift, most executions after it, and random orders of them."""
PROBES = tuple(range(4, 59, 6))
"""Samples at which distances are kept, for quantiles that hold for each of them."""
Table = Mapping[str, np.ndarray]
"""Columns of rows by name."""


def columns(rows: pd.DataFrame) -> Table:
    """Columns of rows by name."""
    return {str(name): np.asarray(rows[name]) for name in rows.columns}


def pick(table: Table, mask: np.ndarray) -> Table:
    """Some rows."""
    return {name: values[mask] for name, values in table.items()}


def is_wrong(table: Table) -> np.ndarray:
    """Which rows have a fault that moves something."""
    return np.isin(table["part"], FAULTS) & (table["moved"] > CM * MOVED)


def scores_of(table: Table) -> dict[str, tuple[np.ndarray, float]]:
    """Score of each execution and threshold, by method; baselines are calibrated on executions of their own."""
    own = table["part"] == CALIBRATION
    own = own if own.any() else table["part"] == NORMAL

    def calibrated(values: np.ndarray, level: float = 0.95) -> float:
        ordered = np.append(np.sort(values[own]), np.inf)
        return float(ordered[min(int(np.ceil(level * len(ordered))) - 1, len(ordered) - 1)])

    distance, height = table["distance"], table["final_height"]
    probes = np.column_stack([table[f"d{k}"] for k in PROBES])
    limits = np.array([calibrated(column, 1 - 0.05 / len(PROBES)) for column in probes.T])
    limits = np.where(np.isfinite(limits), limits, probes[own].max(axis=0))
    return {
        "monitor": (table["score"], float(table["threshold"][0])),
        "futures alone": (table["alone"], float(table["alone_threshold"][0])),
        "distance": (distance, calibrated(distance)),
        "quantile of each sample": ((probes / limits).max(axis=1), 1.0),
        "regions": (table["regions"], 1.0),
        "final height": (height, calibrated(height)),
        "density of windows": (table["windows"], calibrated(table["windows"])),
    }


def auroc(normal: np.ndarray, wrong: np.ndarray) -> float:
    """Probability that a fault scores higher than a normal execution; equal scores count half."""
    above = (wrong[:, None] > normal).mean() + 0.5 * (wrong[:, None] == normal).mean()
    return float(above)


def about_faults(table: Table) -> dict[str, Any]:
    """Detection, delay, causes and rests of executions with faults."""
    alarms = pick(table, table["alarm"] >= 0)
    delays = (alarms["alarm"] - alarms["deviates"])[alarms["deviates"] >= 0]
    wanted = np.array([CAUSES[str(part)] for part in alarms["part"]], dtype=object)
    there = alarms["alarm_rest"] >= 0
    ratios = alarms["alarm_rest"][there] / np.maximum(alarms["alarm_before"][there], 1e-6)
    many = len(wanted) > 0
    return {
        "executions": len(table["part"]),
        "detected": len(wanted) / len(table["part"]),
        "delay": float(np.median(delays)) if len(delays) else None,
        "delay_95": float(np.quantile(delays, 0.95)) if len(delays) else None,
        "cause": float(np.mean(alarms["cause"] == wanted)) if many else None,
        "cause_later": float(np.mean(alarms["cause_later"] == wanted)) if many else None,
        "rest": float(np.median(ratios)) if len(ratios) else None,
    }


def about_rests(table: Table) -> dict[str, Any]:
    """Rests of normal executions after some samples in motion."""
    found = {}
    for name, drops in (("stays on the blade", 0), ("slips later", 1)):
        mine = pick(table, (table["ten_rest"] >= 0) & (table["ten_drops"] == drops))
        if len(mine["part"]):
            found[name] = {
                "executions": len(mine["part"]),
                "ratio": float(mine["ten_rest"].mean() / mine["ten_before"].mean()),
                "held": float(mine["ten_held"].mean()),
                "slip": float(mine["ten_slip"].mean()),
            }
    return found


def drift_after(table: Table, calibration: MonitorCalibration) -> dict[str, float]:
    """Executions with other frictions until a drift is seen, after normal ones; in random orders.

    Args:
        table: Columns of the rows.
        calibration: The calibration in question.
    """
    normal, other = (table["score"][table["part"] == part] for part in (NORMAL, "friction"))
    if len(normal) < BEFORE or not len(other):
        return {}
    rng, late, early = np.random.default_rng(0), [], 0
    for seed in range(ORDERS):
        drift = Drift(calibration, seed=seed)
        early += any([drift.update(float(score)) for score in rng.choice(normal, BEFORE, replace=False)])
        if not drift.drifted:
            after = rng.choice(other, LONGEST)
            late.append(next((k for k, score in enumerate(after, 1) if drift.update(float(score))), LONGEST))
    return {
        "before": early / ORDERS,
        "median": float(np.median(late)),
        "p95": float(np.quantile(late, 0.95)),
    }


def recalibrated(table: Table, false_alarms: float) -> dict[str, float]:
    """What a calibration from recorded executions of the same engine is worth, and how often they show a drift.

    Args:
        table: Columns of the rows.
        false_alarms: Share of normal executions that may alarm.
    """
    recorded, normal = (table["score"][table["part"] == part] for part in (RECORDED, NORMAL))
    if len(recorded) < 1 / false_alarms:  # too few tell no such rate
        return {}
    drift, noticed = Drift(MonitorCalibration.shipped("worlds")), 0
    for seed in range(ORDERS):
        drift = Drift(drift.calibration, seed=seed)
        for score in np.random.default_rng(seed).permutation(recorded):
            drift.update(float(score))
        noticed += drift.drifted
    threshold = drift.recalibrate().threshold(false_alarms)
    return {
        "executions": len(recorded),
        "threshold": threshold,
        "before": float(table["threshold"][0]),
        "false_alarms": float(np.mean(normal > threshold)),
        "detected": float(np.mean(table["score"][is_wrong(table)] > threshold)),
        "noticed": noticed / ORDERS,
    }


def confusion(table: Table) -> str:
    """Table of the causes that are named 0.3 s after alarms."""
    alarms = pick(table, (table["alarm"] >= 0) & is_wrong(table))
    named = sorted({str(cause) for cause in alarms["cause_later"]})
    lines = [
        [
            fault,
            *(
                str(int(np.sum((alarms["part"] == fault) & (alarms["cause_later"] == name))))
                for name in named
            ),
        ]
        for fault in FAULTS
        if (alarms["part"] == fault).any()
    ]
    return markdown_table(["Fault, and the cause that is named 0.3 s after the alarm", *named], lines)


def percent(value: float | None) -> str:
    """A share as it stands in tables."""
    return "" if value is None else f"{100 * value:.0f} %"


def report_of(summary: Mapping[str, Any], table: Table) -> str:
    """Tables of methods, faults, causes and rests."""
    parts = ["# Monitoring", f"{summary['normal']} normal executions."]
    lines = [
        [name, f"{100 * each['false_alarms']:.1f} %", percent(each["detected"]), number(each["auroc"])]
        for name, each in summary["methods"].items()
    ]
    parts.append(markdown_table(["", "False alarms", "Detected", "AUROC"], lines))
    if again := summary.get("recalibrated"):
        parts.append(
            f"Recalibrated on {again['executions']} normal executions of the same engine: "
            f"{100 * again['false_alarms']:.1f} % false alarms, {percent(again['detected'])} detected, threshold "
            f"{again['threshold']:.2f} in place of {again['before']:.2f}. In {100 * again['noticed']:.0f} % of their "
            "orders, `Drift` notices that the calibration does not hold for them."
        )
    parts += [
        f"False alarms of the monitor, {part}: {100 * each['false_alarms']:.1f} % of {each['executions']} normal "
        "executions."
        for part, each in summary["others"].items()
    ]
    head = [
        "Fault",
        "Executions",
        "AUROC",
        "Detected",
        "Delay, median [s]",
        "95 %",
        "Cause right",
        "0.3 s later",
        "Rest",
    ]
    lines = []
    for fault, each in {**summary["faults"], "all": summary["all_faults"]}.items():
        if each:
            found = summary["methods"]["monitor"]
            area = found["auroc"] if fault == "all" else found["auroc_of"][fault]
            lines.append(
                [
                    fault,
                    str(each["executions"]),
                    number(area),
                    percent(each["detected"]),
                    number(each["delay"], 2),
                    number(each["delay_95"], 2),
                    percent(each["cause"]),
                    percent(each["cause_later"]),
                    number(each["rest"], 2),
                ]
            )
    parts.append(markdown_table(head, lines))
    parts.append(
        "Rest: error of the re-imagined remainder at the alarm, relative to what was imagined before the motion; "
        "medians of ratios."
    )
    lines = [
        [
            name,
            str(each["executions"]),
            number(each["ratio"], 2),
            number(each["held"], 2),
            number(each["slip"], 2),
        ]
        for name, each in summary["rest"].items()
    ]
    head = [
        "After ten samples in motion",
        "Executions",
        "Error of the rest, relative",
        "Within 90 % region",
        "P(slip)",
    ]
    parts.append(markdown_table(head, lines))
    parts.append(confusion(table))
    if drift := summary["drift"]:
        parts.append(
            f"Drift, after frictions of all executions are doubled or halved: seen after {drift['median']:.0f} "
            f"executions (median; 95 %: {drift['p95']:.0f}); before, in {100 * drift['before']:.1f} % of 50 normal "
            "executions in a row."
        )
    parts.append(f"One update: {summary['update_ms']:.2f} ms of processor time (median).")
    return "\n\n".join(parts) + "\n"
