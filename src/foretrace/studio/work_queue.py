"""Work that is done in its order, in a thread that ends with the visitor who asks for it."""

import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Lock


class WorkQueue:
    """Pieces of work that are done one after the other, in a thread of their own.

    Libraries keep memory for each thread that they have worked in until it ends: OpenCV 6 MB for letters, Matplotlib
    its fonts. In the 32 threads that viser shares among visitors, that memory would stay.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "foretrace-studio-work")
        self._adding, self._latest, self._ended = Lock(), 0, False

    def add(self, work: Callable[[int], None]) -> None:
        """Do something after all that was added before, unless the queue has ended; it is given its number."""
        with self._adding:
            if not self._ended:
                self._latest += 1
                self._thread.submit(_do, work, self._latest)

    def is_latest(self, number: int) -> bool:
        """Whether nothing was added after the work of this number."""
        return number == self._latest

    def end(self) -> None:
        """Forget what waits, and end the thread after what is being done."""
        with self._adding:
            self._ended = True
            self._thread.shutdown(wait=False, cancel_futures=True)


def _do(work: Callable[[int], None], number: int) -> None:
    try:
        work(number)
    except Exception:
        traceback.print_exc()
