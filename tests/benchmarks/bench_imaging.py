"""The published imaging experiments, repeated on simulated scenes with every method in one table each.

Run `python tests/benchmarks/bench_imaging.py EXPERIMENT`; `--list` names them. `--quick` takes one seed and
fewer cases, `--seeds N` sets the seeds, `--write` puts table and figure into docs/.

Point scenes: unit points uniform within +-0.22 m, radar at 1 m; 0.7 m and 96 x 96 pixels. The analytic
sinogram is divided by its peak; "noise" is the standard deviation of the complex noise of one sample. The
paper's CN(0, 0.1) does not say whether 0.1 is standard deviation or variance: both stand here, 0.1 and 0.316.
Objects: exact series for cans and bottles, physical optics for boxes, noise 20 dB under the peak.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import imaging_points as reflectors
import imaging_report as report
import imaging_unknowns as unknowns
from imaging_scenes import (
    GRID,
    OBJECTS,
    ROWS,
    SCORES,
    Problem,
    field_problem,
    object_problem,
    random_points,
    score,
)
from provenance import commit

DIGITS = (1, 2, 3, 1, 0, 2, 2)
SLOW = ("ATS paper",)
"""Rows that get fewer seeds, as their images take many seconds each."""
SHOWN = tuple(row for row in ROWS if row != "blank" and not row.endswith("bare"))
"""Rows of the figures."""


class Run(NamedTuple):
    """How much is computed."""

    seeds: int
    slow_seeds: int
    quick: bool
    jobs: int
    pictures: Path
    resume: Path | None = None
    minutes: float = 0.0

    def rows_of(self, seed: int) -> tuple[str, ...]:
        """Rows computed for a seed: the slow ones have few."""
        return tuple(row for row in ROWS if row not in SLOW or seed < self.slow_seeds)


def _cells(values: np.ndarray) -> list[str]:
    return [report.interval(column, d) for column, d in zip(values.T, DIGITS, strict=True)]


class Case(NamedTuple):
    """An extended object at the angles range(first, last, step)."""

    name: str
    first_deg: int
    last_deg: int
    step_deg: int


class ObjectCell(NamedTuple):
    """A case with one seed, and the rows wanted."""

    rows: tuple[str, ...]
    case: Case
    seed: int


OBJECT_SCORES = ("PSNR (dB)", "LPIPS", "far-off peak (dB)", "cylinders seen", "seconds")


def score_object(cell: ObjectCell) -> dict[str, tuple[tuple[float, ...], np.ndarray]]:
    """Row -> scores of an extended object, and the image's magnitude.

    The far-off peak is the brightest pixel farther than 4 cm from the outline, against the brightest one; a
    cylinder is seen where the brightest pixel within 2 cm of its surface is at most 10 dB down.
    """
    case = cell.case
    thing = OBJECTS[case.name]()
    angles = np.arange(case.first_deg, case.last_deg, case.step_deg)
    problem = object_problem(thing, angles, 20.0, cell.seed)
    x, y = np.meshgrid(problem.grid.axis, problem.grid.axis)
    near = thing.outline(problem.grid, 0.04) > np.exp(-0.5)
    results = {}
    for row in cell.rows:
        psnr_db, _, perceptual, *_, seconds = score(problem, row)
        values = np.abs(problem.image(row)[0].values)
        magnitude = values / max(float(values.max()), 1e-30)
        off = float(20 * np.log10(max(float(magnitude[~near].max()), 1e-6)))
        seen = [
            float(magnitude[np.hypot(x - cx, y - cy) < radius + 0.02].max()) > 10 ** (-10 / 20)
            for cx, cy, radius in thing.circles
        ]
        count = float(np.sum(seen)) if seen else float("nan")
        results[row] = (psnr_db, perceptual, off, count, seconds), magnitude.astype(np.float32)
    return results


def _objects(run: Run, name: str, cases: dict[str, Case]) -> str:
    """Table and figure of extended objects, by the label of each case."""
    seeds = run.seeds
    cells = [
        ObjectCell(tuple(r for r in SHOWN if r in run.rows_of(seed)), case, seed)
        for case in cases.values()
        for seed in range(seeds)
    ]
    results = report.spread(score_object, cells, run.jobs)
    shown = [row for row in SHOWN if row in results[0]]
    lines, pictures = [], []
    for i, (label, case) in enumerate(cases.items()):
        of_case = results[i * seeds : (i + 1) * seeds]
        thing = OBJECTS[case.name]()
        pictures.append([thing.outline(thing.grid)])
        for row in shown:
            values = np.array([r[row][0] for r in of_case if row in r])
            cell = [report.interval(column, d) for column, d in zip(values.T, (1, 3, 1, 1, 2), strict=True)]
            lines.append([label, row, str(len(values)), *cell])
            pictures[-1].append(of_case[0][row][1])
    extents = [OBJECTS[case.name]().extent_m for case in cases.values()]
    path = run.pictures / f"imaging-{name}.png"
    report.picture_grid(pictures, extents, list(cases), ["outline", *shown], path)
    return report.table(("object", "method", "seeds", *OBJECT_SCORES), lines)


def objects(run: Run) -> str:
    """(3) Can in a cardboard box, two bottles, two cans, metal box: 360 views."""
    return _objects(run, "objects", {name: Case(name, 0, 360, 1) for name in OBJECTS})


TWO_CANS = "two cans 68.58 cm apart"


def skip_cans(run: Run) -> str:
    """(4) Skip angles of 10, 20 and 30 degrees on the two cans."""
    return _objects(run, "skip-cans", {f"skip {s} deg": Case(TWO_CANS, 0, 360, s) for s in (10, 20, 30)})


def partial(run: Run) -> str:
    """(5) 90, 180 and 270 degrees of a turn on the two cans: does the second one stay visible?"""
    return _objects(run, "partial", {f"0 to {a} deg": Case(TWO_CANS, 0, a, 1) for a in (90, 180, 270)})


class TagCell(NamedTuple):
    """A tag in the field's scene, and the rows wanted."""

    rows: tuple[str, ...]
    layout: str
    seed: int


def score_tag(cell: TagCell) -> dict[str, tuple[tuple[float, ...], np.ndarray]]:
    """Row -> scores of a tag on its object, clutter removed, and the image's magnitude."""
    problem = field_problem(cell.layout, cell.seed)
    results = {}
    for row in cell.rows:
        scores = score(problem, row)
        results[row] = scores, np.abs(problem.image(row)[0].values).astype(np.float32)
    return results


def tags(run: Run) -> str:
    """(6) The mug's and the helmet's tags, on their objects, in a room, 15 dB SNR, 360 views."""
    layouts = ("container-90", "container-180", "helmet-120", "helmet-linear")
    lines, pictures = [], []
    for layout in layouts:
        cells = [
            TagCell(tuple(r for r in SHOWN if r in run.rows_of(seed)), layout, seed)
            for seed in range(run.seeds)
        ]
        results = report.spread(score_tag, cells, run.jobs)
        pictures.append([field_problem(layout, 0).truth])
        for row in (r for r in SHOWN if r in results[0]):
            values = np.array([r[row][0] for r in results if row in r])
            lines.append([layout, row, str(len(values)), *_cells(values)])
            pictures[-1].append(results[0][row][1])
    shown = ["truth", *(r for r in SHOWN if r in results[0])]
    path = run.pictures / "imaging-tags.png"
    report.picture_grid(pictures, [0.4] * len(layouts), list(layouts), shown, path)
    return report.table(("tag", "method", "seeds", *SCORES), lines)


def _same_scene_picture(problems: dict[str, Problem], path: Path) -> None:
    pictures = [[p.truth, *(np.abs(p.image(r)[0].values) for r in SHOWN)] for p in problems.values()]
    extents = [p.grid.extent for p in problems.values()]
    report.picture_grid(pictures, extents, list(problems), ["truth", *SHOWN], path)


def methods(run: Run) -> str:
    """The same scenes in every method, for docs/imaging.md."""
    problems = {
        "360 views": random_points(4, 360, 0.1, 1),
        "36 views, noise 0.316": random_points(4, 36, 0.316, 1),
        "12 views": random_points(4, 12, 0.1, 1),
    }
    _same_scene_picture(problems, run.pictures / "imaging-methods.png")
    return f"Four points, {GRID.extent} m, dB below each maximum; noise 0.1 where none is said.\n"


EXPERIMENTS: dict[str, tuple[str, Callable[[Run], str], tuple[str, ...]]] = {
    "methods": ("The same scene in every method", methods, ("imaging-methods",)),
    "points": ("Reflectors in noise", reflectors.points, ()),
    "resolution": ("Two-point resolution", reflectors.resolution, ()),
    "objects": ("Cans, bottles and boxes", objects, ("imaging-objects",)),
    "skip-cans": ("Skip angles on two cans", skip_cans, ("imaging-skip-cans",)),
    "partial": ("Partial rotation of two cans", partial, ("imaging-partial",)),
    "tags": ("Tags of the mug and the helmet", tags, ("imaging-tags",)),
    "calibration": ("Unknown axis distance and wobble", unknowns.calibration, ("imaging-calibration",)),
    "rails": ("Paths at metre scale", unknowns.rails, ("imaging-rails",)),
    "pulse": ("Pulses that are not the nominal one", unknowns.pulses, ()),
}
"""Name -> (title, function, figures). The paper's seventh, time, is the last column of every table."""


def main() -> None:
    """Parse the command line, run, print, and write where asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("experiment", nargs="*", metavar="EXPERIMENT", help="all where none is named")
    parser.add_argument("--list", action="store_true", help="name the experiments")
    parser.add_argument("--quick", action="store_true", help="one seed, fewer cases")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--slow-seeds", type=int, default=10, help="seeds of the paper's method")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--resume", type=Path, help="file that keeps what is done")
    parser.add_argument("--minutes", type=float, default=0.0, help="stop after so many, with --resume")
    parser.add_argument("--write", action="store_true", help="put table and figure into docs/")
    options = parser.parse_args()
    if options.list:
        for name, (title, _, _) in EXPERIMENTS.items():
            print(f"{name:12} {title}")
        return
    unknown = set(options.experiment) - set(EXPERIMENTS)
    if unknown:
        parser.error(f"no experiment {', '.join(sorted(unknown))}; there are {', '.join(EXPERIMENTS)}")
    pictures = report.PICTURES if options.write else Path.cwd()
    seeds = 1 if options.quick else options.seeds
    run = Run(
        seeds, options.slow_seeds, options.quick, options.jobs, pictures, options.resume, options.minutes
    )
    for name in options.experiment or EXPERIMENTS:
        title, work, figures = EXPERIMENTS[name]
        text = work(run)
        arguments = f"{name} --quick" if options.quick else f"{name} --seeds {seeds}"
        machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
        made = f"`python tests/benchmarks/bench_imaging.py {arguments}`, commit {commit()}, "
        made += f"{date.today()}, {machine}, numpy {np.__version__}.\n\n"
        shown = "".join(f"\n![{title}](../pictures/{figure}.png)\n" for figure in figures)
        print(f"{title}\n\n{made}{text}", flush=True)
        if options.write:
            report.write_block("imaging", name, title, made + text + shown)


if __name__ == "__main__":
    main()
