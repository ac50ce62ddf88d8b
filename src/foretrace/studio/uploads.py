"""Uploads that are too large are dropped while they arrive; viser itself takes files of any size."""

from collections.abc import Callable
from typing import Any

from viser._messages import FileTransferPart, FileTransferStartUpload

from foretrace.studio.shapes import MOST_BYTES, too_large

MOST_AT_ONCE = 4
"""Files that may be on their way at once."""


def bound_uploads(gui: Any, tell: Callable[[str], None]) -> None:
    """Drop files larger than `MOST_BYTES`, and those beyond `MOST_AT_ONCE`.

    Args:
        gui: The visitor's panel, in viser, which keeps what arrives to itself.
        tell: Called with what is said of a file that is dropped.
    """
    arriving: dict[str, dict[str, Any]] = gui._current_file_upload_states

    def check(_: int, message: FileTransferStartUpload | FileTransferPart) -> None:
        if (state := arriving.get(message.transfer_uuid)) is None:
            return
        size = max(int(state["total_bytes"]), int(state["transferred_bytes"]))
        if size <= MOST_BYTES and len(arriving) <= MOST_AT_ONCE:
            return
        del arriving[message.transfer_uuid]
        name = str(state["filename"])
        busy = f"{MOST_AT_ONCE} files are on their way already: send {name} afterwards"
        tell(too_large(name, size) if size > MOST_BYTES else busy)

    for kind in (FileTransferStartUpload, FileTransferPart):
        gui._websock_interface.register_handler(kind, check)
