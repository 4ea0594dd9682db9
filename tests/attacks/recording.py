"""Attacks on a recording and its answer."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.attacks import Outcome, attack

_TAGID = [sys.executable, "-P", "-m", "tagid"]

_DYING_JOURNAL = """
import sys
from tagid.storage.journal import JournalWriter
real, calls = JournalWriter.append_all, [0]
def fails_once(self, scans):
    calls[0] += 1
    if calls[0] == 20: raise MemoryError
    return real(self, scans)
JournalWriter.append_all = fails_once
sys.argv = ["tagid", "scan", "--demo", "--save-dir", "scans", "--output", "json", "-q"]
from tagid.cli.app import main
main()
"""


@attack(
    "N1",
    "the journal's thread ends with MemoryError in mid-scan",
    before="exit 0, turn complete, 20 of 3,000 scans kept, a traceback on the terminal",
    test="tests/protocol/test_recording_faults.py::"
    "test_a_recording_whose_journal_dies_ends_with_an_error_and_keeps_the_journal",
)
def _journal(folder: Path) -> Outcome:
    done = subprocess.run(
        [sys.executable, "-P", "-c", _DYING_JOURNAL], cwd=folder, capture_output=True, text=True
    )
    errors = json.loads(done.stdout)["errors"]
    message = errors[0]["message"] if errors else "no error"
    journals = [str(path) for path in folder.glob("scans/*.journal")]
    recovered = subprocess.run([*_TAGID, "recover", *journals, "-q"], cwd=folder, capture_output=True)
    told = "that had arrived could not be written" in message and bool(journals)
    clean = not done.stderr and recovered.returncode == 0
    return Outcome(
        f"exit {done.returncode}, {message.partition(': ')[2]}", bool(done.returncode) and told and clean
    )
