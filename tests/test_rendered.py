"""Lever-ups rendered with the arm: joints recorded or worked out from the tool, what is drawn, what is refused."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import foretrace as ft
from foretrace.cli import main
from foretrace.errors import SimulationError
from foretrace.imagined import ImaginedEffect
from foretrace.pictures.rendered import HEIGHT, WIDTH, rendered_frames
from foretrace.predictor import load_imaginer

PRISM = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])


def first_picture(interaction: ft.Interaction, imagined: ImaginedEffect | None = None) -> np.ndarray:
    try:
        return next(islice(rendered_frames(interaction, imagined), 1)).astype(int)
    except SimulationError as error:
        pytest.skip(str(error))


def test_the_arm_follows_from_the_tool_and_what_was_imagined_is_drawn() -> None:
    action = ft.LeverUp.at_edge(PRISM, 2)
    with_arm = first_picture(ft.simulate(PRISM, action))
    alone = ft.simulate(PRISM, action, embodiment="tool")
    without = first_picture(alone)
    assert with_arm.shape == without.shape == (HEIGHT, WIDTH, 3)
    assert (np.abs(with_arm - without).max(axis=2) > 40).mean() < 0.01  # the same posture
    imagined = load_imaginer().imagine(ft.TopDownView.of(PRISM, action), action)
    drawn = np.abs(first_picture(alone, imagined) - without).max(axis=2) > 10
    assert 0.0005 < drawn.mean() < 0.2


def test_the_arm_that_pushes_is_drawn() -> None:
    push = ft.Push.at_edge(PRISM, 2, path=ft.PushPath(distance=0.02, speed=0.1))
    with_arm, alone = (first_picture(ft.simulate(PRISM, push, embodiment=name)) for name in ("arm", "tool"))
    assert (np.abs(with_arm - alone).max(axis=2) > 40).mean() < 0.01  # the same posture


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--arm"], "--arm renders one interaction: choose it with --id"),
        (["--run", "r"], "--run r goes with --arm"),
    ],
)
def test_options_that_do_not_go_together(options: list[str], message: str, tmp_path: Path, capsys) -> None:
    assert main(["show", str(tmp_path), *options]) == 2
    assert message in capsys.readouterr().err
