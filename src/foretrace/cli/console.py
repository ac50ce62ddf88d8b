"""What the commands say, and how."""

import sys
from typing import Any


def say(line: Any) -> None:
    """One line to the person at the terminal, beside the command's own output."""
    print(f"foretrace: {line}", file=sys.stderr)
