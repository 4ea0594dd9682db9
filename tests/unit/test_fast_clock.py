"""The faster clock of the station's benchmark: every clock and every wait is shortened alike."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import asyncio, os, sys, threading, time
sys.path.insert(0, sys.argv[1])
import fast_clock
fast_clock.relaunch()
assert "LD_PRELOAD" not in os.environ, "children have the true clock"
clock = fast_clock.FastClock()
began = [time.monotonic(), time.time(), clock.true_s()]
clock.run_at(1000.0)
fast_clock.CHECKED_S = 60.0
for kind, seconds, true_seconds in fast_clock.measure(clock):
    assert seconds >= 59.9 and true_seconds < seconds / 100, (kind, seconds, true_seconds)
clock.run_at(1.0)
ended = [time.monotonic(), time.time(), clock.true_s()]
monotonic, wall, truly = [now - then for now, then in zip(ended, began)]
assert monotonic > 360 and abs(monotonic / wall - 1) < 0.1 and truly < monotonic / 100
monotonic, truly = time.monotonic(), clock.true_s()
time.sleep(0.2)
assert time.monotonic() - monotonic < 5 * (clock.true_s() - truly), "at the true speed again"
"""


@pytest.mark.skipif(
    shutil.which("cc") is None or sys.platform != "linux", reason="needs a C compiler on Linux"
)
def test_all_clocks_and_waits_run_at_the_same_speed(tmp_path: Path) -> None:
    folder = Path(__file__).resolve().parents[1] / "benchmarks"
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    done = subprocess.run([sys.executable, program, folder], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
