"""Scans, reports and enrollments at once, in one place: what is there afterwards, counted.

    nice -n 10 python tests/property/attack_concurrent.py --seconds 120

Several processes at a time use one folder of captures, one registry, one history and two report folders.
Every process must end in its own way, with at most one error message. At the end every capture of an
acknowledged scan is whole, every acknowledged enrollment is in the registry, every answer is in the history,
nothing temporary is left, and a last report reads all. The exit code is 1 if anything is missing.
"""

from __future__ import annotations

import argparse
import collections
import json
import random
import re
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from attack_signals import environment  # noqa: E402
from robustness_page import Section, write_section  # noqa: E402

from tagid.errors import TagidError  # noqa: E402
from tagid.storage.hdf5 import read_capture  # noqa: E402

WEIGHTS = {"scan": 5, "enroll": 4, "report": 3, "identify": 2}
_ENDS = {
    "scan": {0, 3},
    "enroll": {0, 1},
    "report": {0, 1, 3, 5},
    "identify": {0, 3},
}
"""Exit codes of a process that nothing disturbed; 1: a report or registry that another process is writing."""
_LONGEST_S = 300.0


@dataclass(frozen=True)
class Ran:
    """One process: its command, the name it enrolled or the capture it wrote, and what must not be."""

    command: str
    code: int
    made: str = ""
    faults: tuple[str, ...] = ()


def words_of(command: str, number: int, rng: random.Random) -> list[str]:
    """The command line of a process; relative to the common folder."""
    if command == "scan":
        name = rng.choice(("helmet-120", "container-90", "helmet-linear"))
        return [
            "scan",
            "--radar",
            f"emulator://{name}",
            "--axis-distance",
            "1",
            "--method",
            "bp",
            "--save-dir",
            "c",
        ]
    if command == "enroll":
        points = [f"{rng.uniform(-0.12, 0.12):.4f},{rng.uniform(-0.12, 0.12):.4f}" for _ in range(4)]
        return [
            "enroll",
            f"tag-{number}",
            *(word for point in points for word in ("--point", point)),
            "--yes",
            "--force",
        ]
    if command == "report":
        return [
            "report",
            "c",
            "--out",
            rng.choice(("first", "second")),
            "-j",
            "1",
            "--resume",
            "--no-pictures",
        ]
    return ["identify", "before.tagid.h5"]


def ran(command: str, number: int, seed: int, folder: Path) -> Ran:
    """Run one process to its end."""
    words = words_of(command, number, random.Random(f"{seed}-{number}"))
    try:
        done = _run(folder, *words)
    except subprocess.TimeoutExpired:
        return Ran(command, -1, faults=("hangs",))
    faults = []
    if done.returncode not in _ENDS[command]:
        faults.append(f"exit code {done.returncode}: {_error(done.stdout) or done.stderr.strip()[-120:]}")
    if "Traceback" in done.stderr or "Exception ignored" in done.stderr:
        faults.append("traceback")
    if len(re.findall(r"^error:", done.stderr, re.MULTILINE)) > 1:
        faults.append("several messages")
    made = ""
    if not faults and done.returncode != 1:
        made = f"tag-{number}" if command == "enroll" else _file(done.stdout)
    return Ran(command, done.returncode, made, tuple(faults))


def _answer(text: str) -> dict[str, Any]:
    try:
        result = json.loads(text)
    except ValueError:
        return {}
    return result if isinstance(result, dict) else {}


def _error(text: str) -> str:
    return str((_answer(text).get("error") or {}).get("message", ""))


def _file(text: str) -> str:
    """The first item's file in an answer."""
    items = (_answer(text).get("data") or {}).get("items") or [{}]
    return str(items[0].get("file", ""))


def missing(folder: Path, done: list[Ran]) -> list[str]:
    """What the processes acknowledged and is not there, and what they should not have left."""
    results = []
    scans = [task.made for task in done if task.command == "scan" and task.made]
    if len(set(scans)) < len(scans):
        results.append(f"{len(scans) - len(set(scans))} captures share a name")
    for name in scans:
        try:
            if not read_capture(folder / name).samples.any(axis=1).all():
                results.append(f"{name} has empty rows")
        except TagidError as error:
            results.append(f"{name}: {error.message}")
    listed = _told(folder, "layouts")
    enrolled = {item["name"] for item in (listed.get("data") or {}).get("layouts", [])}
    results += [
        f"{task.made} is not enrolled"
        for task in done
        if task.command == "enroll" and task.made not in enrolled
    ]
    answers = collections.Counter(
        str(item["command"]) for item in (_told(folder, "history").get("data") or {}).get("items", [])
    )
    for command in ("scan", "identify"):
        asked = sum(task.command == command and not task.faults for task in done)
        if answers[command] != asked:
            results.append(f"{asked} answers of {command}, {answers[command]} in the history")
    _told(folder, "report", "c", "--out", "last", "-j", "1", "--no-pictures")
    for out in ("first", "second", "last"):
        lines = [json.loads(line) for line in (folder / out / "items.jsonl").read_text().splitlines()]
        if out == "last" and len(lines) != len(scans):
            results.append(f"{len(scans)} captures, {len(lines)} in the last report")
        results += [f"{out}: {line['file']} failed" for line in lines if line["status"] == "failed"]
    remaining = [path for path in folder.rglob("*") if path.name.endswith((".tmp", ".tagid.journal"))]
    return [*results, *(f"{path.relative_to(folder)} is left" for path in remaining)]


def _run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "tagid", *words, "--output", "json", "--quiet"],
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        text=True,
        timeout=_LONGEST_S,
    )


def _told(folder: Path, *words: str) -> dict[str, Any]:
    return _answer(_run(folder, *words).stdout)


def main() -> int:
    """Run processes until the time is over, look at what they left, and print the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=120.0, help="no process is started after this time")
    parser.add_argument("--at-once", type=int, default=4, help="processes at the same time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--page", action="store_true", help="write the section of docs/results/robustness.md")
    given = parser.parse_args()
    order = random.Random(given.seed)
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(given.at_once) as threads:
        folder = Path(place)
        _told(folder, "simulate", "helmet-120", "--views", "36", "--out", "before.tagid.h5")
        for out in ("first", "second"):
            _told(folder, "report", "before.tagid.h5", "--out", out, "-j", "1", "--no-pictures")
        end = time.monotonic() + given.seconds
        done: list[Ran] = []
        waiting = set()
        number = 0
        while waiting or time.monotonic() < end:
            while len(waiting) < given.at_once and time.monotonic() < end:
                (command,) = order.choices(list(WEIGHTS), list(WEIGHTS.values()))
                waiting.add(threads.submit(ran, command, number, given.seed, folder))
                number += 1
            over = {item for item in waiting if item.done()}
            done += [item.result() for item in over]
            waiting -= over
            time.sleep(0.02)
        faults = missing(folder, done)
    rows = []
    for command in WEIGHTS:
        matching = [task for task in done if task.command == command]
        codes = collections.Counter(operation.code for operation in matching)
        named = collections.Counter(fault for operation in matching for fault in operation.faults)
        ended = ", ".join(f"{code}: {count}" for code, count in sorted(codes.items()))
        rows.append(
            (command, len(matching), ended, ", ".join(f"{k}: {n}" for k, n in named.items()) or "none")
        )
    rows.append(("afterwards", "", "", "; ".join(faults) or "none"))
    for row in rows:
        print(*row, sep=" | ")
    if given.page:
        text = (
            f"For {given.seconds:g} s, {given.at_once} processes at a time use one folder of captures, one "
            "registry, one history and two report folders. Exit code 1 of a report says that another process "
            "is writing it, exit code 3 that a tag was not named with certainty. A fault is another end, a "
            "traceback, an acknowledged capture, enrollment or answer that is missing or damaged, or a "
            "temporary file."
        )
        columns = ("command", "processes", "exit code: processes", "faults")
        write_section(Section("Commands at the same time", text, str(given.seed), columns, rows))
    return 1 if faults or any(task.faults for task in done) else 0


if __name__ == "__main__":
    sys.exit(main())
