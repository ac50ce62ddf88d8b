"""The studio's server: a page of its own for each visitor."""

import gc
import socket
import time
import warnings
from contextlib import redirect_stdout
from io import StringIO
from threading import Lock
from typing import Any

import viser

from foretrace.errors import ForetraceError, StudioError
from foretrace.interactions.dataset import Dataset
from foretrace.studio.choices import Choices
from foretrace.studio.page import Page
from foretrace.studio.session import learned

MOST_VISITORS = 16
"""Visitors at once, at most."""


class StudioServer:
    """Serves the studio until it is stopped.

    Args:
        host: Address to listen at; the default is this machine alone.
        port: Port; 0: any that is free.
        choices: What is chosen at first.
        data: Data set that visitors can take objects from.
        dark: Dark page.

    Raises:
        StudioError: The address cannot be listened at.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 8080,
        choices: Choices | None = None,
        data: Dataset | None = None,
        dark: bool = False,
    ) -> None:
        self._first, self._data = Choices() if choices is None else choices, data
        self.pages: dict[int, Page] = {}
        """Every visitor's page, by the number of the connection."""
        self._lock = Lock()
        learned()
        gc.collect()
        gc.freeze()  # figures refer to themselves: without all that is here now, they are collected soon
        # A visitor who leaves while something is drawn is no fault.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", module="viser")
        try:
            socket.create_server((host, 0)).close()  # at a wrong host viser tries port after port
        except OSError as error:
            raise StudioError(f"cannot listen at {host} ({error}): give another --host") from error
        try:
            with redirect_stdout(StringIO()):  # the command says where it listens
                self._server = viser.ViserServer(host=host, port=port, label="foretrace", verbose=False)
        except OSError as error:
            raise StudioError(
                f"cannot listen at {host}:{port} ({error}): give another --host or --port"
            ) from error
        self.address = f"{host}:{self._server.get_port()}"
        """Where it listens."""
        self._server.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)
        self._server.scene.world_axes.visible = False
        self._server.gui.main_panel.dock_left()
        self._server.gui.main_panel.set_width(340)
        self._server.on_client_connect(self._come)
        self._server.on_client_disconnect(self._go)

    def wait(self) -> None:
        """Serve until Ctrl-C."""
        while True:
            time.sleep(3600)

    def stop(self) -> None:
        """Close all pages, and stop."""
        for number in list(self.pages):
            self.pages.pop(number).close()
        with redirect_stdout(StringIO()):
            self._server.stop()

    def _come(self, client: Any) -> None:
        with self._lock:
            here = self._server.get_clients()
            for number in (
                self.pages.keys() - here.keys()
            ):  # whose leaving was told before their coming was dealt with
                self.pages.pop(number).close()
            if client.client_id not in here:
                return
            if len(self.pages) >= MOST_VISITORS:
                client.gui.add_markdown(f"There are {MOST_VISITORS} visitors already: come back later.")
                return
            choices, message = self._first, ""
            text, address = self._asked(client)
            try:
                choices = Choices.from_text(text) if text else self._first
            except ForetraceError as error:
                message = str(error)
            self.pages[client.client_id] = Page(client, choices, self._data, message, address)

    def _go(self, client: Any) -> None:
        with self._lock:
            if (page := self.pages.pop(client.client_id, None)) is not None:
                page.close()

    def _asked(self, client: Any) -> tuple[str, str]:
        """What the visitor's link says of the choices, and the address that it goes to; viser keeps both to itself."""
        connections = getattr(self._server._websock_server, "_live_connections", {})
        request = getattr(connections.get(client.client_id), "request", None)
        if request is None:
            return "", self.address
        return request.path.lstrip("/"), request.headers.get("Host", self.address)
