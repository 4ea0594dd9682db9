"""Start-up time of `tagid --help` against an empty Python, and memory and time of `tagid identify`.

Run: python tests/benchmarks/bench_process.py
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path


def seconds(arguments: list[str], repeats: int = 15) -> float:
    """Fastest of some runs, s: the others were disturbed."""
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
        best = min(best, time.perf_counter() - start)
    return best


def identify(path: Path, environment: dict[str, str]) -> tuple[float, float]:
    """(seconds, MB at the peak) of one identify in a process of its own, on one core."""
    code = (
        "import os, resource, sys; os.sched_setaffinity(0, {0})\n"
        "sys.modules['torch'] = None  # as on a computer without torch\n"
        "from tagid.cli.app import main; sys.argv = ['tagid', 'identify', sys.argv[1], '-q']\n"
        "try: main()\n"
        "finally: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, file=sys.stderr)\n"
    )
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], env=environment, capture_output=True, text=True, check=False
    )
    return time.perf_counter() - start, float(done.stderr.split()[-1])


def main() -> None:
    date = datetime.now(UTC).strftime("%Y-%m-%d")
    print(f"{date}, {platform.processor() or platform.machine()}, {os.cpu_count()} cores, Python "
          f"{platform.python_version()}\n")  # fmt: skip
    empty = seconds(["-c", "pass"])
    help_ = seconds(["-m", "tagid", "--help"])
    print(
        f"tagid --help {help_ * 1e3:.0f} ms, python -c pass {empty * 1e3:.0f} ms: ratio {help_ / empty:.1f}"
    )
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "TAGID_DATA": folder, "TAGID_CONFIG": f"{folder}/c.toml"}
        environment["OMP_NUM_THREADS"] = "1"
        for views in (36, 360):
            path = Path(folder) / f"{views}.tagid.h5"
            subprocess.run(
                [sys.executable, "-m", "tagid", "simulate", "helmet-120", "--views", str(views), "--out",
                 str(path), "-q"], check=True, stdout=subprocess.DEVNULL, env=environment,
            )  # fmt: skip
            took, memory = identify(path, environment)
            print(f"tagid identify, {views} views, one core, no torch: {took:.2f} s, {memory:.0f} MB")


if __name__ == "__main__":
    main()
