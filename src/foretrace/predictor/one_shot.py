"""A direct trajectory predictor: whole motions at once, alternatives with probabilities, and error scales."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from foretrace.errors import TrainingError
from foretrace.features import Outline, action_frame, pivot_edges
from foretrace.features.outline import pixel_error
from foretrace.features.pivot_edges import PROBES, PivotEdges
from foretrace.imagined import (
    LEVELS,
    STARTS,
    Futures,
    ImaginedBatch,
    Start,
    conformal_scores,
    quantiles_of,
)
from foretrace.imagined.belief import EXECUTION, RANGES
from foretrace.imagined.context import EXACT, first_action, recorded_context
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.hull import HEIGHT_CELLS, MAX_CORNERS, UNIT
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.ensemble import MANY, Ensemble
from foretrace.predictor.mixture import COORDINATES, TURN_LENGTH, Mixture, along_edges
from foretrace.predictor.one_shot_config import SPEED, OneShotConfig
from foretrace.predictor.phase_time import Warp, in_phase, phase_of
from foretrace.predictor.states import Effects, decode_poses
from foretrace.predictor.temperature import Odds, fit_temperatures, tempered
from foretrace.predictor.traced import TracedDistribution
from foretrace.predictor.trajectory_basis import find_basis, fit_covariance

TURN_WEIGHT = 0.5
"""Weight of the turn in the loss, beside 1 for the displacement."""
TEMPERATURE = 0.003
"""Distance by which a future has to be nearer to the observed motion to count e times as much in training [m]."""
SCALE_WEIGHT = 0.02
"""Weight of the predicted error scale's own loss."""
SAME = 0.01
"""A value relative to edges that varies by less (a millimetre, half a degree) counts as constant."""
LARGEST_ERROR = 1.5
"""Logarithm of the largest error scale, in units of the position's: outputs for improbable futures are arbitrary."""
SMALLEST_ERROR = -15.0
"""Logarithm of the smallest error scale that is learned: below, its likelihood would overflow for an odd lever-up."""
LEAST_WEIGHTED = -7.0
"""Logarithm of the error scale below which motions count no more than at it, see ``error_weighting``."""
ELSEWHERE_SHARE = 0.5
"""Share of actions that training takes as commanded elsewhere, among those of which the contact's error is hidden."""
DISAGREEMENT = 8.0
"""Error scale per distance between the outputs of networks and mirror images.

They disagree most about objects unlike those learned from. Measured on triangles and quadrangles that were held out, of
objects beyond the paper's 160: with 4 to 16, regions are about as exact there as on known shapes; without, they are far
too narrow.
"""
CLEAR_EDGE = 0.002
"""Futures about two edges that differ by less do not tell about which the object turned [m]."""
SAMPLES_PER_STEP = 15
"""Samples of the trajectories, drawn at random, that one training step compares: it makes the step cheaper."""


LARGE, ENOUGH = 20_000, 8_000
"""The PCA basis, scales and covariances of a training part of more interactions than the first number come from some of
them, about as many as the second number."""
PIECE = 2_000
"""Interactions of which futures are held in memory together in the end."""


class Frames(NamedTuple):
    """Frames along whose axes motions are predicted."""

    find: Callable[..., PivotEdges]
    """Finds them, and describes the action relative to them."""
    num_values: int
    """Numbers in that description."""
    most: int
    """Frames of one action, at the most."""


FRAMES = {"lever-up": Frames(pivot_edges.find_pivot_edges, pivot_edges.NUM_VALUES, 2)}
"""By the action's label."""
ACTION_FRAME = Frames(action_frame.find_action_frame, action_frame.NUM_VALUES, 1)
"""Of all other actions."""


class Outputs(NamedTuple):
    """Outputs of the ensemble for lever-ups and their mirror images, by pivot edge and outcome."""

    weights: Float[Tensor, "ensemble batch views edges outcomes components"]
    """Weights in the PCA basis."""
    error: Float[Tensor, "ensemble batch views edges outcomes"]
    """Logarithm of the predicted error scale of the motion, in units of the position's scale."""
    logits: Float[Tensor, "ensemble batch views edges outcomes"]
    """Logarithm of the probability, up to a constant."""


class OneShotPredictor(EffectPredictor):
    """Predicts whole motions at once, in the frames of the edges that the object may turn about.

    From the outline's corners and the centre of mass, `find_pivot_edges` finds two edges in closed form, and describes
    the lever-up relative to them; other actions have one frame, that of `find_action_frame`. For every edge and every
    outcome networks turn these numbers into a future: its probability; weights in a PCA basis of trajectories (how far
    the object is displaced and turned, sample by sample, along the edge's axes); and the scale of the error. Futures
    are never averaged, only the outputs of several networks for the same one. Every action is also
    seen in the mirror: mirror images have mirrored motions, exactly.

    Args:
        config: Settings.
        num_samples: Samples in a trajectory.

    Raises:
        TrainingError: Features other than ``outline``.
    """

    label = "one-shot"
    config_class = OneShotConfig
    config: OneShotConfig
    keeps_last_epoch = True
    observes = True
    value_mean: Tensor
    value_scale: Tensor
    mean_motion: Tensor
    motions: Tensor
    parity: Tensor
    covariance: Tensor
    quantiles: Tensor
    temperature: Tensor
    start_error: Tensor
    slots: Tensor

    def __init__(self, config: OneShotConfig, num_samples: int):
        super().__init__(config, num_samples, "turn", config.outcomes)
        if not isinstance(self.features, Outline):
            raise TrainingError(
                f"the {self.label} predictor reads an object's outline, not {config.features}: train it with "
                "features 'outline'"
            )
        self.heights = self.features.heights
        self.frames = FRAMES.get(first_action(self.outcomes).label, ACTION_FRAME)
        num_values = self.frames.num_values
        numbers, outcomes = num_values + self.heights * PROBES**2, len(self.outcomes)
        components = config.components
        widths = (config.hidden,) * config.layers
        self.networks = Ensemble(
            config.ensemble,
            (numbers + self.num_inputs - self.features.num_features, *widths, outcomes * (components + 2)),
        )
        self.register_buffer("value_mean", torch.zeros(numbers))
        self.register_buffer("value_scale", torch.ones(numbers))
        self.register_buffer("mean_motion", torch.zeros(num_samples, COORDINATES))
        self.register_buffer("motions", torch.zeros(components, num_samples, COORDINATES))  # the PCA basis
        self.register_buffer("parity", torch.ones(components))
        self.register_buffer("covariance", torch.eye(components).repeat(outcomes, 1, 1))
        # For a start that is observed or estimated, and for a context that is told or not.
        self.register_buffer("quantiles", torch.ones(len(STARTS), 2, len(LEVELS)))
        self.register_buffer("temperature", torch.ones(2))  # of outcomes, and of edges given the outcome
        if config.phase_time:
            self.register_buffer(
                "slots", torch.zeros(num_samples)
            )  # phases at which motions are predicted [s]
        # Of centres of mass at rest, beside that from the size of pixels [m].
        self.register_buffer("start_error", torch.zeros(len(STARTS)))

    @property
    def display_name(self) -> str:
        """Name in figures and tables."""
        return self.label

    @property
    def is_symmetric(self) -> bool:
        """Whether mirror images have mirrored motions, exactly."""
        return self.config.mirrored

    @property
    def num_edges(self) -> int:
        """Candidate pivot edges; 1 where an action turns its object about none."""
        return min(self.config.pivot_edges, self.frames.most)

    def lengths(self, batch: InteractionBatch) -> Int[np.ndarray, " batch"]:
        """Whole trajectories: the fall after a slip is an effect, too."""
        return batch.length

    def prepare(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> None:
        """Find the PCA basis of the training part's trajectories, and the scale of values relative to edges.

        A shorter trajectory counts as if it stayed where it ends.
        """
        if self.config.phase_time:
            ends = phase_of((effects.lengths - 1) * self._period, self._speed(features))
            self.slots.copy_(torch.linspace(0, float(ends.max()), len(self.slots)))
        features, effects = _some(features, effects)
        effects = self._in_phase(features, effects)
        edges = self._find_edges(features, self._com(effects.states))
        values = edges.values.flatten(0, 2)
        moved = along_edges(edges.axes[:, 0, 0], self._motion(self._held(effects)))  # (batch, time, 6)
        self.value_mean.copy_(values.mean(dim=0))
        scale = values.std(dim=0, correction=0)
        # A value that is nearly constant tells nothing apart, and must not blow up where it is not: it is shifted.
        self.value_scale.copy_(torch.where(scale < SAME, 1.0, scale))
        mean, components, parity = find_basis(moved, len(self.motions))
        self.mean_motion.copy_(mean)
        self.motions[: len(components)] = components
        self.parity[: len(parity)] = parity

    def augment(
        self, inputs: Float[Tensor, "batch inputs"], effects: Effects
    ) -> tuple[Float[Tensor, "batch inputs"], Effects]:
        """As of all predictors; where the contact's error may be told or not, actions are seen from other contacts.

        An action that was executed elsewhere than commanded is an exact one, seen from there. An exact one of which
        that is not told may have been commanded elsewhere, as far away as a `Belief` holds possible.
        """
        names = [self.context[column] for column in self.optional]
        if EXACT not in names:
            return super().augment(inputs, effects)
        flag = inputs.shape[1] - len(names) + names.index(EXACT)
        known = (inputs[:, flag] > 0) | (effects.execution != 0).any(dim=1)
        inputs = inputs.clone()
        inputs[:, flag] = known.float()
        inputs = self.hide_context(inputs)
        low, high = inputs.new_tensor([RANGES[name] for name in EXECUTION]).T
        rows = len(inputs)
        hidden = known & (inputs[:, flag] == 0)
        elsewhere = hidden & (torch.rand(rows, device=self.device) < ELSEWHERE_SHARE)
        commanded = (low + (high - low) * torch.rand(rows, 3, device=self.device)) * elsewhere[:, None]
        turn = commanded[:, 2] - effects.execution[:, 2]
        c, s = turn.cos(), turn.sin()
        rotation = torch.stack([torch.stack([c, -s], dim=1), torch.stack([s, c], dim=1)], dim=1)
        shift = commanded[:, None, :2] - effects.execution[:, None, :2] @ rotation.mT
        corners = self._corners(inputs) @ rotation.mT + shift
        inputs[:, : 2 * MAX_CORNERS] = corners.flatten(1) / UNIT
        states = effects.states * self.state_scale + self.state_mean
        states[..., :2] = states[..., :2] @ rotation.mT + shift
        states[..., 3:5] = states[..., 3:5] @ rotation.mT
        return inputs, replace(effects, states=(states - self.state_mean) / self.state_scale)

    def training_loss(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> Float[Tensor, ""]:
        """Negative log-likelihood of the observed motions, in units of the normalised position.

        The likelihood falls exponentially with the mean distance of displacements, and of turns by ``TURN_WEIGHT``,
        and is summed over pivot edges. Distances, not their squares: one lever-up that goes another way does not
        outweigh all others.
        """
        scale, effects = self.state_scale[0], self._in_phase(features, effects)
        edges = self._find_edges(features, self._com(effects.states))
        outputs = self._outputs(features, edges)
        time = torch.randperm(effects.states.shape[1], device=self.device)[:SAMPLES_PER_STEP]
        chosen = effects.outcomes[None, :, None, None, None].expand(*outputs.logits.shape[:4], 1)
        weights = outputs.weights.gather(
            4, chosen[..., None].expand(*chosen.shape, outputs.weights.shape[-1])
        )
        motion = (weights[..., 0, :] @ self.motions[:, time].flatten(1)).unflatten(-1, (-1, COORDINATES))
        # The motion at rest; its states were normalised and shifted, so the first sample has to come along.
        states = torch.cat([effects.states[:, :1], effects.states[:, time]], dim=1)
        truth = along_edges(edges.axes, self._motion(states)[:, 1:])
        apart = (motion + self.mean_motion[time] - truth).unflatten(-1, (2, 3)).square().sum(dim=-1)
        # (ensemble, batch, views, edges, time)
        apart = apart.add(1e-12).sqrt() @ apart.new_tensor([1.0, TURN_WEIGHT])
        valid = (time < effects.lengths[:, None]).float()
        error = (apart * valid[:, None, None]).sum(dim=-1) / valid.sum(dim=-1).clamp(min=1)[:, None, None]
        log_probability = outputs.logits.flatten(3).log_softmax(dim=-1).view_as(outputs.logits)
        likelihood = log_probability.gather(4, chosen)[..., 0] - error / TEMPERATURE
        expected = outputs.error.gather(4, chosen)[..., 0].clamp(min=SMALLEST_ERROR)
        share = likelihood.softmax(dim=-1).detach()
        off = (error / scale).detach().clamp(min=1e-6)
        scale_loss = (share * (expected + off * torch.exp(-expected))).sum(dim=-1)
        compared = valid.any(dim=-1).float()[
            :, None
        ]  # of a short trajectory there may be no sample among them
        motion_loss = -TEMPERATURE / scale * likelihood.logsumexp(dim=-1)
        if self.config.error_weighting:
            # Seitzer et al., 2022, with the error scale that futures of this outcome are expected to have.
            known = (share * expected.detach().clamp(min=LEAST_WEIGHTED)).sum(dim=-1)
            counts = torch.exp(-self.config.error_weighting * known)
            motion_loss = motion_loss * counts / counts.mean(dim=1, keepdim=True)
        loss = SCALE_WEIGHT * scale_loss + motion_loss
        return (loss * compared).mean() / compared.mean().clamp(min=1e-6)

    def finish(
        self,
        features: Float[Tensor, "batch inputs"],
        effects: Effects,
        other_features: Float[Tensor, "other inputs"],
        other_effects: Effects,
    ) -> None:
        """Estimate the covariance of normalised residuals, and the widths of prediction regions (split-conformal).

        A predictor that was trained before keeps its covariance: few actions tell little about it.
        """
        if not self.fine_tuned:
            features, effects = _some(features, effects)
            residuals, other_residuals = (
                torch.cat([self._residuals(*piece) for piece in _pieces(*part)])
                for part in ((features, effects), (other_features, other_effects))
            )
            for outcome in range(len(self.outcomes)):
                mine = residuals[effects.outcomes == outcome]
                others = other_residuals[other_effects.outcomes == outcome]
                self.covariance[outcome] = fit_covariance(mine if len(mine) else residuals, others)
        self.calibrate(other_features, other_effects)

    def calibrate(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> None:
        """Fit temperatures and quantiles to a part that the networks have not learned from."""
        before = self.temperature.tolist()
        self.temperature.fill_(1.0)
        every = torch.ones(len(features), len(self.optional), dtype=torch.bool, device=self.device)
        inputs = [features, self.without_context(features, every)] if self.optional else [features]
        views = [piece for each in inputs for piece in _pieces(each, effects)]
        self.temperature.copy_(fit_temperatures([self._odds(*piece) for piece in views], before))
        uniform = effects.estimated_com.isfinite().all(dim=1)
        off = (effects.estimated_com - self._com(effects.states))[uniform].square().sum(dim=1)
        if len(off):
            own = pixel_error(self._corners(features[uniform])).square()
            self.start_error[STARTS.index("estimated")] = (off - own).clamp(min=0).mean().sqrt()
        for told, each in enumerate(inputs):
            for start, name in enumerate(STARTS):
                rows = uniform.nonzero()[:, 0] if name == "estimated" else torch.arange(len(effects))
                scores = [self._scores(*piece, name) for piece in _pieces(each[rows], effects[rows])]
                found = quantiles_of(np.concatenate([np.zeros(0), *scores]))
                self.quantiles[start, told:] = torch.from_numpy(found)

    def _scores(
        self, features: Float[Tensor, "batch inputs"], effects: Effects, start: Start
    ) -> Float[np.ndarray, " batch"]:
        """Conformal scores of observed motions."""
        com = self._com(effects.states) if start == "observed" else effects.estimated_com
        spread = self.start_spread(features) if start == "estimated" else None
        futures = self._futures(self.mixture(features, com), self.quantiles[0, 0], spread)
        truth = self._metres(effects.states).double().cpu().numpy()
        return conformal_scores(futures, truth, effects.lengths.cpu().numpy())

    def _odds(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> Odds:
        """Predicted log-probabilities, and what happened."""
        mixture, effects = (
            self.mixture(features, self._com(effects.states)),
            self._in_phase(features, effects),
        )
        rows = torch.arange(len(effects), device=self.device)
        weights = mixture.mean[rows, :, effects.outcomes]
        truth = along_edges(mixture.axes, self._motion(self._held(effects))).flatten(2)
        moved = self.mean_motion.flatten() + weights @ self.motions.flatten(1)
        off = (moved - truth).unflatten(2, (-1, COORDINATES))[..., :3].norm(dim=3).mean(dim=2)
        clear = ((off[:, :1] - off[:, 1:]).abs() > CLEAR_EDGE).any(dim=1)
        edge = torch.where(clear, off.argmin(dim=1), -1)
        return Odds(mixture.log_probability, effects.outcomes, edge)

    def roll_out(
        self, features: Float[Tensor, "batch inputs"], first: Float[Tensor, "batch state"]
    ) -> Float[Tensor, "batch time state"]:
        """The most probable of the whole motions, from the view and the centre of mass at rest."""
        states = self.mixture(features, self._com(first[:, None])).most_probable()
        return (states - self.state_mean) / self.state_scale

    def imagine_effects(
        self,
        features: Float[Tensor, "batch inputs"],
        com: Float[np.ndarray, "batch 3"],
        observed: Float[np.ndarray, "batch samples 6"] | None = None,
        start: Start = "observed",
    ) -> ImaginedBatch:
        """Effects with all futures, of which the most probable one is the expected one."""
        with torch.inference_mode():
            place = torch.as_tensor(com, dtype=torch.float32, device=self.device)
            spread = self.start_spread(features) if start == "estimated" else None
            futures = self._futures(
                self.mixture(features, place), self._quantiles_of(features, start), spread
            )
        if observed is not None:
            futures = futures.given(observed, float(self.times[1] - self.times[0]))
        best = futures.states[np.arange(len(com)), futures.probability.argmax(axis=1)].astype(float)
        return ImaginedBatch(self.sample_times, best[..., :3], decode_poses(best), futures)

    def network_inputs(self, batch: InteractionBatch) -> Float[Tensor, "batch views values"]:
        """What networks are given about actions, and about their mirror images, of unit scale.

        The action relative to the candidate pivot edge ahead, and behind it the recorded context. The centre of mass is
        that of the first sample.
        """
        with torch.inference_mode():
            features = self.compute_features(self.features.inputs(batch))
            context = recorded_context(batch, self.context, self.marginal)
            features = self.add_context(features, context)
            com = torch.as_tensor(batch.com[:, 0], dtype=torch.float32, device=self.device)
            return self._inputs(features, self._find_edges(features, com))[:, :, 0]

    def expected_weights(
        self, inputs: Float[Tensor, "batch values"]
    ) -> Float[Tensor, "ensemble batch components"]:
        """Weights in the PCA basis that each network expects of such inputs, over all outcomes [m].

        A weight of 1 m displaces the centre of mass by as much, as the root mean square over time.
        """
        with torch.inference_mode():
            rows = inputs.expand(self.config.ensemble, -1, -1)
            numbers = self.networks(rows).unflatten(-1, (len(self.outcomes), -1))
            expected = (numbers[..., -1].softmax(dim=-1)[..., None] * numbers[..., :-2]).sum(dim=2)
            return expected * self.motions[..., :3].square().sum(dim=2).mean(dim=1).sqrt()

    def traced(self) -> TracedDistribution:
        """The network from outlines to all futures."""
        return TracedDistribution(self)

    # --- the networks' outputs ----------------------------------------------------------------------------

    def _find_edges(
        self, features: Float[Tensor, "batch inputs"], com: Float[Tensor, "batch 3"]
    ) -> PivotEdges:
        corners = self._corners(features)
        heights = None
        if self.heights:
            heights = features[:, 2 * MAX_CORNERS : self.features.num_features] * UNIT
            heights = heights.unflatten(1, (HEIGHT_CELLS, HEIGHT_CELLS))
        edges = self.frames.find(corners, com, self.num_edges, heights)
        if self.config.mirrored:
            return edges
        return replace(edges, values=edges.values[:, :1], axes=edges.axes[:, :1])

    @staticmethod
    def _corners(features: Float[Tensor, "batch inputs"]) -> Float[Tensor, "batch corners 2"]:
        return features[:, : 2 * MAX_CORNERS].unflatten(1, (-1, 2)) * UNIT

    def start_spread(self, features: Float[Tensor, "batch inputs"]) -> Float[Tensor, " batch"]:
        """Expected distances of centres of mass that were estimated from views (root mean square) [m]."""
        own = (
            1e3 * self.start_error[STARTS.index("estimated")]
        )  # in mm, whose square does not vanish beside the other
        return ((1e3 * pixel_error(self._corners(features))).square() + own.square()).sqrt() / 1e3

    def _inputs(
        self, features: Float[Tensor, "batch inputs"], edges: PivotEdges
    ) -> Float[Tensor, "batch views edges values"]:
        values = (edges.values - self.value_mean) / self.value_scale
        if not self.context:
            return values
        context = features[:, None, None, self.features.num_features :]
        return torch.cat([values, context.expand(*values.shape[:-1], -1)], dim=-1)

    def _outputs(self, features: Float[Tensor, "batch inputs"], edges: PivotEdges) -> Outputs:
        values = self._inputs(features, edges)
        rows = values.flatten(0, 2).expand(self.config.ensemble, -1, -1)
        numbers = self.networks(rows).unflatten(1, values.shape[:3]).unflatten(-1, (len(self.outcomes), -1))
        return Outputs(numbers[..., :-2], numbers[..., -2], numbers[..., -1])

    def mixture(
        self,
        features: Float[Tensor, "batch inputs"],
        com: Float[Tensor, "batch 3"],
    ) -> Mixture:
        """The distribution over motions: outputs for each future, averaged over ensemble and mirror images.

        Args:
            features: As from `add_context`.
            com: Centres of mass at rest in the action frame [m].
        """
        edges = self._find_edges(features, com)
        outputs = self._outputs(features, edges)
        logits = outputs.logits.flatten(3).log_softmax(dim=-1).view_as(outputs.logits).mean(dim=(0, 2))
        # Signs that turn the weights of a mirror image back.
        signs = torch.stack([torch.ones_like(self.parity), self.parity])[: edges.values.shape[1]]
        sizes = self.motions[..., :3].square().sum(dim=2).mean(dim=1)
        # Many lever-ups network by network: all at once would not fit into the processor's cache.
        many = torch.is_inference_mode_enabled() and len(com) >= MANY
        parts = [
            part * signs[:, None, None] for part in outputs.weights.split(1 if many else len(outputs.weights))
        ]
        mean = torch.stack([part.mean(dim=(0, 2)) for part in parts]).mean(dim=0)
        distances = [((part - mean[:, None]).square() @ sizes).mean(dim=(0, 2)) for part in parts]
        apart = torch.stack(distances).mean(dim=0)
        expected = outputs.error.mean(dim=(0, 2)).clamp(max=LARGEST_ERROR).exp() * self.state_scale[0]
        return Mixture(
            com=com,
            axes=edges.axes[:, 0],
            ends=edges.ends,
            log_probability=tempered(logits.flatten(1).log_softmax(dim=1).view_as(logits), self.temperature),
            mean=mean,
            error=(expected.square() + DISAGREEMENT**2 * apart).sqrt(),
            covariance=self.covariance,
            components=self.motions,
            mean_motion=self.mean_motion,
            warp=self._warp(features),
        )

    def _quantiles_of(
        self, features: Float[Tensor, "batch inputs"], start: Start
    ) -> Float[Tensor, "*batch levels"]:
        """Quantiles for a start, and for how much of the context is told; of a part of it, the larger ones."""
        told, nothing = self.quantiles[STARTS.index(start)]
        if not self.optional:
            return told
        flags = features[:, features.shape[1] - len(self.optional) :] > 0
        some = torch.where(flags.any(dim=1)[:, None], told.maximum(nothing), nothing)
        return torch.where(flags.all(dim=1)[:, None], told, some)

    def _futures(
        self,
        mixture: Mixture,
        quantiles: Float[Tensor, "*batch levels"],
        start_spread: Float[Tensor, " batch"] | None,
    ) -> Futures:
        ends = mixture.ends[:, :, None].expand(*mixture.log_probability.shape, 2, 2).flatten(1, 2)
        spread = mixture.spread().double()
        if start_spread is not None:
            spread = torch.hypot(spread, start_spread.double()[:, None, None])
        return Futures(
            probability=mixture.log_probability.flatten(1).exp().double().cpu().numpy(),
            outcome=self.outcomes * self.num_edges,
            states=mixture.states().cpu().numpy(),
            spread=spread.cpu().numpy(),
            support_points=ends.double().cpu().numpy(),
            quantiles=quantiles.double().cpu().numpy(),
        )

    def _residuals(
        self, features: Float[Tensor, "batch inputs"], effects: Effects
    ) -> Float[Tensor, "batch components"]:
        """Normalised residuals: errors of the weights over the predicted error scale, at the better pivot edge."""
        mixture = self.mixture(features, self._com(effects.states))
        effects = self._in_phase(features, effects)
        truth = along_edges(mixture.axes, self._motion(self._held(effects))).flatten(2)
        rows = torch.arange(len(effects), device=self.device)
        mean = mixture.mean[rows, :, effects.outcomes]  # (batch, edges, components)
        basis = self.motions.flatten(1)
        off = truth - self.mean_motion.flatten() - mean @ basis
        better = off.square().sum(dim=2).argmin(dim=1)
        weights = off[rows, better] @ basis.mT / basis.square().sum(dim=1).clamp(min=1e-12)
        return weights / mixture.error[rows, better, effects.outcomes][:, None]

    # --- phases of the path -------------------------------------------------------------------------------

    @property
    def _period(self) -> Tensor:
        """Time between samples [s]."""
        return self.times[1] - self.times[0]

    def _speed(self, features: Float[Tensor, "batch inputs"]) -> Float[Tensor, " batch"]:
        """Speeds of the actions' paths, as multiples of the nominal one."""
        k = self.context.index(SPEED)
        return features[:, self.features.num_features + k] * self.known_scale[k] + self.known_mean[k]

    def _in_phase(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> Effects:
        """Effects as they are compared with the basis."""
        if not self.config.phase_time:
            return effects
        return in_phase(effects, self._speed(features), self.slots, self._period)

    def _warp(self, features: Float[Tensor, "batch inputs"]) -> Warp | None:
        """Where samples of trajectories lie in the basis."""
        if not self.config.phase_time:
            return None
        speed = self._speed(features)
        if not torch.compiler.is_compiling() and len(speed) > 1 and bool((speed == speed[0]).all()):
            speed = speed[:1]
        wanted = phase_of(self.times, speed[:, None])
        return Warp.to(wanted, self.slots[1] - self.slots[0], len(self.slots))

    # --- from states to motions ---------------------------------------------------------------------------

    def _metres(self, states: Float[Tensor, "batch time state"]) -> Float[Tensor, "batch time 3"]:
        return states[..., :3] * self.state_scale[:3] + self.state_mean[:3]

    def _com(self, states: Float[Tensor, "batch time state"]) -> Float[Tensor, "batch 3"]:
        return self._metres(states[:, :1])[:, 0]

    def _motion(self, states: Float[Tensor, "batch time state"]) -> Float[Tensor, "batch time 6"]:
        """Displacement since the first sample, and turn, in the action frame [m]."""
        positions = self._metres(states)
        turned = states[..., 3:] * self.state_scale[3:] + self.state_mean[3:]
        return torch.cat([positions - positions[:, :1], TURN_LENGTH * turned], dim=-1)

    def _held(self, effects: Effects) -> Float[Tensor, "batch time state"]:
        """States, held at the end of a shorter trajectory."""
        time = torch.arange(effects.states.shape[1], device=self.device)
        held = time.expand(len(effects), -1).minimum(effects.lengths[:, None] - 1)
        return effects.states.gather(1, held[..., None].expand_as(effects.states))


def _some(features: Float[Tensor, "batch inputs"], effects: Effects) -> tuple[Tensor, Effects]:
    """All rows of a training part; of a large one, evenly spaced ones."""
    step = 1 if len(effects) <= LARGE else len(effects) // ENOUGH
    rows = torch.arange(0, len(effects), step, device=features.device)
    return (features, effects) if step == 1 else (features[rows], effects[rows])


def _pieces(
    features: Float[Tensor, "batch inputs"], effects: Effects
) -> Iterator[tuple[Float[Tensor, "_ inputs"], Effects]]:
    """The same rows of features and effects, `PIECE` at a time; those of a part that is not large together."""
    size = PIECE if len(effects) > 2 * PIECE else max(1, len(effects))
    for rows in torch.arange(len(effects), device=features.device).split(size):
        yield features[rows], effects[rows]
