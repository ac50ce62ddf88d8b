"""Three objects with one outline from above, levered in the same way: the paper's figure 16."""

import sys
from pathlib import Path

import foretrace as ft
from foretrace.objects import Cylinder, look_alikes
from foretrace.pictures.look_alikes import non_flat_figure


def main(out: Path) -> None:
    lying = Cylinder(radius=0.025, length=0.12)
    alike = dict(zip(("cylinder", "box", "flat prism"), look_alikes(lying), strict=True))
    interactions = {
        name: ft.simulate(obj, ft.LeverUp.at_edge(obj, edge=0, fraction=0.4), watch_time=1.5)
        for name, obj in alike.items()
    }
    for name, interaction in interactions.items():
        com = interaction.effect.com_trajectory
        print(
            f"{name}: {interaction.effect.outcome}, {100 * (com[-1, 0] - com[0, 0]):.1f} cm along the action"
        )
    non_flat_figure({name: interactions[name] for name in ("box", "cylinder")}).savefig(out)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("figure-16.png"))
