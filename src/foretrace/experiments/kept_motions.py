"""Motions that a twin imagines of many actions: simulated once, and kept in a file beside the results."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from foretrace.files import atomic_path
from foretrace.imagined import Futures, ImaginedBatch
from foretrace.interactions.batch import InteractionBatch
from foretrace.twin import TwinImaginer


def imagine_once(twin: TwinImaginer, batch: InteractionBatch, file: Path) -> ImaginedBatch:
    """What a twin imagines of actions, from the file if it is there; spreads and regions are left out.

    Args:
        twin: The twin.
        batch: The actions.
        file: Where to keep it; its name has to tell batch and twin apart from others.
    """
    if not file.is_file():
        futures = twin.imagine_batch(batch).futures
        with atomic_path(file) as partial, partial.open("wb") as stream:
            np.savez_compressed(
                stream,
                probability=futures.probability,
                states=futures.states,
                support_points=futures.support_points,
            )
    with np.load(file) as content:
        probability, states, support = (content[name] for name in ("probability", "states", "support_points"))
    plain = Futures.point(states[:, 0, :, :3], states[:, 0, :, 3:], "levered")
    futures = replace(
        plain,
        outcome=twin.outcomes,
        probability=probability,
        states=states,
        spread=np.full(states.shape[:3], np.nan),
        support_points=support,
    )
    best = states[np.arange(len(states)), probability.argmax(axis=1)]
    return ImaginedBatch(twin.sample_times, best[..., :3], None, futures)


def rows_of(imagined: ImaginedBatch, rows: np.ndarray) -> ImaginedBatch:
    """Some rows of what was imagined."""
    return replace(imagined, com=imagined.com[rows], pose=None, futures=imagined.futures[rows], warnings=())
