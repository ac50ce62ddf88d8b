"""Lever up a polygon in simulation; with a trained predictor, compare what it imagines with what happens.

    python examples/predict_a_polygon.py [RUN]

RUN is the folder of a training, as ``foretrace train`` or ``foretrace demo`` writes it.
"""

import sys

import numpy as np

import foretrace as ft
from foretrace.geometry import quaternion_to_matrix, tilt
from foretrace.trajectories import final_distance, mean_distance

CORNERS = [(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)]
"""A pentagon, in metres."""


def main() -> None:
    prism = ft.Prism(CORNERS, height=0.02)
    action = ft.LeverUp.at_edge(prism, edge=2, fraction=0.4)
    interaction = ft.simulate(prism, action, engine="mujoco", embodiment="arm", seed=0)
    effect = interaction.effect
    angle = np.rad2deg(tilt(quaternion_to_matrix(effect.pose_trajectory[:, 3:])))
    print(f"outcome: {effect.outcome}")
    print(f"tilt at the end: {angle[-1]:.1f} degrees")
    print(f"stood on corners {effect.support_corners}")
    print("centre of mass in the action frame, every half second:")
    for time, (x, y, z) in zip(effect.times[::10], effect.com_trajectory[::10], strict=True):
        print(f"  {time:4.2f} s   x {100 * x:6.2f} cm   y {100 * y:6.2f} cm   z {100 * z:6.2f} cm")

    view = ft.TopDownView.of(prism, action)
    print(f"seen from above: {view.mask.sum()} of {view.mask.size} pixels are the object")
    if len(sys.argv) > 1:
        imagined = ft.load_predictor(sys.argv[1]).imagine(view)
        end = len(effect.times) if effect.slip_index is None else effect.slip_index
        shared = slice(0, min(end, len(imagined.times)))
        paths = imagined.com_trajectory[shared], effect.com_trajectory[shared]
        print(f"imagined, error over the trajectory: {100 * mean_distance(*paths):.2f} cm")
        print(f"imagined, error at its end: {100 * final_distance(*paths):.2f} cm")


if __name__ == "__main__":
    main()
