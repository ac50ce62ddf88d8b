"""The command that shows what autoencoders retain."""

from pathlib import Path

from tyro.conf import Positional


def evaluate_reconstruction(
    runs: Positional[tuple[Path, ...]], data: Path, out: Path = Path("reconstruction.png"), columns: int = 8
) -> None:
    """Masks as the codes of autoencoders retain them, on the test part.

    Args:
        runs: Folders of trainings with features ae-256 or ae-512, of the same split.
        data: Folder of the data set that they were trained on.
        out: Picture to write.
        columns: Masks in it, at equal steps through the test part.
    """
    import numpy as np

    from foretrace.errors import PredictionError
    from foretrace.experiments.reconstruction import overlap, reconstruct_masks, reconstruction_figure
    from foretrace.interactions.dataset import Dataset
    from foretrace.predictor import load_predictor, part_of

    if not runs:
        raise PredictionError("no training given: name the folders of trainings with ae-256 or ae-512")
    if columns < 1:
        raise PredictionError(f"--columns is {columns}: show at least one mask")
    dataset = Dataset.open(data)
    parts = [part_of(run, dataset) for run in runs]
    if any(not np.array_equal(part.ids, parts[0].ids) for part in parts):
        raise PredictionError(
            "the trainings have different test parts: give trainings of the same split and seed"
        )
    batch, restored = parts[0], {}
    for run in runs:
        predictor = load_predictor(run)
        label = predictor.features.label
        restored[label if label not in restored else str(run)] = made = reconstruct_masks(predictor, batch)
        scores = overlap(batch.mask, made)
        print(
            f"{label} ({run}): IoU {scores.mean():.4f} mean, {scores.min():.4f} worst of {len(batch)} test masks"
        )
    shown = np.linspace(0, len(batch) - 1, min(columns, len(batch))).round().astype(int)
    out.parent.mkdir(parents=True, exist_ok=True)
    reconstruction_figure(batch.mask[shown], {name: made[shown] for name, made in restored.items()}).savefig(
        out
    )
    print(out)
