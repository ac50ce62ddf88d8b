"""The command that tells of a predictor what somebody who is handed it has to know."""

from pathlib import Path

from tyro.conf import Positional


def card(run: Positional[Path], data: Path, out: Path | None = None) -> None:
    """Write a predictor's model card: data, training, errors and calibration on the test part, limits.

    Args:
        run: Folder of the training.
        data: Folder of the data set that it was trained on.
        out: File to write; by default MODEL_CARD.md in the run's folder.
    """
    from foretrace.predictor.model_card import model_card

    out = run / "MODEL_CARD.md" if out is None else out
    text = model_card(run, data)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text, encoding="utf-8")
    print(out)
