"""Predictors that observe a view of the object, on recorded pushes, which are known at their ends alone."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from foretrace.actions import PushOutcome
from foretrace.errors import PredictionError
from foretrace.geometry import quaternion_to_matrix, rotate_plane
from foretrace.imagined.domain import OWN, check_contacts
from foretrace.imagined.futures import FLOOR
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.pushes import RecordedPushes
from foretrace.interactions.pushes_data import end_time, push_interaction
from foretrace.interactions.record import Interaction
from foretrace.interactions.splits import Split
from foretrace.predictor import EffectPredictor, LstmConfig, OneShotConfig, fit_predictor
from foretrace.predictor.config import PredictorConfig
from foretrace.twin.sliding import SlidingTwin
from foretrace.twin.sliding_residual import PushRegions, push_errors

OUTCOMES = (str(PushOutcome.PUSHED), str(PushOutcome.TURNED_AWAY))
"""Outcomes that are learned from."""
CONTEXT = ("distance", "speed")
"""What predictors are conditioned on beside the view."""
EPOCHS = 60
"""Passes of each predictor over the training part."""
VALIDATION = 10
"""One push in ten validates: these pushes decide which epoch is kept, and their errors make the regions."""
VIEWED = {
    "im-cnn": LstmConfig(features="im-cnn", state="pose", mirrored=True, context=CONTEXT),
    "one-shot": OneShotConfig(outcomes=OUTCOMES, context=CONTEXT),
}
"""Settings of the predictors by their names."""


@dataclass(frozen=True, eq=False)
class ViewedPushes:
    """Pushes of which there is a view: the rod meets the object and leads into it, and the window holds it."""

    pushes: RecordedPushes
    """All pushes."""
    end: float
    """Time of the second sample [s]."""

    @cached_property
    def _found(self) -> tuple[Bool[np.ndarray, " pushes"], InteractionBatch]:
        made = [
            each if (each := push_interaction(self.pushes, row, self.end, row)) and _is_usable(each) else None
            for row in range(len(self.pushes))
        ]
        seen = np.array([each is not None for each in made])
        return seen, InteractionBatch.from_interactions([each for each in made if each is not None])

    @property
    def seen(self) -> Bool[np.ndarray, " pushes"]:
        """Which of the pushes have a view."""
        return self._found[0]

    @property
    def batch(self) -> InteractionBatch:
        """Those that have one."""
        return self._found[1]


def answer_from_views(
    config: PredictorConfig, learn: RecordedPushes, test: RecordedPushes, seed: int
) -> tuple[Float[np.ndarray, "pushes 3"], PushRegions, Float[np.ndarray, "pushes 2"]]:
    """Displacements and turns that a predictor gives after learning, and what its regions are made of.

    A push without a view is answered by the nominal twin.

    Args:
        config: Settings of the predictor.
        learn: Pushes to learn from.
        test: Pushes to predict.
        seed: Decides first weights, order, and which pushes are not learned from.
    """
    end = max(end_time(learn), end_time(test))
    known, wanted = ViewedPushes(learn, end), ViewedPushes(test, end)
    usable = np.random.default_rng(seed).permutation(np.flatnonzero(np.isin(known.batch.outcome, OUTCOMES)))
    held = np.sort(usable[: len(usable) // VALIDATION])
    split = Split(np.sort(usable[len(held) :]), held, np.zeros(0, dtype=np.int64))
    training = replace(config.training, epochs=EPOCHS, outcomes=OUTCOMES, seed=seed, threads=1)
    predictor, _ = fit_predictor(known.batch, config, split, training)
    answered, spread = _displacements(predictor, known.batch[held])
    truth = learn[np.flatnonzero(known.seen)[held]].displacement()
    regions = PushRegions(push_errors(answered, truth) / spread[:, None])
    found = SlidingTwin().predict(test)
    scale = np.full(len(test), np.median(spread))
    found[wanted.seen], scale[wanted.seen] = _displacements(predictor, wanted.batch)
    return found, regions, np.column_stack([scale, scale])


def _is_usable(interaction: Interaction) -> bool:
    """Whether imaginers take its view: the push leads into the object."""
    try:
        check_contacts(interaction.view.mask, *OWN)
    except PredictionError:
        return False
    return True


def _displacements(
    predictor: EffectPredictor, batch: InteractionBatch
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Displacements and turns in the object frame at rest, and the spread of each end [m]; 1 where it is unknown."""
    imagined = predictor.imagine_batch(batch)
    assert imagined.pose is not None
    angle = _angle(imagined.pose[:, -1, 3:])
    origin, com = batch.pose[:, 0, :2], imagined.com[:, [0, -1], :2]
    moved = com[:, 1] + rotate_plane(origin - com[:, 0], angle) - origin
    futures = imagined.futures
    best = futures.probability.argmax(axis=1)
    spread = futures.spread[np.arange(len(best)), best, -1]
    own = _angle(batch.pose[:, 0, 3:])
    return np.column_stack([rotate_plane(moved, -own), angle]), np.where(
        np.isfinite(spread), spread + FLOOR, 1.0
    )


def _angle(quaternion: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, " n"]:
    """Turn about the vertical [rad]."""
    matrix = quaternion_to_matrix(quaternion)
    return np.arctan2(matrix[:, 1, 0], matrix[:, 0, 0])
