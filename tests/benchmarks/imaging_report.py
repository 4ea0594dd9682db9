"""Tables and figures of the imaging benchmarks: printed, and on request written into docs/results/.

A block of a page between `<!-- imaging:NAME -->` and `<!-- end -->` belongs to the experiment of that name;
the script that made it replaces it as a whole, so that no figure is ever typed by hand.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from provenance import ROOT, commit

from tagid.report.axes import Axes, colour_bar
from tagid.report.canvas import Canvas
from tagid.report.colours import BLUE, GREEN, INK, ORANGE, colourise, to_decibels

RESULTS = ROOT / "docs" / "results"
PICTURES = ROOT / "docs" / "pictures"
DYNAMIC_RANGE_DB = 30.0
Job = TypeVar("Job")
Result = TypeVar("Result")
_COLOURS = ((140, 140, 150), BLUE, (110, 60, 160), GREEN, (170, 140, 30), ORANGE, (200, 30, 60), INK)


def interval(values: np.ndarray, digits: int) -> str:
    """Mean and half-width of the 95 % interval (1.96 standard errors), "-" where nothing is known."""
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return "-"
    if len(known) == 1:
        return f"{known[0]:.{digits}f}"
    half = 1.96 * known.std(ddof=1) / np.sqrt(len(known))
    return f"{known.mean():.{digits}f} ± {half:.{digits}f}"


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A markdown table."""
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"


def spread(work: Callable[[Job], Result], jobs: Sequence[Job], processes: int) -> list[Result]:
    """work(job) of every job, in order, on some processes."""
    if processes < 2:
        return [work(job) for job in jobs]
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        return pool.map(work, jobs, chunksize=1)


@dataclass(frozen=True)
class Pieces:
    """How a long table is made in pieces.

    Attributes:
        file: keeps every result (JSON lines); such files may be joined by `cat`.
        minutes: stop after so many; 0 computes all.
        part: (i, n) computes the i-th of n parts, from 0 on, and makes no table.
        made: what the results were made with; `resumed` fills it.
        made_of: the same of every result, by its job.
    """

    file: Path | None = None
    minutes: float = 0.0
    part: tuple[int, int] | None = None
    made: set[str] = field(default_factory=set)
    made_of: dict[Any, str] = field(default_factory=dict)

    @classmethod
    def add_options(cls, parser: argparse.ArgumentParser) -> None:
        """--resume, --minutes and --part."""
        parser.add_argument("--resume", type=Path, help="file that keeps what is done")
        parser.add_argument("--minutes", type=float, default=0.0, help="stop after so many, with --resume")
        parser.add_argument("--part", help="I/N: compute the I-th of N parts, from 0 on, with --resume")

    @classmethod
    def of(cls, given: argparse.Namespace) -> Pieces:
        """From the parsed options; the parts must be numbers I < N."""
        part = None
        if given.part:
            i, n = (int(word) for word in given.part.split("/"))
            if not 0 <= i < n or given.resume is None:
                raise SystemExit("--part I/N needs 0 <= I < N and --resume")
            part = (i, n)
        return cls(given.resume, given.minutes, part)


def resumed(work: Callable[[Job], dict[str, Any]], jobs: Sequence[Job], pieces: Pieces) -> dict[Job, Any]:
    """work(job) of every job (a NamedTuple), kept in `pieces.file`, so that a long table is made in pieces.

    After `pieces.minutes` it returns what there is; the next call with the same file goes on. With
    `pieces.part`, a run of neighbouring jobs, it ends the program once that part is computed. Of several
    results of one job the later members count, so that a file with new ones of some rows may follow.
    """
    found: dict[Job, Any] = {}
    name = work.__name__
    if pieces.file is not None and pieces.file.exists():
        known = [json.loads(line) for line in pieces.file.read_text().splitlines()]
        by_key = {json.dumps(job): job for job in jobs}
        for entry in known:
            job = by_key.get(json.dumps(entry["job"]))
            if entry["work"] == name and job is not None:
                found[job] = {**found.get(job, {}), **entry["found"]}
                pieces.made.add(entry["made"])
                pieces.made_of[job] = entry["made"]
    mine = list(jobs)
    if pieces.part is not None:
        i, n = pieces.part
        mine = mine[i * len(jobs) // n : (i + 1) * len(jobs) // n]
    here = made_with()
    began = time.monotonic()
    for job in mine:
        if job in found:
            continue
        if pieces.minutes and time.monotonic() - began > 60 * pieces.minutes:
            print(f"{len(found)} of {len(jobs)} done; run again with the same --resume", file=sys.stderr)
            break
        found[job] = work(job)
        pieces.made.add(here)
        pieces.made_of[job] = here
        if pieces.file is not None:
            entry = {"work": name, "made": here, "job": job, "found": found[job]}
            with pieces.file.open("a") as file:
                print(json.dumps(entry), file=file)
    if pieces.part is not None:
        raise SystemExit(0)
    return found


def made_with() -> str:
    """Commit, date and machine, in words."""
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    return f"commit {commit()}, {date.today()}, {machine}, numpy {np.__version__}"


def heading(title: str, command: str, seeds: str, made: Iterable[str] = ()) -> str:
    """Title of a page of results and where its tables come from: `made` as `made_with`, or this machine."""
    parts = [each.removeprefix("commit ").split(", ", 2) for each in sorted(made) or [made_with()]]
    commits, dates, machines = ("; ".join(dict.fromkeys(column)) for column in zip(*parts, strict=True))
    return (
        f"# {title}\n\n- Command: `{command}`\n- Commit: {commits.removeprefix('commit ')}\n"
        f"- Machine: {machines}\n- Date: {dates}\n- Seeds: {seeds}\n"
    )


def write_block(page: str, name: str, title: str, text: str) -> None:
    """Replace the block of that name in docs/results/PAGE.md, or add it at the end."""
    path = RESULTS / f"{page}.md"
    content = path.read_text(encoding="utf-8")
    block = f"<!-- imaging:{name} -->\n## {title}\n\n{text.strip()}\n<!-- end -->\n"
    there = re.compile(rf"<!-- imaging:{re.escape(name)} -->\n.*?<!-- end -->\n", re.DOTALL)
    if there.search(content):
        content = there.sub(lambda _: block, content)
    else:
        content = content.rstrip("\n") + "\n\n" + block
    path.write_text(content, encoding="utf-8")


def write_rows(
    page: str, name: str, text: str, rows: Sequence[str], made: str, others: Sequence[str] = ()
) -> None:
    """Replace the lines of some methods in the tables of a block; a sentence says what made them.

    A line that the block lacks goes below those of its case, of `rows` and of `others`.

    Raises:
        SystemExit: the page has no such block, or no line of a case.
    """
    path = RESULTS / f"{page}.md"
    content = path.read_text(encoding="utf-8")
    there = re.search(rf"<!-- imaging:{re.escape(name)} -->\n.*?<!-- end -->\n", content, re.DOTALL)
    if there is None:
        raise SystemExit(f"{path} has no block {name}")
    lines = there.group().splitlines()
    new = text.splitlines()
    for line, key in zip(new, _keys(new, rows), strict=True):
        if key is None:
            continue
        keys = _keys(lines, (*rows, *others))
        if key in keys:
            lines[keys.index(key)] = line
            continue
        case = [i for i, each in enumerate(keys) if each is not None and each[:-1] == key[:-1]]
        if not case:
            raise SystemExit(f"block {name} has no line {key}")
        lines.insert(case[-1] + 1, line)
    note = f"{', '.join(rows)}: {made}."
    lines = [line for line in lines if not line.startswith(f"{', '.join(rows)}: commit ")]
    block = "\n".join([*lines[:4], "", note, *lines[4:]]) + "\n"
    path.write_text(content.replace(there.group(), block), encoding="utf-8")


def write_figure_note(page: str, name: str) -> None:
    """Say in a block what its figure was drawn with, where it is not what its table was made with.

    Raises:
        SystemExit: the page has no such block.
    """
    path = RESULTS / f"{page}.md"
    content = path.read_text(encoding="utf-8")
    there = re.search(rf"<!-- imaging:{re.escape(name)} -->\n.*?<!-- end -->\n", content, re.DOTALL)
    if there is None:
        raise SystemExit(f"{path} has no block {name}")
    block = re.sub(r"\nFigure: [^\n]*\n", "", there.group())
    block = block.replace("\n![", f"\nFigure: {made_with()}.\n\n![", 1)
    path.write_text(content.replace(there.group(), block), encoding="utf-8")


def _keys(lines: Sequence[str], rows: Sequence[str]) -> list[tuple[str, ...] | None]:
    """Of every line: its table's number and its cells up to the method; None where no method of `rows` is."""
    keys: list[tuple[str, ...] | None] = []
    table = 0
    for line in lines:
        table += line.startswith("|---")
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        method = next((i for i, cell in enumerate(cells) if cell in rows), None)
        known = line.startswith("|") and method is not None
        keys.append((str(table), *cells[: method + 1]) if known and method is not None else None)
    return keys


def picture_grid(
    pictures: Sequence[Sequence[np.ndarray]],
    extents_m: Sequence[float],
    rows: Sequence[str],
    columns: Sequence[str],
    path: Path,
) -> None:
    """Magnitudes in dB below each one's maximum: rows of scenes, columns of methods."""
    side, gap, left, top = 150, 22, 118, 56
    width = left + len(columns) * (side + gap) + 90
    canvas = Canvas(width, top + len(rows) * (side + 46) + 10)
    for j, name in enumerate(columns):
        canvas.text((left + j * (side + gap) + side / 2, 30), name, 17, anchor="mm")
    for i, (line, extent) in enumerate(zip(pictures, extents_m, strict=True)):
        y = top + i * (side + 46)
        for j, values in enumerate(line):
            x = left + j * (side + gap)
            axes = Axes(
                canvas, (x, y, x + side, y + side), (-extent / 2, extent / 2), (-extent / 2, extent / 2)
            )
            axes.raster(colourise(to_decibels(np.abs(values), DYNAMIC_RANGE_DB)[::-1], DYNAMIC_RANGE_DB))
            canvas.line([(x, y), (x + side, y), (x + side, y + side), (x, y + side), (x, y)], INK, 1)
        for k, word in enumerate(_wrap(rows[i], 12)):
            canvas.text((8, y + 14 + 20 * k), word, 16)
        canvas.text((left, y + side + 6), f"{extent:g} m", 15)
    x = left + len(columns) * (side + gap)
    colour_bar(canvas, (x, top, x + 16, top + side), DYNAMIC_RANGE_DB)
    canvas.save(path)


def curves(
    x: Sequence[float],
    lines: dict[str, Sequence[float]],
    labels: tuple[str, str],
    path: Path,
    title: str = "",
) -> None:
    """Lines with a legend over common x values."""
    known = np.array([v for line in lines.values() for v in line if np.isfinite(v)])
    pad = 0.05 * float(np.ptp(known)) or 1.0
    canvas = Canvas(820, 480)
    limits = (float(known.min()) - pad, float(known.max()) + pad)
    axes = Axes(canvas, (100, 50, 590, 400), (float(min(x)), float(max(x))), limits)
    axes.grid()
    for i, (name, line) in enumerate(lines.items()):
        colour = _COLOURS[i % len(_COLOURS)]
        axes.curve(np.asarray(x, dtype=float), np.asarray(line, dtype=float), colour, 2.5)
        canvas.line([(610, 70 + 28 * i), (640, 70 + 28 * i)], colour, 3)
        canvas.text((648, 70 + 28 * i), name, 17, anchor="lm")
    axes.frame(*labels, title)
    canvas.save(path)


def _wrap(text: str, width: int) -> list[str]:
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + 1 + len(word) > width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines
