"""Made-up tables of the paper's comparisons."""

import itertools

import numpy as np
import pandas as pd

from foretrace.experiments.paper_claims import PAIRS, PAPER_FEATURES, SIZES

COLUMNS = ["experiment", "features", "seed", "setting", "metric", "value"]
ERRORS = {
    "none": 0.55, "sc-200": 0.40, "sc-800": 0.37, "sc-3200": 0.41, "ae-256": 0.33, "ae-512": 0.32, "sc-cnn": 0.29,
    "im-cnn": 0.25, "sp-pred": 0.20, "sp-truth": 0.18, "sp-rule": 0.21,
}  # fmt: skip
"""Errors over the full trajectory in the paper's order [cm]."""
PERCENTAGES = ("5", "10", "25", "50", "75", "100")


def paper_like(num_seeds: int = 10, noise: float = 0.004) -> pd.DataFrame:
    """A complete table in which every claim of the paper holds."""
    rng = np.random.default_rng(0)
    rows = []

    def add(experiment, features, setting, metric, value, spread=noise):
        for seed in range(num_seeds):
            rows.append((experiment, features, seed, setting, metric, value + spread * rng.normal()))

    accuracies = {"sp-pred": 0.94, "sp-rule": 0.95, "chance": 0.23}
    for (name, best), (k, setting) in itertools.product(accuracies.items(), enumerate(PERCENTAGES)):
        learned = best - (0.25 * 0.4**k if name == "sp-pred" else 0)
        for metric in ["accuracy", "accuracy_from_mask", *(f"accuracy_{count}" for count in range(3, 11))]:
            add("support-points", name, setting, metric, learned, 0.004)
    for (name, best), pair in itertools.product(accuracies.items(), PAIRS):
        add("support-points-novel", name, pair, "accuracy", best - 0.03, 0.004)
    for k, (name, error) in enumerate(ERRORS.items()):
        spread = noise * (4 if name.startswith(("sc-", "ae-")) and name != "sc-cnn" else 0.7)
        for setting, more in (("shuffled", 1.0), ("by-object", 1.15)):
            for metric, factor in (("full", 1), ("final", 2), ("full_median", 0.8), ("final_median", 1.6)):
                add("features", name, setting, metric, factor * more * error, factor * spread)
            add("features", name, setting, "seconds", 60.0 + k)
        if name in ("sc-200", "sc-800", "sc-3200"):
            add("half-plane", name, "shuffled", "full", error + 0.02)
            add("half-plane", name, "shuffled", "final", 2 * error + 0.04)
        for size in SIZES:
            steep = {"ae-256": 4, "ae-512": 4, "sc-cnn": 3, "im-cnn": 3, "sp-pred": 0.6, "sp-truth": 0.4}.get(
                name, 1
            )
            if name != "sp-rule":
                add("training-size", name, size, "full", error * (1 + steep * 0.5 / float(size) ** 0.5))
        for n in ("2", "3", "4", "5"):
            add("steps-ahead", name, n, "full", error + 0.01 * (int(n) - 1))
        for pair in PAIRS:
            worse = {"im-cnn": 1.1, "sc-cnn": 1.1, "sc-800": 1.6}.get(name, 1.3)
            poor = pair == "3&4" and name in ("sp-pred", "sp-truth", "sp-rule", "ae-256", "ae-512", "sc-800")
            add("novel-corners", name, pair, "full", error * (worse + (0.4 if poor else 0)), noise / 2)
    return pd.DataFrame(rows, columns=COLUMNS)


def in_every_seed(experiment: str, setting: str, metric: str, values: dict[str, float], num_seeds: int = 5):
    """A table of one experiment with the same values in every seed."""
    rows = [
        (experiment, name, seed, setting, metric, value)
        for name, value in values.items()
        for seed in range(num_seeds)
    ]
    return pd.DataFrame(rows, columns=COLUMNS)


assert list(ERRORS)[:10] == list(PAPER_FEATURES)
