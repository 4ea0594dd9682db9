"""Attacks: what gave way once, tried again.

Each attack runs in a process and an empty folder of its own, with its own data and configuration, for at most
180 s. "Before" is the figure at commit e61f330; the test named beside it guards the fault in `make test`.

    python tests/benchmarks/attacks.py                 # all of them, under 20 minutes
    python tests/benchmarks/attacks.py F8 F9           # some
    python tests/benchmarks/attacks.py --page docs/results
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
from pathlib import Path

from provenance import ROOT, page, publish

sys.path.insert(0, str(ROOT))

from tests import attacks
from tests.attacks import ATTACKS, Attack, Outcome

LIMIT_S = 180.0


def load() -> list[Attack]:
    """All attacks, in the order of their findings."""
    for module in pkgutil.iter_modules(attacks.__path__):
        importlib.import_module(f"tests.attacks.{module.name}")

    names = [one.finding for one in ATTACKS]
    assert len(names) == len(set(names)), "two attacks of one name"
    for one in ATTACKS:
        file, _, name = one.test.partition("::")
        assert f"def {name.partition('[')[0]}(" in (ROOT / file).read_text(), (
            f"{one.finding}: no test {one.test}"
        )

    def order(one: Attack) -> tuple[str, int, str]:
        kind = one.finding.rstrip("0123456789abcdefghij ")
        digits = "".join(letter for letter in one.finding if letter.isdigit())
        return kind, int(digits or 0), one.finding

    return sorted(ATTACKS, key=order)


def alone(one: Attack) -> tuple[Outcome, float]:
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
            [sys.executable, str(Path(__file__).resolve()), "--inside", str(home / "work"), one.finding],
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


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("findings", nargs="*", help="run only these")
    parser.add_argument("--page", type=Path, help="folder of the page attacks.md")
    parser.add_argument("--inside", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    known = load()
    if options.inside:
        (one,) = [one for one in known if one.finding == options.findings[0]]
        outcome = one.run(options.inside)
        print(json.dumps({"figure": outcome.figure, "held": outcome.held}))
        return 0
    chosen = [one for one in known if not options.findings or one.finding in options.findings]
    began, held = time.monotonic(), 0
    lines = page("Attacks", "none", __doc__)
    lines += ["| finding | attack | before | now | holds | s | test |", "|---|---|---|---|---|---|---|"]
    for one in chosen:
        outcome, seconds = alone(one)
        held += outcome.held
        state = "yes" if outcome.held else "**no**"
        print(f"{one.finding}: {outcome.figure}, holds: {state}, {seconds:.0f} s", file=sys.stderr)
        cells = [one.finding, one.title, one.before, outcome.figure, state, f"{seconds:.0f}", f"`{one.test}`"]
        lines.append(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |")
    lines += ["", f"{held} of {len(chosen)} hold; {time.monotonic() - began:.0f} s in all."]
    publish(lines, options.page, "attacks.md")
    return 0 if held == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
