"""The simulation of lever-ups that are chosen for what a predictor learns from them."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from foretrace.cli.console import say
from foretrace.errors import DatasetError, SimulationError
from foretrace.imagined.context import BEVELS, CONSTANTS, EXACT
from foretrace.interactions import storage
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.splits import Split
from foretrace.predictor import OneShotConfig, TrainConfig, fit_predictor
from foretrace.predictor.active import choose_actions
from foretrace.predictor.one_shot import FRAMES, OneShotPredictor
from foretrace.predictor.one_shot_config import SPEED
from foretrace.predictor.parts import usable_lengths
from foretrace.simulation.collect import SHARD_SIZE, CollectConfig, collect, num_trials, planned_trial, trial
from foretrace.simulation.randomisation import LARGEST, NOTHING
from foretrace.urls import Url

TRAINING = TrainConfig(epochs=40, learning_rate=OneShotConfig.training.learning_rate)
"""Settings of the trainings in between."""
VALIDATION = 0.1
"""Share of what was simulated that the trainings do not learn from."""
CANDIDATES = 4000
"""Lever-ups that one choice is made among, at most: drawn at random, since all of their views are held in memory."""
ACTIVE_STREAM = 3
"""Tells the random numbers of choices from those of objects, contacts and what varies."""


def collect_actively(
    config: CollectConfig, out: Path | Url, number: int, workers: int | None
) -> dict[str, int]:
    """Simulate some trials of a configuration, chosen in rounds that double what there is; goes on where it stopped.

    Args:
        config: The configuration.
        out: The data set's folder, or its URL.
        number: How many trials to simulate.
        workers: Processes.

    Returns:
        How often each outcome occurs.

    Raises:
        SimulationError: The number is not larger than a shard, or not smaller than the number of all trials.
    """
    total = num_trials(config)
    if not SHARD_SIZE < number < total:
        raise SimulationError(
            f"--active is {number}: this configuration has {total} lever-ups, of which {SHARD_SIZE} are drawn at "
            f"random first; give "
            + (f"a number from {SHARD_SIZE + 1} to {total - 1}, or " if total > SHARD_SIZE + 1 else "")
            + "more --objects"
        )
    rng = np.random.default_rng(np.random.SeedSequence([config.seed, ACTIVE_STREAM]))
    trials = tuple(rng.permutation(total)[:SHARD_SIZE].tolist())
    if (out / storage.MANIFEST).exists():
        trials = tuple(storage.read_manifest(out)["configuration"].get("trials", trials))
    if len(trials) > number:
        raise DatasetError(
            f"{out} has {len(trials)} chosen lever-ups, --active is {number}: give at least {len(trials)}"
        )
    counts = collect(replace(config, trials=trials), out, workers)
    while len(trials) < number:
        say(
            f"choosing among {min(CANDIDATES, total - len(trials))} actions by what {len(trials)} have taught"
        )
        trials = (*trials, *_more(config, out, trials, min(len(trials), number - len(trials))))
        counts = collect(replace(config, trials=trials), out, workers)
    return counts


def _more(config: CollectConfig, out: Path | Url, trials: tuple[int, ...], count: int) -> list[int]:
    """Trials to simulate next."""
    seed = [config.seed, ACTIVE_STREAM, len(trials)]
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    batch = Dataset.open(out).batch()
    outcomes = tuple(name for name in trial(config, 0)[1].outcomes if name in batch.outcome)
    batch = batch[np.isin(batch.outcome, outcomes) & (usable_lengths(batch) >= 2)]
    if len(batch) < 2:
        raise DatasetError(
            f"{out} has {len(batch)} lever-ups to learn from after {len(trials)}: check its outcomes"
        )
    order = rng.permutation(len(batch))
    held = max(1, int(VALIDATION * len(batch)))
    split = Split(np.sort(order[held:]), np.sort(order[:held]), np.zeros(0, dtype=np.int64))
    predictor, _ = fit_predictor(
        batch, _learner(config, outcomes), split, replace(TRAINING, seed=config.seed)
    )
    assert isinstance(predictor, OneShotPredictor)
    others = np.setdiff1d(np.arange(num_trials(config)), trials)
    others = np.sort(rng.permutation(others)[: max(CANDIDATES, count)])
    at_rest = InteractionBatch.from_interactions(
        [planned_trial(config, id).at_rest() for id in others.tolist()]
    )
    return others[choose_actions(predictor, batch[split.train], at_rest, count)].tolist()


def _learner(config: CollectConfig, outcomes: tuple[str, ...]) -> OneShotConfig:
    """A small predictor that is conditioned on all that varies."""
    drawn = config.randomisation
    action = trial(config, 0)[1]
    names = [
        name for name in (*CONSTANTS, *action.nominal_parameters()) if getattr(drawn, name, None) is not None
    ]
    if drawn.bevel_width_factor or drawn.bevel_height_factor:
        names += BEVELS
    if any(getattr(drawn, name) for name in LARGEST):
        names.append(EXACT)
    return OneShotConfig(
        feature_options={"heights": action.label in FRAMES},  # along edges
        components=48,
        context=tuple(names),
        hidden_share=0.0 if drawn == NOTHING else 0.6,
        error_weighting=0.5,
        phase_time=SPEED in names,
        outcomes=outcomes,
    )
