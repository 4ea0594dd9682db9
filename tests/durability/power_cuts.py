"""Power cuts at every moment of real work: what recovery finds in each state that they may leave, counted.

    nice -n 10 python tests/durability/power_cuts.py --each 12

Each case runs under strace. From its system calls every kind of state that a power cut may leave is built
(see `power_cut_states`), after each call, and the real recovery runs on it: `tagid recover`, the readers of
configuration, registry and history, `report --resume`. The exit code is 1 if anything acknowledged is lost
anywhere. To see that the states would show a missing sync, each case runs again on the same recording without
its syncs of files, and without those of folders; the states with losses are counted.
"""

from __future__ import annotations

import argparse
import collections
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS.parent), str(TESTS / "property")]

from power_cut_cases import CASES, recorded, unsynced  # noqa: E402
from power_cut_states import Density, states  # noqa: E402
from robustness_page import write_section  # noqa: E402
from syscalls import Recording, unavailable  # noqa: E402


@contextmanager
def no_waiting() -> Iterator[None]:
    """Recovery does not wait for the disk: what it makes durable is not examined."""
    real = os.fsync
    os.fsync = lambda descriptor: None
    try:
        yield
    finally:
        os.fsync = real


def try_all(
    name: str, recording: Recording, place: Path, density: Density, seed: int = 1, first: bool = False
) -> collections.Counter[str]:
    """What is lost or wrong in the states of a recording, with counts; "" counts those without a fault.

    With `first` it ends at the first fault.
    """
    promise = CASES[name].promise(recording)
    counter: collections.Counter[str] = collections.Counter()
    folder = place / "state"
    with no_waiting():
        for state in states(recording, promise.stage, density, random.Random(seed)):
            folder.mkdir()
            state.put(folder)
            fault = promise.broken(folder, state.cut)
            counter[fault] += 1
            shutil.rmtree(folder)
            if fault and first:
                break
    return counter


def main() -> int:
    """Run the cases and print their counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--each", type=int, default=8, help="states chosen at random after each system call")
    parser.add_argument("--every", type=int, default=1, help="only after every so many system calls")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--page", action="store_true", help="write the section of docs/results/robustness.md")
    given = parser.parse_args()
    missing = unavailable()
    if missing:
        print(missing)
        return 2
    rows: list[tuple[object, ...]] = []
    bad = 0
    memory = Path("/dev/shm")
    for name in given.cases.split(","):
        with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as text:
            place = Path(text)
            recording = recorded(name, place)
            outcomes = try_all(name, recording, place, Density(given.each, given.every), given.seed)
            total = sum(outcomes.values())
            lost = total - outcomes.pop("", 0)
            bad += lost
            for fault, count in outcomes.most_common(5):
                print(f"  {name}: {count} x {fault}")
            shown = []
            for kind in ("files", "folders"):
                without = try_all(name, unsynced(recording, kind), place, Density(0, 10), given.seed)
                shown.append(f"{sum(without.values()) - without['']} of {sum(without.values())}")
            rows.append((name, len(recording.operations), total, lost, *shown))
            print(*rows[-1], sep=" | ", flush=True)
    total = sum(int(str(row[2])) for row in rows)
    print(f"{total} states, {bad} with a fault")
    if given.page:
        text = (
            f"System calls recorded with strace, and {total} states that a power cut may leave. After "
            "each call, what is not synced is missing, reordered or torn; names are there without "
            "their data, or data without their names. `tagid recover` and the readers of each file "
            "run on every state. A fault is a missing scan that was written more than half a second "
            "before the last one (in `journal`: more than three records before), or anything missing "
            "that the program had reported as done. The last two columns show the states with a fault"
            " if the code did not sync files, or folders."
        )
        columns = ("case", "operations", "states", "with a fault", "files not synced", "folders not synced")
        write_section("Power cuts", text, str(given.seed), columns, rows)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
