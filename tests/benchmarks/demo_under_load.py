"""How often `make demo` names its object on a busy computer.

The demo, which emulates its radar in real time, runs while ten processes keep the cores busy, and fails where
fewer than 95 % name the object.
"""

from __future__ import annotations

import collections
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tests.benchmarks.provenance import ROOT
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

OBJECT, BUSY, AIM = "helmet-120", 10, 0.95
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


Demo = dict[str, Any]
"""One run: exit code (-1: it did not end), status and layout of the answer, seconds taken."""


def one_run(number: int) -> Demo:
    """One `tagid scan --demo` as `make demo` starts it, with folders of its own."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("TAGID_")}
        environment |= {"TAGID_DATA": folder, "TAGID_CONFIG": f"{folder}/config.toml"}
        environment["PYTHONPATH"] = str(ROOT)
        words = [sys.executable, "-m", "tagid", "scan", "--demo", "--save-dir", f"{folder}/demo"]
        words += ["--output", "json", "--quiet"]
        began = time.monotonic()
        try:
            done = subprocess.run(words, capture_output=True, text=True, env=environment, timeout=_LONGEST_S)
        except subprocess.TimeoutExpired:
            return {"code": -1, "status": "did not end", "layout": None, "seconds": _LONGEST_S}
    outcome = {"code": done.returncode, "layout": None, "seconds": time.monotonic() - began}
    try:
        document = json.loads(done.stdout)
    except ValueError:
        return {**outcome, "status": f"no result: {done.stderr.strip()[-200:]}"}
    if document["errors"]:
        return {**outcome, "status": document["errors"][0]["message"][:200]}
    (item,) = document["data"]["items"]
    return {**outcome, "status": item["status"], "layout": item["layout"]}


def runs(run: Run) -> Iterator[Table]:
    count = run.number(20, 1)
    run.seeds = "those of the demo"
    with busy(BUSY):
        outcomes = [*run.each(one_run, list(range(count))).values()]
    named = sum(outcome["code"] == 0 and outcome["layout"] == OBJECT for outcome in outcomes)
    took = sorted(outcome["seconds"] for outcome in outcomes)
    run.failed = named < AIM * count
    note = (
        f"`tagid scan --demo` while {BUSY} processes keep the cores busy. The radar is emulated in "
        f"real time over UDP. {named} of {count} runs named the object, in {took[len(took) // 2]:.0f} s "
        f"(median)."
    )
    counts = collections.Counter((item["status"], item["layout"] or "", item["code"]) for item in outcomes)
    rows = [(*answer, count) for answer, count in counts.most_common()]
    yield Table("answer | layout | exit code | runs", rows, note)
