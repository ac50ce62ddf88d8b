"""Which pinned packages have no wheel for a platform that foretrace is not tested on: macOS and Windows.

`make wheels` asks the package index through uv and installs nothing. It fails if a package is missing that is not one
of `OPTIONAL`, which only extras need.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PINS = Path(__file__).parents[1] / "requirements.lock"
PLATFORMS = {
    "Windows, x86-64": "x86_64-pc-windows-msvc",
    "macOS 14, Apple silicon": "aarch64-apple-darwin",
    "macOS 14, Intel": "x86_64-apple-darwin",
}
ABANDONED = ("macOS 14, Intel",)
"""ONNX Runtime and MuJoCo no longer build for it: told, but no failure."""
PYTHONS = ("3.11", "3.13")
OPTIONAL = {
    "pybullet",  # [bullet]
    "pyrealsense2",  # [realsense]
    "ur-rtde",  # [ur]
    "ur-analytic-ik",  # tests
}
MISSING = re.compile(
    r"Because (?:only )?([\w.-]+)(?:==\S+)? has no (?:usable )?wheels|([\w.-]+)==\S+ has no wheels"
)


def missing_wheels(uv: str, platform: str, python: str) -> list[str]:
    """Pinned packages without a wheel for a platform and a Python."""
    lines, found = PINS.read_text(encoding="utf-8").splitlines(), []
    settings = {**os.environ, "MACOSX_DEPLOYMENT_TARGET": "14.0"}
    with tempfile.TemporaryDirectory() as folder:
        pins = Path(folder) / "pins.txt"
        command = [
            uv,
            "pip",
            "install",
            "--dry-run",
            "--no-deps",
            "--only-binary",
            ":all:",
            "--target",
            f"{folder}/none",
        ]
        while True:
            pins.write_text("\n".join(lines), encoding="utf-8")
            asked = [*command, "--python-platform", platform, "--python-version", python, "-r", str(pins)]
            done = subprocess.run(asked, capture_output=True, text=True, env=settings, check=False)
            if done.returncode == 0:
                return found
            named = MISSING.search(done.stderr)
            if named is None:
                raise SystemExit(done.stderr)
            name = named[1] or named[2]
            found.append(name)
            lines = [line for line in lines if not line.startswith(f"{name}==")]


def main() -> int:
    """Exit status: 1 if a package that more than an extra needs is missing."""
    if (
        uv := shutil.which("uv", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    ) is None:
        raise SystemExit("uv is not installed: pip install uv")
    status = 0
    for name, platform in PLATFORMS.items():
        for python in PYTHONS:
            missing = missing_wheels(uv, platform, python)
            print(
                f"{name}, Python {python}: {', '.join(missing) or 'all'}{' missing' if missing else ''}",
                flush=True,
            )
            status |= name not in ABANDONED and bool(set(missing) - OPTIONAL)
    return status


if __name__ == "__main__":
    raise SystemExit(main())
