"""Work that is done in its order, in a thread that ends with the visitor who asks for it."""

import traceback
from collections.abc import Callable
from queue import SimpleQueue
from threading import Lock, Thread


class WorkQueue:
    """Pieces of work that are done one after the other, in a thread of their own.

    Libraries keep memory for each thread that they have worked in until it ends: OpenCV 6 MB for letters, Matplotlib
    its fonts. In the 32 threads that viser shares among visitors, that memory would stay.
    """

    def __init__(self) -> None:
        self._waiting: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._adding, self._latest = Lock(), 0
        self.thread = Thread(target=self._run, daemon=True, name="foretrace-studio-work")
        """Where the work is done."""
        self.thread.start()

    def add(self, work: Callable[[int], None]) -> None:
        """Do something after all that was added before; it is given its number."""
        with self._adding:
            self._latest = number = self._latest + 1
            self._waiting.put(lambda: work(number))

    def is_latest(self, number: int) -> bool:
        """Whether nothing was added after the work of this number."""
        return number == self._latest

    def end(self) -> None:
        """End the thread after what was added before."""
        self._waiting.put(None)

    def _run(self) -> None:
        while (work := self._waiting.get()) is not None:
            try:
                work()
            except Exception:
                traceback.print_exc()  # and go on with the next
