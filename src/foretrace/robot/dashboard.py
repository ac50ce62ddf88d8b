"""The dashboard server of a UR controller: a text line for a text line; which arm it says it has."""

import re
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from foretrace.errors import RobotError, shown

DASHBOARD_PORT = 29999
PATIENCE = 2.0
"""How long an answer may take [s]."""
LONGEST_LINE = 1024
NAME = re.compile(r"(?=.{1,253}$)[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*")
"""Names of machines, and addresses of IPv4."""
ADDRESS_6 = re.compile(r"[0-9A-Fa-f]*:[0-9A-Fa-f:.]*:[0-9A-Fa-f.]*(%\w+)?")
MODEL, SERIES = "UR10", 3
"""The arm whose kinematics is used: its model, and the number that PolyScope's versions on a CB3 begin with."""
E_SERIES = 5
"""PolyScope's versions on an e-Series begin with this number; there, too, a UR10e calls itself UR10."""


def check_host(host: str) -> None:
    """Refuse what cannot be the name or the address of a machine.

    Raises:
        RobotError: If it is none.
    """
    if isinstance(host, str) and re.fullmatch(r"[^:]+:\d+", host):
        raise RobotError(
            f"host {shown(host[:80])} has a port: leave it out, a controller's ports are always the same"
        )
    if not isinstance(host, str) or not (NAME.fullmatch(host) or ADDRESS_6.fullmatch(host)):
        raise RobotError(
            f"host {shown(str(host)[:80])} is no name or address of a controller: give one such as 192.168.1.10"
        )


@contextmanager
def dashboard(host: str, patience: float = PATIENCE) -> Iterator[Callable[[str], str]]:
    """A connection to the dashboard server: a function that gives its answer to a command.

    Args:
        host: Name or address of the controller.
        patience: How long each answer may take [s].

    Raises:
        OSError: If it does not answer, or something else does.
    """
    with (
        socket.create_connection((host, DASHBOARD_PORT), patience) as connection,
        connection.makefile("rb") as lines,
    ):

        def answer() -> str:
            line = lines.readline(LONGEST_LINE)
            if not line.endswith(b"\n"):
                raise OSError("it hung up" if len(line) < LONGEST_LINE else "it does not speak in lines")
            return line.decode(errors="replace").strip()

        def ask(command: str) -> str:
            connection.sendall(f"{command}\n".encode())
            return answer()

        if "Dashboard" not in (greeting := answer()):
            raise OSError(f"it greets with {shown(greeting[:40])}")
        yield ask


def refuse_other_model(host: str, is_ur10: bool = False) -> None:
    """Refuse an arm that says it is no UR10 (CB3), or does not say what it is.

    Args:
        host: Name or address of the controller.
        is_ur10: Whether the arm is known to be a UR10 (CB3), where its controller cannot say: `get robot model` came
            with PolyScope 3.12.

    Raises:
        RobotError: naming the arm.
    """
    try:
        with dashboard(host) as ask:
            version, model = ask("PolyscopeVersion"), ask("get robot model")
    except OSError as error:
        raise RobotError(
            f"{host} does not say what arm it has, dashboard port {DASHBOARD_PORT} ({error}): start it anew"
        ) from error
    number = re.search(r"\b(\d+)\.\d+(?:\.\d+)*", version)
    if number is None:
        raise RobotError(
            f"{host} does not say its version, but {shown(version)}: only a UR10 (CB3) with PolyScope "
            f"{SERIES} is moved"
        )
    named = re.fullmatch(r"UR\d+\w*", model, re.IGNORECASE)
    series = int(number[1])
    if series == SERIES and named is None and is_ur10:
        return
    if series == SERIES and named is None:
        raise RobotError(
            f"{host} (PolyScope {number[0]}) does not say its model, but {shown(model)}, as before "
            "PolyScope 3.12: give --is-ur10 if its arm is a UR10 (CB3)"
        )
    if series != SERIES or model.upper() != MODEL:
        e_series = series == E_SERIES and model.upper() in ("UR3", "UR5", "UR10", "UR16")
        name = "another arm" if named is None else "a " + model + "e" * e_series
        raise RobotError(
            f"{host} moves {name} (PolyScope {number[0]}), whose links are not a UR10's (CB3): use a UR10 (CB3), the "
            "only arm whose path can be planned here"
        )
