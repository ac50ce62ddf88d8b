"""The physics engines as test parameters; one that is not installed is skipped."""

import os
from importlib.util import find_spec

import pytest

WITHOUT_BULLET = pytest.mark.skipif(find_spec("pybullet") is None, reason="pybullet is not installed")
WITHOUT_WARP = pytest.mark.skipif(
    find_spec("mujoco_warp") is None or not os.environ.get("FORETRACE_WARP"),
    reason="the kernels of MuJoCo Warp take minutes to compile: install foretrace[warp] and set FORETRACE_WARP=1",
)
every_engine = pytest.mark.parametrize(
    "engine",
    [pytest.param(name, marks=[WITHOUT_BULLET] if name == "bullet" else []) for name in ("mujoco", "bullet")],
)
