"""Lever up an object that is given as an STL file.

    python examples/own_mesh.py

A wedge is built with trimesh and saved in millimetres, the usual unit of such files; ``scale`` makes metres of it.
"""

import tempfile
from pathlib import Path

import numpy as np
import trimesh

import foretrace as ft
from foretrace.errors import ShapeError

DENSITY = ft.Physics().density


def wedge() -> trimesh.Trimesh:
    """A ramp, 140 x 90 mm, 15 mm high on one side and 35 mm on the other."""
    base = [(x, y, 0.0) for x in (0.0, 140.0) for y in (0.0, 90.0)]
    top = [(x, y, 15.0 if x == 0.0 else 35.0) for x in (0.0, 140.0) for y in (0.0, 90.0)]
    return trimesh.convex.convex_hull(np.array(base + top))


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "wedge.stl"
        wedge().export(file)
        obj = ft.MeshObject.load(file, scale=0.001)
        try:
            ft.MeshObject.load(file)  # 140 m across: the unit is forgotten
        except ShapeError as error:
            print(f"without the scale: {error}")
    properties = obj.mass_properties(DENSITY)
    print(f"mass: {1000 * properties.mass:.0f} g, centre of mass {100 * properties.com[2]:.2f} cm high")

    for edge in range(len(obj.corners)):
        action = ft.LeverUp.at_edge(obj, edge)
        effect = ft.simulate(obj, action, embodiment="tool").effect
        rise = effect.com_trajectory[:, 2].max() - effect.com_trajectory[0, 2]
        print(f"edge {edge}: {effect.outcome}, centre of mass rises by up to {100 * rise:.2f} cm")


if __name__ == "__main__":
    main()
