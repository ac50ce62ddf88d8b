"""A stand-in for the controller of a UR10 (CB3), on loopback: RTDE version 2, script port, dashboard.

It speaks to the real client library over real sockets, in a process of its own, because that library keeps Python's
lock while it connects. Of the program that the library uploads it plays the commands that the tests need, on the
registers that the program would use; the arm follows its set points with a short lag.
"""

import contextlib
import itertools
import json
import math
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

import numpy as np

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
PERIOD = 0.008
PROTOCOL, VERSION, OUTPUTS, INPUTS, START, PAUSE, DATA = (bytes([c]) for c in b"VvOISPU")
SERVO, SERVO_STOP, SET_WATCHDOG, GET_TCP_OFFSET, STOP_SCRIPT = 11, 16, 35, 40, 255
READY, DONE = 1, 2
STOPPED, PLAYING = 1, 2
FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I"}
UR10 = {"a": [0.0, -0.612, -0.5723, 0.0, 0.0, 0.0], "d": [0.1273, 0.0, 0.0, 0.163941, 0.1157, 0.0922]}
UR10E = {"a": [0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0], "d": [0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655]}
"""Published Denavit-Hartenberg parameters [m]; the twists are the same for every UR."""
TWISTS = [math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0]
STILL = 0.01
"""Speed of a joint below which the arm stands still [rad/s]."""
SAFETY_BITS = {1: 0b1, 3: 0b100, 7: 0b10000000}
_hosts = itertools.count(2)


@dataclass
class Facts:
    """What a controller has seen when it is over."""

    connections: int = 0
    set_points: list[list[float]] = field(default_factory=list)
    stops: list[str] = field(default_factory=list)
    uploads: int = 0
    joints: list[float] = field(default_factory=list)
    moved: float = 0.0
    """When a joint last turned faster than `STILL`, by the monotonic clock [s]."""


class RunningController:
    """A controller in a process of its own; ``facts`` are there after the ``with`` block.

    Args:
        joints: Where the arm stands [rad].
        after: Number of set points after which ``event`` happens.
        event: ``protective``, ``emergency`` (stops), ``reduced`` (mode), ``freeze`` (data stop coming), ``drop`` (all
            connections close, none is accepted), ``stuck`` (the arm stays where it is), ``none``, or the names of
            signals for the process that started this: ``SIGINT``, ``SIGINT SIGINT``.
        settings: Other attributes of `Controller` to start with.
    """

    def __init__(self, joints: Any, after: int = 0, event: str = "none", **settings: Any) -> None:
        # 127.0.0.0/8 is loopback as a whole; the process number keeps tests that run side by side apart.
        self.host = f"127.{os.getpid() // 250 % 250 + 1}.{os.getpid() % 250 + 1}.{next(_hosts)}"
        start = {"host": self.host, "joints": list(joints), "after": after, "event": event, **settings}
        self._command = [sys.executable, "-I", __file__, json.dumps(start)]

    def __enter__(self) -> "RunningController":
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        output, _ = self._process.communicate(timeout=10)
        self.facts = Facts(**json.loads(output))


class Client:
    """One connection to one of the ports."""

    def __init__(self, connection: socket.socket, port: int) -> None:
        self.socket, self.port, self.buffer = connection, port, b""
        self.recipes: list[list[str]] = []
        self.outputs: list[str] = []
        self.started = False

    def send(self, kind: bytes, payload: bytes) -> None:
        self.socket.sendall(struct.pack(">Hc", 3 + len(payload), kind) + payload)


class Controller:
    """The controller's side."""

    def __init__(self, host: str, joints: list[float], after: int, event: str, **settings: Any) -> None:
        self.host, self.joints, self.target = host, joints, joints
        self.after, self.event = after, event
        self.robot_mode, self.safety_mode, self.speed_slider, self.lag = 7, 1, 1.0, 0.02
        self.playing = self.servoing = self.frozen = self.stuck = self.busy = False
        self.version, self.model = "URSoftware 3.15.8.106339 (Mar 06 2022)", "UR10"
        self.dh, self.tcp = UR10, [0.0] * 6
        self.signalled = os.getppid()
        vars(self).update(settings)
        self.facts = Facts()
        self.registers: dict[str, float] = {}
        self.watchdog, self.last_input = math.inf, 0.0
        self.clients: list[Client] = []
        self.listeners = {port: self._listen(port) for port in (RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT)}

    def serve(self) -> None:
        """Go on until standard input ends, and the watchdog has had its chance to stop the arm."""
        due, over = time.monotonic(), False
        while not over or (self.playing and self.watchdog < math.inf):
            sockets: list[Any] = [*self.listeners.values(), *(client.socket for client in self.clients)]
            sockets += [] if over else [sys.stdin]
            ready, _, _ = select.select(sockets, [], [], max(0.0, due - time.monotonic()))
            over = over or sys.stdin in ready
            for port, listener in list(self.listeners.items()):
                if listener in ready:
                    self._accept(listener, port)
            for client in [each for each in self.clients if each.socket in ready]:
                self._read(client)
            if time.monotonic() >= due:
                due = max(due + PERIOD, time.monotonic() - 10 * PERIOD)
                self._tick()
        self.facts.joints = self.joints

    def _listen(self, port: int) -> socket.socket:
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((self.host, port))
        listener.listen()
        return listener

    def _accept(self, listener: socket.socket, port: int) -> None:
        connection, _ = listener.accept()
        self.facts.connections += 1
        self.clients.append(Client(connection, port))
        if port == DASHBOARD_PORT:
            connection.sendall(b"Connected: Universal Robots Dashboard Server\n")

    def _read(self, client: Client) -> None:
        data = b""
        with contextlib.suppress(OSError):
            data = client.socket.recv(65536)
        if not data:
            client.socket.close()
            self.clients = [each for each in self.clients if each is not client]
            return
        client.buffer += data
        if client.port == RTDE_PORT:
            while len(client.buffer) >= 3 and client in self.clients:
                size = struct.unpack(">H", client.buffer[:2])[0]
                if len(client.buffer) < size:
                    break
                kind, payload = client.buffer[2:3], client.buffer[3:size]
                client.buffer = client.buffer[size:]
                self._answer(client, kind, payload)
        elif client.port == DASHBOARD_PORT:
            *lines, client.buffer = client.buffer.split(b"\n")
            for line in lines:
                self._dashboard(client, line.decode().strip())
        elif client.buffer.endswith(b"end\n") and self.safety_mode == 1:
            client.buffer, self.playing = b"", True
            self.facts.uploads += 1
            self.registers["output_int_register_0"] = READY

    def _dashboard(self, client: Client, command: str) -> None:
        if command == "stop":
            self._halt("dashboard")
        answers = {"PolyscopeVersion": self.version, "get robot model": self.model, "stop": "Stopped"}
        client.socket.sendall((answers.get(command) or f"could not understand: '{command}'").encode() + b"\n")

    def _answer(self, client: Client, kind: bytes, payload: bytes) -> None:
        if kind == PROTOCOL:
            client.send(kind, bytes([payload == b"\x00\x02"]))
        elif kind == VERSION:
            client.send(kind, struct.pack(">4I", 3, 15, 8, 106339))
        elif kind == OUTPUTS:
            client.outputs = payload[8:].decode().strip(",").split(",")
            client.send(kind, b"\x01" + ",".join(map(variable_type, client.outputs)).encode())
        elif kind == INPUTS:
            client.recipes.append(payload.decode().strip(",").split(","))
            types = ",".join(map(variable_type, client.recipes[-1])).encode()
            client.send(kind, bytes([len(client.recipes)]) + types)
        elif kind in (START, PAUSE):
            client.started = kind == START
            client.send(kind, b"\x01")
        elif kind == DATA:
            names = client.recipes[payload[0] - 1]
            layout = ">" + "".join(FORMATS[variable_type(name)] for name in names)
            self.registers.update(zip(names, struct.unpack(layout, payload[1:]), strict=True))
            self.last_input = time.monotonic()
            if self.playing:
                self._command(int(self.registers["input_int_register_0"]))

    def _command(self, command: int) -> None:
        """What the uploaded program does with the command in its first register."""
        if command == SERVO:
            self.target = [self.registers[f"input_double_register_{i}"] for i in range(6)]
            self.servoing = True
            self.facts.set_points.append(self.target)
            if len(self.facts.set_points) == self.after:
                self._happen()
        elif command == 0:
            self.busy = False
            self.registers["output_int_register_0"] = READY
        elif command == STOP_SCRIPT:
            self._halt("program")
        elif not self.busy:
            if command == SERVO_STOP:
                self.servoing = False
                self.facts.stops.append("servo")
            elif command == SET_WATCHDOG:
                self.watchdog = 1 / self.registers["input_double_register_0"]
            elif command == GET_TCP_OFFSET:
                self.registers |= {f"output_double_register_{i}": value for i, value in enumerate(self.tcp)}
            self.busy = True
            self.registers["output_int_register_0"] = DONE

    def _happen(self) -> None:
        if self.event in ("protective", "emergency"):
            self.safety_mode = 3 if self.event == "protective" else 7
            self.playing = self.servoing = False
        elif self.event == "reduced":
            self.safety_mode = 2
        elif self.event == "drop":
            for each in [*self.listeners.values(), *(client.socket for client in self.clients)]:
                each.close()
            self.listeners, self.clients = {}, []
        elif self.event.startswith("SIG"):
            for name in self.event.split():
                os.kill(self.signalled, getattr(signal, name))
                time.sleep(0.02)
        else:
            self.frozen, self.stuck = self.event == "freeze", self.event == "stuck"

    def _halt(self, by: str) -> None:
        if self.playing:
            self.facts.stops.append(by)
        self.playing = self.servoing = False
        self.watchdog = math.inf

    def _tick(self) -> None:
        if self.playing and time.monotonic() - self.last_input > self.watchdog:
            self._halt("watchdog")
        if self.servoing and not self.stuck:
            share = 1 - math.exp(-PERIOD / self.lag)
            steps = [share * (t - q) for q, t in zip(self.joints, self.target, strict=True)]
            self.joints = [q + step for q, step in zip(self.joints, steps, strict=True)]
            if max(map(abs, steps)) > STILL * PERIOD:
                self.facts.moved = time.monotonic()
        values: dict[str, Any] = {
            **self.registers,
            "timestamp": time.monotonic(),
            "actual_q": self.joints,
            "target_q": self.target,
            "actual_TCP_pose": tool_pose(self.joints, self.dh, self.tcp),
            "robot_mode": self.robot_mode,
            "safety_mode": self.safety_mode,
            "safety_status_bits": SAFETY_BITS.get(self.safety_mode, 0),
            "runtime_state": PLAYING if self.playing else STOPPED,
            "speed_scaling": 1.0,
            "target_speed_fraction": self.speed_slider,
        }
        for client in [each for each in self.clients if each.started and not self.frozen]:
            payload = b"\x01"
            for name in client.outputs:
                kind = variable_type(name)
                value = values.get(name, [0.0] * 6 if kind == "VECTOR6D" else 0)
                payload += struct.pack(">" + FORMATS[kind], *(value if isinstance(value, list) else [value]))
            try:
                client.send(DATA, payload)
            except OSError:
                client.started = False


def variable_type(name: str) -> str:
    """RTDE's type of a variable, by its documented name."""
    if "double_register" in name or name in ("timestamp", "speed_scaling", "target_speed_fraction"):
        return "DOUBLE"
    if "int_register" in name or name in ("robot_mode", "safety_mode"):
        return "INT32"
    if name in ("runtime_state", "robot_status_bits", "safety_status_bits"):
        return "UINT32"
    return "VECTOR6D"


def tool_pose(joints: list[float], dh: dict[str, list[float]], tcp: list[float]) -> list[float]:
    """Tool centre point in the base frame: position [m], rotation vector [rad]."""
    pose = np.eye(4)
    for q, a, d, twist in zip(joints, dh["a"], dh["d"], TWISTS, strict=True):
        c, s, ct, st = math.cos(q), math.sin(q), math.cos(twist), math.sin(twist)
        pose = pose @ [[c, -s * ct, s * st, a * c], [s, c * ct, -c * st, a * s], [0, st, ct, d], [0, 0, 0, 1]]
    x, y, z = angle = np.array(tcp[3:])
    if turn := float(np.linalg.norm(angle)):
        k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) / turn
        offset = np.eye(4)
        offset[:3, :3] += math.sin(turn) * k + (1 - math.cos(turn)) * k @ k
    else:
        offset = np.eye(4)
    offset[:3, 3] = tcp[:3]
    pose = pose @ offset
    # The axis of a turn is the eigenvector that it leaves alone; its sign by one entry beside the diagonal.
    values, vectors = np.linalg.eig(pose[:3, :3])
    axis = np.real(vectors[:, np.abs(values - 1).argmin()])
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = math.atan2(-np.trace(k @ pose[:3, :3]) / 2, (np.trace(pose[:3, :3]) - 1) / 2)
    return [*pose[:3, 3], *(turn * axis)]


if __name__ == "__main__":
    controller = Controller(**json.loads(sys.argv[1]))
    print("ready", flush=True)
    controller.serve()
    print(json.dumps(vars(controller.facts)))
