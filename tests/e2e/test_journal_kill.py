"""A process that is killed while it records loses nothing that the journal acknowledged."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from tagid.storage.journal_capture import read_journal_capture
from tests.unit.storage_samples import read_journal

BINS = 1152
KILLS = 10

RECORDER = """
import sys
from pathlib import Path
import numpy as np
from tagid.storage.journal import JournalWriter

with JournalWriter(Path(sys.argv[1]), {"range_start_m": 0.0, "range_step_m": 0.01}, sync_every=20) as journal:
    for i in range(1_000_000):
        samples = np.random.default_rng(i).integers(-(2**31), 2**31, %d, dtype=np.int64).astype(np.int32)
        journal.append(i, 10**18 + i, 21.5 * i, samples)
        sys.stdout.write(f"{i}\\n")
        sys.stdout.flush()
"""


def record_and_kill(path: Path, scans: int, delay_s: float) -> int:
    """Kill the recorder some time after it acknowledged `scans` scans; the number acknowledged in the end."""
    child = subprocess.Popen(
        [sys.executable, "-c", RECORDER % BINS, str(path)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2]), "OMP_NUM_THREADS": "1"},
    )
    assert child.stdout is not None
    with child, child.stdout as stdout:
        lines = [stdout.readline() for _ in range(scans)]
        time.sleep(delay_s)
        child.send_signal(signal.SIGKILL)
        lines += stdout.read().splitlines(keepends=True)
    assert child.returncode == -signal.SIGKILL
    # A line without its end is an acknowledgement that was not given.
    whole = [int(line) for line in lines if line.endswith(b"\n")]
    assert whole == list(range(len(whole)))
    return len(whole)


def test_every_acknowledged_scan_survives_sigkill(tmp_path: Path) -> None:
    moments = random.Random(20)
    for kill in range(KILLS):
        path = tmp_path / f"{kill}.tagid.journal"
        acknowledged = record_and_kill(path, moments.randint(1, 90), moments.random() * 0.003)
        journal = read_journal(path)
        assert journal.summary is None
        # One more may be there: written, but killed before it was acknowledged.
        assert acknowledged <= len(journal.scans) <= acknowledged + 1
        for i, scan in enumerate(journal.scans):
            truth = np.random.default_rng(i).integers(-(2**31), 2**31, BINS, dtype=np.int64).astype(np.int32)
            assert (scan.scan_id, scan.host_time_ns, scan.radar_time_ms) == (i, 10**18 + i, 21.5 * i)
            np.testing.assert_array_equal(scan.samples, truth)
        assert not read_journal_capture(path).complete
