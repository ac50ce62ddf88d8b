"""Look the pinned versions up in the database of known vulnerabilities; `make audit` runs it.

pip-audit calls a package that it cannot look up "skipped", and a run in which all are skipped a success: the two are
told apart here.
"""

import json
import subprocess
import sys
from pathlib import Path

PINS = Path(__file__).parents[1] / "requirements.lock"


def main() -> int:
    """Exit status: 1 if a pinned version has a known vulnerability."""
    command = [
        sys.executable,
        "-m",
        "pip_audit",
        "--requirement",
        str(PINS),
        "--disable-pip",
        "--format",
        "json",
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    try:
        found = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        reason = done.stderr.strip().splitlines()[-1:] or ["no reason given"]
        print(f"skipped: the database of vulnerabilities cannot be reached ({reason[0][:200]})")
        return 0
    known = [each for each in found if each.get("vulns")]
    missing = [each["name"] for each in found if "skip_reason" in each]
    for each in known:
        print(f"{each['name']} {each['version']}: {', '.join(one['id'] for one in each['vulns'])}")
    if len(missing) == len(found):
        print(f"skipped: the database of vulnerabilities answers for none of {len(found)} pinned versions")
    else:
        looked = f"{len(found) - len(missing)} of {len(found)} pinned versions looked up, {len(known)} with known ones"
        print(looked + (f"; not looked up: {', '.join(missing)}" if missing else ""))
    return int(bool(known))


if __name__ == "__main__":
    sys.exit(main())
