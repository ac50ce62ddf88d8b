"""List the licences of all installed packages that foretrace pins, as Markdown; `make licences` runs it.

The exit status is 1 if one of them could not be distributed beside an MIT licence, or does not say what it is.
"""

import re
import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement

PINS = Path(__file__).parents[1] / "requirements.lock"
NAMES = {
    "MIT": r"\bMIT\b|Expat",
    "BSD": r"BSD|\b0BSD\b",
    "Apache-2.0": r"Apache",
    "MPL-2.0": r"MPL|Mozilla Public",
    "PSF": r"PSF|Python Software Foundation",
    "ISC": r"\bISC\b",
    "Zlib": r"\bzlib\b",
    "HPND": r"HPND|CMU",
    "Unlicense": r"Unlicense|public domain",
    "any OSI licence": r"any-OSI",
    "LGPL": r"LGPL|Lesser General Public",
    "GPL": r"(?<![AL])GPL|(?<!Lesser )General Public",
}
"""Short names of licences, by what metadata say."""


def main() -> int:
    """Print the table; exit status."""
    needed = _needed()
    pins = [line.split("==")[0] for line in PINS.read_text().splitlines() if "==" in line]
    odd = []
    print("| Package | Version | Licence | For |\n| --- | --- | --- | --- |")
    for name in sorted({"torch", *pins}, key=str.lower):
        try:
            found = distribution(name)
        except PackageNotFoundError:
            continue
        licence = licence_of(found)
        use = "foretrace" if _plain(name) in needed else "extras and development"
        print(f"| {name} | {found.version.partition('+')[0]} | {licence} | {use} |")
        if licence == "unknown" or "GPL" in licence:
            odd.append(f"{name}: {licence}, for {use}")
    if odd:
        print(f"\nto look at: {'; '.join(odd)}", file=sys.stderr)
    return int(bool(odd))


def licence_of(found: Distribution) -> str:
    """Short names of a package's licences."""
    meta = found.metadata
    said = [meta.get("License-Expression") or ""]
    if not said[0]:
        said = [each for each in meta.get_all("Classifier") or [] if each.startswith("License ::")]
        said.append((meta.get("License") or "")[:120])
    text = " ".join(said)
    return ", ".join(name for name, pattern in NAMES.items() if re.search(pattern, text)) or "unknown"


def _needed() -> set[str]:
    """Names of what foretrace needs without extras, and of what that needs."""
    waiting, needed = ["foretrace"], set()
    while waiting:
        try:
            requires = distribution(waiting.pop()).requires or []
        except PackageNotFoundError:
            continue
        for each in map(Requirement, requires):
            name = _plain(each.name)
            if name not in needed and (each.marker is None or each.marker.evaluate({"extra": ""})):
                needed.add(name)
                waiting.append(name)
    return needed


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


if __name__ == "__main__":
    sys.exit(main())
