"""Read a data set: filter it, take it as arrays, as a table, as single interactions; needs the extras sim and eval.

    python examples/read_a_data_set.py [DATA]

DATA is a folder that ``foretrace simulate`` wrote. Without it, a tiny one is made in a temporary folder.
"""

import sys
import tempfile

import numpy as np

import foretrace as ft


def tiny_data_set() -> ft.Dataset:
    """Two objects, one lever-up at each edge, the blade alone: seven interactions in a few seconds."""
    simulation = ft.SimulationConfig(embodiment="tool")
    config = ft.CollectConfig(objects=2, contacts_per_edge=1, simulation=simulation)
    with tempfile.TemporaryDirectory() as folder:
        ft.collect(config, folder, workers=1)
        return ft.Dataset.open(folder)  # whole, into memory


def main() -> None:
    dataset = ft.Dataset.open(sys.argv[1]) if len(sys.argv) > 1 else tiny_data_set()
    print(f"{len(dataset)} interactions: {dataset.outcomes()}")

    # One value, several values, or a function of the column.
    levered = dataset.where(outcome="levered", num_corners=[3, 4], path_error=lambda error: error < 1e-3)
    print(f"{len(levered)} levered ones of objects with 3 or 4 corners")

    batch = levered.batch()
    print(f"arrays: masks {batch.mask.shape}, centre of mass {batch.com.shape}, pose {batch.pose.shape}")
    rise = batch.com[np.arange(len(batch)), batch.length - 1, 2] - batch.com[:, 0, 2]
    print(f"rise of the centre of mass at the end: {np.round(100 * rise, 1)} cm")

    table = dataset.to_pandas()
    print(table[["id", "object_id", "num_corners", "outcome", "slip_index"]].to_string(index=False))

    interaction = dataset[0]
    print(f"interaction {interaction.id} was simulated with {interaction.provenance.versions}")


if __name__ == "__main__":
    main()
