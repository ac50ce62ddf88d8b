"""An imaginer that learns nothing: it builds the object that it sees, and simulates the action on it."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from foretrace.actions import LeverUp, ToolPath
from foretrace.errors import (
    ActionError,
    PredictionError,
    ShapeError,
    check_choices,
    check_ranges,
    check_type,
    is_whole,
    shown,
)
from foretrace.geometry import rotation_vector_to_quaternion, transform_points
from foretrace.imagined import (
    LEVELS,
    Futures,
    ImaginedBatch,
    Imaginer,
    Scenes,
    conformal_scores,
    quantiles_of,
)
from foretrace.imagined.context import BEVELS, CONSTANTS
from foretrace.interactions.batch import Candidates, InteractionBatch
from foretrace.interactions.record import Physics
from foretrace.objects import BEVEL, Bevel, ObjectModel, Prism, Weighted
from foretrace.simulation.randomisation import RANDOMISED, Randomisation
from foretrace.twin.calibration import TwinCalibration, check_calibration
from foretrace.twin.gather import SLOTS, gather
from foretrace.twin.outline import SeenObject, locate_object, match_corners, see_object
from foretrace.twin.worlds import Player, World, check_player, draw_shares, play_worlds, vary
from foretrace.workers import MOST_WORKERS, count_workers

OFF_CENTRE = 0.002
"""A centre of mass that is further than this from that of the uniform object, in the plane, is off the centre [m]."""
NOMINAL = ToolPath()


@dataclass(frozen=True)
class TwinConfig:
    """How a twin simulates.

    Raises:
        PredictionError: A value is out of its range.
    """

    embodiment: str = "tool"
    """``tool``: the blade alone; ``arm``: the whole robot, which gives way a little."""
    worlds: int = 32
    """Simulations of an action of which something is not told; an even number."""
    outline_noise: float = 0.0005
    """Root mean square error of outlines where something is not told [m]."""
    ranges: Randomisation = RANDOMISED
    """Ranges of what is not told: friction, density, bevel, thickness, and the contact's error."""
    sees_height: bool = True
    """Whether the height map tells the object's thickness; otherwise that is not known exactly, either."""
    timestep: float = 0.002
    """Time step [s]."""
    sample_period: float = 0.05
    """Time between samples [s]."""
    watch_time: float = 0.0
    """Time for which the object is observed after the end of the nominal path [s]."""
    set_down: bool = False
    """Whether the blade goes back the way it came, until the object rests on the table: for sequences of lever-ups."""
    seed: int = 0
    """Decides what is drawn."""
    workers: int | None = None
    """Processes to share many simulations among; None: one for each core."""

    def __post_init__(self) -> None:
        for name, least, most in (("worlds", 2, 65536), ("seed", 0, 2**63 - 1)):
            if not is_whole(value := getattr(self, name), least, most):
                raise PredictionError(f"{name} is {shown(value)}: give a whole number from {least} to {most}")
        if self.worlds % 2:
            raise PredictionError(
                f"worlds is {self.worlds}: give an even number, since they come in mirrored pairs"
            )
        if self.workers is not None and not is_whole(self.workers, 1, MOST_WORKERS):
            raise PredictionError(f"workers is {shown(self.workers)}: give a number from 1 to {MOST_WORKERS}")
        check_type("ranges", self.ranges, Randomisation, PredictionError)
        check_type("embodiment", self.embodiment, str, PredictionError)
        check_choices(PredictionError, self)
        limits = {
            "outline_noise": (0.0, 0.005),
            "timestep": (1e-5, 0.02),
            "sample_period": (1e-3, 1.0),
            "watch_time": (0.0, 60.0),
        }
        check_ranges(PredictionError, "twin", self, limits)


class TwinImaginer(Imaginer):
    """Imagines the effect of a lever-up by simulating it on the object that the view shows.

    The object is built from the view: its outline to a fraction of a pixel, extruded to its height, with the usual
    bevel; or a lying cylinder, if the height map is that of one. If all constants are told, the action is simulated
    once. Otherwise it is simulated in many worlds, in which what is not told is drawn at random, and their motions are
    gathered into futures by outcome and pivot edge.

    Args:
        engine: Physics engine.
        config: Settings.
        object: The object, where it is known: then the view tells only where it lies.
        calibration: How far the twin is off, as `calibrate` measures it, or a file of it. Without one, regions are
            unknown, and spreads are those of the worlds alone.

    Raises:
        PredictionError: The engine is unknown or not installed, or a value is not usable.
    """

    context = (*CONSTANTS, *LeverUp.units)
    marginal = True
    bevels_all = True

    def __init__(
        self,
        engine: str = "mujoco",
        config: TwinConfig = TwinConfig(),
        object: ObjectModel | None = None,
        calibration: TwinCalibration | str | Path | None = None,
    ) -> None:
        check_type("engine", engine, str, PredictionError, "its name")
        check_type("config", config, TwinConfig, PredictionError)
        check_type("object", object, (ObjectModel, type(None)), PredictionError, "a Prism or another object")
        self.config = config
        """Settings."""
        self.object = object
        """The object, where it is known."""
        self.calibration = check_calibration(calibration)
        """How far the twin is off."""
        duration = LeverUp.nominal().time_to_rest if config.set_down else NOMINAL.duration
        duration += config.watch_time
        self.rests = config.set_down
        samples = round(duration / config.sample_period)
        self._player = Player(
            engine,
            config.embodiment,
            config.timestep,
            config.sample_period,
            samples * config.sample_period,
            config.set_down,
        )
        check_player(self._player)
        self._times = np.arange(samples + 1) * config.sample_period

    @property
    def sample_times(self) -> Float[np.ndarray, " time"]:
        """Times of the imagined samples [s]."""
        return self._times

    @property
    def name(self) -> str:
        """Name in messages."""
        return "twin"

    @property
    def learned_outcomes(self) -> tuple[str, ...]:
        """Those of a lever-up, the action that it plays."""
        return LeverUp.outcomes

    @property
    def outcomes(self) -> tuple[str, ...]:
        """Outcome of each future."""
        return SLOTS

    def imagine_scenes(self, scenes: Scenes) -> ImaginedBatch:
        """Simulate the actions, each in one world or, where something is not told, in many."""
        objects = self._see(scenes)
        worlds: list[World] = []
        counts: list[int] = []
        for row, found in enumerate(objects):
            seen = objects[row] = self._rimmed(scenes, row, found)
            mine = self._worlds(scenes, row, seen)
            counts.append(len(mine))
            worlds += mine
        workers = count_workers(self.config.workers, PredictionError)
        played = play_worlds(self._player, worlds, workers)
        ends = np.cumsum(counts)
        gathered = []
        for row, (start, end) in enumerate(zip(ends - counts, ends, strict=True)):
            sound = [each for each in played[start:end] if each is not None]
            if not sound:
                raise PredictionError(
                    f"the simulation of action {row} blew up: take a smaller timestep, or check object and context"
                )
            gathered.append(gather(sound, scenes.com[row]))
        spread = np.stack([each.spread for each in gathered])
        quantiles = np.full(len(LEVELS), np.nan)
        if self.calibration is not None:
            spread = np.sqrt(spread**2 + self.calibration.at(self._times) ** 2)
            quantiles = self.calibration.quantiles
        elif max(counts) == 1:
            spread = np.full_like(spread, np.nan)
        futures = Futures(
            probability=np.stack([each.probability for each in gathered]),
            outcome=SLOTS,
            states=np.stack([each.states for each in gathered]),
            spread=spread,
            support_points=np.stack([each.support_points for each in gathered]),
            quantiles=quantiles,
        )
        best = futures.states[np.arange(len(futures)), futures.probability.argmax(axis=1)]
        pose = np.concatenate([best[..., :3], rotation_vector_to_quaternion(best[..., 3:])], axis=-1)
        notes = tuple(seen.notes for seen in objects)
        return ImaginedBatch(self._times, best[..., :3], pose, futures, notes)

    def calibrate(self, batch: InteractionBatch) -> TwinCalibration:
        """Measure on recorded actions how far the twin is off, and keep that for its spreads and regions.

        Whole motions count. What was recorded of an action is told.

        Args:
            batch: Actions that nothing else was fitted to, a hundred or more.

        Returns:
            The calibration, which can be saved.

        Raises:
            PredictionError: As `imagine_batch`, or a motion is sampled at other times than the twin's.
        """
        check_type("batch", batch, InteractionBatch, PredictionError)
        count = min(len(batch.times), len(self._times))
        if count < 2 or not np.allclose(batch.times[:count], self._times[:count], rtol=0, atol=1e-9):
            raise PredictionError(
                f"the batch is sampled at {shown(batch.times[:3].tolist())}..., the twin at "
                f"{shown(self._times[:3].tolist())}...: give a twin with the batch's sample_period"
            )
        self.calibration = None
        found = self.imagine_batch(batch).futures
        plain = replace(found, spread=np.nan_to_num(found.spread))
        lengths, truth = np.minimum(batch.length, count), batch.com[:, :count]
        valid = np.arange(count) < lengths[:, None]
        off = np.linalg.norm(plain.com[:, :, :count] - truth[:, None], axis=-1)  # (batch, futures, time)
        mean = np.where(valid[:, None], off, 0.0).sum(axis=2) / np.maximum(lengths, 1)[:, None]
        nearest = np.where(plain.counted, mean, np.inf).argmin(axis=1)
        own = np.where(valid, off[np.arange(len(batch)), nearest], np.nan)
        error = np.sqrt(np.nanmean(own**2, axis=0))
        error = np.append(error, np.full(len(self._times) - count, error[-1]))
        spread = np.sqrt(plain.spread**2 + error**2)
        scored = replace(plain, states=plain.states[:, :, :count], spread=spread[:, :, :count])
        scores = conformal_scores(scored, truth, lengths)
        self.calibration = TwinCalibration(len(batch), self._times, error, quantiles_of(scores))
        return self.calibration

    def _see(self, scenes: Scenes) -> list[SeenObject]:
        """The object of each action, in that action's frame."""
        source = scenes.source
        if isinstance(source, Candidates):  # one object, looked at once
            seen = self._look(source.view.mask, source.view.height, None)
            return [
                replace(seen, T_action_object=action.T_action_object @ seen.T_action_object)
                for action in source.actions
            ]
        return [
            self._look(mask, height, corners[:number])
            for mask, height, corners, number in zip(
                source.mask, source.height, source.corners, source.num_corners, strict=True
            )
        ]

    def _look(
        self, mask: np.ndarray, height: np.ndarray, corners: Float[np.ndarray, "n 2"] | None
    ) -> SeenObject:
        """The object of a view; a known one where its recorded corners are, or where it fits the mask."""
        if self.object is None:
            return see_object(mask, height)
        found = match_corners(self.object, corners) if corners is not None and len(corners) else None
        return found or locate_object(self.object, mask)

    def _worlds(self, scenes: Scenes, row: int, seen: SeenObject) -> list[World]:
        """The world of an action, or the worlds, as they may be by what is told."""
        values = dict(zip(self.context, scenes.context[row].tolist(), strict=True))
        told = {name for name, value in values.items() if np.isfinite(value)}
        physics = Physics(**{name: values[name] for name in told if name in Physics.__dataclass_fields__})
        if self.object is not None or not isinstance(seen.model, Prism):  # it has its own bevel, or none
            told |= {*BEVELS}
        model = self._weighted(seen, scenes.com[row], physics.density)
        world = World(model, seen.T_action_object, self._action(scenes, row, values), physics)
        unsure = [name for name in CONSTANTS if name not in told]
        if not unsure and self.config.sees_height:
            return [world]
        if self.config.sees_height:
            told.add("thickness_factor")
        shares = draw_shares(self.config.worlds, self.config.seed)
        noise = 0.0 if self.object is not None else self.config.outline_noise
        told |= {f"{name}_factor" for name in BEVELS if name in told}
        if self.object is not None:
            told.add("thickness_factor")
        return [vary(world, tuple(told), self.config.ranges, noise, each) for each in shares]

    def _rimmed(self, scenes: Scenes, row: int, seen: SeenObject) -> SeenObject:
        """The object with the bevel that is told; where it bears no such one, with its own, and a note."""
        model = seen.model
        if self.object is not None or not isinstance(model, Prism):
            return seen
        width, height = (float(scenes.context[row, self.context.index(name)]) for name in BEVELS)
        width = model.bevel.width if np.isnan(width) else width
        height = model.bevel.height if np.isnan(height) else height
        if (width, height) == (BEVEL.width, BEVEL.height):  # the usual one, as it fits the object
            return seen
        try:
            return replace(seen, model=Prism(model.corners, model.height, Bevel(width, height)))
        except ShapeError:
            own = model.bevel
            note = (
                f"a bevel of {1e3 * width:.3g} x {1e3 * height:.3g} mm does not fit the object: it is simulated with "
                f"one of {1e3 * own.width:.3g} x {1e3 * own.height:.3g} mm"
            )
            return replace(seen, notes=(*seen.notes, note))

    def _weighted(self, seen: SeenObject, com: Float[np.ndarray, "3"], density: float) -> ObjectModel:
        """The object with its centre of mass where it is known to be, if that is not where it would be anyway."""
        own = seen.model.mass_properties(density).com
        there = transform_points(seen.T_action_object, own[None])[0]
        off = seen.T_action_object[:2, :2].T @ (com - there)[:2]
        if self.object is not None or np.linalg.norm(off) < OFF_CENTRE:
            return seen.model
        return Weighted(seen.model, off)

    def _action(self, scenes: Scenes, row: int, values: dict[str, float]) -> LeverUp:
        """The action by its path; its place does not matter.

        Raises:
            PredictionError: It is no lever-up, or its path is impossible.
        """
        if isinstance(scenes.source, Candidates):
            action = scenes.source.actions[row]
            if not isinstance(action, LeverUp):
                raise PredictionError(f"candidate {row} is a {action.label}: the twin plays lever-ups")
            return action
        settings = {name: values[name] for name in LeverUp.units if np.isfinite(values[name])}
        try:
            return LeverUp((0.0, 0.0), (1.0, 0.0), _path(settings))
        except ActionError as error:
            raise PredictionError(f"the twin cannot play the action: {error}") from error


def _path(settings: dict[str, float]) -> ToolPath:
    """The nominal path with other parameters: bit for bit the nominal one where they are nominal."""
    return NOMINAL if settings == NOMINAL.parameters() else ToolPath.of(**settings)
