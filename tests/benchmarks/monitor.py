"""Frames a second of `tagid radar monitor` on two sizes of terminal, and what an ssh line would carry.

The monitor runs as a user runs it, on a pseudo terminal, against an emulated radar in real time over UDP.
"""

from __future__ import annotations

import fcntl
import json
import os
import pty
import struct
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator

from tests.benchmarks.measure import started
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

SETTINGS = (("480 samples, index 11", "11", "4.4"), ("96 samples, index 6", "6", "0.8"))
TERMINALS = ((80, 24, True), (80, 24, False), (200, 50, True))
TAGID = [sys.executable, "-m", "tagid"]


def watch(url: str, seconds: float, terminal: tuple[int, int, bool]) -> tuple[dict, int]:
    """(result of the monitor, bytes sent to the terminal)."""
    columns, lines, colour = terminal
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
    environment = {**os.environ, "TERM": "xterm-256color", "COLORTERM": "truecolor", "PYTHONUTF8": "1"}
    environment |= {} if colour else {"NO_COLOR": "1"}
    words = ["radar", "monitor", "--radar", url, "--seconds", str(seconds), "--output", "json"]
    child = subprocess.Popen(
        [*TAGID, *words], stdin=slave, stdout=subprocess.PIPE, stderr=slave, env=environment
    )
    os.close(slave)
    sent = 0

    def read() -> None:
        nonlocal sent
        try:
            while data := os.read(master, 1 << 16):
                sent += len(data)
        except OSError:  # the other end is closed
            return

    reader = threading.Thread(target=read)
    reader.start()
    out, _ = child.communicate()
    reader.join()
    os.close(master)
    return json.loads(out)["data"], sent


def frames(run: Run) -> Iterator[Table]:
    """A row for each setting and terminal."""
    run.seeds = "one run"
    rows = []
    with started(["emulate", "p440", "--bind", "127.0.0.1:0"]) as emulator:
        url = emulator["url"]
        for name, integration, stop in SETTINGS:
            words = ["--radar", url, "--start", "0", "--stop", stop, "--pii", integration, "-q"]
            subprocess.run([*TAGID, "radar", "config", *words], check=True, stdout=subprocess.DEVNULL)
            for terminal in TERMINALS:
                data, sent = watch(url, 3.0 if run.quick else 10.0, terminal)
                rates = (f"{data['frames_per_second']:.1f}", f"{sent / data['seconds'] / 1e3:.0f}")
                size = f"{terminal[0]} x {terminal[1]}"
                kind = "colour" if terminal[2] else "characters"
                rows.append((name, size, kind, *rates, f"{data['scan_rate_hz']:.1f}", data["lost"]))
    yield Table("setting | terminal | drawn in | frames/s | kB/s | scans/s | lost", rows)
