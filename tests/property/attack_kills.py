"""Recordings killed at random moments: what was acknowledged before the kill, and what recovery finds.

    nice -n 10 python tests/property/attack_kills.py --kills 500

Each recorder is a process of its own, which prints the number of a scan once the journal has taken it, and is
killed with SIGKILL. The exit code is 1 if an acknowledged scan is missing or differs anywhere.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "e2e")]

import numpy as np  # noqa: E402
from robustness_page import Section, write_section  # noqa: E402
from test_journal_kill import BINS, record_and_kill  # noqa: E402

from tagid.errors import TagidError  # noqa: E402
from tagid.storage.journal_capture import read_journal_capture  # noqa: E402


def lost_of(path: Path, acknowledged: int) -> int:
    """Acknowledged scans that recovery does not find or finds different."""
    try:
        samples = read_journal_capture(path).samples
    except TagidError:
        return acknowledged
    lost = max(0, acknowledged - len(samples))
    for number, row in enumerate(samples[:acknowledged]):
        rng = np.random.default_rng(number)
        lost += not np.array_equal(row, rng.integers(-(2**31), 2**31, BINS, dtype=np.int64).astype(np.int32))
    return lost


def main() -> int:
    """Kill recordings and print the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--scans", type=int, default=2000, help="at most before a kill")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--page", action="store_true", help="write the section of docs/results/robustness.md")
    given = parser.parse_args()
    moments = random.Random(given.seed)
    acknowledged = lost = bad = 0
    with tempfile.TemporaryDirectory() as place:
        for kill in range(given.kills):
            path = Path(place) / f"{kill}.tagid.journal"
            taken = record_and_kill(path, moments.randint(1, given.scans), moments.random() * 0.01)
            missing = lost_of(path, taken)
            acknowledged += taken
            lost += missing
            bad += bool(missing)
            path.unlink()
    print(f"{given.kills} kills, {acknowledged} scans acknowledged, {lost} lost")
    if given.page:
        text = (
            "A recorder prints the number of each scan that its journal has taken, and is killed with "
            "SIGKILL at a random moment. Lost are scans that were printed and are missing or different "
            "after recovery."
        )
        columns = ("kills", "scans acknowledged", "lost", "recordings with a loss")
        rows = [(given.kills, acknowledged, lost, bad)]
        write_section(Section("Killed recordings", text, str(given.seed), columns, rows))
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
