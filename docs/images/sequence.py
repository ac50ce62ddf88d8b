"""Draws docs/images/sequence.gif: a plate is pushed to a pose by several pushes, planned again after each."""

from pathlib import Path

import numpy as np

import foretrace as ft
from foretrace.geometry import planar_transform
from foretrace.objects import NO_BEVEL, Footed
from foretrace.pictures.sequence import sequence_animation
from foretrace.simulation.world import SimulatedWorld

corners = [(0.09, 0.0), (0.02, 0.08), (-0.07, 0.05), (-0.08, -0.04), (0.03, -0.08)]
plate = ft.Prism([(0.6 * x, 0.6 * y) for x, y in corners], 0.013, NO_BEVEL)
goal = ft.goals.MoveTo((0.11, 0.08), turn=-0.8, tolerance=0.005, turn_tolerance=np.deg2rad(5))
config = ft.SimulationConfig(
    embodiment="tool", timestep=0.004, sample_period=0.04, physics=ft.Physics(tool_friction=0.2)
)
world = SimulatedWorld(Footed(plate, "rim"), config, seen=plate)
done = ft.execute_sequence(world, goal, 5, ft.SlidingTwin(), config=ft.PlanConfig(spacing=0.02, refine=3))
print(done.reached, [sequence.cost for sequence in done.sequences], done.cost)
middle = plate.mass_properties(1.0).com[:2]
T = planar_transform([0.0, 0.0, 0.0], goal.turn or 0.0)
T[:2, 3] = np.array(goal.position) - T[:2, :2] @ middle
sequence_animation(
    done, world.played, plate.corners, T, Path(__file__).with_suffix(".gif"), "To a pose by pushes"
)
