"""What one, three or ten lever-ups in another world are worth for its other objects.

The frictions are the same for all of its objects: they are identified from lever-ups of some, each once, and told when
others are imagined. Centres of mass and contact errors belong to one object and one execution, and are not carried
over. The predictor of the package identifies; it and the twin are then told. Bevels are the same for objects that are
made alike; here they also take up what engines do differently. Learned from the same lever-ups: a residual over what
was imagined with the identified constants.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from tyro.conf import Fixed, Suppress

from foretrace.actions import LeverUp
from foretrace.errors import ActionError, ResultsError, ViewError
from foretrace.evaluation.charts import GREEN, GREY, ORANGE, SKY, VERMILLION, finish, grid
from foretrace.evaluation.experiment import Experiment, Row, Trial, chosen
from foretrace.evaluation.metrics import METRICS, at_times
from foretrace.evaluation.statistics import bootstrap
from foretrace.evaluation.tables import markdown_table, mean_with_interval
from foretrace.experiments import SUMMARIES
from foretrace.experiments.monitor_calibration import predictor
from foretrace.files import short_hash
from foretrace.geometry import (
    matrix_to_pose,
    pose_to_matrix,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
    transform_points,
)
from foretrace.imagined import Belief, ImaginedBatch, Imaginer, estimate_com
from foretrace.imagined.belief import WORLD
from foretrace.imagined.context import BEVELS, nominal_constants
from foretrace.interactions.batch import InteractionBatch
from foretrace.interactions.record import ExecutionOffset, Interaction, Physics
from foretrace.monitoring import identify
from foretrace.objects import Prism, sample_prism
from foretrace.pictures.style import new_figure, styled
from foretrace.predictor.loading import default_checkpoint
from foretrace.predictor.states import valid_samples
from foretrace.simulation.lever_up import simulate_lever_up
from foretrace.simulation.stand_in import StandIn
from foretrace.twin import TwinConfig, TwinImaginer
from foretrace.twin.residual import train_residual
from foretrace.twin.residual_network import ResidualConfig

OTHER = {"friction": 0.6, "tool_friction": 0.4}
"""Frictions of the other worlds; the nominal ones are 0.8 and 0.3."""
RANGES = {name: (value, value) for name, value in OTHER.items()}
WORLDS = {
    "bullet": replace(StandIn.undisturbed("bullet", "tool"), **RANGES),
    "stand-in": replace(StandIn(engine="mujoco", embodiment="arm", sample_rate=20.0), **RANGES),
}
"""Another engine; and the whole arm, with everything that the stand-in perturbs but the frictions."""
IMAGINERS = {"learned": "the predictor of the package", "twin": "the twin"}
COUNTS = (1, 3, 10)
"""Numbers of lever-ups that are learned from."""
METHODS = {
    "nominal": GREY,
    "told": GREEN,
    "frictions": SKY,
    "frictions and bevel": ORANGE,
    "residual": VERMILLION,
}
"""What is told, with its colour; the residual is one over the identified frictions and bevel."""
SHARED = {"frictions": WORLD, "frictions and bevel": (*WORLD, *BEVELS)}
"""What is identified and carried over to other objects."""
CORRECTED = "frictions and bevel"
"""What the residual corrects."""
TEST_STREAM = 1
"""Tells the random numbers of other objects from those of the ones that are learned from."""
CM = 100.0


@dataclass(frozen=True)
class IdentifiedWorldTrial(Trial):
    """One draw of lever-ups in one world."""

    world: str
    """One of WORLDS."""
    draw: int
    """Its number."""


@dataclass(frozen=True)
class IdentifiedWorld(Experiment):
    """Identify the constants of another world from few lever-ups, and imagine its other objects."""

    draws: int = 5
    """Draws of the lever-ups that are learned from, and of the others."""
    tests: int = 40
    """Levered lever-ups of other objects, of each draw."""
    lever_ups: tuple[int, ...] = COUNTS
    """Numbers of lever-ups to learn from."""
    worlds: tuple[str, ...] = ()
    """Which worlds; by default all."""
    imaginers: tuple[str, ...] = ()
    """What imagines: learned, twin; by default both."""
    seed: int = 977
    """Seed of the draws."""
    residual: Suppress[Fixed[ResidualConfig]] = field(default_factory=ResidualConfig)
    """Settings of residuals."""

    label = "identified-world"
    summary = SUMMARIES["identified-world"]
    trial = IdentifiedWorldTrial

    def trials(self) -> Sequence[IdentifiedWorldTrial]:
        """Draw by draw."""
        chosen("imaginer", self.imaginers, tuple(IMAGINERS))
        if min(self.draws, self.tests) < 1 or min(self.lever_ups, default=0) < 1:
            raise ResultsError(
                f"draws is {self.draws}, tests is {self.tests}, lever_ups is {self.lever_ups}: give numbers from 1 on"
            )
        worlds = chosen("world", self.worlds, tuple(WORLDS))
        return [IdentifiedWorldTrial(world, draw) for draw in range(self.draws) for world in worlds]

    def identity(self) -> dict[str, Any] | None:
        """The predictor, the seed, and what is learned from."""
        config = (default_checkpoint() / "config.json").read_bytes()
        about = {"seed": self.seed, "tests": self.tests, "lever_ups": list(self.lever_ups)}
        imaginers = chosen("imaginer", self.imaginers, tuple(IMAGINERS))
        return about | {
            "predictor": short_hash([config]), "imaginers": imaginers, "residual": asdict(self.residual)
        }  # fmt: skip

    def run(self, trial: IdentifiedWorldTrial, folder: Path) -> Sequence[Row]:
        """Errors [cm] on other objects, and the identified constants."""
        world, key = WORLDS[trial.world], [self.seed, list(WORLDS).index(trial.world), trial.draw]
        rng, other = np.random.default_rng(key), np.random.default_rng([*key, TEST_STREAM])
        learned = [tracked(levered(world, rng), world, rng) for _ in range(max(self.lever_ups))]
        test = InteractionBatch.from_interactions([levered(world, other) for _ in range(self.tests)])
        beliefs = {method: self._identified(learned, shared) for method, shared in SHARED.items()}
        rows: list[Row] = []
        for name in chosen("imaginer", self.imaginers, tuple(IMAGINERS)):
            imaginer = self._twin if name == "twin" else predictor()
            constants = dict(nominal_constants())
            for method, told in (("nominal", constants), ("told", constants | OTHER)):
                imagined = imaginer.imagine_batch(test, "estimated", context=told)
                rows.append(_row(name, method, 0, "error", _error(imagined, test)))
            for method, shared in SHARED.items():
                for count, belief in beliefs[method].items():
                    told = constants | {each: belief.mean[each] for each in shared}
                    imagined = imaginer.imagine_batch(test, "estimated", context=told)
                    rows.append(_row(name, method, count, "error", _error(imagined, test)))
                    rows += [_row(name, method, count, each, told[each]) for each in shared]
                    if method == CORRECTED:
                        corrected = self._corrected(
                            imaginer, learned[:count], told, test, imagined, trial.draw
                        )
                        rows.append(_row(name, "residual", count, "error", _error(corrected, test)))
        return rows

    def _identified(self, learned: Sequence[Interaction], shared: tuple[str, ...]) -> dict[int, Belief]:
        """What is believed of another object after each number of lever-ups."""
        belief, found = Belief(), {}
        for k, made in enumerate(learned, start=1):
            belief = identify(made.view, made.action, made.effect, belief, imaginer=predictor(), seed=k)
            found[k] = belief = belief.of_another_object(shared)
        return {count: found[count] for count in self.lever_ups}

    def _corrected(
        self,
        imaginer: Imaginer,
        learned: Sequence[Interaction],
        told: Mapping[str, float],
        test: InteractionBatch,
        imagined: ImaginedBatch,
        seed: int,
    ) -> ImaginedBatch:
        """What was imagined, corrected by a residual that the same lever-ups taught."""
        batch = InteractionBatch.from_interactions(learned)
        own = _first_samples(imaginer.imagine_batch(batch, "estimated", context=told), batch)
        config = replace(self.residual, seed=seed)
        residual = train_residual(batch, batch, self._twin, config, imagined=(own, own))
        return residual.correct(test, estimate_com(test), _first_samples(imagined, test))

    @cached_property
    def _twin(self) -> TwinImaginer:
        return TwinImaginer(config=TwinConfig(workers=1))

    def summarise(self, rows: pd.DataFrame) -> dict[str, Any]:
        """By world, imaginer, method, number of lever-ups and metric: mean over draws, 95 % bootstrap interval."""
        summary: dict[str, Any] = {}
        keys = ["world", "imaginer", "method", "lever_ups", "metric"]
        for found, values in rows.groupby(keys, sort=False)["value"]:
            world, imaginer, method, count, metric = map(str, found)  # pyright: ignore[reportArgumentType]
            place = summary.setdefault(world, {}).setdefault(imaginer, {}).setdefault(method, {})
            place.setdefault(count, {})[metric] = bootstrap(np.asarray(values)).as_dict(5)
        return summary

    def report(self, summary: Mapping[str, Any], rows: pd.DataFrame) -> str:
        """Tables of errors and of identified constants."""
        parts = [
            "# Other objects of another world",
            f"Means over {rows['draw'].nunique()} draws, with 95 % intervals (bootstrap over draws).",
        ]
        for world, by_imaginer in summary.items():
            for imaginer, found in by_imaginer.items():
                counts = sorted({int(count) for each in found.values() for count in each})
                lines = [
                    [
                        method,
                        *(
                            mean_with_interval(each.get(str(count), {}).get("error"), missing="-")
                            for count in counts
                        ),
                    ]
                    for method, each in found.items()
                ]
                parts.append(f"## Error [cm] in {world}, {IMAGINERS[imaginer]}, by the number of lever-ups")
                parts.append(markdown_table(["", *map(str, counts)], lines))
                parts.append(_constants(found))
        return "\n\n".join(parts) + "\n"

    @styled
    def figures(self, rows: pd.DataFrame) -> dict[str, Figure]:
        """Errors by the number of lever-ups, a panel for each world and imaginer."""
        summary = self.summarise(rows)
        panels = [(world, name) for world, each in summary.items() for name in each]
        if not panels:
            return {}
        fig = new_figure(3.6 * len(panels) ** 0.5 + 2.4, 3.2 * -(-len(panels) // 2) + 0.8)
        axes = np.ravel(fig.subplots(-(-len(panels) // 2), min(2, len(panels)), squeeze=False))
        for ax, (world, name) in zip(axes, panels, strict=False):
            _panel(ax, summary[world][name])
            ax.set_title(f"{world}, {name}")
            grid(ax, xlabel="lever-ups learned from", ylabel="error [cm]")
        fig.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        finish(fig, "Other objects of another world", "means over draws, 95 % bootstrap intervals")
        return {"errors": fig}


def levered(world: StandIn, rng: np.random.Generator) -> Interaction:
    """A lever-up of a new object that levers it, as recorded: with the object and view that the robot believes in."""
    while True:
        prism = sample_prism(rng, int(rng.integers(3, 11)))
        action = LeverUp.at_edge(prism, int(rng.integers(len(prism.corners))), rng.uniform(0.25, 0.75))
        drawn = world.draw(rng)
        real = Prism(prism.corners, prism.height + drawn.thickness_error, prism.bevel)
        density = Physics.density * drawn.density_factor
        config = world.simulation(Physics(density, drawn.friction, drawn.tool_friction))
        error = ExecutionOffset(drawn.contact_across, drawn.contact_along, drawn.direction_error)
        try:
            view = world.see(prism, action, drawn)
            made = simulate_lever_up(real, action, config, execution_error=error)
        except (ActionError, ViewError):
            continue
        if made.effect.outcome == "levered":
            return replace(made, object=prism, view=view)


def tracked(made: Interaction, world: StandIn, rng: np.random.Generator) -> Interaction:
    """The same with the noise of a marker that is tracked in that world."""
    effect = made.effect
    poses = pose_to_matrix(effect.pose_trajectory)
    turns = rng.normal(scale=world.marker_rotation, size=(len(poses), 3))
    poses[:, :3, :3] = quaternion_to_matrix(rotation_vector_to_quaternion(turns)) @ poses[:, :3, :3]
    poses[:, :3, 3] += rng.normal(scale=world.marker_position, size=(len(poses), 3))
    com = transform_points(poses, made.object.mass_properties(1.0).com[None, None])[:, 0]
    return replace(made, effect=replace(effect, pose_trajectory=matrix_to_pose(poses), com_trajectory=com))


def _error(imagined: ImaginedBatch, batch: InteractionBatch) -> float:
    """Mean distance over whole trajectories, mean over lever-ups [cm]."""
    truth = np.where(valid_samples(batch)[..., None], batch.com, np.nan)
    return CM * float(np.mean(METRICS["full"](at_times(imagined, batch.times), truth)))


def _first_samples(imagined: ImaginedBatch, batch: InteractionBatch) -> ImaginedBatch:
    """What was imagined, up to the last sample of a batch."""
    count = len(batch.times)
    futures = imagined.futures
    cut = replace(futures, states=futures.states[:, :, :count], spread=futures.spread[:, :, :count])
    return replace(
        imagined, times=imagined.times[:count], com=imagined.com[:, :count], pose=None, futures=cut
    )


def _row(imaginer: str, method: str, count: int, metric: str, value: float) -> Row:
    return {"imaginer": imaginer, "method": method, "lever_ups": count, "metric": metric, "value": value}


def _constants(found: Mapping[str, Any]) -> str:
    """Table of identified constants."""
    lines = [
        [
            f"{method}, {count}",
            *(f"{each[name]['mean']:.3g}" if name in each else "-" for name in (*WORLD, *BEVELS)),
        ]
        for method in SHARED
        for count, each in found.get(method, {}).items()
    ]
    return markdown_table(
        ["Identified", "friction", "of the blade", "bevel's width [m]", "height [m]"], lines
    )


def _panel(ax: Any, found: Mapping[str, Any]) -> None:
    """Errors of the methods of one imaginer in one world."""
    counts = sorted({int(count) for each in found.values() for count in each if int(count)})
    for k, (method, each) in enumerate(found.items()):
        errors = {int(count): one["error"] for count, one in each.items()}
        if 0 in errors:
            ax.axhline(errors[0]["mean"], color=METHODS[method], linestyle="--", label=method)
            continue
        at = [counts.index(count) + 0.05 * (k - 3) for count in errors]  # beside each other
        mean = np.array([one["mean"] for one in errors.values()])
        ends = np.array([[one["low"], one["high"]] for one in errors.values()], dtype=float)  # None: one draw
        apart = np.nan_to_num(np.abs(ends - mean[:, None])).T
        ax.errorbar(at, mean, apart, fmt="o-", color=METHODS[method], label=method)
    ax.set_xticks(range(len(counts)), [str(count) for count in counts])
    ax.set_ylim(bottom=0)
