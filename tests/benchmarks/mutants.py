"""Mutation tests: one small fault at a time is put into a module, and its tests are run.

Each fault of `mutants.toml` is chosen by hand, as a slip that a change of the code may bring: a wrong sign,
factor, unit or order, a bound that is off by one, a condition or a reset that is missing. A fault that no
test notices survives; the file says why it may. A fault whose text is not found exactly once is reported
as well, so that a module that changes takes its faults along. The tree is copied first, and the tests import
tagid from the copy; two modules are tried at a time. A test that runs for over 20 s and three times its usual
time has noticed the fault, too. The tables are of the last run of each module, kept in build/mutants.json.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

from tests.benchmarks.provenance import ROOT, commit
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

FILE = Path(__file__).with_suffix(".toml")
KEPT = ROOT / "build" / "mutants.json"
PROCESSES = 2
_stamps = itertools.count(1)
"""Times of changed files, s: each change has its own, by which Python tells cached byte code from newer."""
_stopped = threading.Event()
"""Set where one module failed or the program is to end: the tests of the others end, too."""


class Mutant(NamedTuple):
    """A fault: the text `now` in place of `was`; `reason`: why it may survive, "" if it may not."""

    was: str
    now: str
    reason: str = ""


class Module(NamedTuple):
    """A file, the tests that are to notice a fault in it, and the faults."""

    file: str
    tests: list[str]
    mutants: list[Mutant]


class Result(NamedTuple):
    """What became of a fault: whether a test noticed it, which one or why none did, and the commit."""

    file: str
    mutant: Mutant
    killed: bool
    remark: str
    tree: str = ""


def load() -> list[Module]:
    return [
        Module(item["file"], item["tests"], [Mutant(*mutant) for mutant in item["mutants"]])
        for item in tomllib.loads(FILE.read_text(encoding="utf-8"))["module"]
    ]


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("words", nargs="*", help="only modules whose path contains one of these")


def faults(run: Run) -> Iterator[Table]:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    words = run.options.words or (["storage/units"] if run.quick else [])
    modules = [m for m in load() if not words or any(word in m.file for word in words)]
    tree = commit()
    copies = SimpleQueue[Path]()
    for number in range(PROCESSES):
        copies.put(copy_tree(run.folder / str(number)))

    def tried(module: Module) -> list[Result]:
        copy = copies.get()
        try:
            return try_all(copy, module)
        finally:
            copies.put(copy)

    with ThreadPoolExecutor(PROCESSES) as pool:
        try:
            results = [result for item in pool.map(tried, modules) for result in item]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            _stopped.set()
            raise
    stored = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.is_file() else {}
    for file, group in itertools.groupby(results, key=lambda result: result.file):
        stored[file] = [[*r.mutant[:2], r.killed, r.remark, tree] for r in group]
    KEPT.parent.mkdir(exist_ok=True)
    KEPT.write_text(json.dumps(stored, indent=1), encoding="utf-8")
    run.failed = any(not result.killed and not result.mutant.reason for result in results)
    # Those stored for the faults that `FILE` has now.
    yield from report([
        Result(module.file, mutant, killed, remark if killed else mutant.reason or remark, tree)
        for module in load()
        for mutant in module.mutants
        for was, now, killed, remark, tree in stored.get(module.file, [])
        if (was, now) == mutant[:2]
    ])  # fmt: skip


def copy_tree(copy: Path) -> Path:
    """Copy tracked and new files and the compiled modules; check that tagid is imported from there."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    built = [str(path.relative_to(ROOT)) for path in (ROOT / "tagid").rglob("*.so")]
    for name in filter(None, names + built):
        if (ROOT / name).exists():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name, follow_symlinks=False)
    words = [sys.executable, "-c", "import tagid; print(tagid.__file__)"]
    origin = subprocess.run(
        words, cwd=copy, env=environment(copy), capture_output=True, text=True, check=True
    )
    assert Path(origin.stdout.strip()).is_relative_to(copy), origin.stdout
    return copy


def environment(copy: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}


def try_all(copy: Path, module: Module) -> list[Result]:
    """Run a module's tests on each of its faults. Raises SystemExit if they fail without one."""
    path, results = copy / module.file, list[Result]()
    began = time.monotonic()
    passed, output = run_tests(copy, module.tests, 600.0)
    if not passed:
        raise SystemExit(f"{module.file}: its tests fail without a fault\n{output[-3000:]}")
    limit_s = 20 + 3 * (time.monotonic() - began)
    source = path.read_text(encoding="utf-8")
    for mutant in module.mutants:
        if source.count(mutant.was) != 1 or mutant.was == mutant.now:
            result = f"text found {source.count(mutant.was)} times: change {FILE.name}"
            results.append(Result(module.file, mutant, False, result))
        else:
            write(path, source.replace(mutant.was, mutant.now))
            survived, output = run_tests(copy, module.tests, limit_s)
            tests = re.findall(r"^(?:FAILED|ERROR) \S*?([^/\s]+?\.py\S*)", output, re.MULTILINE)
            remark = mutant.reason if survived else tests[0] if tests else f"the limit of {limit_s:.0f} s"
            results.append(Result(module.file, mutant, not survived, remark))
        state = "killed" if results[-1].killed else "SURVIVED"
        print(f"{state} {module.file}: {code(mutant.now)}: {results[-1].remark}", file=sys.stderr)
    write(path, source)
    return results


def write(path: Path, source: str) -> None:
    path.write_text(source, encoding="utf-8")
    stamp = next(_stamps)
    os.utime(path, (stamp, stamp))


def run_tests(copy: Path, tests: list[str], limit_s: float) -> tuple[bool, str]:
    """Whether all tests pass in this time, and what pytest printed."""
    words = [sys.executable, "-m", "pytest", "-x", "-n", "0", "-p", "no:cacheprovider"]
    words += [f"--basetemp={copy}/temporary", *tests]
    printed = copy / "printed.txt"
    with printed.open("wb") as file:
        process = subprocess.Popen(
            words, cwd=copy, env=environment(copy), stdout=file, stderr=file, start_new_session=True
        )
    end = time.monotonic() + limit_s
    try:
        while process.poll() is None and time.monotonic() < end and not _stopped.is_set():
            time.sleep(0.1)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        status = process.wait()
    output = printed.read_text(encoding="utf-8", errors="replace")
    if _stopped.is_set():
        raise SystemExit("stopped")
    if status in (4, 5):
        raise SystemExit(f"{tests}: no such tests\n{output[-3000:]}")
    return status == 0, output


def report(results: list[Result]) -> Iterator[Table]:
    rows = []
    for package, group in itertools.groupby(results, key=lambda result: result.file.split("/")[1]):
        outcome = list(group)
        trees = ", ".join(sorted({result.tree for result in outcome}))
        rows.append((package, len(outcome), sum(result.killed for result in outcome), trees))
    note = f"{sum(result.killed for result in results)} of {len(results)} killed."
    yield Table("package | faults | killed | commit", rows, note)
    for name, column, killed in (("survivors", "reason", False), ("killed", "first test that fails", True)):
        lines = [
            (f"`{r.file}`", code(r.mutant.was), code(r.mutant.now), r.remark or "**not explained**")
            for r in results
            if r.killed == killed
        ]
        yield Table(f"file | was | fault | {column}", lines, f"{name.capitalize()}:", name)


def code(text: str) -> str:
    return f"`` {' '.join(text.split())} ``"
