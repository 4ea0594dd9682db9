"""Cost of starting the program: CPU time of short commands against `python -c pass`, in one run.

    python tests/benchmarks/bench_start.py [--rounds 7]

The least of several rounds of each command is compared, taken in turn so that a busy machine hits all alike.
Each child is measured by its own user and system time (`os.wait4`), not by the clock, and its peak memory.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

COMMANDS: dict[str, tuple[str, ...]] = {
    "python -c pass": ("-c", "pass"),
    "tagid --help": ("-m", "tagid", "--help"),
    "tagid layouts": ("-m", "tagid", "layouts"),
    "tagid config": ("-m", "tagid", "config"),
    "tagid identify FILE (36 views)": ("-m", "tagid", "identify", "36.tagid.h5"),
    "tagid identify FILE (360 views)": ("-m", "tagid", "identify", "360.tagid.h5"),
}
LIMITS = {"tagid --help": 8.0, "tagid layouts": 10.0}
"""Times the cost of `python -c pass`."""


def cost(words: Sequence[str], folder: Path, environment: dict[str, str]) -> tuple[float, float]:
    """CPU seconds and peak memory, MB, of one child."""
    child = subprocess.Popen(
        [sys.executable, *words],
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, _, usage = os.wait4(child.pid, 0)
    child.returncode = 0
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    rounds = parser.parse_args().rounds
    root = str(Path(__file__).resolve().parents[2])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        own = {"TAGID_DATA": name, "TAGID_CONFIG": f"{name}/config.toml", "OMP_NUM_THREADS": "1"}
        paths = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
        # Byte code is compiled once, as in any installation, whatever the surroundings say of it.
        own["PYTHONPYCACHEPREFIX"] = f"{name}/pyc"
        kept = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
        environment = {**kept, **own, "PYTHONPATH": paths}
        for views in (36, 360):
            words = ("simulate", "helmet-120", "--views", str(views), "--out", f"{views}.tagid.h5")
            subprocess.run([sys.executable, "-m", "tagid", *words], cwd=folder, env=environment, check=True,
                           stdout=subprocess.DEVNULL)  # fmt: skip
        for words in COMMANDS.values():
            cost(words, folder, environment)
        found: dict[str, list[tuple[float, float]]] = {what: [] for what in COMMANDS}
        for _ in range(rounds):
            for what, words in COMMANDS.items():
                found[what].append(cost(words, folder, environment))
    base = min(seconds for seconds, _ in found["python -c pass"])
    print("| command | CPU ms | times `python -c pass` | limit | peak MB |\n|---|---|---|---|---|")
    for what, costs in found.items():
        seconds, memory = min(costs)[0], max(megabytes for _, megabytes in costs)
        limit = f"{LIMITS[what]:g}" if what in LIMITS else ""
        print(f"| {what} | {1e3 * seconds:.0f} | {seconds / base:.1f} | {limit} | {memory:.0f} |")


if __name__ == "__main__":
    main()
