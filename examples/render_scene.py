"""Render the arm, the screwdriver and an object at four moments of a lever-up."""

import sys
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

import foretrace as ft
from foretrace.actions import Screwdriver
from foretrace.simulation.camera import make_renderer
from foretrace.simulation.scene import build_scene

HEIGHT, WIDTH = 420, 560


def main(out: Path) -> None:
    prism = ft.Prism([(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)])
    interaction = ft.simulate(prism, ft.LeverUp.at_edge(prism, edge=2, fraction=0.4))
    spec = build_scene(prism, ft.Physics(), Screwdriver(), "arm", timestep=0.002)
    sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_FLAT}
    spec.add_texture(name="sky", rgb1=[0.93, 0.95, 0.97], width=16, height=16, **sky)
    model = spec.compile()
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    camera.lookat[:] = (-0.25, 0.0, 0.2)
    camera.distance, camera.azimuth, camera.elevation = 1.5, 125.0, -18.0
    effect = interaction.effect
    pictures = []
    with make_renderer(model, HEIGHT, WIDTH) as renderer:
        for k in np.linspace(2, len(effect.times) - 1, 4).round().astype(int):
            data.qpos[:7], data.qpos[7:] = effect.pose_trajectory[k], effect.joint_trajectory[k]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            pictures.append(renderer.render().copy())
    rows = [np.hstack(pictures[:2]), np.hstack(pictures[2:])]
    Image.fromarray(np.vstack(rows)).save(out)
    print(f"{out}: {interaction.effect.outcome}, at {len(pictures)} moments")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("scene.png"))
