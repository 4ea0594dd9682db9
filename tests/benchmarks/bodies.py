"""Tags on bodies, blind: full-wave scenes, null and foreign objects, and whether more signal or views helps.

Run `python tests/benchmarks/bodies.py --write docs/results` for the tables, `--only fullwave --scenes 1
--development` for a check of some minutes. Every answer becomes a line of a JSONL file in --work, so that a
run can be stopped and continued; answers of another version of the reader are not used again. Sealed seeds
(tests/data/sealed_population.json) are read where the generator's hash agrees; nothing is chosen on them.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import platform
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# train/ is not installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from bodies_scenes import FULLWAVE, OWN, RECORDINGS, ROOT, Scene, captured, drawn, tagged, unnamed
from provenance import commit
from scipy.stats import beta

from tagid.capture import Capture
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.proportion import wilson
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching.matcher import MatchedScan, ReaderSettings, read_tag
from tagid.tags.matching.on_shell import on_shell
from train.population import PAIR_APART_M, STATEMENT, draw

SEALED = ROOT / "tests" / "data" / "sealed_population.json"
LAYOUTS = list(builtin_layouts().values())
GRID_VIEWS = (12, 18, 36, 72)
GRID_SNRS_DB = (0.0, 5.0, 10.0, 20.0, 30.0)
FIRST_SEALED = 169
"""First seed of the reported full-wave scenes; 1 to 167 were read before, faults mended since."""
ENROLLED_PAIR = "enrolled_pair"
"""Outcome of what was drawn as a foreign object and is none: it is left out."""
DRAWN_FROM = {True: 0, False: 720_000}
"""First number of the drawn full-wave scenes: of development, and reported; 500,000 to 710,000 on were
before."""


@dataclass(frozen=True)
class Answer:
    """What became of one scene.

    Attributes:
        group, column: row and column of the table.
        scene: what it was, for people.
        outcome: "correct", "wrong" or the code of the refusal.
        kind: hypothesis that won.
        reason: of a refusal.
        seconds: CPU time of the reading.
    """

    group: str
    column: str
    scene: str
    outcome: str
    kind: str
    reason: str
    seconds: float


NOT_FOREIGN = Answer("", "", "", ENROLLED_PAIR, "", "", 0.0)


@dataclass(frozen=True)
class Run:
    """How the benchmark is run.

    Attributes:
        jobs: processes.
        work: folder of the answers.
        development: even seeds and numbers, on which constants may be chosen; odd ones are reported.
        until: time (monotonic, s) at which no further scene is started.
    """

    jobs: int
    work: Path
    development: bool
    until: float


@dataclass(frozen=True)
class Task:
    """One scene: a part of the benchmark and what its function takes."""

    part: str
    values: tuple[float, ...]

    @property
    def key(self) -> str:
        return f"{self.part}:" + ",".join(str(float(v)).removesuffix(".0") for v in self.values)


def read(capture: Capture, truth: str | None, row: tuple[str, str, str]) -> Answer:
    """The answer to one capture."""
    start = time.process_time()
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    reading = read_tag(preprocess(capture, settings=settings), LAYOUTS)
    seconds = round(time.process_time() - start, 3)
    outcome = reading.code.value or reading.status
    if reading.status == "identified":
        outcome = "correct" if reading.layout == truth else "wrong"
    return Answer(*row, outcome, str(reading.kind), reading.reason, seconds)


def read_as_shell(capture: Capture, row: tuple[str, str, str]) -> Answer:
    """The answer to a capture of an object that may not be named, on a thin shell alone."""
    start = time.process_time()
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    scan = MatchedScan(preprocess(capture, settings=settings), LAYOUTS, ReaderSettings())
    found = on_shell(scan.own, scan.scans, LAYOUTS, ReaderSettings().contest)
    seconds = round(time.process_time() - start, 3)
    if found is None:
        return Answer(*row, "no shell", "", "", seconds)
    outcome = "wrong" if found.status == "identified" else found.code.value
    return Answer(*row, outcome, str(found.kind), found.reason, seconds)


def degrees(scene: Scene) -> str:
    """Angles of the reflectors, for people."""
    return "" if scene.angles_deg is None else f"({', '.join(f'{angle:.0f}' for angle in scene.angles_deg)})"


def one(task: Task) -> tuple[str, Answer]:
    """One scene, made and read."""
    numbers = [int(v) for v in task.values]
    if task.part in ("tagged", "unnamed"):
        which, how, seed = numbers
        scene, recording = (tagged() if task.part == "tagged" else unnamed())[which], RECORDINGS[how]
        row = (scene.group, recording.label, f"{scene.name} {degrees(scene)}")
        return task.key, read(captured(scene, recording, seed), scene.truth, row)
    if task.part == "drawn":
        scene, recording = drawn(numbers[0])
        if scene.is_enrolled_pair:
            return task.key, NOT_FOREIGN
        row = (scene.group, "all", f"{scene.name} {degrees(scene)} {recording.label}")
        return task.key, read(captured(scene, recording, numbers[0]), None, row)
    if task.part == "null":
        specimen = draw(numbers[0])
        if specimen.is_enrolled_pair:
            return task.key, NOT_FOREIGN
        row = (
            specimen.body,
            f"{specimen.views} views",
            f"{specimen.reflectors} reflectors {specimen.clutter}",
        )
        return task.key, read(specimen.capture, None, row)
    if task.part == "shell":
        specimen = draw(numbers[0])
        row = (specimen.body, f"{specimen.views} views", f"{specimen.reflectors} reflectors")
        return task.key, read_as_shell(specimen.capture, row)
    seed, views, snr = numbers
    specimen = draw(seed, tagged=True, views=views, snr_db=float(snr))
    row = (f"{views} views", f"{snr} dB", specimen.body)
    return task.key, read(specimen.capture, specimen.truth, row)


@cache
def reader_hash() -> str:
    """Hash of everything that decides an answer."""
    digest = hashlib.sha256(" ".join(sorted(path.name for path in OWN.glob("*.npz"))).encode())
    for folder in (
        "tagid/tags",
        "tagid/imaging",
        "tagid/fields",
        "train/population.py",
        "tests/benchmarks/bodies_scenes.py",
    ):
        path = ROOT / folder
        for file in [path] if path.is_file() else sorted(path.rglob("*")):
            if file.suffix in (".py", ".json") and "ats" not in file.parts:
                digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def mixed(tasks: list[Task]) -> list[Task]:
    """Tasks in an order drawn once: a run that is stopped by the time has read a fair sample."""
    return [tasks[i] for i in np.random.default_rng(5).permutation(len(tasks))]


def answered(tasks: Sequence[Task], run: Run) -> list[Answer]:
    """The answers to tasks, from the file or by reading; those that time did not allow are left out."""
    path = run.work / f"answers-{reader_hash()}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    known: dict[str, Answer] = {}
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            found = json.loads(line)
        except ValueError:
            # A run that was stopped may leave half a line.
            continue
        key = found.pop("key")
        known[key] = Answer(**found)
    missing = [task for task in tasks if task.key not in known]
    with path.open("a") as file:
        for key, answer in _read_all(missing, run):
            known[key] = answer
            file.write(json.dumps({"key": key, **asdict(answer)}) + "\n")
            file.flush()
    return [known[task.key] for task in tasks if task.key in known]


def _read_all(tasks: Sequence[Task], run: Run):  # type: ignore[no-untyped-def]
    """(key, answer) of tasks until the time is up."""
    if run.jobs == 1:
        for task in tasks:
            if time.monotonic() > run.until:
                return
            yield one(task)
        return
    with multiprocessing.get_context("fork").Pool(run.jobs) as pool:
        for found in pool.imap(one, tasks):
            yield found
            if time.monotonic() > run.until:
                pool.terminate()
                return


def cell(hits: int, total: int) -> str:
    """Counts with Wilson's 95 % interval."""
    interval = wilson(hits / total, total)
    return f"{hits}/{total} ({100 * interval.low:.0f}..{100 * interval.high:.0f} %)"


def most(hits: int, total: int) -> str:
    """Upper end of the exact 95 % interval (Clopper and Pearson 1934), one-sided."""
    return f"{100 * (1.0 if hits == total else beta.ppf(0.95, hits + 1, total - hits)):.2f} %"


def table(answers: list[Answer], wanted: str) -> list[str]:
    """Groups against conditions: how many had the outcome wanted; "refused" is any that names nothing."""
    columns = list(dict.fromkeys(a.column for a in answers))
    lines = ["| | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    for group in dict.fromkeys(a.group for a in answers):
        cells = []
        for column in columns:
            own = [a.outcome for a in answers if a.group == group and a.column == column]
            hits = sum(o == wanted or (wanted == "refused" and o not in ("correct", "wrong")) for o in own)
            cells.append(cell(hits, len(own)) if own else "")
        lines.append(f"| {group} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def reasons(answers: list[Answer]) -> str:
    """Refusals by code."""
    count = Counter(a.outcome for a in answers if a.outcome not in ("correct", "wrong"))
    return ", ".join(f"{code} {n}" for code, n in count.most_common()) or "none"


def named(answers: list[Answer]) -> str:
    """How many were named, and the bound that follows."""
    count = sum(a.outcome in ("correct", "wrong") for a in answers)
    bound = most(count, len(answers))
    return f"Named: {count} of {len(answers)}; 95 % upper bound (Clopper and Pearson): {bound}."


def fullwave(run: Run, number: int) -> list[str]:
    """Named and refused full-wave scenes."""
    seeds = [2 * i + (0 if run.development else FIRST_SEALED) for i in range(number)]
    grid = [(how, seed) for seed in seeds for how in range(len(RECORDINGS))]
    own = answered(mixed([Task("tagged", (i, *g)) for g in grid for i in range(len(tagged()))]), run)
    if not own:
        return ["No scene was read in the time allowed."]
    own.sort(key=lambda a: [r.label for r in RECORDINGS].index(a.column))
    wrong = sum(a.outcome == "wrong" for a in own)
    lines = ["Named rightly, blind (95 % interval):", "", *table(own, "correct")]
    lines += [f"Named wrongly: {cell(wrong, len(own))}. Refusals: {reasons(own)}.", ""]
    if len(own) < len(grid) * len(tagged()):
        lines += [f"{len(own)} of {len(grid) * len(tagged())} scenes were read in the time allowed.", ""]
    for answer in own:
        if answer.outcome != "correct" and run.development:
            lines += [f"    {answer.scene} | {answer.column} | {answer.outcome} | {answer.reason}"]
    time_ = sorted(a.seconds for a in own if a.column.startswith("36 views")) or [0.0]
    return [
        *lines,
        f"CPU seconds of a reading at 36 views: median {np.median(time_):.2f}, most {time_[-1]:.2f}.",
    ]


def foreign(run: Run, number: int) -> list[str]:
    """Full-wave objects that carry no enrolled tag: fixed ones, and drawn ones."""
    seed = 0 if run.development else FIRST_SEALED
    grid = [(how, seed) for how in range(len(RECORDINGS))]
    tasks = mixed([Task("unnamed", (i, *g)) for i in range(len(unnamed())) for g in grid])
    fixed = answered(tasks, run)
    fixed.sort(key=lambda a: [r.label for r in RECORDINGS].index(a.column))
    if len(fixed) < len(tasks):
        number = 0
    first = DRAWN_FROM[run.development]
    read_ones = answered([Task("drawn", (first + i,)) for i in range(number)], run)
    random = [a for a in read_ones if a.outcome != ENROLLED_PAIR]
    if not fixed and not random:
        return ["No scene was read in the time allowed."]
    lines = [named([*fixed, *random]), "", *table(fixed, "refused")]
    lines += table(random, "refused") if random else []
    if len(fixed) < len(tasks):
        lines += [f"{len(fixed)} of {len(tasks)} fixed scenes were read in the time allowed.", ""]
    if random:
        pairs = len(read_ones) - len(random)
        lines += [
            f"Drawn scenes: numbers {first} to {first + len(read_ones) - 1}. Bare pairs within "
            f"{PAIR_APART_M * 1e3:.0f} mm of an enrolled spacing are that layout: {pairs} are left out.",
            "",
        ]
    lines += [f"    {a.group} | {a.scene} | {a.kind}" for a in (*fixed, *random) if a.outcome == "wrong"]
    return lines


def sealed_seeds() -> range:
    """The sealed seeds. Ends the program where the generator is not the one that they were sealed with."""
    sealed = json.loads(SEALED.read_text())
    digest = hashlib.sha256((ROOT / "train" / "population.py").read_bytes()).hexdigest()
    if digest != sealed["generator_sha256"]:
        raise SystemExit("train/population.py changed after the seeds were sealed: seal new ones")
    return range(sealed["first"], sealed["first"] + sealed["count"])


def null(run: Run, number: int) -> list[str]:
    """Named objects of the sealed population; of its own seeds in development."""
    seeds = range(100_000, 110_000) if run.development else sealed_seeds()
    seeds = seeds[: min(number, len(seeds))]
    drawn_ones = answered([Task("null", (seed,)) for seed in seeds], run)
    answers = [a for a in drawn_ones if a.outcome != ENROLLED_PAIR]
    head = f"Population: {STATEMENT}. Seeds {seeds[0]} to {seeds[0] + len(drawn_ones) - 1}."
    lines = [head, "", named(answers), "", *table(answers, "refused")]
    if run.development:
        lines += [
            f"    {a.group} | {a.column} | {a.scene} | {a.kind}" for a in answers if a.outcome == "wrong"
        ]
    return lines


def shells(run: Run, number: int) -> list[str]:
    """Objects of the sealed population that a thin shell alone names, on top of the other names."""
    seeds = range(5_300_000, 5_310_000) if run.development else sealed_seeds()
    seeds = seeds[: min(number, len(seeds))]
    answers = answered([Task("shell", (seed,)) for seed in seeds], run)
    head = f"Population: {STATEMENT}. Seeds {seeds[0]} to {seeds[0] + len(answers) - 1}."
    lines = [head, "", named(answers), "", *table(answers, "refused")]
    return lines + [f"    {a.group} | {a.column} | {a.scene}" for a in answers if a.outcome == "wrong"]


def monotone(run: Run, number: int) -> list[str]:
    """Tagged objects of the population at every SNR and number of views: the same seeds in each cell."""
    # 50,000 to 110,000 on were reported before.
    first = 0 if run.development else 120_000
    tasks = [Task("grid", (first + s, v, n)) for s in range(number) for v in GRID_VIEWS for n in GRID_SNRS_DB]
    answers = answered(tasks, run)
    answers.sort(key=lambda a: (int(a.group.split()[0]), int(a.column.split()[0])))
    lines = ["Bare tags and cans of the simulated population, named rightly:", "", *table(answers, "correct")]
    rate = {
        (v, n): np.mean(
            [a.outcome == "correct" for a in answers if (a.group, a.column) == (f"{v} views", f"{n:.0f} dB")]
            or [0]
        )
        for v in GRID_VIEWS
        for n in GRID_SNRS_DB
    }
    falls = [rate[v, a] - rate[v, b] for v in GRID_VIEWS for a, b in pairwise(GRID_SNRS_DB)]
    falls += [rate[a, n] - rate[b, n] for n in GRID_SNRS_DB for a, b in pairwise(GRID_VIEWS)]
    wrong = sum(a.outcome == "wrong" for a in answers)
    lines += [
        f"Largest fall from one cell to the next with more signal or views: {100 * max(falls):.1f} points."
    ]
    return [*lines, f"Named wrongly: {cell(wrong, len(answers))}. Refusals: {reasons(answers)}."]


PARTS: dict[str, tuple[str, Callable[[Run, int], list[str]]]] = {
    "fullwave": ("Full-wave scenes with an enrolled tag", fullwave),
    "foreign": ("Full-wave scenes without an enrolled tag", foreign),
    "null": ("Simulated null and foreign objects", null),
    "shells": ("Simulated null and foreign objects, as tags on shells", shells),
    "monotone": ("More signal, more views", monotone),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", choices=tuple(PARTS), default=tuple(PARTS))
    parser.add_argument("--scenes", type=int, default=4, help="recordings of each full-wave scene")
    parser.add_argument("--foreign", type=int, default=500, help="drawn full-wave scenes")
    parser.add_argument("--objects", type=int, default=10_000, help="sealed objects")
    parser.add_argument("--grid", type=int, default=100, help="tagged objects in each cell of the grid")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1e9, help="start no further scene after this time")
    parser.add_argument("--development", action="store_true", help="the seeds on which constants are chosen")
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "bodies", help="folder of the answers")
    parser.add_argument("--write", type=Path, help="folder for bodies.md")
    arguments = parser.parse_args()
    until = time.monotonic() + arguments.seconds
    run = Run(arguments.jobs, arguments.work, arguments.development, until)
    numbers = {
        "fullwave": arguments.scenes,
        "foreign": arguments.foreign,
        "null": arguments.objects,
        "shells": arguments.objects,
        "monotone": arguments.grid,
    }
    words = " ".join(["python", *sys.argv])
    reported = f"odd from {FIRST_SEALED}; nothing was chosen on them"
    seeds = "even, of development" if arguments.development else reported
    lines = ["# Tags on bodies, read blind", ""]
    lines += [f"Command: `{words}`.", f"Commit: {commit()}. Reader: {reader_hash()}."]
    lines += [
        f"Machine: {platform.machine()}, {os.cpu_count()} cores, one thread per scene, Python "
        f"{platform.python_version()}, numpy {np.__version__}. Date: {datetime.now(UTC):%Y-%m-%d}.",
        f"Seeds: {seeds}.",
        f"Full-wave responses: {'../shared/fullwave and ' if FULLWAVE.is_dir() else ''}tests/data/responses.",
        "",
    ]
    for name in arguments.only:
        title, part = PARTS[name]
        lines += [f"## {title}", "", *part(run, numbers[name]), ""]
    text = "\n".join(lines).rstrip() + "\n"
    print(text)
    if arguments.write:
        arguments.write.mkdir(parents=True, exist_ok=True)
        (arguments.write / "bodies.md").write_text(text)


if __name__ == "__main__":
    main()
