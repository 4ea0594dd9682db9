"""Attacks: what gave way once, tried again; and how often `make demo` names its object on a busy computer.

Each attack runs in a process and an empty folder of its own, with its own data and configuration, for at
most 180 s. "Before" is the figure at commit e61f330; the test named beside it guards the fault in `make
test`. The demo, which emulates its radar in real time, runs while ten processes keep the cores busy, and
fails where fewer than 95 % name the object.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import importlib
import json
import os
import pkgutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests import attacks
from tests.attacks import ATTACKS, Attack, Outcome
from tests.benchmarks.provenance import ROOT
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

LIMIT_S = 180.0
INSIDE = (
    "import sys; sys.path.insert(0, sys.argv[1])\n"
    "from tests.benchmarks.attacks import inside; inside(sys.argv[2], sys.argv[3])"
)


def load() -> list[Attack]:
    """All attacks, in the order of their findings."""
    for module in pkgutil.iter_modules(attacks.__path__):
        importlib.import_module(f"tests.attacks.{module.name}")

    names = [attack.finding for attack in ATTACKS]
    assert len(names) == len(set(names)), "two attacks of one name"
    for item in ATTACKS:
        file, _, name = item.test.partition("::")
        assert f"def {name.partition('[')[0]}(" in (ROOT / file).read_text(), (
            f"{item.finding}: no test {item.test}"
        )

    def order(item: Attack) -> tuple[str, int, str]:
        kind = item.finding.rstrip("0123456789abcdefghij ")
        digits = "".join(letter for letter in item.finding if letter.isdigit())
        return kind, int(digits or 0), item.finding

    return sorted(ATTACKS, key=order)


def alone(attack: Attack) -> tuple[Outcome, float]:
    """Run an attack in a process of its own; returns its outcome and how long it took, s."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="tagid-attack-", ignore_cleanup_errors=True) as folder:
        home = Path(folder)
        environment = {
            **os.environ, "HOME": folder, "TAGID_DATA": str(home / "data"),
            "TAGID_CONFIG": str(home / "config.toml"),
        }  # fmt: skip
        (home / "work").mkdir()
        process = subprocess.Popen(
            [sys.executable, "-c", INSIDE, str(ROOT), attack.finding, str(home / "work")],
            env=environment, cwd=home / "work", stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            start_new_session=True,
        )  # fmt: skip
        try:
            output, errors = process.communicate(timeout=LIMIT_S)
            outcome = Outcome(**json.loads(output.strip().splitlines()[-1]))
        except subprocess.TimeoutExpired:
            outcome = Outcome(f"not finished after {LIMIT_S:g} s", False)
        except (ValueError, IndexError, TypeError):
            outcome = Outcome(f"failed: {(errors.strip().splitlines() or ['no output'])[-1]}", False)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    return outcome, time.monotonic() - began


def inside(finding: str, folder: str) -> None:
    """One attack, in this process: prints its outcome as JSON."""
    (first,) = [item for item in load() if item.finding == finding]
    outcome = first.run(Path(folder))
    print(json.dumps({"figure": outcome.figure, "held": outcome.held}), flush=True)


def attempts_options(parser: argparse.ArgumentParser) -> None:
    """Which of them."""
    parser.add_argument("findings", nargs="*", help="run only these")


def attempts(run: Run) -> Iterator[Table]:
    """A row for every attack; it fails where one no longer holds."""
    given, known = run.options, load()
    chosen = [item for item in known if not given.findings or item.finding in given.findings]
    rows, held = [], 0
    for entry in chosen[:3] if run.quick else chosen:
        outcome, seconds = alone(entry)
        held += outcome.held
        state = "yes" if outcome.held else "**no**"
        run.say(f"{entry.finding}: {outcome.figure}, holds: {state}, {seconds:.0f} s")
        said = (entry.finding, entry.title, entry.before, outcome.figure)
        rows.append((*said, state, f"{seconds:.0f}", f"`{entry.test}`"))
    run.failed = held < len(rows)
    columns = "finding | attack | before | now | holds | s | test"
    yield Table(columns, rows, f"{held} of {len(rows)} hold.", shown=lambda row: row[4] != "yes")


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
    """How often each answer was given."""
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
