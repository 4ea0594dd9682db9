"""Memory and CPU of turning a long recording's journal into capture files; a process of its own a size.

The scans are 1152 samples of noise, as a P440 sends; files are split at 128 MiB of samples instead of
1 GiB, so that the split is part of it.
"""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tagid.storage.journal import JournalWriter
from tagid.storage.journal_capture import write_captures
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

SIZES = (1_000, 5_000, 60_000)
BINS = 1152


def convert(scans: int) -> tuple[object, ...]:
    """Write a journal, turn it into captures; what that took."""
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
        return scans, path.stat().st_size >> 20, len(written.paths), before, after, f"{spent:.1f}"


def sizes(run: Run) -> Iterator[Table]:
    """A row a size."""
    run.seeds = "one run"
    columns = (
        "scans of 1152 samples | journal (MB) | files of 128 MiB | memory before (MB) | at most (MB) | "
        "CPU (s)"
    )
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        rows = list(pool.imap(convert, SIZES[:2] if run.quick else SIZES, chunksize=1))
    yield Table(columns, rows)
