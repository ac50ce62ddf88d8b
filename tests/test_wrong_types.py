"""Arguments of a wrong type are one-line errors of the package, also where no type checker runs."""

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
TopDownView is no interaction: give one, such as dataset.with_id(12)
Box is no action: give a LeverUp or another Action
view of type Box: give TopDownView
actions of type LeverUp: give a list of actions
candidate 1 of type int: give Action
observed of type TopDownView: give an Effect, or ObservedMotion(times, poses) with\
 poses of the object in the action frame
data of type str: give a Dataset or an InteractionBatch
data of type TopDownView: give a Dataset or an InteractionBatch
"""


def test_wrong_types_are_named_with_the_remedy():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    errors, imagined = done.stdout.rsplit("ImaginedEffect", 1)
    assert errors == EXPECTED
    assert imagined.startswith("(90 samples, levered ")
    assert len(imagined) < 120
