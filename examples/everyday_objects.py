"""Objects of the recipe ``everyday``, each row a family, and where they are levered."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from foretrace.simulation.recipes import RECIPES, object_and_actions

NAMES = {0: "prisms", 3: "look-alikes", 6: "oval", 7: "rounded", 8: "organic", 9: "dented"}
COLUMNS = 9


def main(out: Path) -> None:
    turn = len(RECIPES["everyday"].families)
    figure, axes = plt.subplots(len(NAMES), COLUMNS, figsize=(COLUMNS, len(NAMES)), layout="constrained")
    for row, (place, name) in zip(axes, NAMES.items(), strict=True):
        for k, ax in enumerate(row):
            obj, actions = object_and_actions("everyday", 0, turn * k + place, 2)
            ax.fill(*obj.corners.T, facecolor="#cfe3f1", edgecolor="#0072b2", linewidth=0.8)
            starts = np.array([action.contact - 0.025 * action.direction for action in actions])
            arrows = 0.025 * np.array([action.direction for action in actions])
            ax.quiver(
                *starts.T, *arrows.T, angles="xy", scale_units="xy", scale=1, color="#d55e00", width=0.02
            )
            ax.set(xlim=(-0.14, 0.14), ylim=(-0.14, 0.14), aspect="equal")
            ax.axis("off")
        row[0].set_title(name, loc="left", fontsize=8, pad=2)
    figure.savefig(out, dpi=150)
    print(out)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("everyday.png"))
