"""Monitors that requests come back to: bounded in number, in life, and in what each takes in."""

import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Lock
from time import monotonic

from foretrace.errors import StudioError
from foretrace.monitoring import Monitor, Verdict

MOST = 64
"""Monitors at once, at most."""
LIFE = 600.0
"""A monitor is forgotten this long after it was last asked [s]."""
MOST_SAMPLES = 10_000
"""Samples that one monitor takes in, at most."""


class UnknownWatchError(StudioError):
    """There is no such monitor, or there is none any longer."""


class BusyError(StudioError):
    """There are too many at once."""


@dataclass
class Watch:
    """One monitor, and what it last said."""

    monitor: Monitor
    """The monitor."""
    asked: float
    """When it was last asked [s]."""
    verdict: Verdict | None = None
    """Its last verdict."""
    taken: int = 0
    """Samples that it has taken in."""
    lock: Lock = field(default_factory=Lock)
    """One request at a time."""

    def update(self, t: float, pose: list[float] | None) -> Verdict:
        """Take in one sample.

        Raises:
            StudioError: It has taken in too many.
            MonitoringError: As of `Monitor.update`.
        """
        if self.taken >= MOST_SAMPLES:
            raise StudioError(f"the monitor has taken in {MOST_SAMPLES} samples: begin another one")
        self.verdict = self.monitor.update(t, pose)
        self.taken += 1
        return self.verdict


class Watches:
    """All monitors of a service, by names that cannot be guessed.

    Args:
        clock: Tells the time [s].
    """

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self._clock, self._lock = clock, Lock()
        self._watches: dict[str, Watch] = {}

    def __len__(self) -> int:
        return len(self._watches)

    def begin(self, monitor: Monitor) -> str:
        """Keep a monitor; returns its name.

        Raises:
            BusyError: There are too many.
        """
        with self._lock:
            self._forget()
            if len(self._watches) >= MOST:
                raise BusyError(f"there are {MOST} monitors already: end one, or wait until one is forgotten")
            name = secrets.token_urlsafe(12)
            self._watches[name] = Watch(monitor, self._clock())
            return name

    def find(self, name: str) -> Watch:
        """A monitor by its name.

        Raises:
            UnknownWatchError: There is none of that name.
        """
        with self._lock:
            self._forget()
            if (found := self._watches.get(name)) is None:
                raise UnknownWatchError(
                    f"there is no monitor of that name, or it was not asked for {LIFE:g} s: begin another one"
                )
            found.asked = self._clock()
            return found

    def end(self, name: str) -> None:
        """Forget a monitor.

        Raises:
            UnknownWatchError: There is none of that name.
        """
        self.find(name)
        with self._lock:
            self._watches.pop(name, None)

    def _forget(self) -> None:
        """Forget those that have not been asked for long."""
        oldest = self._clock() - LIFE
        self._watches = {name: each for name, each in self._watches.items() if each.asked >= oldest}
