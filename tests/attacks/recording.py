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


@attack(
    "N3",
    "20 scans, 0.1 s of a turn of 10 s: scan, identify, vote of two, the same as positions, Python API",
    before="scan: identified, exit 0; identify, vote and positions: identified",
    test="tests/unit/test_diagnosis.py::test_a_name_needs_most_of_a_turn_however_the_recording_ended",
)
def _part(folder: Path) -> Outcome:
    from dataclasses import replace

    import tagid
    from tagid.tags.layouts.layout import builtin_layouts

    def answers(*words: str) -> list[str]:
        done = subprocess.run(
            [*_TAGID, *words, "--output", "json", "-q"], cwd=folder, capture_output=True, text=True
        )
        return [item["status"] for item in json.loads(done.stdout)["data"]["items"]]

    said = answers("scan", "--demo", "--scans", "20", "--save-dir", "a")
    said += answers("scan", "--demo", "--scans", "20", "--repeat", "2", "--save-dir", "b")
    files = sorted(str(path) for path in folder.glob("?/*.h5"))
    said += answers("identify", *files) + answers("identify", *files, "--vote")
    capture = tagid.load_capture(Path(files[0]))
    places = replace(
        capture,
        angles_rad=None,
        angle_sigma_rad=None,
        axis_distance_m=None,
        antenna_positions_m=capture.aperture().antennas[0],
    )
    layouts = list(builtin_layouts().values())
    said += [tagid.identify(one, layouts).status for one in (capture, places)]
    named = said.count("identified")
    return Outcome(f"{named} of {len(said)} answers name an object", not named)


@attack(
    "field 20",
    "scan --demo with streams that are closed or break",
    before="stdout closed: traceback, exit 1; stderr a broken pipe: exit 1, no image and no answer",
    test="tests/cli/test_commands.py::test_the_exit_code_is_that_of_the_answer_whatever_the_streams",
)
def _streams(folder: Path) -> Outcome:
    running = []
    for number, streams in enumerate((">&-", ">&- 2>&- <&-", "2>&1 | head -c 20 >/dev/null")):
        place = folder / str(number)
        place.mkdir()
        command = " ".join([*_TAGID, "scan", "--demo", "--save-dir", "."])
        line = f"{command} {streams}; echo $? >code"
        if "|" in streams:
            line = f"({command}; echo $? >code) {streams}"
        running.append(
            (place, subprocess.Popen(line, shell=True, cwd=place, stderr=subprocess.PIPE, text=True))
        )
    said = []
    for place, process in running:
        clean = "Traceback" not in process.communicate()[1]
        kept = len([*place.glob("*.h5"), *place.glob("scan*.png")])
        said.append(((place / "code").read_text().strip(), kept, clean))
    good = sum(one == ("0", 2, True) for one in said)
    return Outcome(f"{good} of {len(said)} scans with exit 0, capture and image", good == len(said))
