"""Cost of starting the program: CPU time of short commands against `python -c pass`, in one run.

The least of several rounds of each command is compared, taken in turn so that a busy machine hits all alike.
Each child is measured by its own user and system time (`os.wait4`), not by the clock, and its peak memory.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

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
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    child = subprocess.Popen([sys.executable, *words], cwd=folder, env=environment, **quiet)
    _, _, usage = os.wait4(child.pid, 0)
    child.returncode = 0
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def starts(run: Run) -> Iterator[Table]:
    """A row for each command."""
    run.seeds = "0"
    # Byte code is compiled once, as in any installation, whatever the surroundings say of it.
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    environment = {**kept, "PYTHONPYCACHEPREFIX": f"{run.folder}/pyc"}
    for views in (36, 360):
        words = ("simulate", "helmet-120", "--views", str(views), "--out", f"{views}.tagid.h5")
        cost(("-m", "tagid", *words), run.folder, environment)
    for words in COMMANDS.values():
        cost(words, run.folder, environment)
    results: dict[str, list[tuple[float, float]]] = {what: [] for what in COMMANDS}
    for _ in range(run.number(7, 2)):
        for what, words in COMMANDS.items():
            results[what].append(cost(words, run.folder, environment))
    base = min(seconds for seconds, _ in results["python -c pass"])
    rows = []
    for what, costs in results.items():
        seconds, memory = min(costs)[0], max(megabytes for _, megabytes in costs)
        limit = f"{LIMITS[what]:g}" if what in LIMITS else ""
        rows.append((f"`{what}`", f"{1e3 * seconds:.0f}", f"{seconds / base:.1f}", limit, f"{memory:.0f}"))
    yield Table("command | CPU (ms) | times `python -c pass` | limit | peak (MB)", rows)
