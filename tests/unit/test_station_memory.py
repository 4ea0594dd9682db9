"""A station gives the arrays of a scan back to the system."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tagid.station.memory import return_large_blocks

PROGRAM = """
import os, sys
from pathlib import Path

def resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

import numpy as np
from tagid.station.memory import return_large_blocks

if sys.argv[1] == "returned":
    return_large_blocks()
del (first := [np.ones(1 << 19)])[0]
before = resident_mb()
arrays, kept = [], []
for _ in range(30):
    arrays.append(np.ones(1 << 18))
    kept.append(bytes(100_000))
arrays.clear()
print(resident_mb() - before)
"""


def grown_mb(how: str) -> float:
    """Memory that 60 MB of freed arrays between 3 MB of small objects leave."""
    words = [sys.executable, "-c", PROGRAM, how]
    return float(subprocess.run(words, capture_output=True, text=True, check=True).stdout)


def test_freed_arrays_do_not_stay_between_small_objects() -> None:
    if not return_large_blocks():
        pytest.skip("this C library has no such limit")
    assert grown_mb("default") > 40
    assert grown_mb("returned") < 10
