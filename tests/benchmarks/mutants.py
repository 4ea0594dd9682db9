"""Mutation testing: how many broken lines of a module its tests notice.

    pip install cosmic-ray
    nice -n 10 python tests/benchmarks/mutants.py --page docs/results/mutants.md

One change is made at a time, in a copy of the tree, and the module's tests run on it; a change that fails
none of them survives. cosmic-ray's operators make most changes (another comparison or operator, a number one
up or down, a condition negated, `and` for `or`, another exception, a decorator removed); the others delete a
statement. Every place that can be changed is changed once, in one of its possible ways, drawn with the seed.
Left out are places that never run (annotations, imports for type checking), `is` for `==`, and bitwise
operators for arithmetic.

A process that has imported numpy and the other libraries forks for each change, so that only tagid and its
tests are imported anew. `--targets decision clock` takes some modules, `--sample 80` a random part of each,
`--again` only what survived the last run, while tests are being written. mutants_reasons.toml keeps the
reasons why a change may survive; the page lists every survivor with its own.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import os
import platform
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path

from provenance import commit

ROOT = Path(__file__).resolve().parents[2]
REASONS = Path(__file__).with_name("mutants_reasons.toml")
LIBRARIES = ("numpy", "scipy", "h5py", "hypothesis", "PIL", "serial", "rich", "typer", "jinja2", "_pytest")
"""Imported once, before the forks."""
BITS = ("RShift", "LShift", "BitOr", "BitAnd", "BitXor")
"""In place of arithmetic they would only fail on numbers that are not whole."""
MEMORY_BYTES = 6 << 30
"""Address space of a changed module's tests: a loop without an end may also fill the memory."""


ABOUT = (
    "One change at a time is made in a module, and the tests that belong to it are run; a change that fails",
    "none of them survives. Every place is changed once, in one of its possible ways, drawn with the seed:",
    "another comparison or operator, a number one up or down, a condition negated, `and` for `or`, another",
    "exception, a decorator removed, a statement deleted. The interval (Wilson) is that of the share of all",
    "changes of the module that would be killed. Places that never run, as annotations, are not counted.",
)


@dataclass(frozen=True)
class Target:
    """A module and the tests that are to notice a change in it, the likeliest first."""

    module: str
    tests: tuple[str, ...]


TARGETS = {
    "assembler": Target("tagid/radar/assembler.py", ("tests/property/test_radar_assembler.py",)),
    "clock": Target("tagid/angles/clock.py", ("tests/unit/test_motion_clock_angles.py",)),
    "journal": Target(
        "tagid/storage/journal.py",
        ("tests/unit/test_storage_journal.py", "tests/unit/test_storage_journal_sync.py"),
    ),
    "journal-records": Target(
        "tagid/storage/journal_records.py",
        ("tests/unit/test_storage_journal_records.py",),
    ),
    "decision": Target("tagid/tags/reading/decision.py", ("tests/unit/test_tags_decision.py",)),
    "operator": Target("tagid/imaging/operator.py", ("tests/unit/test_imaging_operator.py",)),
    "job": Target("tagid/batch/job.py", ("tests/unit/test_batch_fingerprint.py",)),
    "spool": Target("tagid/batch/spool.py", ("tests/unit/test_batch_spool.py",)),
}


@dataclass(frozen=True)
class Mutant:
    """One change of a module.

    Attributes:
        line: where it starts, from 1.
        kind: the operator's name.
        was, now: the changed lines before and after, in one line each.
        source: the whole module after the change.
    """

    line: int
    kind: str
    was: str
    now: str
    source: str

    @property
    def name(self) -> str:
        return f"{self.was} -> {self.now}"


@dataclass(frozen=True)
class Result:
    """What one module's run came to; `survivors` are mutants without their source."""

    target: str
    places: int
    tried: int
    killed: int
    timeouts: int
    seconds: float
    seed: int
    commit: str
    date: str
    survivors: tuple[Mutant, ...]


def main() -> int:
    """Try the mutants of some modules; returns 1 where fewer than --aim percent are killed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--targets", nargs="+", choices=TARGETS, default=list(TARGETS))
    parser.add_argument("--sample", type=int, help="changes of each module, chosen at random")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--aim", type=float, default=85.0, help="percent to be killed")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "mutants.json", help="results, JSON")
    parser.add_argument("--again", action="store_true", help="only what survived in --out; --out stays")
    parser.add_argument("--page", type=Path, help="write this page from all results in --out")
    asked = parser.parse_args()
    results = load(asked.out)
    good = True
    os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy is imported, below
    for name in asked.targets:
        mutants, places = chosen(TARGETS[name], asked.seed, asked.sample)
        if asked.again:
            left = {one.name for one in results[name].survivors} if name in results else set()
            mutants = [one for one in mutants if one.name in left]
        result = run(name, mutants, places, asked.seed)
        good &= 100 * result.killed >= asked.aim * result.tried
        if not asked.again:
            results[name] = result
            asked.out.parent.mkdir(parents=True, exist_ok=True)
            asked.out.write_text(json.dumps({k: asdict(v) for k, v in results.items()}, indent=1))
    if asked.page:
        asked.page.write_text(page([results[name] for name in TARGETS if name in results]), encoding="utf-8")
    return int(not good)


def load(path: Path) -> dict[str, Result]:
    """The results of earlier runs; empty if there are none."""
    if not path.is_file():
        return {}
    return {
        name: Result(**{**one, "survivors": tuple(Mutant(**s) for s in one["survivors"])})
        for name, one in json.loads(path.read_text()).items()
    }


# Changes


def chosen(target: Target, seed: int, sample: int | None) -> tuple[list[Mutant], int]:
    """One change of every place, or of `sample` places, in the order of lines; and the number of places."""
    source = (ROOT / target.module).read_text(encoding="utf-8")
    rng = random.Random(seed)
    places = sorted(all_places(source).items())
    drawn = [(place, rng.choice(ways)) for place, ways in places]
    if sample is not None and sample < len(drawn):
        kept = sorted(rng.sample(range(len(drawn)), sample))
        drawn = [drawn[i] for i in kept]
    mutants = []
    for (line, *_, kind), change in drawn:
        changed = change()
        was, now = difference(source, changed)
        mutants.append(Mutant(line, kind, was, now, changed))
    return mutants, len(places)


def all_places(source: str) -> dict[tuple[int, int, str], list[Callable[[], str]]]:
    """(line, column, kind) of everything that can be changed -> functions that return the changed module."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator, operator_names

    idle = list(never_run(source))
    nodes = list(ast_nodes(get_ast(source)))
    places: dict[tuple[int, int, str], list[Callable[[], str]]] = {}
    for name in operator_names():
        kind, _, way = name.rpartition("/")[2].partition("_")
        was, _, now = way.partition("_")
        identity = now in ("Is", "IsNot") and not was.startswith("Is")
        if kind.startswith("Variable") or identity or (now in BITS and was not in BITS):
            continue
        operator = get_operator(name)()
        spots = [spot for node in nodes for spot in operator.mutation_positions(node)]
        for occurrence, spot in enumerate(spots):
            if any(first <= spot[0] < last for first, last in idle):
                continue

            def change(operator: object = operator, occurrence: int = occurrence) -> str:
                return str(mutate_code(source, operator, occurrence))

            places.setdefault((*spot[0], kind), []).append(change)
    for node in deletable(ast.parse(source)):
        places[node.lineno, node.col_offset, "DeleteStatement"] = [lambda node=node: without(source, node)]
    return places


def never_run(source: str) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Start and end of annotations, which are not evaluated, and of what only a type checker imports."""
    for node in ast.walk(ast.parse(source)):
        for part in (getattr(node, "annotation", None), getattr(node, "returns", None)):
            if isinstance(part, ast.expr):
                yield _span(part)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield _span(node)
        if isinstance(node, ast.Assert) and ast.unparse(node.test).endswith("is not None"):
            yield _span(node)  # for the type checker


def _span(node: ast.stmt | ast.expr) -> tuple[tuple[int, int], tuple[int, int]]:
    assert node.end_lineno is not None and node.end_col_offset is not None
    return (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)


def deletable(tree: ast.AST) -> Iterator[ast.stmt]:
    """Statements inside functions whose absence does not leave a name undefined."""
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for node in ast.walk(function):
            call = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
            names = [part for part in ast.walk(node) if isinstance(part, ast.Name)]
            kept = isinstance(node, ast.Assign) and not any(isinstance(n.ctx, ast.Store) for n in names)
            if call or kept or isinstance(node, ast.AugAssign | ast.Raise | ast.Delete):
                assert isinstance(node, ast.stmt)
                yield node


def without(source: str, node: ast.stmt) -> str:
    """The module with `pass` in place of a statement."""
    lines = source.splitlines(keepends=True)
    first, last = node.lineno - 1, node.end_lineno or node.lineno
    return "".join([*lines[:first], " " * node.col_offset + "pass\n", *lines[last:]])


def difference(before: str, after: str) -> tuple[str, str]:
    """The lines that differ, as one line before and one after."""
    old, new = before.splitlines(), after.splitlines()
    blocks = difflib.SequenceMatcher(None, old, new, autojunk=False).get_opcodes()
    changed = [block for block in blocks if block[0] != "equal"]

    def text(lines: list[str], low: int, high: int) -> str:
        return " ".join(" ".join(lines[low:high]).split())

    return (
        " / ".join(text(old, a, b) for _, a, b, _, _ in changed),
        " / ".join(text(new, a, b) for _, _, _, a, b in changed),
    )


# Runs


def run(name: str, mutants: list[Mutant], places: int, seed: int) -> Result:
    """Run the tests of a target on every mutant, and print those that survive."""
    target = TARGETS[name]
    began = time.monotonic()
    survivors, timeouts = [], 0
    with tempfile.TemporaryDirectory(prefix="tagid-mutants-") as folder:
        copy = Path(folder)
        _copy_tree(copy)
        for library in _libraries(copy, target):
            import_module(library)
        start = time.monotonic()
        if _tests(copy, target, 600.0) != 0:
            raise SystemExit(f"{target.module}: its tests fail without a change")
        limit = 10 + 5 * (time.monotonic() - start)
        module = copy / target.module
        original = module.read_text(encoding="utf-8")
        for second, mutant in enumerate(mutants):
            module.write_text(mutant.source, encoding="utf-8")
            os.utime(module, (second, second))  # cached byte code is told from newer one by this
            code = _tests(copy, target, limit)
            timeouts += code is None
            if code == 0:
                survivors.append(replace(mutant, source=""))
                print(
                    f"{target.module}:{mutant.line} {mutant.kind}\n  - {mutant.was}\n  + {mutant.now}",
                    flush=True,
                )
        module.write_text(original, encoding="utf-8")
    killed = len(mutants) - len(survivors)
    spent = time.monotonic() - began
    print(f"{name}: {killed} of {len(mutants)} killed ({100 * killed / max(len(mutants), 1):.1f} %), "
          f"{timeouts} by the time limit; {spent:.0f} s", flush=True)  # fmt: skip
    return Result(
        target=name,
        places=places,
        tried=len(mutants),
        killed=killed,
        timeouts=timeouts,
        seconds=spent,
        seed=seed,
        commit=commit(),
        date=datetime.now(UTC).strftime("%Y-%m-%d"),
        survivors=tuple(survivors),
    )


def _copy_tree(copy: Path) -> None:
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    files = subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout
    for name in filter(None, files.decode().split("\0")):
        if (ROOT / name).is_file() or (ROOT / name).is_symlink():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name, follow_symlinks=False)
    for built in (ROOT / "tagid").rglob("*.so"):
        shutil.copy2(built, copy / built.relative_to(ROOT))


def _libraries(copy: Path, target: Target) -> list[str]:
    """Modules of `LIBRARIES` that the tests import, found in a process of their own."""
    code = "import sys, pytest; pytest.main(sys.argv[1:]); print('modules', *sys.modules, file=sys.stderr)"
    words = ["--collect-only", "-q", "-n", "0", "-p", "no:cacheprovider", *target.tests]
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        cwd=copy,
        env={**os.environ, "PYTHONPATH": str(copy)},
        capture_output=True,
        text=True,
        check=True,
    )
    names = done.stderr.rpartition("modules ")[2].split()
    # Parts of a package come with the package, some only in the order that it imports them.
    return [name for name in LIBRARIES if name in names] + [
        name for name in names if name.startswith("scipy.") and name.count(".") == 1 and name[6] != "_"
    ]


class _FirstFailure:
    """Hypothesis stops at the first failing example instead of looking for the smallest."""

    def pytest_sessionstart(self) -> None:
        from hypothesis import Phase, settings

        phases = (Phase.explicit, Phase.generate)
        settings.register_profile("first failure", derandomize=True, deadline=None, phases=phases)
        settings.load_profile("first failure")


def _tests(copy: Path, target: Target, limit_s: float) -> int | None:
    """Exit status of the tests in a fork: 0 where none fails; None where the time was over."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        os.setsid()
        silent = os.open(os.devnull, os.O_RDWR)
        for descriptor in (0, 1, 2):
            os.dup2(silent, descriptor)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        os.chdir(copy)
        os.environ["PYTHONPATH"] = str(copy)
        sys.path[:] = [str(copy), *(p for p in sys.path if Path(p or ".").resolve() != ROOT)]
        code = 3
        try:
            import pytest

            options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", f"--basetemp={copy}/temporary"]
            # The libraries are imported already, so that pytest cannot rewrite their assertions.
            options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
            code = int(pytest.main([*options, *target.tests], plugins=[_FirstFailure()]))
        finally:
            os._exit(code)
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


# Page


def page(results: list[Result]) -> str:
    """docs/results/mutants.md."""
    import numpy as np

    def all_of(values: Iterable[object]) -> str:
        return ", ".join(dict.fromkeys(str(value) for value in values))

    python = f"Python {platform.python_version()}, numpy {np.__version__}"
    lines = [
        "# Mutation tests",
        "",
        "- Command: `python tests/benchmarks/mutants.py --page docs/results/mutants.md`; `--sample` where",
        "  fewer changes were tried than there are places",
        f"- Commit: {all_of(one.commit for one in results)}",
        f"- Machine: {platform.machine()}, {os.cpu_count()} cores, {python}",
        f"- Date: {all_of(one.date for one in results)}",
        f"- Seeds: {all_of(one.seed for one in results)}",
        "",
        *ABOUT,
        "",
        "| module | places | tried | killed | by the time limit | share | 95 % |",
        "|---|---|---|---|---|---|---|",
        *(_row(f"`{TARGETS[one.target].module}`", one) for one in results),
        _row("all", _sum(results)),
        "",
        f"{sum(one.seconds for one in results) / 60:.0f} minutes, one process.",
        "",
        "## Survivors",
        "",
    ]
    reasons = _reasons()
    for one in results:
        if one.survivors:
            lines += [f"`{TARGETS[one.target].module}`", ""]
            lines += ["| line | was | survives as | reason |", "|---|---|---|---|"]
        for mutant in one.survivors:
            reason = reasons.get((mutant.was, mutant.now), "not judged yet")
            lines.append(f"| {mutant.line} | {_code(mutant.was)} | {_code(mutant.now)} | {reason} |")
        lines += [""] if one.survivors else []
    return "\n".join(lines).rstrip() + "\n"


def _sum(results: list[Result]) -> Result:
    return replace(
        results[0],
        places=sum(one.places for one in results),
        tried=sum(one.tried for one in results),
        killed=sum(one.killed for one in results),
        timeouts=sum(one.timeouts for one in results),
    )


def _reasons() -> dict[tuple[str, str], str]:
    """(was, now) -> why the change may survive."""
    if not REASONS.is_file():
        return {}
    found = tomllib.loads(REASONS.read_text(encoding="utf-8"))["survivor"]
    return {(one["was"], one["now"]): one["reason"] for one in found}


def _row(name: str, one: Result) -> str:
    from tagid.proportion import wilson

    share = one.killed / max(one.tried, 1)
    interval = wilson(share, max(one.tried, 1))
    return (
        f"| {name} | {one.places} | {one.tried} | {one.killed} | {one.timeouts} | {100 * share:.1f} % | "
        f"{100 * interval.low:.0f} to {100 * interval.high:.0f} % |"
    )


def _code(text: str) -> str:
    return f"`` {text} ``"


if __name__ == "__main__":
    raise SystemExit(main())
