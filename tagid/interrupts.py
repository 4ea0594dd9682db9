"""SIGINT, SIGTERM and SIGHUP: the only module that handles them.

A stop signal must never interrupt a write, least of all inside a callback of a C library. Writes run within
`deferred`, which delays signals until the write has ended.
"""

from __future__ import annotations

import atexit
import os
import select
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, Self

from tagid.errors import CaptureInterrupted, TagidError

SIGNALS = (signal.SIGHUP, signal.SIGTERM, signal.SIGINT)
"""The signals that stop a command. SIGINT is last, so that its handler is restored last."""

Handler = Callable[[int, FrameType | None], Any] | int | None


def stopped_by_user(stop: KeyboardInterrupt, remedy: str = "") -> CaptureInterrupted:
    """The error to show for a stop signal; it keeps the message and remedy of an earlier error."""
    before = stop.__context__
    if isinstance(before, TagidError):
        return CaptureInterrupted(f"stopped by the user; {before.message}", before.remedy)
    return CaptureInterrupted("stopped by the user", remedy)


@contextmanager
def naming(kept: Callable[[], str]) -> Iterator[None]:
    """Within it errors and stop signals say what is kept, and how to go on with it; "" for nothing."""
    try:
        yield
    except KeyboardInterrupt as stop:
        raise stopped_by_user(stop, kept()) from stop
    except TagidError as error:
        raise error.with_remedy(kept()) from error


class _Stop:
    """A graceful stop request; see `asked_to_stop`."""

    def __init__(self, tell: Callable[[], None]) -> None:
        self.asked = False
        self.tell = tell


class _State:
    """State of the main thread; no other thread changes it, and signal handlers run there only."""

    depth = 0
    waiting: list[int]
    stop: _Stop | None = None
    delivered = False

    def __init__(self) -> None:
        self.waiting = []


_state = _State()


def _on_signal(number: int, frame: FrameType | None) -> None:
    if _state.depth:
        if number not in _state.waiting:
            _state.waiting.append(number)
    else:
        _act()


def _act(late: bool = False) -> None:
    """Effect of a signal within `handled`; `late` marks one that waited for a write to end."""
    _state.waiting.clear()
    _state.delivered = True
    stop = _state.stop
    if stop is None or (stop.asked and not late):
        raise KeyboardInterrupt
    if not stop.asked:
        stop.asked = True
        stop.tell()


@contextmanager
def handled(*, to_the_end: bool = False) -> Iterator[None]:
    """Make each of `SIGNALS` raise KeyboardInterrupt in the main thread; for a program's outermost call.

    A signal that was ignored when the process started (`nohup`) stays ignored. While the interpreter exits,
    all signals are ignored: all files are written by then. Signals after the block are handled as before it,
    or have no effect if the program ends with it (`to_the_end`).
    """
    if not _on_main_thread():
        yield
        return
    _state.delivered = False
    before = _install()
    try:
        yield
    finally:
        if to_the_end:
            # Restored, a signal between here and the end of the interpreter would change the exit code.
            _state.depth += 1
        else:
            _restore(before)
        atexit.unregister(_ignore_all)
        atexit.register(_ignore_all)


def delivered() -> bool:
    """Whether a signal has taken effect since `handled` was entered."""
    return _state.delivered


@contextmanager
def asked_to_stop(tell: Callable[[], None] = lambda: None) -> Iterator[Callable[[], bool]]:
    """The first signal makes the yielded function return True; a second one raises KeyboardInterrupt.

    Signals that arrive during a write count as one, the first. SIGINT, which the shell makes a background
    process ignore, is handled as well, because stopping is how such a command ends. `tell` is called in the
    main thread at the first signal.
    """
    if not _on_main_thread():
        yield lambda: False
        return
    stop = _Stop(tell)
    before = _install(also=(signal.SIGINT,))
    outer, _state.stop = _state.stop, stop
    try:
        yield lambda: stop.asked
    finally:
        _state.stop = outer
        _restore(before)


class Deferred:
    """The context manager returned by `deferred`."""

    def __init__(self) -> None:
        self._active = _on_main_thread()
        self._outer = 0
        self._before: dict[int, Handler] = {}

    def __enter__(self) -> Self:
        if self._active:
            self._outer = _state.depth
            self._begin()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._active:
            self._end(stopped_already=isinstance(error, KeyboardInterrupt | CaptureInterrupted))

    def listening(self) -> Listening:
        """A context manager: within it, signals take effect at once, unless an outer `deferred` is active."""
        return Listening(self)

    def _begin(self) -> None:
        _state.depth = self._outer + 1
        if not self._outer:
            self._before = _install()

    def _end(self, stopped_already: bool = False) -> None:
        if self._outer:
            _state.depth = self._outer
            return
        try:
            ours = _restore(self._before)
        finally:
            # First: a signal from here on takes effect, and is not put into a list that is read.
            _state.depth = 0
            waiting, _state.waiting = _state.waiting, []
        if not ours:
            for number in waiting:
                signal.raise_signal(number)
        elif waiting and not stopped_already:
            _act(late=True)


class Listening:
    """The context manager returned by `Deferred.listening`."""

    def __init__(self, deferral: Deferred) -> None:
        self._deferral = deferral

    def __enter__(self) -> None:
        if self._deferral._active and not self._deferral._outer:
            try:
                self._deferral._end()
            except BaseException:
                self._deferral._begin()
                raise

    def __exit__(self, *_: object) -> None:
        if self._deferral._active and not self._deferral._outer:
            self._deferral._begin()


def deferred() -> Deferred:
    """A context manager that delays `SIGNALS`; each takes effect once, when the outermost one ends.

    It does nothing on threads other than the main one, because signals are handled on the main thread. If the
    program handles the signals itself, its handlers are called at the end. If KeyboardInterrupt or
    CaptureInterrupted leaves the block, the delayed signals are dropped: the work is stopping already.
    """
    return Deferred()


def wait_readable(descriptor: int) -> None:
    """Wait until a read of a file descriptor does not block; signals take effect at once.

    In a blocking read, a signal that arrives after the last bytecode and before the system call would take
    effect only with the next signal: its handler runs in Python, and nothing interrupts the call. Here the
    signal itself writes to a pipe that is waited for as well (`signal.set_wakeup_fd`).
    """
    awaited = select.poll()
    awaited.register(descriptor, select.POLLIN)
    if not _on_main_thread():
        awaited.poll()
        return
    woken, waking = os.pipe()
    before = -1
    try:
        os.set_blocking(woken, False)
        os.set_blocking(waking, False)
        awaited.register(woken, select.POLLIN)
        before = signal.set_wakeup_fd(waking, warn_on_full_buffer=False)
        # A signal's handler runs after each call of poll, and ends the wait by raising.
        while descriptor not in [ready for ready, _ in awaited.poll()]:
            os.read(woken, 512)
    finally:
        signal.set_wakeup_fd(before)
        os.close(woken)
        os.close(waking)


def _on_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _install(also: tuple[int, ...] = ()) -> dict[int, Handler]:
    """Install the handlers; returns the previous ones."""
    before: dict[int, Handler] = {}
    for number in SIGNALS:
        handler = signal.getsignal(number)
        # None: set by C code, which we could not restore.
        if handler in (_on_signal, None) or (handler == signal.SIG_IGN and number not in also):
            continue
        before[number] = handler
        signal.signal(number, _on_signal)
    return before


def _restore(before: dict[int, Handler]) -> bool:
    """Restore handlers; returns whether an outer `handled` still handles the signals."""
    failure: BaseException | None = None
    for number, handler in before.items():
        while signal.getsignal(number) is _on_signal:
            try:
                signal.signal(number, handler)
            except BaseException as error:  # raised by a handler that was just restored
                failure = error
    if failure is not None:
        raise failure
    return any(signal.getsignal(number) is _on_signal for number in SIGNALS)


def _ignore_all() -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
