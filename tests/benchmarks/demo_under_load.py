"""How often `make demo` names its object while the computer is busy.

Ten processes keep the cores busy while `tagid scan --demo` runs, which emulates its radar in real time. It
fails where fewer than --aim percent name the object.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

from tests.benchmarks.provenance import ROOT
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

OBJECT = "helmet-120"
_LONGEST_S = 600.0


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Processes that use a core each, as far as there are any; ended with the block."""
    spin = "while True: pass"
    processes = [subprocess.Popen([sys.executable, "-S", "-c", spin]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()


@dataclass(frozen=True)
class Outcome:
    """One run: exit code (-1: it did not end), status and layout of the answer, seconds taken."""

    code: int
    status: str
    layout: str | None
    seconds: float

    @property
    def named(self) -> bool:
        """Whether the answer is the object that was shown."""
        return self.code == 0 and self.layout == OBJECT


def run_demo() -> Outcome:
    """One `tagid scan --demo` as `make demo` starts it, with folders of its own."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("TAGID_")}
        environment |= {"TAGID_DATA": folder, "TAGID_CONFIG": f"{folder}/config.toml"}
        environment["PYTHONPATH"] = str(ROOT)
        words = [sys.executable, "-m", "tagid", "scan", "--demo", "--save-dir", f"{folder}/demo"]
        began = time.monotonic()
        try:
            done = subprocess.run(
                [*words, "--output", "json", "--quiet"],
                capture_output=True,
                text=True,
                env=environment,
                timeout=_LONGEST_S,
            )
        except subprocess.TimeoutExpired:
            return Outcome(-1, "did not end", None, _LONGEST_S)
        seconds = time.monotonic() - began
    try:
        document = json.loads(done.stdout)
    except ValueError:
        return Outcome(done.returncode, f"no result: {done.stderr.strip()[-200:]}", None, seconds)
    if document["errors"]:
        return Outcome(done.returncode, document["errors"][0]["message"][:200], None, seconds)
    (item,) = document["data"]["items"]
    return Outcome(done.returncode, item["status"], item["layout"], seconds)


def add_options(parser: argparse.ArgumentParser) -> None:
    """The load and the aim."""
    parser.add_argument("--busy", type=int, default=10, help="processes that keep the cores busy")
    parser.add_argument("--aim", type=float, default=95.0, help="percent that must name the object")


def one_run(number: int) -> dict[str, object]:
    """The outcome of the run of a number."""
    return asdict(run_demo())


def runs(run: Run) -> Iterator[Table]:
    """How often each answer was given."""
    given, count = run.options, run.number(20, 1)
    run.seeds = "those of the demo"
    with busy(given.busy):
        outcomes = [Outcome(**members) for members in run.each(one_run, list(range(count))).values()]
    named = sum(outcome.named for outcome in outcomes)
    took = sorted(outcome.seconds for outcome in outcomes)
    run.failed = named < given.aim / 100 * count
    note = (
        f"`tagid scan --demo` while {given.busy} processes keep the cores busy. The radar is emulated in "
        f"real time over UDP. {named} of {count} runs named the object, in {took[len(took) // 2]:.0f} s "
        f"(median)."
    )
    counts = collections.Counter((outcome.status, outcome.layout or "", outcome.code) for outcome in outcomes)
    rows = [(*answer, count) for answer, count in counts.most_common()]
    yield Table(("answer", "layout", "exit code", "runs"), rows, note)
