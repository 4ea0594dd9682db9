"""Attacks on a recording and its answer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
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
    reported = "that had arrived could not be written" in message and bool(journals)
    clean = not done.stderr and recovered.returncode == 0
    return Outcome(
        f"exit {done.returncode}, {message.partition(': ')[2]}", bool(done.returncode) and reported and clean
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
    positions = replace(
        capture,
        angles_rad=None,
        angle_sigma_rad=None,
        axis_distance_m=None,
        antenna_positions_m=capture.aperture().antennas[0],
    )
    layouts = list(builtin_layouts().values())
    said += [tagid.identify(item, layouts).status for item in (capture, positions)]
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
    good = sum(item == ("0", 2, True) for item in said)
    return Outcome(f"{good} of {len(said)} scans with exit 0, capture and image", good == len(said))


@attack(
    "F17g",
    "a terminal of 65535 x 65535 cells during scan --demo --live",
    before="236 s, 2.1 GB written to the terminal",
    test="tests/unit/test_live.py::test_the_screen_fits_any_terminal_and_hides_no_control_character",
)
def _terminal(folder: Path) -> Outcome:
    from tests.cli.on_a_terminal import run

    began = time.monotonic()
    words = ["scan", "--demo", "--live", "--save-dir", str(folder), "--output", "json"]
    drawn = run(dict(os.environ), words, (65535, 65535), seconds=170.0)
    took, sent = time.monotonic() - began, len(drawn.sent) / 1e6
    return Outcome(
        f"exit {drawn.code}, {took:.0f} s, {sent:.0f} MB written",
        drawn.code == 0 and took < 60 and sent < 100,
    )


@attack(
    "F17h",
    "scene options out of bounds, and a capture of denormal samples in `show`",
    before="unexpected ValueError (seed -1), ZeroDivisionError: this is a bug in tagid",
    test="tests/protocol/test_radar_udp.py::test_numbers_of_a_scene_are_bounded_where_they_come_in",
)
def _numbers(folder: Path) -> Outcome:
    from dataclasses import replace

    import numpy as np

    from tagid.simulate.capture import simulate_capture
    from tagid.simulate.presets import scene_from_name
    from tagid.storage.hdf5 import write_capture

    capture = simulate_capture(scene_from_name("helmet-120", 3))[0]
    faint = capture.samples / np.abs(capture.samples).max() * 1e-38
    write_capture(folder / "faint.tagid.h5", replace(capture, samples=faint.astype(np.float32)))
    queries = ("seed=-1", "seed=1e300", "snr=1e300", "centre=1e400,0", "budget=1&axis_distance=1e-300")
    commands = [
        ["scan", "--radar", f"emulator://helmet-120?{query}", "--motion", "free?rpm=6"] for query in queries
    ]
    said = []
    for words, code in [*((command, 2) for command in commands), (["show", "faint.tagid.h5"], 0)]:
        done = subprocess.run([*_TAGID, *words], cwd=folder, capture_output=True, text=True)
        said.append(done.returncode == code and "bug" not in done.stderr and "Warning" not in done.stderr)
    return Outcome(f"{sum(said)} of {len(said)} with the right exit code and no fault", all(said))
