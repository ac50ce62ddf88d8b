"""The physics engines as test parameters; one that is not installed is skipped."""

from importlib.util import find_spec

import pytest

from foretrace.simulation.engine import ENGINES

WITHOUT_BULLET = pytest.mark.skipif(find_spec("pybullet") is None, reason="pybullet is not installed")
every_engine = pytest.mark.parametrize(
    "engine", [pytest.param(name, marks=[WITHOUT_BULLET] if name == "bullet" else []) for name in ENGINES]
)
