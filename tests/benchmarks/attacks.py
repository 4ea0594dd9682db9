"""Attacks: what gave way once, tried again.

Each attack runs in a process and an empty folder of its own, with its own data and configuration, for at most
180 s. "Before" is the figure at commit e61f330; the test named beside it guards the fault in `make test`.
"""

from __future__ import annotations

import argparse
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
from pathlib import Path

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


def add_options(parser: argparse.ArgumentParser) -> None:
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
