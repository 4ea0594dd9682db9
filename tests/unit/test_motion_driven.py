"""What every commanded device shares: however its thread or its start fails, it is halted, once and first."""

from __future__ import annotations

import math
import os
import select
import threading
import time
import tty
from typing import Any

import pytest

from tagid.errors import DeviceError, DeviceGoneError
from tagid.motion.device import MotionStoppedError, PausedError
from tagid.motion.driven import AngleReading, DrivenMotion
from tagid.motion.links import SerialLink
from tagid.station.errors import OverloadedError, begin
from tagid.workers import Worker


class Scripted(DrivenMotion):
    """A device whose steps fail as told."""

    kind = "scripted"
    stops_by = "hold it"

    def __init__(
        self, begin: BaseException | None = None, poll: BaseException | None = None, **options: Any
    ) -> None:
        super().__init__("the thing", 1, 10.0, **options)
        self._begin_error, self._poll_error = begin, poll
        self.halt_error: Exception | None = None
        self.calls: list[str] = []

    def _begin(self) -> None:
        self.calls.append("begin")
        if self._begin_error is not None:
            raise self._begin_error

    def _poll(self) -> list[AngleReading]:
        time.sleep(1e-3)
        if self._poll_error is not None and self._readings:
            raise self._poll_error
        return [(time.time_ns(), 0.5, 1e-3)]

    def _halt(self) -> None:
        self.calls.append("halt")
        if self.halt_error is not None:
            raise self.halt_error

    def _close(self) -> None:
        self.calls.append("close")

    def describe(self) -> dict[str, Any]:
        return {}

    def halt_now(self) -> None:
        """Nothing."""


def run_to_its_end(motion: DrivenMotion) -> None:
    motion.start()
    worker = motion._worker
    assert worker is not None
    assert worker.join(20)


@pytest.mark.parametrize("fault", [ZeroDivisionError, SystemExit])
def test_an_exception_in_the_thread_halts_and_is_told(fault: type[BaseException]) -> None:
    motion = Scripted(poll=fault("a fault of the program"))
    run_to_its_end(motion)
    assert motion.calls == ["begin", "halt"], "halted before anybody asked"
    with pytest.raises(DeviceError, match=f"{fault.__name__}: a fault of the program"):
        motion.check()
    motion.stop()
    assert motion.calls[-1] == "close"


@pytest.mark.parametrize("error", [DeviceError("the start failed"), KeyboardInterrupt(), OSError("port")])
def test_a_start_that_fails_halts_and_lets_go(error: BaseException) -> None:
    motion = Scripted(begin=error)
    with pytest.raises(type(error)):
        motion.start()
    assert motion.calls == ["begin", "halt", "close"]


@pytest.mark.parametrize("error", [RuntimeError("can't start new thread"), MemoryError()])
def test_a_thread_that_does_not_start_halts_with_a_remedy(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def start(thread: threading.Thread) -> None:
        raise error

    monkeypatch.setattr(threading.Thread, "start", start)
    motion = Scripted()
    with pytest.raises(DeviceError, match="thread that drives the thing does not start") as caught:
        motion.start()
    assert "Free memory and processes" in caught.value.remedy
    assert motion.calls == ["begin", "halt", "close"]
    with pytest.raises(OverloadedError):
        begin(Worker(lambda: None, "any"))


def test_it_turns_no_longer_than_max_seconds() -> None:
    motion = Scripted(max_seconds=0.05)
    run_to_its_end(motion)
    assert motion.calls == ["begin", "halt"]
    with pytest.raises(MotionStoppedError, match="has turned for"):
        motion.check()


@pytest.mark.parametrize("cause", [DeviceGoneError("the cable is out", "Check it."), KeyError("x")])
def test_a_halt_that_fails_says_first_that_it_may_still_turn(cause: Exception) -> None:
    motion = Scripted(poll=cause)
    motion.halt_error = KeyError("no answer")
    run_to_its_end(motion)
    with pytest.raises(DeviceError, match=r"^It may still be turning: hold it\. .*") as error:
        motion.stop()
    assert isinstance(error.value, DeviceGoneError) == isinstance(cause, DeviceGoneError)


def test_a_pause_marks_the_angle_as_lost() -> None:
    motion = Scripted(poll=PausedError("paused"))
    run_to_its_end(motion)
    track = motion.track()
    assert track.sigma_rad[-1] == pytest.approx(math.pi) and track.sigma_rad[-2] < 0.01


def waiting(master: int) -> bytes:
    """What has arrived; b"" where nothing has."""
    return os.read(master, 100) if select.select([master], [], [], 1.0)[0] else b""


def test_a_link_closed_without_disarming_stops_the_device() -> None:
    """The error path of every driver: whatever happened, the guardian has the last word."""
    master, slave = os.openpty()
    tty.setraw(slave)
    link = SerialLink(os.ttyname(slave), 115200, b"HALT")
    link.arm(30.0)
    link.close()
    assert waiting(master) == b"HALT" * 3, "the guardian has ended, so all of it is there"
    again = SerialLink(os.ttyname(slave), 115200, b"HALT")
    again.arm(30.0)
    again.write(b"last words")
    again.disarm()
    again.close()
    assert waiting(master) == b"last words"
    for descriptor in (master, slave):
        os.close(descriptor)
