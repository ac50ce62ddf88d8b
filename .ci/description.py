"""The description of the built package: README, its links to files of the repository made absolute.

FORETRACE_URL is the address below which the repository's files are served, such as https://host/owner/foretrace/raw/main;
without it links stay as they are.
"""

import os
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

RELATIVE = re.compile(r"\]\((?!\w+:|#)([^)\s]+)\)")


def absolute(text: str, url: str) -> str:
    """Markdown whose links to files lead below an address."""
    return RELATIVE.sub(lambda match: f"]({url.rstrip('/')}/{match.group(1)})", text)


class Description(MetadataHookInterface):
    """Called by hatchling."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Add the description."""
        text, url = Path(self.root, "README.md").read_text(encoding="utf-8"), os.environ.get("FORETRACE_URL")
        text = absolute(text, url) if url else text
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
