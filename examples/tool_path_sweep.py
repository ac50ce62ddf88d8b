"""Vary how far the blade is pushed under the object and how far it is lifted; see what becomes of the object.

python examples/tool_path_sweep.py
"""

import numpy as np

import foretrace as ft
from foretrace.geometry import quaternion_to_matrix, tilt

INSERTIONS = (0.004, 0.012, 0.022)
"""How far the tip goes past the contact point [m]; the last one is the default."""
SWEEPS = (0.4, 0.75, 1.2)
"""Angle of the arc on which the tip is lifted [rad]; the middle one is the default."""


def main() -> None:
    prism = ft.sample_prism(np.random.default_rng(2), num_corners=5)
    action = ft.LeverUp.at_edge(prism, edge=2, fraction=0.5)
    print("insertion   sweep     outcome   largest tilt   rise   time on the blade")
    for insertion in INSERTIONS:
        for sweep in SWEEPS:
            path = ft.ToolPath(insertion=insertion, sweep=sweep)
            effect = ft.simulate(prism, action, embodiment="tool", path=path).effect
            angle = np.rad2deg(tilt(quaternion_to_matrix(effect.pose_trajectory[:, 3:]))).max()
            rise = 100 * (effect.com_trajectory[:, 2].max() - effect.com_trajectory[0, 2])
            lost = effect.times[-1] if effect.slip_index is None else effect.times[effect.slip_index]
            print(
                f"{1000 * insertion:6.0f} mm {np.rad2deg(sweep):5.0f} deg {effect.outcome!s:>10}"
                f" {angle:10.1f} deg {rise:5.1f} cm {lost:10.2f} s"
            )


if __name__ == "__main__":
    main()
