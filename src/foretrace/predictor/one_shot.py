"""A predictor that says whole motions at once, what may happen instead, and how sure it is."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from foretrace.errors import TrainingError
from foretrace.features import FeatureExtractor, Outline
from foretrace.features.outline import HEIGHT_CELLS, MAX_CORNERS, UNIT
from foretrace.imagined import LEVELS, Futures, ImaginedBatch, conformal_scores, quantiles_of
from foretrace.interactions.dataset import InteractionBatch
from foretrace.interactions.record import Outcome
from foretrace.interactions.topdown import CONTACT_PIXEL, METRES_PER_PIXEL, VIEW_SIZE, TopDownView
from foretrace.predictor.base import EffectPredictor, estimate_com
from foretrace.predictor.context import given_values
from foretrace.predictor.ensemble import MANY, Members
from foretrace.predictor.mixture import COORDINATES, TURN_LENGTH, Mixture, along_hinges
from foretrace.predictor.pivot_edges import NUM_VALUES, PROBES, Hinges, find_hinges
from foretrace.predictor.states import Effects, decode_poses

ODD = (1, 3, 5)
"""Coordinates of a motion that change their sign in a mirror: along the hinge; turns about the other two axes."""
TURN_WEIGHT = 0.5
"""Weight of the turn in the loss, beside 1 for the displacement."""
TEMPERATURE = 0.003
"""Of two futures, one that is this much nearer to what happened [m] counts e times as much in training."""
SURENESS_WEIGHT = 0.02
"""Weight of the error of the expected error in the loss."""
SAME = 0.01
"""A number seen from hinges that varies by less (a millimetre, half a degree) counts as the same everywhere."""
FEW = 10
"""So many lever-ups with an outcome tell how much they scatter."""
LARGEST_ERROR = 1.5
"""Logarithm of the largest error to be expected, in units of the position's scale: of futures that nobody expects,
networks say anything."""
DISAGREEMENT = 8.0
"""Where networks and mirror images disagree, so many times their distance is the error to be expected.

They disagree most about objects unlike those learned from. Measured on triangles and quadrangles that were held out, of
objects beyond the paper's 160: with 4 to 16, regions are about as exact there as on known shapes; without, they are far
too narrow.
"""
SAMPLES_PER_STEP = 15
"""Samples of the trajectories, drawn at random, that one training step looks at: it makes the step cheaper."""


@dataclass(frozen=True)
class OneShotConfig:
    """Settings of the predictor of whole motions."""

    hidden: int = 128
    """Units of each hidden layer."""
    layers: int = 3
    """Hidden layers."""
    members: int = 5
    """Networks that learn side by side and are averaged."""
    motions: int = 32
    """Principal motions of the training part that the networks put a trajectory together from."""
    hinges: int = 2
    """Edges that it considers: the one ahead of the centre of mass, and its neighbour."""
    mirrored: bool = True
    """Whether every lever-up is also seen in the mirror."""
    known: tuple[str, ...] = ()
    """Physical constants that it is told beside the view."""
    outcomes: tuple[str, ...] = ("levered",)
    """Outcomes that it tells apart; each has a future of its own."""

    def __post_init__(self) -> None:
        for name, most in (("hidden", 4096), ("layers", 32), ("members", 100), ("motions", 1024)):
            if not 1 <= getattr(self, name) <= most:
                raise TrainingError(f"{name} is {getattr(self, name)}: give a number from 1 to {most}")
        if self.hinges not in (1, 2):
            raise TrainingError(f"hinges must be 1 or 2, not {self.hinges}")
        for name in self.outcomes:
            if name not in list(Outcome):
                raise TrainingError(f"unknown outcome {name!r}; choose from {', '.join(Outcome)}")
        if not self.outcomes:
            raise TrainingError("there is no outcome to learn: name at least one")


class Said(NamedTuple):
    """What the members say about lever-ups and their mirror images, hinge by hinge and outcome by outcome."""

    weights: Float[Tensor, "members batch views hinges outcomes motions"]
    """Of the principal motions."""
    error: Float[Tensor, "members batch views hinges outcomes"]
    """Logarithm of the error that is to be expected of the motion, in units of the position's scale."""
    odds: Float[Tensor, "members batch views hinges outcomes"]
    """Logarithm of the probability, up to a constant."""


class OneShotPredictor(EffectPredictor):
    """Says whole motions at once, in the frames of the edges that the object may turn about.

    From the outline's corners and the centre of mass, `find_hinges` finds two edges in closed form, and what the
    lever-up looks like from there. For every edge and every outcome networks turn these numbers into a future: its
    probability; the weights of principal motions (how far the object is displaced and turned, sample by sample,
    along the hinge's axes); and the error to be expected. Futures are never averaged, only what several networks
    say about the same one. Every lever-up is also seen in the mirror: mirror images have mirrored motions, exactly.

    Args:
        features: Must be ``outline``.
        num_samples: Samples in a trajectory.
        settings: Settings.

    Raises:
        TrainingError: Other features.
    """

    label = "one-shot"
    keeps_last_epoch = True
    value_mean: Tensor
    value_scale: Tensor
    mean_motion: Tensor
    motions: Tensor
    parity: Tensor
    covariance: Tensor
    quantiles: Tensor

    def __init__(
        self, features: FeatureExtractor, num_samples: int, settings: OneShotConfig = OneShotConfig()
    ):
        if not isinstance(features, Outline):
            raise TrainingError(
                f"the {self.label} predictor reads an object's outline, not {features.label}: train it with "
                "features 'outline'"
            )
        super().__init__(features, "turn", num_samples, settings.known, settings.outcomes)
        self.settings = settings
        self.heights = features.heights
        seen, outcomes, motions = NUM_VALUES + self.heights * PROBES**2, len(self.outcomes), settings.motions
        hidden = (settings.hidden,) * settings.layers
        self.networks = Members(settings.members, (seen + len(self.known), *hidden, outcomes * (motions + 2)))
        self.register_buffer("value_mean", torch.zeros(seen))
        self.register_buffer("value_scale", torch.ones(seen))
        self.register_buffer("mean_motion", torch.zeros(num_samples, COORDINATES))
        self.register_buffer("motions", torch.zeros(motions, num_samples, COORDINATES))
        self.register_buffer("parity", torch.ones(motions))
        self.register_buffer("covariance", torch.eye(motions).repeat(outcomes, 1, 1))
        self.register_buffer("quantiles", torch.ones(len(LEVELS)))

    @property
    def config(self) -> OneShotConfig:
        """Its settings."""
        return self.settings

    @property
    def feature_weights(self) -> list[nn.Parameter]:
        """None: corners are not multiplied with weights, only what is made of them."""
        return []

    def lengths(self, batch: InteractionBatch) -> Int[np.ndarray, " batch"]:
        """Whole trajectories: what follows a slip is an effect too."""
        return batch.length

    def prepare(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> None:
        """Find the principal motions of the training part, and the scale of what is seen from the hinges.

        A shorter trajectory counts as if it stayed where it ends. Principal motions are found apart for what stays
        the same in a mirror and what changes its sign, so each is its own mirror image, up to its sign.
        """
        hinges = self._see(features, self._com(effects.states))
        values = hinges.values.flatten(0, 2)
        self.value_mean.copy_(values.mean(dim=0))
        scale = values.std(dim=0, correction=0)
        # What is nearly the same everywhere tells nothing apart, and must not blow up where it is not: it is shifted.
        self.value_scale.copy_(torch.where(scale < SAME, 1.0, scale))
        moved = along_hinges(hinges.axes[:, 0, 0], self._motion(self._held(effects)))  # (batch, time, 6)
        odd = torch.isin(torch.arange(COORDINATES), torch.tensor(ODD)).to(moved)
        self.mean_motion.copy_(moved.mean(dim=0) * (1 - odd))
        found = []
        for parity, part in ((1.0, 1 - odd), (-1.0, odd)):
            deviation = ((moved - self.mean_motion) * part).flatten(1)
            _, sizes, directions = torch.linalg.svd(deviation, full_matrices=False)
            found += [
                (float(s), parity, d) for s, d in zip(sizes / len(moved) ** 0.5, directions, strict=True)
            ]
        found.sort(key=lambda motion: -motion[0])
        for k, (size, parity, direction) in enumerate(found[: len(self.motions)]):
            self.motions[k] = size * direction.view_as(self.mean_motion)
            self.parity[k] = parity

    def training_loss(self, features: Float[Tensor, "batch inputs"], effects: Effects) -> Float[Tensor, ""]:
        """Negative logarithm of the likelihood of what happened, in units of the normalised position.

        The likelihood falls exponentially with the mean distance of displacements, and of turns by ``TURN_WEIGHT``,
        and is summed over hinges. Distances, not their squares: one lever-up that goes another way does not
        outweigh all others.
        """
        scale = self.state_scale[0]
        hinges = self._see(features, self._com(effects.states))
        said = self._say(features, hinges)
        time = torch.randperm(effects.states.shape[1], device=self.device)[:SAMPLES_PER_STEP]
        chosen = effects.outcomes[None, :, None, None, None].expand(*said.odds.shape[:4], 1)
        weights = said.weights.gather(4, chosen[..., None].expand(*chosen.shape, said.weights.shape[-1]))
        motion = (weights[..., 0, :] @ self.motions[:, time].flatten(1)).unflatten(-1, (-1, COORDINATES))
        # The motion at rest; its states were normalised and shifted, so the first sample has to come along.
        states = torch.cat([effects.states[:, :1], effects.states[:, time]], dim=1)
        truth = along_hinges(hinges.axes, self._motion(states)[:, 1:])
        apart = (motion + self.mean_motion[time] - truth).unflatten(-1, (2, 3)).square().sum(dim=-1)
        apart = apart.add(1e-12).sqrt() @ apart.new_tensor(
            [1.0, TURN_WEIGHT]
        )  # (members, batch, views, hinges, time)
        valid = (time < effects.lengths[:, None]).float()
        error = (apart * valid[:, None, None]).sum(dim=-1) / valid.sum(dim=-1).clamp(min=1)[:, None, None]
        odds = said.odds.flatten(3).log_softmax(dim=-1).view_as(said.odds).gather(4, chosen)[..., 0]
        likelihood = odds - error / TEMPERATURE
        expected = said.error.gather(4, chosen)[..., 0]
        share = likelihood.softmax(dim=-1).detach()
        off = (error / scale).detach().clamp(min=1e-6)
        sureness = (share * (expected + off * torch.exp(-expected))).sum(dim=-1)
        seen = valid.any(dim=-1).float()[:, None]  # of a short trajectory there may be no sample among them
        loss = SURENESS_WEIGHT * sureness - TEMPERATURE / scale * likelihood.logsumexp(dim=-1)
        return (loss * seen).mean() / seen.mean().clamp(min=1e-6)

    def finish(
        self,
        features: Float[Tensor, "batch inputs"],
        effects: Effects,
        other_features: Float[Tensor, "other inputs"],
        other_effects: Effects,
    ) -> None:
        """Measure how motions scatter about those expected, and how wide regions have to be.

        Which errors go together is taken from the training part. How large they are is taken from the validation
        part, and so are the widths of regions (split-conformal prediction).
        """
        scatter, other_scatter = (
            self._scatter(features, effects),
            self._scatter(other_features, other_effects),
        )
        for outcome in range(len(self.outcomes)):
            mine, others = (
                scatter[effects.outcomes == outcome],
                other_scatter[other_effects.outcomes == outcome],
            )
            mine = mine if len(mine) else scatter
            covariance = mine.mT @ mine / len(mine)
            ridge = 1e-3 * covariance.diagonal().mean() + 1e-12
            covariance = covariance + ridge * torch.eye(len(covariance)).to(covariance)
            if len(others) >= FEW:
                root = torch.linalg.cholesky(covariance)
                white = torch.linalg.solve_triangular(root, others.mT, upper=False)
                covariance = covariance * white.square().mean()
            self.covariance[outcome] = covariance
        com = self._com(other_effects.states)
        futures = self._futures(self.mixture(other_features, com))
        truth = self._metres(other_effects.states).double().cpu().numpy()
        scores = conformal_scores(futures, truth, other_effects.lengths.cpu().numpy())
        self.quantiles.copy_(torch.from_numpy(quantiles_of(scores)))

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
        observed: Float[np.ndarray, "batch samples state"] | None = None,
    ) -> ImaginedBatch:
        """As the base class; with all futures."""
        with torch.inference_mode():
            start = torch.as_tensor(com, dtype=torch.float32, device=self.device)
            futures = self._futures(self.mixture(features, start))
        if observed is not None:
            futures = futures.given(observed, float(self.times[1] - self.times[0]))
        best = futures.states[np.arange(len(com)), futures.probability.argmax(axis=1)].astype(float)
        return ImaginedBatch(self.times.cpu().numpy(), best[..., :3], decode_poses(best), futures)

    def imagine_contacts(
        self,
        view: TopDownView,
        contacts: Float[np.ndarray, "n 2"],
        directions: Float[np.ndarray, "n 2"],
        com: Float[np.ndarray, "3"] | None = None,
        known: Mapping[str, float] | None = None,
    ) -> ImaginedBatch:
        """Imagine lever-ups of one object at many contacts from a single view, whose outline is fitted once.

        Args:
            view: The object, in any action frame.
            contacts: Contact points in that frame [m].
            directions: Unit vectors along which the blade is pushed there.
            com: Centre of mass at rest in that frame [m]; estimated from the view if not given.
            known: As of `imagine`.

        Returns:
            One row per contact, each in the frame of its own action.

        Raises:
            PredictionError: A known value is missing or of no use.
        """
        batch = InteractionBatch.from_views([view])
        start = estimate_com(batch)[0] if com is None else np.asarray(com, dtype=float)
        turned = np.stack(
            [directions, directions[:, ::-1] * [-1, 1]], axis=1
        )  # rows: x and y of the new frames
        values = np.repeat(given_values(known, self.known), len(contacts), axis=0)
        starts = np.concatenate(
            [np.einsum("nij,nj->ni", turned, start[:2] - contacts), np.full((len(contacts), 1), start[2])],
            axis=1,
        )
        seen = self.features.inputs(batch).to(self.device)
        axes, origins = (torch.from_numpy(a).to(seen) for a in (turned, contacts))
        corners = seen[:, : 2 * MAX_CORNERS].unflatten(1, (-1, 2)) - origins[:, None] / UNIT
        features = (corners @ axes.mT).flatten(1)
        if self.heights:
            cells = seen[:, 2 * MAX_CORNERS :].unflatten(1, (1, HEIGHT_CELLS, HEIGHT_CELLS))
            moved = _moved_maps(cells.expand(len(contacts), -1, -1, -1), axes, origins)
            features = torch.cat([features, moved.flatten(1)], dim=1)
        return self.imagine_effects(self.add_known(features, values), starts)

    # --- what the networks say ----------------------------------------------------------------------------

    def _see(self, features: Float[Tensor, "batch inputs"], com: Float[Tensor, "batch 3"]) -> Hinges:
        corners = features[:, : 2 * MAX_CORNERS].unflatten(1, (-1, 2)) * UNIT
        heights = None
        if self.heights:
            heights = features[:, 2 * MAX_CORNERS : self.features.num_features] * UNIT
            heights = heights.unflatten(1, (HEIGHT_CELLS, HEIGHT_CELLS))
        hinges = find_hinges(corners, com, self.settings.hinges, heights)
        if self.settings.mirrored:
            return hinges
        return replace(hinges, values=hinges.values[:, :1], axes=hinges.axes[:, :1])

    def _say(self, features: Float[Tensor, "batch inputs"], hinges: Hinges) -> Said:
        values = (hinges.values - self.value_mean) / self.value_scale
        if self.known:
            known = features[:, None, None, self.features.num_features :]
            values = torch.cat([values, known.expand(*values.shape[:-1], -1)], dim=-1)
        rows = values.flatten(0, 2).expand(self.settings.members, -1, -1)
        said = self.networks(rows).unflatten(1, values.shape[:3]).unflatten(-1, (len(self.outcomes), -1))
        return Said(said[..., :-2], said[..., -2], said[..., -1])

    def mixture(
        self,
        features: Float[Tensor, "batch inputs"],
        com: Float[Tensor, "batch 3"],
    ) -> Mixture:
        """What members and mirror images say about each future, averaged.

        Args:
            features: As from `add_known`.
            com: Centres of mass at rest in the action frame [m].
        """
        hinges = self._see(features, com)
        said = self._say(features, hinges)
        odds = said.odds.flatten(3).log_softmax(dim=-1).view_as(said.odds).mean(dim=(0, 2))
        # What the motion in the mirror is here.
        seen = torch.stack([torch.ones_like(self.parity), self.parity])[: hinges.values.shape[1]]
        sizes = self.motions[..., :3].square().sum(dim=2).mean(dim=1)
        # Many lever-ups member by member: all at once would not fit into the processor's cache.
        many = torch.is_inference_mode_enabled() and len(com) >= MANY
        parts = [part * seen[:, None, None] for part in said.weights.split(1 if many else len(said.weights))]
        mean = torch.stack([part.mean(dim=(0, 2)) for part in parts]).mean(dim=0)
        distances = [((part - mean[:, None]).square() @ sizes).mean(dim=(0, 2)) for part in parts]
        apart = torch.stack(distances).mean(dim=0)
        expected = said.error.mean(dim=(0, 2)).clamp(max=LARGEST_ERROR).exp() * self.state_scale[0]
        return Mixture(
            com=com,
            axes=hinges.axes[:, 0],
            ends=hinges.ends,
            odds=odds.flatten(1).log_softmax(dim=1).view_as(odds),
            mean=mean,
            error=(expected.square() + DISAGREEMENT**2 * apart).sqrt(),
            covariance=self.covariance,
            motions=self.motions,
            mean_motion=self.mean_motion,
        )

    def _futures(self, mixture: Mixture) -> Futures:
        ends = mixture.ends[:, :, None].expand(*mixture.odds.shape, 2, 2).flatten(1, 2)
        return Futures(
            probability=mixture.odds.flatten(1).exp().double().cpu().numpy(),
            outcome=self.outcomes * self.settings.hinges,
            states=mixture.states().cpu().numpy(),
            spread=mixture.spread().double().cpu().numpy(),
            support_points=ends.double().cpu().numpy(),
            quantiles=self.quantiles.double().cpu().numpy(),
        )

    def _scatter(
        self, features: Float[Tensor, "batch inputs"], effects: Effects
    ) -> Float[Tensor, "batch motions"]:
        """Errors of the weights of motions, relative to what was expected, at the better hinge."""
        mixture = self.mixture(features, self._com(effects.states))
        truth = along_hinges(mixture.axes, self._motion(self._held(effects))).flatten(2)
        rows = torch.arange(len(effects), device=self.device)
        mean = mixture.mean[rows, :, effects.outcomes]  # (batch, hinges, motions)
        motions = self.motions.flatten(1)
        off = truth - self.mean_motion.flatten() - mean @ motions
        better = off.square().sum(dim=2).argmin(dim=1)
        weights = off[rows, better] @ motions.mT / motions.square().sum(dim=1).clamp(min=1e-12)
        said = mixture.error[rows, better, effects.outcomes]
        return weights / said[:, None]

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
        """States; past the end of a shorter trajectory those at its end."""
        time = torch.arange(effects.states.shape[1], device=self.device)
        held = time.expand(len(effects), -1).minimum(effects.lengths[:, None] - 1)
        return effects.states.gather(1, held[..., None].expand_as(effects.states))


def _moved_maps(
    maps: Float[Tensor, "n 1 rows columns"], axes: Float[Tensor, "n 2 2"], origins: Float[Tensor, "n 2"]
) -> Float[Tensor, "n rows columns"]:
    """Maps over a whole view as seen from other frames, of which the axes and origins in the view's are given [m]."""
    # Lengths in units of half a view, positions from its middle; below, columns come first.
    contact = (2 * maps.new_tensor(CONTACT_PIXEL) + 1) / VIEW_SIZE - 1
    origins = contact - contact @ axes - origins / (VIEW_SIZE * METRES_PER_PIXEL / 2)
    unmoved = F.affine_grid(torch.eye(2, 3)[None].to(maps), [1, *maps.shape[1:]], align_corners=False)
    # All maps' places come from one product, pixels last: in long rows.
    places = axes.mT.flip(1, 2) @ unmoved.flatten(0, 2).T + origins.flip(1)[..., None]
    places = places.unflatten(2, maps.shape[2:]).permute(0, 2, 3, 1)
    return F.grid_sample(maps, places, align_corners=False)[:, 0]
