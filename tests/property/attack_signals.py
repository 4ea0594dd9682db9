"""Aimed stop signals against real processes that write: what is left on disk after each, counted.

    nice -n 10 python tests/property/attack_signals.py --tries 500

Each try starts `tagid scan`, `radar record`, `simulate` or `report` as a process, waits until its output file
is being written (the temporary file exists) and sends one to three of SIGINT, SIGTERM and SIGHUP within a few
milliseconds. Half of the recordings get a first signal while scans still arrive. What the process leaves is
compared with the journal, to which the attacker keeps a hard link, or with an undisturbed run. The exit code
is 1 if anything was found that must not be. With --log, a run goes on where an earlier one ended.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
from robustness_page import write_section  # noqa: E402

from tagid.errors import TagidError  # noqa: E402
from tagid.storage.hdf5 import read_capture  # noqa: E402
from tagid.storage.journal_capture import read_journal_capture  # noqa: E402

COMMANDS = ("scan", "record", "simulate", "report")
KINDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SCANS = 1500
_LONGEST_S = 120.0
_ENDS = frozenset({0, 1, 3, 5, 130})
"""Exit codes of a process that ended in its own way; all but 130 where the signal came too late to matter."""


@dataclass
class Outcome:
    """What one try left."""

    returncode: int  # of the process; negative where a signal ended it
    aimed: bool  # whether a signal was sent while the temporary file existed
    faults: list[str] = field(default_factory=list)  # what must not be, in words


def environment(folder: Path) -> dict[str, str]:
    """Of a process that keeps everything in `folder` and runs this checkout."""
    base = {name: value for name, value in os.environ.items() if not name.startswith("TAGID_")}
    return base | {
        "TAGID_CONFIG": str(folder / "home" / "config.toml"),
        "TAGID_DATA": str(folder / "home"),
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT),
    }


def command_line(command: str, folder: Path) -> list[str]:
    """The attacked command; it writes into `folder`/out."""
    tagid = [sys.executable, "-m", "tagid"]
    radar = ["--radar", "emulator://helmet-120", "--axis-distance", "1", "--save-dir", str(folder / "out")]
    if command == "scan":
        return [*tagid, "scan", *radar, "--scans", str(SCANS), "--max-seconds", "3600", "--method", "bp"]
    if command == "record":
        return [*tagid, "radar", "record", *radar, "--scans", str(SCANS)]
    if command == "simulate":
        out = str(folder / "out" / "a.tagid.h5")
        return [*tagid, "simulate", "helmet-120", "--views", str(SCANS), "--out", out]
    return [*tagid, "report", str(folder / "captures"), "--out", str(folder / "out"), "-j", "1"]


@contextmanager
def started(command: str, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """The process, in a process group of its own; killed where it does not end."""
    (folder / "out").mkdir(parents=True, exist_ok=True)
    process = subprocess.Popen(
        command_line(command, folder), env=environment(folder), cwd=folder, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[str]) -> bool:
    """Whether the condition came true before the process ended."""
    end = time.monotonic() + _LONGEST_S
    while time.monotonic() < end:
        if condition():
            return True
        if process.poll() is not None:
            return False
    return False


def attack(command: str, folder: Path, rng: random.Random, truth: Path | None = None) -> Outcome:
    """One try; `folder` is new, `truth` the output of an undisturbed `simulate`."""
    out = folder / "out"
    if command == "report":
        source = truth or ROOT
        (folder / "captures").mkdir()
        for number in range(2):
            shutil.copy(source, folder / "captures" / f"{number}.tagid.h5")
    with started(command, folder) as process:
        recording = command in ("scan", "record")
        if recording and rng.random() < 0.5:
            enough = rng.randint(50_000, 1_500_000)
            wait_for(lambda: _longest_journal(out) > enough, process)
            process.send_signal(rng.choice(KINDS))
        aimed = wait_for(lambda: any(path.name.endswith(".tmp") for path in out.iterdir()), process)
        for number, journal in enumerate(out.glob("*.tagid.journal")):
            with suppress(FileNotFoundError):  # it may go at any moment
                os.link(journal, folder / f"kept-{number}.tagid.journal")
        time.sleep(rng.random() * 0.02)
        for _ in range(rng.randint(1, 3)):
            if process.poll() is None:
                process.send_signal(rng.choice(KINDS))
            time.sleep(rng.random() * 0.02)
        try:
            _, err = process.communicate(timeout=_LONGEST_S)
        except subprocess.TimeoutExpired:
            return Outcome(0, aimed, ["hangs"])
    outcome = Outcome(process.returncode, aimed)
    if process.returncode not in _ENDS:
        outcome.faults.append(f"exit code {process.returncode}")
    if "Traceback" in err or "Exception ignored" in err:
        outcome.faults.append("traceback")
    if len(re.findall(r"^error:", err, re.MULTILINE)) > 1:
        outcome.faults.append("several messages")
    if any(path.name.endswith(".tmp") for path in out.iterdir()):
        outcome.faults.append("temporary file left")
    if command == "report":
        outcome.faults += report_faults(out, process.returncode)
    else:
        outcome.faults += capture_faults(folder, truth)
    return outcome


def _longest_journal(folder: Path) -> int:
    """Size of the longest journal in a folder, bytes; a journal may go at any moment."""
    longest = 0
    for path in folder.glob("*.tagid.journal"):
        with suppress(FileNotFoundError):
            longest = max(longest, path.stat().st_size)
    return longest


def capture_faults(folder: Path, truth: Path | None) -> list[str]:
    """What is wrong with the captures in out/, which hold the truth or the journal beside them does."""
    kept = sorted(folder.glob("kept-*.tagid.journal"))
    captures = sorted((folder / "out").glob("*.tagid.h5"))
    journals = sorted((folder / "out").glob("*.tagid.journal"))
    if not captures:
        return ["neither file nor journal"] if kept and not journals else []
    try:
        capture = read_capture(captures[0])
        wanted = read_journal_capture(kept[0]) if kept else None if truth is None else read_capture(truth)
    except TagidError as error:
        lost = "" if journals else ", journal gone"
        return [f"unreadable{lost} ({error.message.partition(': ')[2][:40]})"]
    if wanted is None or np.array_equal(capture.samples, wanted.samples):
        return []
    zeros = int((~capture.samples.any(axis=1)).sum())
    missing = len(wanted.samples) - len(capture.samples)
    return [f"corrupt{'' if journals else ', journal gone'}"] if zeros or missing else ["samples differ"]


def report_faults(out: Path, code: int) -> list[str]:
    """What is wrong with a report's files: each is absent or whole, and the summary fits the rest."""
    try:
        if not (out / "summary.json").exists():
            return []
        summary = json.loads((out / "summary.json").read_text())
        lines = [json.loads(line) for line in (out / "items.jsonl").read_text().splitlines()]
        whole = (out / "report.html").read_text().rstrip().endswith("</html>")
    except (OSError, ValueError) as error:
        return [f"report damaged ({type(error).__name__})"]
    result = [] if whole and len(lines) == summary["items"] else ["report and summary disagree"]
    return result + (["interrupted, but not exit code 130"] if summary["interrupted"] and code != 130 else [])


def main() -> int:
    """Run the tries and print the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tries", type=int, default=100, help="of all commands together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--log", type=Path, help="a line for each try; those in it are not repeated")
    parser.add_argument("--page", action="store_true", help="write the section of docs/results/robustness.md")
    given = parser.parse_args()
    for kind in KINDS:  # a shell has its background processes ignore them, and their children do as well
        signal.signal(kind, signal.default_int_handler)
    log = given.log or Path(os.devnull)
    before = [json.loads(line) for line in log.read_text().splitlines()] if log.is_file() else []
    outcomes = [(str(item.pop("command")), Outcome(**item)) for item in before]
    with tempfile.TemporaryDirectory() as place, log.open("a") as lines:
        with started("simulate", Path(place) / "truth") as undisturbed:
            undisturbed.communicate()
        truth = Path(place) / "truth" / "out" / "a.tagid.h5"
        for number in range(len(outcomes), given.tries):
            command = COMMANDS[number % len(COMMANDS)]
            folder = Path(place) / str(number)
            folder.mkdir()
            expected = truth if command in ("simulate", "report") else None
            outcome = attack(command, folder, random.Random(f"{given.seed}-{number}"), expected)
            outcomes.append((command, outcome))
            lines.write(json.dumps({"command": command, **asdict(outcome)}) + "\n")
            lines.flush()
            shutil.rmtree(folder)
    return _told(outcomes, given.seed, given.page)


def _told(outcomes: list[tuple[str, Outcome]], seed: int, page: bool) -> int:
    """Print the counts, and write them to the page where asked; 1 if there was a fault."""
    rows = []
    for command in sorted({command for command, _ in outcomes}):
        matching = [outcome for name, outcome in outcomes if name == command]
        codes = collections.Counter(outcome.returncode for outcome in matching)
        faults = collections.Counter(fault for outcome in matching for fault in set(outcome.faults))
        ended = ", ".join(f"{code}: {count}" for code, count in sorted(codes.items()))
        named = ", ".join(f"{fault}: {count}" for fault, count in sorted(faults.items())) or "none"
        rows.append((command, len(matching), sum(outcome.aimed for outcome in matching), ended, named))
        print(*rows[-1], sep=" | ")
    bad = sum(bool(outcome.faults) for _, outcome in outcomes)
    print(f"{len(outcomes)} tries, {sum(item.aimed for _, item in outcomes)} hit a write, {bad} with a fault")
    if page:
        text = (
            "One to three of SIGINT, SIGTERM and SIGHUP within a few milliseconds while the output "
            "file is being written. A fault is a damaged or missing file, a journal that went before "
            "its capture was whole, a temporary file, a traceback, several messages, a wrong exit "
            "code, or a process that does not end."
        )
        columns = ("command", "tries", "during a write", "exit code: tries", "faults")
        write_section("Stop signals", text, str(seed), columns, rows)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
