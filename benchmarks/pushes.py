"""Pushes of one plate, by the quasi-static model and by MuJoCo, in turns.

Usage: python benchmarks/pushes.py
"""

import time

import numpy as np

import foretrace as ft
from foretrace.objects import NO_BEVEL, Footed
from foretrace.simulation.sliding import Footprint, slide

SIDE, COUNT, REPEATS = 0.09, 160, 3
PATH = ft.PushPath(distance=0.05, approach=0.0)


def main() -> None:
    """Print pushes per second of both, and their ratio."""
    corners = SIDE / 2 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    plate = Footed(ft.Prism(corners, 0.013, NO_BEVEL))
    heights = np.random.default_rng(0).uniform(-0.9, 0.9, COUNT) * SIDE / 2
    pushes = [ft.Push((-SIDE / 2, y), (1, 0), PATH) for y in heights]
    radius = pushes[0].tool.radius
    start = np.array([push.contact - radius * push.direction for push in pushes])
    motion = np.tile([PATH.distance, 0.0], (COUNT, 1))
    rates: list[tuple[float, float]] = []
    for repeat in range(REPEATS):
        begun = time.perf_counter()
        slide(Footprint(corners, plate.feet), start, motion, radius, 0.2)
        middle = time.perf_counter()
        some = pushes[10 * repeat : 10 * (repeat + 1)]
        for push in some:
            ft.simulate(plate, push, embodiment="tool")
        end = time.perf_counter()
        rates.append((COUNT / (middle - begun), len(some) / (end - middle)))
    fast, slow = np.median(rates, axis=0)
    print(
        f"quasi-static {fast:.0f} pushes/s, {COUNT} at once; MuJoCo {slow:.1f}/s; {fast / slow:.0f} times as fast"
    )


if __name__ == "__main__":
    main()
