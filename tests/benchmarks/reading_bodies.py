"""How often the reader names a tag on a real body: cans, cups, helmet shells, boxes, off the axis.

`python tests/benchmarks/reading_bodies.py --label before` writes docs/results/reader-bodies-before.md. Every
scene becomes a line of a JSONL file, so a run can be stopped and continued, or done in pieces. Scenes are
read in a fixed random order, one of every cell before a second of any. `--quick` reads 40 and only prints.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import random
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
# The package is found beside the benchmarks even where another checkout is installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import reading_bodies_scenes as scenes
from provenance import commit
from reading_bodies_scenes import Cell

from tagid.errors import TagidError
from tagid.pipeline.identify import aspect_spectra, identify
from tagid.pipeline.prepared import prepare
from tagid.pipeline.settings import ImagingSettings
from tagid.proportion import wilson
from tagid.tags.bodies.joint import Named, enrol_signature
from tagid.tags.bodies.signature import Signature, SignatureKind

ROOT = Path(__file__).resolve().parents[2]
OUTCOMES = ("correct", "ambiguous", "refused", "wrong")
ORDER_SEED = 13


@dataclass(frozen=True)
class Row:
    """One scene read: a line of the results file."""

    cell: Cell
    mode: str
    population: str
    number: int
    seed: int
    what: str
    name: str
    status: str
    answer: str
    outcome: str
    seconds: float

    @property
    def task(self) -> Task:
        """What makes it the same scene."""
        return Task(self.cell, self.mode, self.population, self.number)


@dataclass(frozen=True)
class Task:
    """One scene to be drawn and read."""

    cell: Cell
    mode: str
    population: str
    number: int


def blind(task: Task, drawn: scenes.Drawn) -> tuple[str, str]:
    """What `tagid identify` answers with the default settings: (status, layout)."""
    return answered(drawn, ())


def enrolled(task: Task, drawn: scenes.Drawn) -> tuple[str, str]:
    """The same with the untagged body enrolled from three captures; a bare tag has none."""
    return _knowing(task, drawn, "its-body", "body")


def whole(task: Task, drawn: scenes.Drawn) -> tuple[str, str]:
    """The same with the tagged object enrolled as a whole; a bare tag has no body to be enrolled with."""
    return _knowing(task, drawn, drawn.name or "another", "object")


def _knowing(task: Task, drawn: scenes.Drawn, name: str, kind: SignatureKind) -> tuple[str, str]:
    if task.cell.body == "none":
        return answered(drawn, ())
    try:
        captures = scenes.enrolment_captures(task.cell, task.population, task.number, tagged=kind == "object")
        named = [Named(f"capture {i + 1}", aspect_spectra(capture)) for i, capture in enumerate(captures)]
        signature = enrol_signature(named, name, kind).signature
    except TagidError as error:
        return f"not enrolled: {error.message}", ""
    return answered(drawn, (signature,))


def answered(drawn: scenes.Drawn, signatures: tuple[Signature, ...]) -> tuple[str, str]:
    """(status, layout) of a recording."""
    try:
        answer = identify(prepare(drawn.capture), drawn.layouts, ImagingSettings(), signatures=signatures)
    except TagidError as error:
        return f"failed: {error.code}", ""
    return answer.status, answer.reading.layout or ""


MODES: dict[str, Callable[[Task, scenes.Drawn], tuple[str, str]]] = {
    "blind": blind,
    "enrolled": enrolled,
    "object": whole,
}
"""What the reader knows: nothing of the body, the untagged body, or the object with its tag."""


def outcome_of(status: str, answer: str, name: str) -> str:
    """One of OUTCOMES. Naming anything where no name is right is wrong."""
    if status == "identified":
        return "correct" if name and answer == name else "wrong"
    return "ambiguous" if status == "ambiguous" else "refused"


def one(task: Task) -> Row:
    """One scene, drawn and read."""
    cell, population, number = task.cell, task.population, task.number
    drawn = scenes.draw(cell, population, number)
    start = time.process_time()
    status, answer = MODES[task.mode](task, drawn)
    seconds = round(time.process_time() - start, 3)
    outcome = outcome_of(status, answer, drawn.name)
    seed = scenes.seed_of(population, number)
    return Row(
        cell, task.mode, population, number, seed, drawn.what, drawn.name, status, answer, outcome, seconds
    )


def stored(path: Path) -> list[Row]:
    """Rows read before; an unfinished last line is ignored."""
    rows = []
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            found = json.loads(line)
        except ValueError:
            continue
        rows.append(Row(**{**found, "cell": Cell(**found["cell"])}))
    return rows


def tasks(arguments: argparse.Namespace) -> Iterator[Task]:
    """Scenes in the order in which they are read: rounds of the shuffled grid."""
    grid = [cell for cell in scenes.cells(tuple(arguments.worlds)) if cell.views in arguments.views]
    for number in range(arguments.first, arguments.first + arguments.rounds):
        shuffled = list(grid)
        random.Random(f"{ORDER_SEED}/{number}").shuffle(shuffled)
        for cell in shuffled:
            for mode in arguments.modes:
                if mode == "blind" or cell.world == "own":
                    yield Task(cell, mode, arguments.population, number)


def share(hits: int, total: int) -> str:
    """Per cent with its interval."""
    interval = wilson(hits / total, total)
    return f"{100 * hits / total:.1f} ({100 * interval.low:.1f}..{100 * interval.high:.1f})"


def table(head: str, groups: Iterable[tuple[str, list[Row]]]) -> list[str]:
    """A markdown table of outcomes, one line per group; empty groups are left out."""
    names = f"{head} | scenes | {' | '.join(OUTCOMES)} | median s"
    lines = [f"| {names} |", "|" + "---|" * (names.count("|") + 1)]
    for name, some in groups:
        if some:
            count = Counter(row.outcome for row in some)
            shown = " | ".join(share(count[outcome], len(some)) for outcome in OUTCOMES)
            lines.append(f"| {name} | {len(some)} | {shown} | {np.median([r.seconds for r in some]):.2f} |")
    return [*lines, ""]


def section(rows: list[Row], world: str, mode: str) -> list[str]:
    """Everything about one world and mode."""
    own = [row for row in rows if row.cell.world == world and row.mode == mode]
    paper = [row for row in own if row.cell.group == "tagged" and row.cell.enrolled == "paper"]
    if not own:
        return []
    source = "our simulator" if world == "own" else "full-wave responses"
    lines = [
        f"## {source.capitalize()}, {mode}",
        "",
        "Tagged, the paper's four layouts enrolled, 36 views:",
        "",
    ]
    at36 = [row for row in paper if row.cell.views == 36]
    bodies = [body for body in scenes.BODIES if any(row.cell.body == body for row in paper)]
    lines += table(
        "body | SNR dB",
        (
            (f"{body} | {snr}", [r for r in at36 if (r.cell.body, r.cell.snr_db) == (body, snr)])
            for body in bodies
            for snr in scenes.SNRS_DB
        ),
    )
    lines += ["All views, offsets, SNRs and pulses together, by one of them at a time:", ""]
    lines += table("body", ((b, [r for r in paper if r.cell.body == b]) for b in bodies))
    for head, field, values in (
        ("body | offset mm", "offset_mm", scenes.OFFSETS_MM),
        ("body | views", "views", scenes.VIEWS),
        ("body | pulse", "pulse", scenes.PULSES),
    ):
        lines += table(
            head,
            (
                (f"{b} | {v}", [r for r in paper if r.cell.body == b and getattr(r.cell, field) == v])
                for b in bodies
                for v in values
            ),
        )
    designed = sorted({row.cell.enrolled for row in own} - {"paper"})
    if designed:
        lines += ["Designed layouts, 36 views, offsets of 0 and 6 mm, nominal pulse:", ""]
        lines += table(
            "enrolled | body | SNR dB",
            (
                (
                    f"{r[0]} | {r[1]} | {snr}",
                    [x for x in own if (x.cell.enrolled, x.cell.snr_db) == (r[0], snr)],
                )
                for r in sorted({(x.cell.enrolled, x.cell.body) for x in own if x.cell.enrolled in designed})
                for snr in scenes.SNRS_DB
            ),
        )
    others = [row for row in own if row.cell.group != "tagged"]
    if others:
        lines += [
            "No enrolled tag, 36 views, 20 and 10 dB (`wrong`: named; the interval's end bounds it):",
            "",
        ]
        groups = sorted({(r.cell.group, r.cell.body) for r in others})
        lines += table(
            "object | body",
            [(f"{g} | {b}", [r for r in others if (r.cell.group, r.cell.body) == (g, b)]) for g, b in groups]
            + [("all | all", others)],
        )
    wrong = [row for row in own if row.outcome == "wrong"]
    lines += [f"Named wrongly: {len(wrong)} of {len(own)}.", ""]
    lines += [
        f"- {r.what} ({r.cell.views} views, {r.cell.snr_db} dB, {r.cell.offset_mm} mm): {r.answer}"
        for r in wrong
    ]
    return [*lines, ""]


METHOD = """
Bodies stand off the rotation axis together with their tag. Own scenes: octahedra of 20 or 40 mm with
strengths 0.5 dB apart, the tag's middle off the body's by 0.5 mm (standard deviation per axis), tags up to
100 mm above or below the stated plane, noise partly coloured, a narrow-band tone in every fifth scene, 1 %
wobble, axis distance wrong by up to 15 mm, room clutter. Full-wave scenes: as their scenes.py makes them,
0.01 rad wobble, axis distance wrong by up to 15 mm, vertical polarisation. No capture states its pulse. SNR
is per reflector (tagid/simulate/snr.py). `refused` is unknown, no_tag or an error. Rows that pool cells are
balanced only on average, as the scenes are a stratified random subsample. Per cent, with Wilson's 95 %
intervals.
"""


def document(rows: list[Row], arguments: argparse.Namespace) -> str:
    """The page: how it was measured, then the tables."""
    used = [row for row in rows if row.population == arguments.population]
    cells, grid = len({row.cell for row in used}), len(scenes.cells(("own", "full-wave")))
    numbers = sorted({row.number for row in used}) or [0]
    views, modes = (" ".join(map(str, some)) for some in (arguments.views, arguments.modes))
    lines = [
        f"# Reading tags on bodies: {arguments.label}",
        "",
        f"Command: `python tests/benchmarks/reading_bodies.py --label {arguments.label} --population "
        f"{arguments.population} --worlds {' '.join(arguments.worlds)} --views {views} --modes {modes} "
        f"--first {arguments.first}`",
        "(continued until the time was up).",
        f"Commit: {commit()}.",
        f"Machine: {platform.machine()}, {os.cpu_count()} cores, one thread per scene, Python "
        f"{platform.python_version()}, numpy {np.__version__}. Date: {datetime.now(UTC):%Y-%m-%d}.",
        "Seconds are processor times, with enrolment where a body is enrolled.",
        f"{len(used)} scenes in {cells} of the {grid} cells.",
        f"Seeds: population `{arguments.population}`, numbers {numbers[0]}",
        f"to {numbers[-1]} (`seed_of` in reading_bodies_scenes.py). SHA-256 of the sealed seeds:",
        f"{scenes.SEALED_SHA256}.",
        METHOD,
        *([arguments.note, ""] if arguments.note else []),
    ]
    for world in ("own", "full-wave"):
        for mode in MODES:
            lines += section(used, world, mode)
    return "\n".join(lines).rstrip() + "\n"


def run(arguments: argparse.Namespace, path: Path) -> list[Row]:
    """Read what is missing until the time is up."""
    rows = stored(path)
    known = {row.task for row in rows}
    path.parent.mkdir(parents=True, exist_ok=True)
    until = time.monotonic() + arguments.seconds
    missing = [task for task in tasks(arguments) if task not in known][: arguments.most]
    if not missing:
        return rows
    with multiprocessing.get_context("fork").Pool(arguments.jobs) as pool, path.open("a") as file:
        for row in pool.imap(one, missing):
            rows.append(row)
            file.write(json.dumps(asdict(row)) + "\n")
            file.flush()
            if time.monotonic() > until:
                pool.terminate()
                break
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--label", default="now", help="name of the table and of the results file")
    parser.add_argument("--population", choices=tuple(scenes.POPULATIONS), default="development")
    parser.add_argument("--worlds", nargs="+", choices=("own", "full-wave"), default=["own", "full-wave"])
    parser.add_argument("--modes", nargs="+", choices=tuple(MODES), default=["blind"])
    parser.add_argument("--views", nargs="+", type=int, default=list(scenes.VIEWS), help="numbers of views")
    parser.add_argument("--rounds", type=int, default=1, help="scenes per cell")
    parser.add_argument("--first", type=int, default=0, help="first number: those seen before are spent")
    parser.add_argument("--seconds", type=float, default=1e9, help="stop reading after this time")
    parser.add_argument(
        "--most", type=int, default=10**9, help="read at most so many scenes more; 0 only writes the table"
    )
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "reading-bodies", help="results folder")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results", help="folder of the table")
    parser.add_argument("--note", default="", help="a paragraph for the page")
    parser.add_argument("--quick", action="store_true", help="40 scenes, table to the terminal only")
    arguments = parser.parse_args()
    if scenes.sealed_hash() != scenes.SEALED_SHA256:
        raise SystemExit("the sealed seeds are not those whose hash is in reading_bodies_scenes.py")
    if arguments.quick:
        arguments.label, arguments.most = f"{arguments.label}-quick", 40
    rows = run(arguments, arguments.work / f"{arguments.label}.jsonl")
    page = document(rows, arguments)
    if not arguments.quick:
        arguments.out.mkdir(parents=True, exist_ok=True)
        (arguments.out / f"reader-bodies-{arguments.label}.md").write_text(page)
    print(page)


if __name__ == "__main__":
    main()
