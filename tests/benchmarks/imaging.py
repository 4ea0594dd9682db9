"""Experiments on extended objects and tags, every method in one table.

Objects: exact series for cans and bottles, physical optics for boxes, noise 20 dB under the peak.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

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
from tests.benchmarks.tables import Table, column, grouped, interval
from train.metrics import localise, pick_peaks, psnr

__all__ = ["add_options", "methods", "scored"]

MOST_PEAKS = 8
SHOWN = tuple(row for row in ROWS if row not in ("blank", "ATS 300 steps"))
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


CASES = {
    "imaging-objects": tuple(Case(name, name) for name in OBJECTS),
    "imaging-skip-cans": tuple(Case(f"skip {s} deg", TWO_CANS, 360, s) for s in (10, 20, 30)),
    "imaging-partial": tuple(Case(f"0 to {a} deg", TWO_CANS, a) for a in (90, 180, 270)),
    "imaging-tags": tuple(Case(layout, layout) for layout in TAGS),
}


def scene_of(case: Case, seed: int) -> Problem:
    """A tag on its object in a room, or an object seen with noise 20 dB under the peak."""
    if case.name in TAGS:
        return field_problem(case.name, seed)
    return object_problem(case.name, np.arange(0, case.last_deg, case.step_deg), seed)


def score(cell: tuple[Case, int, str]) -> dict[str, float]:
    """A case of a seed as a row of the tables shows it: members of `TAG_COLUMNS` or of `OBJECT_COLUMNS`.

    The far-off peak is the brightest pixel farther than 4 cm from the outline, against the brightest one; a
    cylinder is seen where the brightest pixel within 2 cm of its surface is at most 10 dB down.
    """
    case, seed, row = cell
    problem = scene_of(case, seed)
    image, seconds = problem.image(row)
    scores = {
        "held_out": held_out_percent(problem, row),
        "lpips": perceptual(image.values, problem.truth),
        "psnr_db": psnr(image.values, problem.truth),
        "seconds": seconds,
    }
    if case.name in TAGS:
        located = localise(pick_peaks(image, MOST_PEAKS), problem.points)
        detected = 100 * located.detected / len(problem.points)
        return {
            **scores,
            "where_mm": 1e3 * located.rmse_m,
            "detected": detected,
            "false": float(located.false),
        }
    thing = OBJECTS[case.name]
    x, y = np.meshgrid(problem.grid.axis, problem.grid.axis)
    near = thing.outline(problem.grid, 0.04) > np.exp(-0.5)
    magnitude = np.abs(image.values) / max(float(np.abs(image.values).max()), 1e-30)
    seen = [
        float(magnitude[np.hypot(x - cx, y - cy) < radius + 0.02].max()) > 10 ** (-10 / 20)
        for cx, cy, radius in thing.circles
    ]
    far_db = float(20 * np.log10(max(float(magnitude[~near].max()), 1e-6)))
    return {**scores, "far_db": far_db, "seen": float(np.sum(seen)) if seen else float("nan")}


def scored(run: Run) -> Iterator[Table]:
    """A line for every case and row, with the mean over the seeds and its interval."""
    cases, kind = CASES[run.name], "tag" if run.name == "imaging-tags" else "object"
    columns = TAG_COLUMNS if kind == "tag" else OBJECT_COLUMNS
    rows, seeds = chosen(run, SHOWN), run.drawn(10)
    cells = [(case, seed, row) for row in rows for case in cases for seed in seeds]
    scores = grouped(run.each(score, cells), lambda cell: (cell[0], cell[2]))
    lines = []
    for case in cases:
        for row in (row for row in SHOWN if row in rows):
            some = scores[case, row]
            values = [interval(column(some, key), digits) for key, _, digits in columns]
            lines.append((case.label, row, len(some), *values))
    figure = ""
    if run.pictures is not None:
        problems = {case.label: scene_of(case, 0) for case in cases}
        figure = _figure(problems, run.pictures, run.name, "truth" if kind == "tag" else "outline")
    headings = (kind, "method", "seeds", *(title for _, title, _ in columns))
    yield Table(headings, lines, shown=lambda line: line[1] in BEST, below=figure)


def _figure(problems: dict[str, Problem], folder: Path, name: str, truth: str = "truth") -> str:
    pictures = [[p.truth, *(np.abs(p.image(r)[0].values) for r in SHOWN)] for p in problems.values()]
    extents = [p.grid.extent for p in problems.values()]
    picture_grid(pictures, extents, list(problems), [truth, *SHOWN], folder / f"{name}.png")
    said = name.removeprefix("imaging-")
    return f"![{said}: every method, dB below each maximum](../pictures/{name}.png)"


def methods(run: Run) -> Iterator[Table]:
    """The same scenes in every method, for docs/imaging.md; without --write in the current folder."""
    run.seeds = "1"
    problems = {
        "360 views": random_points(4, 360, 0.1, 1),
        "36 views, noise 0.316": random_points(4, 36, 0.316, 1),
        "12 views": random_points(4, 12, 0.1, 1),
    }
    figure = _figure(problems, run.pictures or Path.cwd(), run.name)
    note = f"Four points, {GRID.extent} m, dB below each maximum; noise 0.1 where none is said."
    yield Table((), (), note, below=figure)
