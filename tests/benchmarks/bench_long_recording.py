"""Memory and CPU of turning a long recording's journal into capture files; a process of its own a size.

    python tests/benchmarks/bench_long_recording.py            # --short: the two smallest

The scans are 1152 samples of noise, as a P440 sends; files are split at 128 MiB of samples instead of
1 GiB, so that the split is part of it.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tagid.storage.journal import JournalWriter
from tagid.storage.journal_capture import write_captures

SIZES = (1_000, 5_000, 60_000)
BINS = 1152


def one(scans: int) -> None:
    """Write a journal, turn it into captures, print what that took."""
    noise = np.random.default_rng(0).normal(0, 120, (64, BINS)).astype(np.int32)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.tagid.journal"
        with JournalWriter(path, {"range_start_m": 0.0, "range_step_m": 0.009}, sync_every=0) as journal:
            for number in range(scans):
                journal.append(number, number, float(number), noise[number % len(noise)])
            journal.close({})
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
        began = time.process_time()
        written = write_captures(path, lambda part: Path(folder) / f"{part}.tagid.h5", part_bytes=128 << 20)
        spent = time.process_time() - began
        after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
        megabytes = path.stat().st_size >> 20
    print(
        f"{scans:>7} scans {megabytes:>5} MB journal {len(written.paths):>2} files "
        f"memory {before} MB before, {after} MB at most, {spent:.1f} s CPU"
    )


def main() -> None:
    """A line a size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--scans", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.scans:
        one(options.scans)
        return
    for scans in SIZES[:2] if options.short else SIZES:
        subprocess.run([sys.executable, __file__, "--scans", str(scans)], check=True)


if __name__ == "__main__":
    main()
