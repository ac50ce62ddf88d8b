"""Effects that must not change unnoticed: recorded once, compared ever since.

After a change that is meant to change them, run ``pytest tests/test_golden.py --update-golden`` and look at the diff.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from foretrace.simulation.collect import CollectConfig, simulate_trial
from foretrace.simulation.lever_up import SimulationConfig

GOLDEN = Path(__file__).parent / "golden"
TRIALS = {"arm": (31, 60), "tool": (31, 50, 77)}
"""Levered trials of the first eight objects, well away from a change of outcome."""


@pytest.mark.parametrize(("embodiment", "id"), [(name, id) for name, ids in TRIALS.items() for id in ids])
def test_lever_up_is_as_recorded(embodiment: str, id: int, request: pytest.FixtureRequest) -> None:
    config = CollectConfig(objects=8, simulation=SimulationConfig(embodiment=embodiment))
    interaction = simulate_trial(config, id)
    effect = interaction.effect
    now = {
        "corners": np.round(interaction.object.corners, 9).tolist(),
        "outcome": str(effect.outcome),
        "support_corners": list(effect.support_corners),
        "mask_pixels": int(interaction.view.mask.sum()),
        "com_mm": np.round(1000 * effect.com_trajectory[::6], 3).tolist(),
    }
    file = GOLDEN / f"{embodiment}-{id}.json"
    if request.config.getoption("--update-golden"):
        file.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    golden = json.loads(file.read_text(encoding="utf-8"))
    for name in ("corners", "outcome", "support_corners", "mask_pixels"):
        assert now[name] == golden[name], name
    # Other processors round differently, and contacts amplify that: a tenth of a millimetre.
    np.testing.assert_allclose(now["com_mm"], golden["com_mm"], atol=0.1)
