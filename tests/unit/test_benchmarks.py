"""The runner of the benchmarks: kept results are not made again, needs come first, text of a page stays."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.benchmarks import catalogue
from tests.benchmarks.run import Run
from tests.benchmarks.tables import LONG, Table, write

ROOT = Path(__file__).resolve().parents[2]
calls: list[int] = []


def square(job: tuple[int]) -> dict[str, int]:
    calls.append(job[0])
    return {"value": job[0] ** 2}


def run_of(folder: Path) -> Run:
    return Run(False, argparse.Namespace(), 1, folder / "kept.jsonl", folder, None)


def test_a_stopped_run_goes_on_and_names_every_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last line of a run that was killed may be cut; its result is made anew and stored whole."""
    jobs = [(1,), (2,), (3,)]
    monkeypatch.setenv("TAGID_COMMIT", "before")
    run_of(tmp_path).each(square, jobs)
    kept = tmp_path / "kept.jsonl"
    kept.write_text(kept.read_text()[:-5])
    calls.clear()
    monkeypatch.setenv("TAGID_COMMIT", "now")
    run = run_of(tmp_path)
    assert run.each(square, jobs) == {(1,): {"value": 1}, (2,): {"value": 4}, (3,): {"value": 9}}
    assert calls == [3] and run.commits == {"before", "now"}
    calls.clear()
    run_of(tmp_path).each(square, jobs)
    assert calls == []


def test_a_block_of_a_page_is_replaced_and_the_rest_stays(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    long = Table(("n", "square"), [(i, i * i) for i in range(LONG + 1)], shown=lambda row: row[0] == 3)
    write(page, "squares", "Squares", ["Command: a. Commit: 1."], [long])
    page.write_text(page.read_text() + "\nWritten by hand.\n")
    write(page, "squares", "Squares", ["Command: a. Commit: 2."], [long])
    text = page.read_text()
    assert text.count("## Squares") == 1 and "Commit: 2." in text and "Commit: 1." not in text
    assert text.endswith("<!-- end squares -->\n\nWritten by hand.\n")
    assert "| 3 | 9 |" in text and "| 4 | 16 |" not in text and "[squares.csv](squares.csv)" in text
    stored = (tmp_path / "squares.csv").read_text().splitlines()
    assert stored[:3] == ["# Command: a. Commit: 2.", "n,square", "0,0"] and len(stored) == LONG + 3


def test_needs_are_checked_before_anything_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(catalogue.NEEDS, "torch", (False, "pip install '.[ats]'"))
    assert catalogue.missing(("torch", "linux")) == ["torch is missing: pip install '.[ats]'"]
    words = [sys.executable, "-m", "tests.benchmarks", "no-such-benchmark"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and "tests.benchmarks list" in done.stderr


PROGRAM = """
import asyncio, os, sys, threading, time
sys.path.insert(0, sys.argv[1])
import fast_clock
fast_clock.relaunch()
assert "LD_PRELOAD" not in os.environ, "children have the true clock"
clock = fast_clock.FastClock()
began = [time.monotonic(), time.time(), clock.true_s()]
clock.run_at(1000.0)
fast_clock.CHECKED_S = 60.0
for kind, seconds, true_seconds in fast_clock.measure(clock):
    assert seconds >= 59.9 and true_seconds < seconds / 100, (kind, seconds, true_seconds)
clock.run_at(1.0)
ended = [time.monotonic(), time.time(), clock.true_s()]
monotonic, wall, truly = [now - then for now, then in zip(ended, began)]
assert monotonic > 360 and abs(monotonic / wall - 1) < 0.1 and truly < monotonic / 100
monotonic, truly = time.monotonic(), clock.true_s()
time.sleep(0.2)
assert time.monotonic() - monotonic < 5 * (clock.true_s() - truly), "at the true speed again"
"""


@pytest.mark.skipif(
    shutil.which("cc") is None or sys.platform != "linux", reason="needs a C compiler on Linux"
)
def test_all_clocks_and_waits_run_at_the_same_speed(tmp_path: Path) -> None:
    folder = Path(__file__).resolve().parents[1] / "benchmarks"
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    done = subprocess.run([sys.executable, program, folder], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
