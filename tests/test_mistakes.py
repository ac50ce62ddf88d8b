"""Mistakes of a user in Python are one-line errors of the package, also where no type checker runs."""

import subprocess
import sys

PROGRAM = """
import foretrace as ft

box = ft.Box(0.15, 0.14, 0.02)
action = ft.LeverUp.at_edge(box, 0)
view = ft.TopDownView.of(box, action)
predictor = ft.load_predictor()
for call in (
    lambda: ft.replay(view),
    lambda: ft.simulate(action, box),
    lambda: predictor.imagine(box),
    lambda: predictor.imagine_candidates(view, action),
    lambda: predictor.imagine_candidates(view, [action, 3]),
    lambda: predictor.imagine(view, observed=view),
    lambda: ft.train_predictor("data", ft.OneShotConfig(), "run"),
    lambda: ft.train_predictor(view, "one-shot", "run"),
):
    try:
        call()
    except ft.ForetraceError as error:
        print(error)
print(repr(predictor.imagine(view)))
"""
EXPECTED = """\
interaction of type TopDownView: give an Interaction, such as dataset.with_id(12)
action of type Box: give a LeverUp or another Action
view of type Box: give TopDownView
actions of type LeverUp: give a list of actions
candidate 1 of type int: give Action
observed of type TopDownView: give an Effect, or ObservedMotion(times, poses) with\
 poses of the object in the action frame
data of type str: give InteractionBatch or Dataset
data of type TopDownView: give InteractionBatch or Dataset
"""


def test_wrong_types_are_named_with_the_remedy():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    errors, imagined = done.stdout.rsplit("ImaginedEffect", 1)
    assert errors == EXPECTED
    assert imagined.startswith("(113 samples, levered ")
    assert len(imagined) < 120


EXTENSIONS = """
import sys
from dataclasses import dataclass, field

import numpy as np
import torch

import foretrace as ft
from foretrace.actions import Rod


@dataclass(frozen=True)
class Path:
    speed: float = 0.1


@dataclass(frozen=True, eq=False)
class Rest(ft.Action):
    label, outcomes = "rest", ("rested",)
    path: Path = Path()
    tool: Rod = field(default_factory=Rod)
    duration = 0.2

    def tool_motion(self, times):
        return np.tile([-0.1, 0.0, 0.1, 0.0, 0.0, 0.0], (len(times), 1))

    def judge(self, motion, obj, com):
        return "rested"

    def parameters(self):
        return {}


class Narrow(ft.FeatureExtractor):
    label, num_features = "narrow", 2

    def inputs(self, batch):
        return torch.zeros(len(batch), 1)

    def forward(self, inputs):
        return inputs


@dataclass(frozen=True)
class StillConfig(ft.PredictorConfig):
    features: str = "none"


class Still(ft.EffectPredictor):
    label, config_class = "still", StillConfig

    def roll_out(self, features, first):
        return first[:, None].repeat(1, self.num_samples, 1)

    def training_loss(self, features, effects):
        return torch.zeros(())


box = ft.Box(0.15, 0.13, 0.02)
lever_up = ft.LeverUp.at_edge(box, 0)
data = ft.InteractionBatch.from_interactions([ft.simulate(box, lever_up, embodiment="tool")] * 4)
loop = ft.TrainConfig(epochs=1, min_steps=1, split=(2, 1, 1))
for call in (
    lambda: ft.simulate(box, Rest(lever_up.contact, lever_up.direction), embodiment="tool"),
    lambda: ft.train_predictor(data, ft.LstmConfig(features="narrow"), sys.argv[1] + "/a", loop, progress=False),
    lambda: ft.train_predictor(data, StillConfig(), sys.argv[1] + "/b", loop, progress=False),
):
    try:
        call()
    except ft.ForetraceError as error:
        print(error)
"""


def test_mistakes_in_extensions_are_named(tmp_path):
    command = [sys.executable, "-c", EXTENSIONS, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [
        "action 'rest' was judged 'rested': its judge is to return a Judgement",
        "features 'narrow' have the shape (2, 1) for 2 interactions: num_features is 2",
        "predictor 'still' has no parameters to train: create them in __init__",
    ]
