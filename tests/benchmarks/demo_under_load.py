"""How often `make demo` names its object while the computer is busy.

    python tests/benchmarks/demo_under_load.py --runs 20

Ten processes keep the cores busy while `tagid scan --demo` runs, which emulates its radar in real time. Exit
code, answer and seconds of each run are printed. The exit code is 1 where fewer than --aim percent name the
object. With --log, a run goes on where an earlier one ended.
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
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "property")]

from robustness_page import Section, write_section  # noqa: E402

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


def main() -> int:
    """Run the demo under load and print the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--busy", type=int, default=10, help="processes that keep the cores busy")
    parser.add_argument("--aim", type=float, default=95.0, help="percent that must name the object")
    parser.add_argument("--log", type=Path, help="a line for each run; those in it are not repeated")
    parser.add_argument("--page", action="store_true", help="write the section of docs/results/robustness.md")
    given = parser.parse_args()
    log = given.log or Path(os.devnull)
    before = log.read_text().splitlines() if log.is_file() else []
    outcomes = [Outcome(**json.loads(line)) for line in before]
    with busy(given.busy), log.open("a") as lines:
        for number in range(len(outcomes), given.runs):
            outcomes.append(run_demo())
            print(number + 1, outcomes[-1], flush=True)
            lines.write(json.dumps(asdict(outcomes[-1])) + "\n")
            lines.flush()
    named = sum(outcome.named for outcome in outcomes)
    took = sorted(outcome.seconds for outcome in outcomes)
    print(f"{named} of {len(outcomes)} named {OBJECT}, median {took[len(took) // 2]:.0f} s")
    if given.page:
        text = (
            f"`tagid scan --demo` while {given.busy} processes keep the cores busy. The radar is emulated in "
            f"real time over UDP. {named} of {given.runs} runs named the object."
        )
        counts = collections.Counter((one.status, one.layout or "", one.code) for one in outcomes)
        rows = [(*answer, count) for answer, count in counts.most_common()]
        columns = ("answer", "layout", "exit code", "runs")
        write_section(Section("Demo on a busy computer", text, "those of the demo", columns, rows))
    return 0 if named >= given.aim / 100 * given.runs else 1


if __name__ == "__main__":
    sys.exit(main())
