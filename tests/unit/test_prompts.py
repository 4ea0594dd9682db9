"""Prompts: what counts as an answer, where it may come from, and a stop signal at the worst moment."""

from __future__ import annotations

import os
import pty
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tagid import interrupts
from tagid.cli import consent


@contextmanager
def keyboard(monkeypatch: pytest.MonkeyPatch, kind: str, place: Path) -> Iterator[Callable[[bytes], int]]:
    """Standard input of a kind; the yielded function types."""
    if kind == "file":
        path = place / "answers"
        path.touch()
        reading, typing = os.open(path, os.O_RDONLY), os.open(path, os.O_WRONLY)
    else:
        typing, reading = pty.openpty() if kind == "terminal" else os.pipe()[::-1]
    with os.fdopen(reading) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        try:
            yield lambda keys: os.write(typing, keys)
        finally:
            os.close(typing)


@pytest.fixture(params=["terminal", "pipe", "file"])
def typed(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Callable[[bytes], int]]:
    with keyboard(monkeypatch, request.param, tmp_path) as types:
        yield types


def test_each_line_is_read_alone_and_the_rest_is_left(typed: Callable[[bytes], int]) -> None:
    typed("one\nzwölf\n\nfour\n".encode())
    assert [consent.read_line() for _ in range(3)] == ["one", "zwölf", ""]
    import sys

    assert os.read(sys.stdin.fileno(), 100) == b"four\n"


@pytest.mark.parametrize(
    ("keys", "default", "agreed"),
    [(b"y\n", False, True), (b" YES \n", False, True), (b"n\n", True, False), (b"\n", True, True),
     (b"\n", False, False), (b"maybe\nyes\n", False, True), (b"\xff\xfe\nno\n", True, False)],
)  # fmt: skip
def test_only_yes_or_no_answers_a_question(
    typed: Callable[[bytes], int],
    keys: bytes,
    default: bool,
    agreed: bool,
    capsys: pytest.CaptureFixture[str],
) -> None:
    typed(keys)
    assert consent.confirm("Red \x1b[31m?", default) is agreed
    asked = capsys.readouterr().err
    assert asked.count(f"Red \\x1b[31m? [{'Y/n' if default else 'y/N'}]: ") == keys.count(b"\n")


def test_the_end_of_the_input_is_no_answer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with keyboard(monkeypatch, "file", tmp_path) as typed:
        typed(b"the last line has no end")
        assert consent.read_line() == "the last line has no end"
        assert consent.confirm("Well?", default=True) is False
        with pytest.raises(EOFError):
            consent.read_line()
    monkeypatch.setattr("sys.stdin", None)
    assert not consent.can_ask()
    with pytest.raises(EOFError):
        consent.read_line()


@pytest.mark.parametrize("kind", ["terminal", "pipe"])
@pytest.mark.parametrize("number", interrupts.SIGNALS)
def test_a_signal_that_interrupts_no_system_call_ends_the_wait_at_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kind: str, number: int
) -> None:
    """As one between the last bytecode and the read: it reaches another thread, so no call returns early."""
    before = signal.set_wakeup_fd(-1)
    with keyboard(monkeypatch, kind, tmp_path) as typed:
        ended = threading.Event()

        def send() -> None:
            time.sleep(0.2)
            signal.pthread_kill(threading.get_ident(), number)
            if not ended.wait(10):
                typed(b"too late\n")

        sender = threading.Thread(target=send)
        sender.start()
        with interrupts.handled():
            with pytest.raises(KeyboardInterrupt):
                consent.read_line()
            ended.set()
            sender.join()
            typed(b"next\n")
            assert consent.read_line() == "next"
    assert signal.set_wakeup_fd(before) == -1


def test_a_signal_that_stops_nothing_is_waited_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[int] = []
    handler = signal.signal(signal.SIGUSR1, lambda number, frame: seen.append(number))
    try:
        with keyboard(monkeypatch, "pipe", tmp_path) as typed:

            def send() -> None:
                for _ in range(3):
                    time.sleep(0.05)
                    signal.pthread_kill(threading.get_ident(), signal.SIGUSR1)
                time.sleep(0.05)
                typed(b"here\n")

            sender = threading.Thread(target=send)
            sender.start()
            assert consent.read_line() == "here"
            sender.join()
    finally:
        signal.signal(signal.SIGUSR1, handler)
    assert len(seen) == 3


def test_another_thread_waits_without_signals(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with keyboard(monkeypatch, "pipe", tmp_path) as typed:
        read: list[str] = []
        reader = threading.Thread(target=lambda: read.append(consent.read_line()))
        reader.start()
        typed(b"there\n")
        reader.join(20)
        assert read == ["there"]
