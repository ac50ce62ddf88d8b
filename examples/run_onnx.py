"""What may happen to a polygon, from any exported predictor, without loading its checkpoint.

python examples/run_onnx.py [model.onnx]; by default the file of the predictor that comes with the package.
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime

import foretrace as ft
from foretrace.features import FEATURES, make_features
from foretrace.imagined.context import nominal_constants, nominal_parameters
from foretrace.interactions.dataset import InteractionBatch
from foretrace.predictor.loading import default_checkpoint

prism = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)], height=0.02)
action = ft.LeverUp.at_edge(prism, edge=2)
view = ft.TopDownView.of(prism, action)  # or TopDownView.from_mask, from_points

file = Path(sys.argv[1]) if len(sys.argv) > 1 else default_checkpoint() / "model.onnx"
try:
    session = onnxruntime.InferenceSession(file)
    about = session.get_modelmeta().custom_metadata_map
    config, context = (json.loads(about[f"foretrace.{name}"]) for name in ("config", "context"))
except Exception:  # onnxruntime's have no class in common
    sys.exit(f"{file} is missing or no predictor: give a file that `foretrace export onnx` wrote")
x, y = view.to_metres(np.argwhere(view.mask).mean(axis=0)[None])[0]
usual = dict(nominal_constants()) | dict(nominal_parameters())
inputs = {
    "mask": view.mask[None].astype(np.uint8),
    "height": view.height[None].astype(np.float32),
    "com": np.array([[x, y, view.height.max() / 2]], dtype=np.float32),
    "context": np.array([[usual[name] for name in context]], dtype=np.float32),
}
wanted = {each.name: each.shape for each in session.get_inputs()}
if "features" in wanted:
    label = config["features"]
    features = make_features(label, **config["feature_options"])
    inputs["features"] = np.zeros((1, wanted["features"][1]), dtype=np.float32)
    if FEATURES.find(label).oracle or any(True for _ in features.parameters()):
        print(f"features {label} need the effect or the training: zeros stand in for them")
    else:
        batch = InteractionBatch.from_views([view])
        inputs["features"] = features(features.inputs(batch)).detach().numpy()

found = map(np.asarray, session.run(None, {name: inputs[name] for name in wanted}))
said = {each.name: values for each, values in zip(session.get_outputs(), found, strict=True)}
path = said["com_trajectory"]
if "probability" in said:  # several futures: the most probable one
    best = said["probability"][0].argmax()
    print(f"{said['probability'][0, best]:.0%}: give or take {said['spread'][0, best, -1]:.4f} m,")
    path = path[:, best]
print(f"the centre of mass ends at {path[0, -1].round(4)} m")
