"""Simulated lever-ups stand on the corners that recorded ones stood on."""

import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TRIALS = ROOT.parent / "shared" / "data" / "vrep_support.json"


@pytest.mark.skipif(not TRIALS.is_file(), reason="the recorded lift trials are not on this machine")
def test_support_corners_agree_with_recorded_trials() -> None:
    spec = importlib.util.spec_from_file_location(
        "support_corners", ROOT / "benchmarks" / "support_corners.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["support_corners"] = module
    spec.loader.exec_module(module)
    shares = module.agreement(module.compare_trials(TRIALS, every=7))
    assert shares["trials"] >= 95
    assert shares["simulated_as_recorded_levered"] >= 0.9
    assert shares["rule_as_recorded"] >= 0.9
