"""A visitor of the studio without a browser: speaks viser's protocol over its websocket."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import msgspec
import numpy as np
import viser
import zstandard
from websockets.sync.client import connect


class Visitor:
    """Connects, keeps what the page shows, and uses its controls by their labels."""

    def __init__(self, address: str, link: str = "") -> None:
        self.controls: dict[str, dict[str, Any]] = {}
        self.nodes: dict[str, dict[str, Any]] = {}
        self.downloads: list[str] = []
        self.drawn = 0
        self.owner = ""
        protocols = [f"viser-v{viser.__version__}"]
        self._open = ExitStack()
        self._socket = self._open.enter_context(
            connect(f"ws://{address}/{link}", subprotocols=protocols, max_size=None, compression=None)
        )
        self._send(
            "ViewerCameraMessage", wxyz=(1.0, 0, 0, 0), position=(0.0, -0.3, 0.5), fov=1.0, near=0.01, far=100.0,
            image_height=800, image_width=1280, look_at=(0.0, 0, 0), up_direction=(0.0, 0, 1),
        )  # fmt: skip

    def __enter__(self) -> "Visitor":
        return self

    def __exit__(self, *error: object) -> None:
        self._open.close()

    def look(self, until: Callable[[], bool] | None = None, seconds: float = 30.0) -> None:
        """Take in what comes until something is seen, or for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0 and not (until is not None and until()):
            try:
                self._take(self._socket.recv(timeout=min(left, 0.1)))
            except TimeoutError:
                continue
        assert until is None or until()

    def label(self, uuid: str) -> str:
        return self.controls[uuid]["label"]

    def find(self, label: str, kind: str = "") -> str:
        """A control by the beginning of its label; of that kind, if one is given."""
        for uuid, props in self.controls.items():
            if str(props.get("label", "")).startswith(label) and kind in ("", props["type"]):
                return uuid
        raise KeyError(f"{label}: {[each.get('label') for each in self.controls.values()]}")

    def set(self, label: str, value: Any) -> None:
        self._send("GuiUpdateMessage", uuid=self.find(label), updates={"value": value})

    def click(self, label: str) -> None:
        self.set(label, True)

    def upload(self, label: str, name: str, content: bytes, size: int | None = None, parts: int = 1) -> None:
        """Send the first part of a file; a size may be claimed that it does not have."""
        here = {"source_component_uuid": self.find(label), "transfer_uuid": f"{name}-{len(content)}"}
        size = len(content) if size is None else size
        self._send(
            "FileTransferStartUpload", **here, filename=name, mime_type="", part_count=parts, size_bytes=size
        )
        self._send("FileTransferPart", **here, part_index=0, content=content)

    def value(self, label: str) -> Any:
        return self.controls[self.find(label)]["value"]

    def drag(self, x: float, y: float, name: str = "/grip", modifier: str | None = None) -> None:
        """Drag a thing to a point of the table."""
        for phase in ("start", "update", "end"):
            self.move(x, y, phase, name, modifier)

    def move(
        self, x: float, y: float, phase: str = "update", name: str = "/grip", modifier: str | None = None
    ) -> None:
        """Be in the midst of dragging a thing, with the pointer at a point of the table."""
        self._send(
            "SceneNodeDragMessage", phase=phase, name=name, instance_index=None, start_position=(0.0, 0.0, 0.0),
            start_screen_pos=(0.0, 0.0), end_position=(float(x), float(y), 0.0), end_screen_pos=(0.0, 0.0),
            button="left", modifier=modifier, owner=self.owner,
        )  # fmt: skip

    def press(self, x: float, y: float) -> None:
        """Click a point of the table."""
        eye = np.array([0.0, -0.3, 0.5])
        way = np.array([x, y, 0.0]) - eye
        self._send(
            "ScenePointerMessage", event_type="click", ray_origin=eye.tolist(), ray_direction=way.tolist(),
            screen_pos=((0.5, 0.5),), modifier=None,
        )  # fmt: skip

    @property
    def html(self) -> str:
        return next(each["content"] for each in self.controls.values() if each["type"] == "GuiHtmlMessage")

    @property
    def verdict(self) -> str:
        """What the monitor says."""
        return [each["content"] for each in self.controls.values() if each["type"] == "GuiHtmlMessage"][1]

    def texts(self) -> str:
        """All Markdown of the page."""
        return "\n".join(str(each["_markdown"]) for each in self.controls.values() if "_markdown" in each)

    def _send(self, kind: str, **content: Any) -> None:
        self._socket.send(msgspec.msgpack.encode({"type": kind, **content}))

    def _take(self, window: Any) -> None:
        size = int.from_bytes(window[8:16], "little")
        inner = zstandard.ZstdDecompressor().decompress(window[16 : 16 + size])
        for message in msgspec.msgpack.decode(inner)["messages"]:
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        kind = message["type"]
        if kind == "GuiUpdateMessage":
            if message["uuid"] in self.controls:
                self.controls[message["uuid"]].update(message["updates"])
        elif kind == "FileTransferStartDownload":
            self.downloads.append(message["filename"])
        elif kind == "GuiRemoveMessage":
            self.controls.pop(message["uuid"], None)
        elif kind.startswith("Gui") and "uuid" in message and "props" in message:
            self.controls[message["uuid"]] = {
                "type": kind, "value": message.get("value"), **message["props"]
            }  # fmt: skip
        elif kind == "RemoveSceneNodeMessage":
            self.nodes.pop(message["name"], None)
        elif "name" in message and "props" in message:
            self.nodes[message["name"]] = {"type": kind, **message["props"]}
            self.drawn += message["name"] == "/path0"  # comes after the tube, and all that is expected
            self.owner = message.get("owner") or self.owner
        elif kind == "SetSceneNodeVisibilityMessage" and message["name"] in self.nodes:
            self.nodes[message["name"]]["visible"] = message["visible"]
        elif kind in ("SetPositionMessage", "SetOrientationMessage") and message["name"] in self.nodes:
            self.nodes[message["name"]].update(
                {k: v for k, v in message.items() if k in ("position", "wxyz")}
            )
