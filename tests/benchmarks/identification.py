"""How often the reader is right: layouts, views, SNR, other objects, imperfections, and the limit.

Run `python tests/benchmarks/identification.py --jobs 2` for what docs/results/identification.md shows,
`--short` for a check of some minutes, `--only grid` (roc, methods, robustness) for a part.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# train/ is not installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from identification_images import read_image
from identification_scenes import SETS, TWISTS, Condition, Recorded, record

from tagid.proportion import wilson
from tagid.tags.matching.matcher import read_tag
from tagid.tags.reading.decision import DecisionSettings, Evidence, decide
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.hypotheses import SearchSettings, search

VIEWS = (360, 36, 18, 12)
SNRS_DB = (20, 10, 5, 0)
OUTCOMES = ("correct", "ambiguous", "unknown", "no_tag", "wrong")
PARTS = ("grid", "others", "roc", "methods", "robustness")
HARD = ((36, 10), (36, 0), (12, 10), (18, 0))
FALSE_ACCEPTS = (1e-4, 1e-3, 1e-2, 1e-1)


@dataclass(frozen=True)
class Outcome:
    """What became of one scene."""

    condition: Condition
    method: str
    outcome: str
    seconds: float
    evidence: Evidence | None = None
    right: bool = False


@dataclass(frozen=True)
class Said:
    """What a method says of a recording: its status, the likeliest layout, and any evidence."""

    status: str
    layout: str
    evidence: Evidence | None = None


@dataclass(frozen=True)
class Task:
    """One scene of a condition, and the method that reads it."""

    condition: Condition
    method: str
    number: int


def by_reader(recorded: Recorded, enrolled: str) -> Said:
    """The product."""
    reading = read_tag(recorded.scans, SETS[enrolled])
    return Said(reading.status, reading.nearest, reading.evidence)


def by_limit(recorded: Recorded, enrolled: str) -> Said:
    """Likelihood ratio of templates with rotation and centre free; distance, pulse and noise are known."""
    matched = MatchedField(recorded.scans, 0.16)
    settings = SearchSettings(
        offsets_m=(recorded.range_offset_m,), arc_step_m=4e-3, centre_step_m=3.4e-3, starts=5, balance=1e-9
    )
    fits = search(matched, SETS[enrolled], settings)
    n = matched.independent_samples
    gain = [fit.explained / matched.noise_variance - fit.layout.size * np.log(n) for fit in fits]
    return Said("identified", fits[int(np.argmax(gain))].layout.name)


def by_estimated_limit(recorded: Recorded, enrolled: str) -> Said:
    """The same with distance and noise estimated: the reader's best layout, without its right to refuse."""
    return Said("identified", read_tag(recorded.scans, SETS[enrolled]).nearest)


def by_image(method: str, finder: str, recorded: Recorded, enrolled: str) -> Said:
    """An image, its reflectors by local maxima or the network, and the likeliest layout for them."""
    reading = read_image(recorded.capture, SETS[enrolled], method, finder)
    return Said(reading.status, reading.matches[0].layout.name)


METHODS: dict[str, Callable[[Recorded, str], Said]] = {
    "reader": by_reader,
    "limit, known": by_limit,
    "limit, estimated": by_estimated_limit,
    "BP + local maxima": partial(by_image, "bp", "maxima"),
    "BP + network": partial(by_image, "bp", "network"),
    "ATS + local maxima": partial(by_image, "ats", "maxima"),
    "ATS + network": partial(by_image, "ats", "network"),
}
"""Rows by method."""


def one(task: Task) -> Outcome:
    """One scene, recorded and read."""
    recorded = record(task.condition, task.number)
    start = time.perf_counter()
    said = METHODS[task.method](recorded, task.condition.enrolled)
    seconds = time.perf_counter() - start
    right = said.layout == recorded.name
    outcome = said.status if said.status != "identified" else "correct" if right else "wrong"
    return Outcome(task.condition, task.method, outcome, seconds, said.evidence, right)


def cell(hits: int, total: int) -> str:
    interval = wilson(hits / total, total)
    return f"{100 * hits / total:.1f} ({100 * interval.low:.1f}..{100 * interval.high:.1f})"


def table(head: str, rows: Iterable[tuple[str, list[Outcome]]], columns: tuple[str, ...] = OUTCOMES) -> None:
    """A markdown table of outcomes in per cent, one line a row."""
    names = f"{head} | scenes | {' | '.join(columns)} | seconds"
    print(f"| {names} |\n|" + "---|" * (names.count("|") + 1))
    for name, some in rows:
        if some:
            count = Counter(o.outcome for o in some)
            cells = " | ".join(cell(count[c], len(some)) for c in columns)
            print(f"| {name} | {len(some)} | {cells} | {np.median([o.seconds for o in some]):.2f} |")
    print(flush=True)


class Runner:
    """Runs scenes in parallel and keeps what was asked for twice."""

    def __init__(self, jobs: int) -> None:
        self.pool = multiprocessing.get_context("fork").Pool(jobs)
        self.known: dict[tuple[Condition, str, int], list[Outcome]] = {}

    def run(self, condition: Condition, scenes: int, method: str = "reader") -> list[Outcome]:
        key = condition, method, scenes
        if key not in self.known:
            tasks = [Task(condition, method, i) for i in range(scenes)]
            self.known[key] = list(self.pool.imap(one, tasks, chunksize=4))
            wrong = [i for i, o in enumerate(self.known[key]) if o.outcome == "wrong"]
            print(condition, method, f"wrong: {wrong}" if wrong else "", file=sys.stderr, flush=True)
        return self.known[key]


def grid(runner: Runner, arguments: argparse.Namespace) -> None:
    for enrolled in arguments.sets:
        print(f"Tagged, {enrolled} ({len(SETS[enrolled])} layouts)\n")
        rows = []
        for views in arguments.views:
            for snr in arguments.snr:
                condition = Condition("tagged", enrolled, views, snr)
                rows.append((f"{views} | {snr}", runner.run(condition, arguments.scenes)))
        table("views | SNR dB", rows)


def others(runner: Runner, arguments: argparse.Namespace) -> None:
    for group in ("unenrolled", "untagged"):
        print(f"{group.capitalize()} objects, the paper's four enrolled\n")
        rows = [
            (f"{v} | {s}", runner.run(Condition(group, "paper", v, s), arguments.scenes)) for v, s in HARD
        ]
        table("views | SNR dB", rows, OUTCOMES[1:])
    print("SNR of the summed echo (`tagid simulate --snr-of summed`): up to 6 dB less per reflector\n")
    rows = []
    for views, snr in HARD:
        condition = Condition("tagged", "paper", views, snr, "SNR of the summed echo")
        rows.append((f"{views} | {snr}", runner.run(condition, arguments.scenes)))
    table("views | SNR dB", rows)


def roc(runner: Runner, arguments: argparse.Namespace) -> None:
    print("Named, in per cent, at a false-accept setting (the paper's four enrolled)\n")
    head = "views | SNR dB | false accept | tagged, right | unenrolled, named | untagged, named"
    print(f"| {head} |\n|" + "---|" * 6)
    for views, snr in HARD:
        groups = [
            runner.run(Condition(group, "paper", views, snr), arguments.scenes)
            for group in ("tagged", "unenrolled", "untagged")
        ]
        for rate in FALSE_ACCEPTS:
            settings = replace(DecisionSettings(), false_accept=rate)
            cells = []
            for group in groups:
                named = [
                    o.evidence is not None and decide(o.evidence, settings).status == "identified"
                    for o in group
                ]
                tagged = group[0].condition.group == "tagged"
                hits = sum(n and (o.right or not tagged) for n, o in zip(named, group, strict=True))
                cells.append(cell(hits, len(group)))
            print(f"| {views} | {snr} | {rate:g} | {' | '.join(cells)} |")
    print(flush=True)


def methods(runner: Runner, arguments: argparse.Namespace) -> None:
    print("By method, the paper's four (the limits must name a layout)\n")
    rows = []
    for views, snr in HARD:
        for method in METHODS:
            condition = Condition("tagged", "paper", views, snr)
            rows.append((f"{views} | {snr} | {method}", runner.run(condition, arguments.scenes, method)))
    table("views | SNR dB | method", rows)


def robustness(runner: Runner, arguments: argparse.Namespace) -> None:
    print(
        "Imperfections, the paper's four, 36 views a turn, 10 dB (one missing or extra: `unknown` is right)\n"
    )
    rows = [(t, runner.run(Condition("tagged", "paper", 36, 10, t), arguments.scenes)) for t in TWISTS]
    table("what", rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=400, help="scenes a cell")
    parser.add_argument("--short", action="store_true", help="24 scenes a cell, 36 and 12 views, 10 and 0 dB")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--views", type=int, nargs="*", default=VIEWS)
    parser.add_argument("--snr", type=int, nargs="*", default=SNRS_DB)
    parser.add_argument("--sets", nargs="*", choices=tuple(SETS), default=tuple(SETS), help="of the grid")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS)
    arguments = parser.parse_args()
    if arguments.short:
        arguments.scenes, arguments.views, arguments.snr = 24, (36, 12), (10, 0)
    print(
        f"Machine: {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"numpy {np.__version__}. Date: {datetime.now(UTC):%Y-%m-%d}."
    )
    print(f"Command: `python {' '.join(sys.argv)}`; {arguments.scenes} scenes a cell, one seed each.\n")
    runner = Runner(arguments.jobs)
    parts = {
        "grid": grid,
        "others": others,
        "roc": roc,
        "methods": methods,
        "robustness": robustness,
    }
    for name in arguments.only:
        parts[name](runner, arguments)


if __name__ == "__main__":
    main()
