"""Simple rules that a planner is compared with."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from foretrace.actions import LeverUp
from foretrace.geometry import support_edge, transform_points
from foretrace.imagined import Futures, ImaginedBatch, Imaginer, Scenes
from foretrace.interactions.batch import Candidates
from foretrace.interactions.outline import fit_outline

STEEPEST = 1.4
"""Largest angle by which the rule turns an object [rad]."""


class ClosedForm(Imaginer):
    """The closed-form rule: the object turns about the edge that statics names, as far as the blade lifts its rim.

    It knows no slips, and nothing of friction.
    """

    @property
    def sample_times(self) -> Float[np.ndarray, " time"]:
        """Times of the imagined samples [s]."""
        return np.linspace(0.0, LeverUp((0.0, 0.0), (1.0, 0.0)).duration, 60)

    @property
    def name(self) -> str:
        """Name in messages."""
        return "closed-form"

    def imagine_scenes(self, scenes: Scenes) -> ImaginedBatch:
        """Turn the object about the edge, one action after the other."""
        times = self.sample_times
        states = np.zeros((len(scenes), len(LeverUp.outcomes), len(times), 6))
        support = np.full((len(scenes), len(LeverUp.outcomes), 2, 2), np.nan)
        outlines = self._outlines(scenes)
        for row, com in enumerate(scenes.com):
            outline, edge = outlines[row], None
            try:
                edge = outline[list(support_edge(outline, np.zeros(2), com[:2]))]
            except IndexError:  # the centre of mass, as estimated, lies on the rim
                edge = outline[np.argsort(-(outline @ com[:2]))[:2]]
            support[row] = edge
            states[row] = _turned(com, edge, LeverUp((0.0, 0.0), (1.0, 0.0)).path.at(times)[:, 1])
        probability = np.zeros(states.shape[:2])
        probability[:, 0] = 1.0
        futures = Futures(
            probability=probability,
            outcome=LeverUp.outcomes,
            states=states,
            spread=np.full(states.shape[:3], np.nan),
            support_points=support,
            quantiles=np.full(99, np.nan),
        )
        return ImaginedBatch(times, states[:, 0, :, :3], None, futures)

    def _outlines(self, scenes: Scenes) -> list[np.ndarray]:
        """The outline of each scene in its action frame [m]."""
        if isinstance(scenes.source, Candidates):
            outline = fit_outline(scenes.source.view.mask)
            flat = np.column_stack([outline, np.zeros(len(outline))])
            return [transform_points(each.T_action_object, flat)[:, :2] for each in scenes.source.actions]
        return [fit_outline(mask) for mask in scenes.source.mask]


def _turned(
    com: Float[np.ndarray, "3"], edge: Float[np.ndarray, "2 2"], tip: Float[np.ndarray, " time"]
) -> Float[np.ndarray, "time 6"]:
    """Positions [m] and rotation vectors of an object whose rim at the origin follows a tip's height [m]."""
    start = np.array([*edge[0], 0.0])
    along = np.array([*(edge[1] - edge[0]), 0.0])
    along /= max(np.linalg.norm(along), 1e-9)
    if np.cross(along, -start)[2] < 0:  # turning about it raises the origin
        along = -along
    reach = max(float(np.linalg.norm(np.cross(along, -start))), 1e-6)
    angle = np.arcsin(np.clip((tip - tip[0]) / reach, 0.0, np.sin(STEEPEST)))
    turned = angle[:, None] * along
    path = Rotation.from_rotvec(turned).apply(com - start) + start
    return np.concatenate([path, turned], axis=1)


def choose_by_rule(
    rule: str,
    contacts: Float[np.ndarray, "n 2"],
    outline: Float[np.ndarray, "corners 2"],
    com: Float[np.ndarray, "2"],
) -> int:
    """The contact that a rule takes, whatever the goal.

    Args:
        rule: ``longest edge``: the one nearest to the middle of the longest edge; ``far``: the one farthest from the
            centre of mass.
        contacts: Contacts to choose from [m].
        outline: The object's outline [m].
        com: Its centre of mass [m].
    """
    if rule == "far":
        return int(np.linalg.norm(contacts - com, axis=1).argmax())
    ends = np.roll(outline, -1, axis=0)
    longest = int(np.linalg.norm(ends - outline, axis=1).argmax())
    middle = (outline[longest] + ends[longest]) / 2
    return int(np.linalg.norm(contacts - middle, axis=1).argmin())
