"""What may happen to a polygon, from an exported one-shot predictor, without loading the checkpoint.

python examples/run_onnx.py model.onnx
"""

import sys

import numpy as np
import onnxruntime

import foretrace as ft
from foretrace.features import Outline
from foretrace.interactions.dataset import InteractionBatch

prism = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)], height=0.02)
view = ft.TopDownView.of(prism, ft.LeverUp.at_edge(prism, edge=2))  # or TopDownView.from_mask, from_points

session = onnxruntime.InferenceSession(sys.argv[1])
num_features = session.get_inputs()[0].shape[1]
outline = Outline(heights=num_features > Outline().num_features)
features = outline.inputs(InteractionBatch.from_views([view])).numpy()
x, y = view.to_metres(np.argwhere(view.mask).mean(axis=0)[None])[0]
com = np.array([[x, y, view.height.max() / 2]], dtype=np.float32)
probability, path, turn, spread, edge = session.run(None, {"features": features, "com": com})
best = probability[0].argmax()
print(f"{probability[0, best]:.0%}: the centre of mass ends at {path[0, best, -1].round(4)} m,")
print(f"give or take {spread[0, best, -1]:.4f} m, about the edge {edge[0, best].round(3).tolist()}")
