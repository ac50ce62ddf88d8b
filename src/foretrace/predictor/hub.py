"""A predictor's folder as model hubs expect it: configuration, tensors, and a README with facts on top."""

from pathlib import Path

from foretrace.errors import CheckpointError
from foretrace.files import as_path, write_text
from foretrace.predictor.base import EffectPredictor
from foretrace.predictor.checkpoint import save_checkpoint
from foretrace.predictor.loading import CONFIG, MODEL

CARD = "README.md"
HEAD = """\
---
library_name: foretrace
license: mit
tags:
- robotics
- manipulation
- effect-prediction
---
"""


def save_pretrained(predictor: EffectPredictor, path: str | Path) -> None:
    """Write a predictor into a folder: ``config.json``, ``model.safetensors`` and a card as ``README.md``.

    A card that the folder has is kept.

    Args:
        predictor: The predictor.
        path: The folder; made if it does not exist.

    Raises:
        CheckpointError: The folder cannot be made.
    """
    folder = as_path(path, CheckpointError)
    save_checkpoint(folder, predictor)
    if not (folder / CARD).exists():
        write_text(folder / CARD, card_of(predictor))


def card_of(predictor: EffectPredictor) -> str:
    """What the predictor is, and how it is loaded, in Markdown."""
    facts = {
        "Predictor": predictor.label,
        "Features": predictor.features.label,
        "Context": ", ".join(predictor.context) or "none",
        "Outcomes learned from": ", ".join(predictor.learned_from),
        "Samples": f"{predictor.num_samples} in {predictor.sample_times[-1]:.2f} s",
        "Weights": f"{sum(each.numel() for each in predictor.parameters()):,}",
    }
    rows = "\n".join(f"| {name} | {value} |" for name, value in facts.items())
    return f"""{HEAD}
# {predictor.display_name}

Imagines how an object moves when a robot levers it up, from a view from above, in the action frame and in SI units.

| | |
| --- | --- |
{rows}

```python
import foretrace as ft

predictor = ft.EffectPredictor.from_pretrained("this-folder")  # {CONFIG} and {MODEL}
```
"""
