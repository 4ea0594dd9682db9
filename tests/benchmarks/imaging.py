"""Experiments on extended objects and tags, every method in one table.

Objects: exact series for cans and bottles, physical optics for boxes, noise 20 dB under the peak.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.benchmarks.imaging_scenes import (
    GRID,
    OBJECTS,
    ROWS,
    SLOW,
    Problem,
    add_options,
    chosen,
    field_problem,
    held_out_percent,
    object_problem,
    perceptual,
    random_points,
)
from tests.benchmarks.pictures import picture_grid
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, interval
from train.metrics import localise, pick_peaks, psnr

__all__ = ["add_options", "methods", "objects", "partial", "skip_cans", "tags"]

MOST_PEAKS = 8
SHOWN = tuple(r for r in ROWS if r not in ("blank", "ATS 300 steps") and not r.endswith("bare"))
"""Rows of the figures, and of the tables of objects and tags."""
BEST = ("BP", "FISTA", "OMP", SLOW, "ATS field")
"""Rows that a page shows of a long table."""
TWO_CANS = "two cans 68.58 cm apart"
TAGS = ("container-90", "container-180", "helmet-120", "helmet-linear")
OBJECT_COLUMNS = (
    ("held_out", "held-out residual (%)", 1),
    ("lpips", "LPIPS", 3),
    ("psnr_db", "PSNR (dB)", 1),
    ("far_db", "far-off peak (dB)", 1),
    ("seen", "cylinders seen", 1),
    ("seconds", "seconds", 2),
)
TAG_COLUMNS = (
    ("where_mm", "localisation (mm)", 1),
    ("detected", "detected (%)", 0),
    ("false", "false", 2),
    *OBJECT_COLUMNS[:3],
    ("seconds", "seconds", 2),
)


class Case(NamedTuple):
    """An extended object at the angles range(0, last, step), degrees, or a tag, and how a table calls it."""

    label: str
    name: str
    last_deg: int = 360
    step_deg: int = 1


class Cell(NamedTuple):
    """A case and a seed, seen by one row of the tables."""

    case: Case
    seed: int
    row: str


CASES = {
    "objects": tuple(Case(name, name) for name in OBJECTS),
    "skip-cans": tuple(Case(f"skip {s} deg", TWO_CANS, 360, s) for s in (10, 20, 30)),
    "partial": tuple(Case(f"0 to {a} deg", TWO_CANS, a) for a in (90, 180, 270)),
    "tags": tuple(Case(layout, layout) for layout in TAGS),
}


def object_scene(case: Case, seed: int) -> Problem:
    """A case seen with noise 20 dB under the peak."""
    return object_problem(case.name, np.arange(0, case.last_deg, case.step_deg), 20.0, seed)


def score_object(cell: Cell) -> dict[str, float]:
    """The members of `OBJECT_COLUMNS`.

    The far-off peak is the brightest pixel farther than 4 cm from the outline, against the brightest one; a
    cylinder is seen where the brightest pixel within 2 cm of its surface is at most 10 dB down.
    """
    problem = object_scene(cell.case, cell.seed)
    thing = OBJECTS[cell.case.name]()
    x, y = np.meshgrid(problem.grid.axis, problem.grid.axis)
    near = thing.outline(problem.grid, 0.04) > np.exp(-0.5)
    image, seconds = problem.image(cell.row)
    magnitude = np.abs(image.values) / max(float(np.abs(image.values).max()), 1e-30)
    seen = [
        float(magnitude[np.hypot(x - cx, y - cy) < radius + 0.02].max()) > 10 ** (-10 / 20)
        for cx, cy, radius in thing.circles
    ]
    return {
        "held_out": held_out_percent(problem, cell.row),
        "lpips": perceptual(image, problem.truth),
        "psnr_db": psnr(image.values, problem.truth),
        "far_db": float(20 * np.log10(max(float(magnitude[~near].max()), 1e-6))),
        "seen": float(np.sum(seen)) if seen else float("nan"),
        "seconds": seconds,
    }


def score_tag(cell: Cell) -> dict[str, float]:
    """The members of `TAG_COLUMNS`, for a tag on its object, clutter removed."""
    problem = field_problem(cell.case.name, cell.seed)
    image, seconds = problem.image(cell.row)
    located = localise(pick_peaks(image, MOST_PEAKS), problem.points)
    return {
        "where_mm": located.rmse_m * 1e3,
        "detected": 100 * located.detected / len(problem.points),
        "false": float(located.false),
        "held_out": held_out_percent(problem, cell.row),
        "lpips": perceptual(image, problem.truth),
        "psnr_db": psnr(image.values, problem.truth),
        "seconds": seconds,
    }


def _scored(run: Run, name: str, work: Any, columns: Sequence[tuple[str, str, int]], kind: str) -> Table:
    """A line for every case and row, with the mean over the seeds and its interval."""
    seeds = run.number(10)
    run.seeds = f"0 to {seeds - 1}"
    rows = chosen(run, SHOWN)
    cells = [Cell(case, seed, row) for row in rows for case in CASES[name] for seed in range(seeds)]
    scores = run.each(work, cells)
    lines = []
    for case in CASES[name]:
        for row in (row for row in SHOWN if row in rows):
            some = [score for cell, score in scores.items() if (cell.case, cell.row) == (case, row)]
            values = [interval(np.array([s[key] for s in some], dtype=float), d) for key, _, d in columns]
            lines.append((case.label, row, str(len(some)), *values))
    headings = (kind, "method", "seeds", *(title for _, title, _ in columns))
    return Table(headings, lines, shown=lambda line: line[1] in BEST, below=_figure(run, name))


def _figure(run: Run, name: str) -> str:
    """Draw the first seed of every case, where figures are drawn."""
    if run.pictures is None:
        return ""
    make = (
        (lambda case: field_problem(case.name, 0)) if name == "tags" else (lambda case: object_scene(case, 0))
    )
    problems = {case.label: make(case) for case in CASES[name]}
    return _same_scene_picture(problems, run.pictures, name, "truth" if name == "tags" else "outline")


def _same_scene_picture(problems: dict[str, Problem], folder: Path, name: str, truth: str = "truth") -> str:
    pictures = [[p.truth, *(np.abs(p.image(r)[0].values) for r in SHOWN)] for p in problems.values()]
    extents = [p.grid.extent for p in problems.values()]
    picture_grid(pictures, extents, list(problems), [truth, *SHOWN], folder / f"imaging-{name}.png")
    return f"![{name}: every method, dB below each maximum](../pictures/imaging-{name}.png)"


def objects(run: Run) -> Iterator[Table]:
    """Can in a cardboard box, two bottles, two cans, metal box: 360 views."""
    yield _scored(run, "objects", score_object, OBJECT_COLUMNS, "object")


def skip_cans(run: Run) -> Iterator[Table]:
    """Skip angles of 10, 20 and 30 degrees on the two cans."""
    yield _scored(run, "skip-cans", score_object, OBJECT_COLUMNS, "object")


def partial(run: Run) -> Iterator[Table]:
    """90, 180 and 270 degrees of a turn on the two cans: does the second one stay visible?"""
    yield _scored(run, "partial", score_object, OBJECT_COLUMNS, "object")


def tags(run: Run) -> Iterator[Table]:
    """The mug's and the helmet's tags, on their objects, in a room, 15 dB SNR, 360 views."""
    yield _scored(run, "tags", score_tag, TAG_COLUMNS, "tag")


def methods(run: Run) -> Iterator[Table]:
    """The same scenes in every method, for docs/imaging.md; without --write in the current folder."""
    run.seeds = "1"
    problems = {
        "360 views": random_points(4, 360, 0.1, 1),
        "36 views, noise 0.316": random_points(4, 36, 0.316, 1),
        "12 views": random_points(4, 12, 0.1, 1),
    }
    figure = _same_scene_picture(problems, run.pictures or Path.cwd(), "methods")
    note = f"Four points, {GRID.extent} m, dB below each maximum; noise 0.1 where none is said."
    yield Table((), (), note, below=figure)
