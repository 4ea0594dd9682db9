"""Runs `tagid` on a pseudo-terminal and keeps what it draws there."""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
import threading
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Drawn:
    """An ended command.

    Attributes:
        code: exit status.
        out: its standard output, which is a pipe.
        sent: everything that the terminal was sent.
    """

    code: int
    out: bytes
    sent: bytes


def run(
    home: dict[str, str],
    words: list[str],
    size: tuple[int, int],
    react: Callable[[bytes, subprocess.Popen[bytes], int], None] | None = None,
    seconds: float = 120.0,
    **environment: str,
) -> Drawn:
    """`tagid WORDS` on a colour terminal of (lines, columns), ended within `seconds`.

    `react` is called with everything that was sent whenever more came, the process, and the terminal's end
    on which keys are pressed.
    """
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", *size, 0, 0))
    child = subprocess.Popen(
        [sys.executable, "-m", "tagid", *words],
        stdin=slave, stdout=subprocess.PIPE, stderr=slave,
        env={**{k: v for k, v in home.items() if k not in ("COLUMNS", "NO_COLOR")},
             "TERM": "xterm-256color", "COLORTERM": "truecolor", "PYTHONUTF8": "1", **environment},
    )  # fmt: skip
    os.close(slave)
    sent = bytearray()

    def read() -> None:
        try:
            while data := os.read(master, 65536):
                sent.extend(data)
                if react is not None:
                    react(bytes(sent), child, master)
        except OSError:  # the other end is closed
            return

    reader = threading.Thread(target=read)
    reader.start()
    out, _ = child.communicate(timeout=seconds)
    reader.join(timeout=120)
    os.close(master)
    return Drawn(child.returncode, out, bytes(sent))


def answering(*answers: tuple[bytes, bytes]) -> Callable[[bytes, subprocess.Popen[bytes], int], None]:
    """Presses the keys of each (prompt, keys) when the prompt has come, in their order."""
    left = list(answers)

    def react(sent: bytes, child: subprocess.Popen[bytes], keyboard: int) -> None:
        while left and left[0][0] in sent:
            os.write(keyboard, left.pop(0)[1])

    return react


def stop_at(enough: Callable[[bytes], bool]) -> Callable[[bytes, subprocess.Popen[bytes], int], None]:
    """Sends Ctrl-C once, when what came is `enough`."""
    asked: list[int] = []

    def react(sent: bytes, child: subprocess.Popen[bytes], keyboard: int) -> None:
        if not asked and enough(sent):
            asked.append(1)
            child.send_signal(signal.SIGINT)

    return react
