"""The experiment on plans: rules by hand, and its summary from made-up rows."""

import numpy as np
import pandas as pd
import pytest

import foretrace as ft
from foretrace.errors import ResultsError
from foretrace.experiments.planning import Planning
from foretrace.experiments.planning_report import GOALS, METHODS, report_of, summary_of
from foretrace.experiments.planning_rules import ClosedForm, choose_by_rule
from foretrace.geometry import quaternion_to_matrix as matrix
from foretrace.geometry import tilt

SLAB = np.array([[-0.1, -0.05], [0.1, -0.05], [0.1, 0.05], [-0.1, 0.05]])


def test_closed_form_turns_a_slab_about_its_far_edge():
    """A rigid slab levered at the middle of its left edge turns about its right edge: angle and path are known."""
    box = ft.Box(0.2, 0.1, 0.02)
    action = ft.LeverUp.at_edge(box, 3)
    imagined = ClosedForm().imagine(ft.TopDownView.of(box, action), action)
    rise = np.ptp(action.path.at(imagined.times)[:, 1])
    angle = np.arcsin(rise / 0.2)
    futures = imagined.futures
    states = futures.states[0, 0]
    assert np.linalg.norm(states[-1, 3:]) == pytest.approx(angle, abs=0.01)
    assert states[-1, 4] == pytest.approx(-angle, abs=0.02) or states[-1, 4] == pytest.approx(angle, abs=0.02)
    assert states[-1, 2] - states[0, 2] == pytest.approx(
        0.1 * np.sin(angle) - 0.01 * (1 - np.cos(angle)), abs=2e-3
    )
    assert futures.outcomes()["levered"] == 1
    assert tilt(matrix(futures.pose[0, 0, -1, 3:])) == pytest.approx(angle, abs=0.01)


def test_rules_take_the_contacts_that_they_are_named_after():
    contacts = np.array([[0.0, -0.05], [0.1, 0.0], [0.09, 0.05], [-0.05, 0.05]])
    assert choose_by_rule("longest edge", contacts, SLAB, np.zeros(2)) == 0
    assert choose_by_rule("far", contacts, SLAB, np.zeros(2)) == 2


def rows_of(costs: dict[str, float]) -> pd.DataFrame:
    rng = np.random.default_rng(0)
    rows = [
        {"family": "box", "number": number, "goal": goal, "world": "nominal", "method": method,
         "cost": cost * scale, "reached": -cost, "slipped": 0.1, "seconds": 0.02}
        for number, scale in enumerate(rng.uniform(1, 2, size=12))
        for goal in GOALS
        for method, cost in costs.items()
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_summary_of_known_costs():
    costs = {"random": 0.0, "learned": -0.75, "twin": 0.25, "oracle": -1.0}
    summary = summary_of(rows_of(costs))["nominal"]
    assert summary["objects"] == 12
    found = summary["methods"]
    assert found["learned"]["closed"] == {"mean": 0.75, "low": 0.75, "high": 0.75}
    assert found["twin"]["closed"]["mean"] == -0.25
    assert found["oracle"]["closed"]["mean"] == 1
    assert found["learned"]["success, relative"]["mean"] == pytest.approx(0.75)
    assert found["learned"]["slips"]["mean"] == pytest.approx(0.1)
    report = report_of({"nominal": summary}, rows_of(costs))
    assert "| planner, learned | 75.0 % [75.0, 75.0]" in report
    assert list(found) == [name for name in METHODS if name in costs]


def test_options_that_make_no_sense():
    for settings in ({"objects": -1}, {"contacts": 2}, {"worlds": ("mars",)}):
        with pytest.raises(ResultsError):
            Planning(**settings)
    with pytest.raises(ResultsError, match="family 'blob'"):
        Planning(families=("blob",)).trials()
    assert Planning(objects=0).identity() is None
