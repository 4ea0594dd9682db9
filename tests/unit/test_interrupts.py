"""Stop signals wait for writes, take effect once, and reach whoever handles them."""

from __future__ import annotations

import re
import signal
import threading
from pathlib import Path

import pytest

from tagid import interrupts
from tagid.errors import CaptureInterrupted, DiskFullError

PACKAGE = Path(interrupts.__file__).parent
STOP = list(interrupts.SIGNALS)


@pytest.fixture(autouse=True)
def handlers_are_restored():
    before = {number: signal.getsignal(number) for number in STOP}
    yield
    assert {number: signal.getsignal(number) for number in STOP} == before


@pytest.mark.parametrize("number", STOP)
def test_a_signal_waits_for_the_outermost_end(number: int) -> None:
    reached = []
    with interrupts.handled():
        with pytest.raises(KeyboardInterrupt):
            with interrupts.deferred():
                with interrupts.deferred():
                    for one in (number, *STOP, number):
                        signal.raise_signal(one)
                    reached.append("inner")
                reached.append("outer")
            reached.append("after")
        with interrupts.deferred():
            reached.append("it takes effect once")
    assert reached == ["inner", "outer", "it takes effect once"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, CaptureInterrupted])
def test_what_stops_the_work_already_covers_the_signals_that_waited(error: type[BaseException]) -> None:
    with interrupts.handled():
        with pytest.raises(error), interrupts.deferred():
            signal.raise_signal(signal.SIGINT)
            raise error("first")
        with interrupts.deferred():
            pass


def test_an_error_before_a_signal_is_kept_in_its_message() -> None:
    with interrupts.handled(), pytest.raises(KeyboardInterrupt) as caught, interrupts.deferred():
        signal.raise_signal(signal.SIGTERM)
        raise DiskFullError("a.h5: the disk is full", "Free some space.")
    error = interrupts.stopped_by_user(caught.value)
    assert error.message == "stopped by the user; a.h5: the disk is full"
    assert (error.remedy, error.exit_code) == ("Free some space.", 130)


def test_handlers_of_the_program_are_called_after_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[int] = []
    before = {number: signal.signal(number, lambda n, frame: called.append(n)) for number in STOP}
    try:
        with interrupts.deferred():
            for number in STOP:
                signal.raise_signal(number)
                signal.raise_signal(number)
            assert called == []
        assert called == STOP
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_an_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupts.handled(), interrupts.deferred():
            signal.raise_signal(signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_write_on_another_thread_defers_nothing() -> None:
    writing, done = threading.Event(), threading.Event()
    failures: list[BaseException] = []

    def work() -> None:
        try:
            with interrupts.handled(), interrupts.deferred() as signals, signals.listening():
                writing.set()
                done.wait(10)
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    writing.wait(10)
    with pytest.raises(KeyboardInterrupt), interrupts.handled():
        signal.raise_signal(signal.SIGHUP)
    done.set()
    thread.join()
    assert failures == []


def test_listening_lets_signals_through_and_defers_again_after_it() -> None:
    reached = []
    with pytest.raises(KeyboardInterrupt), interrupts.handled(), interrupts.deferred() as signals:
        with pytest.raises(KeyboardInterrupt), signals.listening():
            signal.raise_signal(signal.SIGINT)
            reached.append("not reached")
        signal.raise_signal(signal.SIGINT)
        reached.append("written")
        with signals.listening():
            reached.append("not reached")
    assert reached == ["written"]


def test_listening_within_an_outer_deferral_does_not_let_signals_through() -> None:
    reached = []
    with interrupts.handled(), pytest.raises(KeyboardInterrupt), interrupts.deferred():
        with interrupts.deferred() as inner, inner.listening():
            signal.raise_signal(signal.SIGINT)
            reached.append("inner")
        reached.append("outer")
    assert reached == ["inner", "outer"]


def test_the_first_signal_asks_and_the_second_forces() -> None:
    reported: list[bool] = []
    with interrupts.handled(), interrupts.asked_to_stop(lambda: reported.append(True)) as asked:
        assert not asked()
        signal.raise_signal(signal.SIGHUP)
        assert asked() and reported == [True]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)


def test_signals_during_a_write_ask_but_never_force() -> None:
    with interrupts.handled(), interrupts.asked_to_stop() as asked:
        for _ in range(2):
            with interrupts.deferred():
                for number in STOP:
                    signal.raise_signal(number)
            assert asked()


def test_signals_are_handled_in_one_place() -> None:
    # The guardian is a process of its own, which ignores signals until the robot stands still.
    allowed = {"interrupts.py", "motion/guard.py"}
    for path in PACKAGE.rglob("*.py"):
        if str(path.relative_to(PACKAGE)) not in allowed:
            assert not re.search(
                r"\bsignal\.(signal|raise_signal|sigwait|set_wakeup_fd)\(", path.read_text()
            ), path
