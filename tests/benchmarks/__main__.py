"""Runs one benchmark: `python -m tests.benchmarks NAME --quick`; `list` prints all of them.

The tables are printed; --write puts them into the benchmark's page of docs/results/, long ones as CSV files
beside it. A run with --keep FILE can be stopped and continued.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.catalogue import BENCHMARKS, Benchmark, missing
from tests.benchmarks.provenance import ROOT, made_with

RESULTS = ROOT / "docs" / "results"


def listing() -> str:
    lines = []
    for benchmark in BENCHMARKS.values():
        needs = f" (needs {', '.join(benchmark.needs)})" if benchmark.needs else ""
        lines.append(f"{benchmark.name:20} {benchmark.minutes:>4} min  {benchmark.summary}{needs}")
    return "\n".join(lines)


def parser_of(benchmark: Benchmark) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m tests.benchmarks {benchmark.name}",
        description=f"{benchmark.summary}. About {benchmark.minutes} minutes of one core.",
    )
    parser.add_argument("--quick", action="store_true", help="a look: fewer scenes, shorter times")
    parser.add_argument("--seeds", type=int, help="scenes of every row, instead of the usual number")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--keep", type=Path, help="file that keeps what is done; the run continues it")
    parser.add_argument(
        "--write",
        type=Path,
        nargs="?",
        const=RESULTS,
        help=f"put the tables into {benchmark.page} of docs/results",
    )
    return parser


def main() -> int:
    """Exit codes: 0 done, 1 the benchmark says that something failed, 2 usage or a need that is not met."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help"):
        print(f"{__doc__}\n{listing()}")
        return 0 if words else 2
    if words[0] == "list":
        print(listing())
        return 0
    s = BENCHMARKS.get(words[0])
    if s is None:
        print(f"there is no benchmark {words[0]}: see `python -m tests.benchmarks list`", file=sys.stderr)
        return 2
    asks_help = "-h" in words or "--help" in words
    lacking = [] if asks_help else missing(s.needs)
    if lacking:
        print("\n".join(f"{s.name}: {line}" for line in lacking), file=sys.stderr)
        return 2
    if s.one_thread:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory(prefix="tagid-benchmark-", ignore_cleanup_errors=True) as name:
        os.environ |= {"TAGID_DATA": f"{name}/data", "TAGID_CONFIG": f"{name}/config.toml"}
        os.environ["PYTHONPATH"] = os.pathsep.join(
            filter(None, (str(ROOT), str(ROOT / "firmware_tools"), os.environ.get("PYTHONPATH")))
        )
        return run(s, words[1:], Path(name))


def run(benchmark: Benchmark, words: list[str], folder: Path) -> int:
    from tests.benchmarks import tables
    from tests.benchmarks.run import Run

    module, _, function = benchmark.work.partition(":")
    loaded = importlib.import_module(f"tests.benchmarks.{module}")
    parser = parser_of(benchmark)
    for name in ("add_options", f"{function}_options"):
        getattr(loaded, name, lambda _: None)(parser)
    given = parser.parse_args(words)
    pictures = (RESULTS.parent / "pictures") if given.write else None
    asked = Run(
        given.quick, given, given.jobs, given.keep, folder, pictures, given.seeds, name=benchmark.name
    )
    made, began = made_with("SEEDS"), time.monotonic()
    done = []
    try:
        for table in getattr(loaded, function)(asked):
            done.append(table)
            print(f"\n{table.markdown()}", flush=True)
    except KeyboardInterrupt:
        kept = f"; the same command continues it ({given.keep})" if given.keep else ""
        print(f"stopped{kept}", file=sys.stderr)
        return 130
    made[-1] = made[-1].replace("SEEDS", asked.seeds)
    if asked.commits:
        made[0] = f"{made[0].rpartition('Commit: ')[0]}Commit: {', '.join(sorted(asked.commits))}."
    print("\n" + "\n".join(made), flush=True)
    print(f"{(time.monotonic() - began) / 60:.1f} minutes", file=sys.stderr)
    if given.write:
        given.write.mkdir(parents=True, exist_ok=True)
        page = given.write / benchmark.page
        tables.write(page, benchmark.name, benchmark.title, made, done)
        print(f"{page} written", file=sys.stderr)
    return int(asked.failed)


if __name__ == "__main__":
    sys.exit(main())
