"""What is in a data set, in a few figures."""

from typing import Any

import numpy as np

from foretrace.geometry import quaternion_to_matrix, support_edge, tilt
from foretrace.interactions.dataset import Dataset
from foretrace.interactions.record import Interaction, Outcome

CM, MM = 100.0, 1000.0
VARIABLE = ("density", "friction", "tool_friction", "execution_ahead", "execution_left", "execution_turn")
"""Columns that may be drawn anew for every interaction, as well as the actions' parameters."""


def describe_dataset(dataset: Dataset) -> dict[str, Any]:
    """Outcomes, and medians over the levered interactions.

    Args:
        dataset: The interactions.

    Returns:
        ``outcomes`` (counts), ``outcomes_by_kind`` (the same for each kind of object), ``outcomes_by_action`` (the same
        for each action), ``interactions``, ``varies`` (least and greatest value of what is not the same in all
        interactions: constants, execution error, height and bevel; SI units), ``fell_off_the_table`` (count),
        ``median_rolled_cm`` (distance that the rolled ones went, if there are any), and
        for the levered ones: ``median_final_tilt_deg``,
        ``median_final_rise_cm`` of the centre of mass, ``median_slide_mm`` of the centre of mass along the table before
        the lift, ``largest_path_error_mm`` of the blade, ``two_support_corners`` (share of lever-ups with exactly two
        observed support corners) and ``rule_agreement`` (share of those whose corners the closed-form rule of
        ``geometry.support_edge`` names); the last two are left out where no corners were observed.
    """
    outcome = dataset.index["outcome"].to_numpy()
    levered = dataset[outcome == Outcome.LEVERED]
    rows = np.fromiter(map(_describe, levered), np.dtype((float, 6)), len(levered))
    kinds, sizes = _shapes(dataset)
    actions = dataset.index["action"].to_numpy()
    figures: dict[str, Any] = {
        "outcomes": dataset.outcomes(),
        "outcomes_by_kind": {str(kind): dataset[kinds == kind].outcomes() for kind in np.unique(kinds)},
        "outcomes_by_action": {
            str(action): dataset[actions == action].outcomes() for action in np.unique(actions)
        },
        "interactions": len(dataset),
        "varies": _ranges(dataset, sizes),
        "fell_off_the_table": dataset.index["fall_index"].drop_null().length(),
    }
    rolled = (interaction.effect.com_trajectory[:, :2] for interaction in dataset[outcome == Outcome.ROLLED])
    if distances := [np.linalg.norm(path[-1] - path[0]) for path in rolled]:
        figures["median_rolled_cm"] = float(CM * np.median(distances))
    if not len(rows):
        return figures
    angle, rise, slide, error, observed, right = rows.T
    figures |= {
        "median_final_tilt_deg": float(np.median(angle)),
        "median_final_rise_cm": float(np.median(rise)),
        "median_slide_mm": float(np.median(slide)),
        "largest_path_error_mm": float(error.max()),
    }
    if observed.any():  # recordings show none
        figures["two_support_corners"] = float((observed == 2).mean())
    if (observed == 2).any():
        figures["rule_agreement"] = float(right[observed == 2].mean())
    return figures


def _shapes(dataset: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """(n,) kinds of the objects, and (n, 3) heights, and widths and heights of bevels [m]; NaN for what one lacks."""
    names: dict[str, int] = {}
    none = (np.nan, np.nan)
    found = (
        (names.setdefault(obj["kind"], len(names)), obj.get("height", np.nan), *(obj.get("bevel") or none))
        for obj in dataset.objects()
    )
    numbers = np.fromiter(found, np.dtype((float, 4)), len(dataset))
    return np.array([*names, ""])[numbers[:, 0].astype(int)], numbers[:, 1:]


def _ranges(dataset: Dataset, sizes: np.ndarray) -> dict[str, tuple[float, float]]:
    """Least and greatest value of each quantity that is not the same in all interactions."""
    columns = {name: dataset.index[name].to_numpy() for name in VARIABLE} | dataset.parameters
    for name, values in zip(("height", "bevel_width", "bevel_height"), sizes.T, strict=True):
        columns[name] = values[~np.isnan(values)]
    return {
        name: (float(values.min()), float(values.max()))
        for name, values in columns.items()
        if len(values) and values.min() < values.max()
    }


def _describe(interaction: Interaction) -> tuple[float, float, float, float, int, bool]:
    effect, obj = interaction.effect, interaction.object
    com = effect.com_trajectory
    angle = tilt(quaternion_to_matrix(effect.pose_trajectory[:, 3:]))
    # The lift begins where the blade tip leaves the table by more than a millimetre.
    raised = effect.tool_trajectory[:, 2] > effect.tool_trajectory[0, 2] + 1e-3
    slide = np.linalg.norm(com[int(raised.argmax()), :2] - com[0, :2])
    observed = effect.support_corners
    com_in_object = obj.mass_properties(interaction.physics.density).com[:2]
    # A round object stands on a line, not on a face with edges.
    named = (
        () if obj.is_round else support_edge(obj.support_corners, interaction.action.contact, com_in_object)
    )
    return (
        float(np.rad2deg(angle[-1])),
        float(CM * (com[-1, 2] - com[0, 2])),
        float(MM * slide),
        float(MM * effect.path_error),
        len(observed),
        observed == named,
    )
