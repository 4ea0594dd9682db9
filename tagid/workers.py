"""Threads whose owner learns of their end, whatever ended them, and that stop where nobody waits for them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final

NO_THREAD: Final = "can't start new thread"
"""Text of the RuntimeError of `threading`, and of `Worker.start`."""


_own = threading.local()


class UnwantedError(Exception):
    """Nobody waits for the work of this thread any more."""


def check_wanted() -> None:
    """For long computations to call now and then: raise UnwantedError where nobody waits for this thread."""
    unwanted: Callable[[], bool] | None = getattr(_own, "unwanted", None)
    if unwanted is not None and unwanted():
        raise UnwantedError


class Worker:
    """A daemon thread that keeps the exception that ended it.

    The owner starts it, asks `failure` wherever it relies on the thread's work, and joins it.

    Args:
        work: runs on the thread.
        name: of the thread, for logs.
        failed: called on the thread, after `failure` is set, if `work` raised; wakes an owner that waits.
        unwanted: True ends the work at its next `check_wanted`, which is no failure.

    Attributes:
        failure: the exception that ended the thread, or kept it from starting; None if there was none.

    >>> worker = Worker(lambda: int("x"), "example")
    >>> worker.start()
    >>> worker.join()
    True
    >>> type(worker.failure).__name__
    'ValueError'
    """

    def __init__(
        self,
        work: Callable[[], None],
        name: str,
        failed: Callable[[BaseException], None] = lambda error: None,
        unwanted: Callable[[], bool] | None = None,
    ) -> None:
        self.name = name
        self._work, self._failed, self._unwanted = work, failed, unwanted
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def alive(self) -> bool:
        """Whether the thread is running."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread.

        Raises RuntimeError if the system allows no further one, or has no memory for it; `failure` keeps it.
        """
        try:
            self._thread.start()
        except (RuntimeError, MemoryError) as error:
            self.failure = RuntimeError(NO_THREAD)
            raise self.failure from error

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait for the end of the thread; True if it has ended, or was never started."""
        if self._thread.ident is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout_s)
        return not self.alive

    def _run(self) -> None:
        _own.unwanted = self._unwanted
        try:
            self._work()
        except UnwantedError:
            logging.getLogger("tagid").debug("thread %s was no longer wanted", self.name)
        except BaseException as error:
            self.failure = error
            logging.getLogger("tagid").debug("thread %s ended", self.name, exc_info=True)
            self._failed(error)
        finally:
            # As in `threading.Thread`: an owner that refers to it is freed without garbage collection.
            del self._work, self._failed, self._unwanted, _own.unwanted
