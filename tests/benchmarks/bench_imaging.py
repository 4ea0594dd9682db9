"""The published imaging experiments, repeated on simulated scenes with every method in one table each.

Run `python tests/benchmarks/bench_imaging.py EXPERIMENT`; `--list` names them. `--quick` takes one seed and
fewer cases, `--seeds N` sets the seeds, `--write` puts table and figure into docs/; `--figures` draws the
figures alone, as they stand beside the tables.

Point scenes: unit points uniform within +-0.22 m, radar at 1 m; 0.7 m and 96 x 96 pixels. The analytic
sinogram is divided by its peak; "noise" is the standard deviation of the complex noise of one sample. The
paper's CN(0, 0.1) does not say whether 0.1 is standard deviation or variance: both stand here, 0.1 and 0.316.
Objects: exact series for cans and bottles, physical optics for boxes, noise 20 dB under the peak.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial as partial_of
from pathlib import Path
from typing import Any, NamedTuple

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
    Problem,
    field_problem,
    held_out_percent,
    object_problem,
    perceptual,
    random_points,
)

from train.metrics import localise, pick_peaks, psnr

MOST_PEAKS = 8
SHOWN = tuple(r for r in ROWS if r not in ("blank", "ATS 300 steps") and not r.endswith("bare"))
"""Rows of the figures, and of the tables of objects and tags."""
asked_rows: list[str] = [*ROWS, "oracle"]
"""Rows of the tables that are computed; `--rows` sets them."""


class Column(NamedTuple):
    """A score, its heading and its digits."""

    name: str
    title: str
    digits: int


class Run(NamedTuple):
    """How much is computed."""

    seeds: int
    quick: bool
    jobs: int
    pictures: Path
    draw: bool
    pieces: report.Pieces
    rows: tuple[str, ...]


class Case(NamedTuple):
    """An extended object at the angles range(first, last, step)."""

    name: str
    first_deg: int
    last_deg: int
    step_deg: int


class ObjectCell(NamedTuple):
    """A case and a seed."""

    case: Case
    seed: int


OBJECT_COLUMNS = (
    Column("held_out", "held-out residual (%)", 1),
    Column("lpips", "LPIPS", 3),
    Column("psnr_db", "PSNR (dB)", 1),
    Column("far_db", "far-off peak (dB)", 1),
    Column("seen", "cylinders seen", 1),
    Column("seconds", "seconds", 2),
)


def object_scene(case: Case, seed: int) -> Problem:
    """A case seen with noise 20 dB under the peak."""
    return object_problem(case.name, np.arange(case.first_deg, case.last_deg, case.step_deg), 20.0, seed)


def score_object(cell: ObjectCell) -> dict[str, dict[str, float]]:
    """The members of `OBJECT_COLUMNS` of every row that is asked for.

    The far-off peak is the brightest pixel farther than 4 cm from the outline, against the brightest one; a
    cylinder is seen where the brightest pixel within 2 cm of its surface is at most 10 dB down.
    """
    problem = object_scene(cell.case, cell.seed)
    thing = OBJECTS[cell.case.name]()
    x, y = np.meshgrid(problem.grid.axis, problem.grid.axis)
    near = thing.outline(problem.grid, 0.04) > np.exp(-0.5)
    scores = {}
    for row in (row for row in SHOWN if row in asked_rows):
        image, seconds = problem.image(row)
        magnitude = np.abs(image.values) / max(float(np.abs(image.values).max()), 1e-30)
        seen = [
            float(magnitude[np.hypot(x - cx, y - cy) < radius + 0.02].max()) > 10 ** (-10 / 20)
            for cx, cy, radius in thing.circles
        ]
        scores[row] = {
            "held_out": held_out_percent(problem, row),
            "lpips": perceptual(image, problem.truth),
            "psnr_db": psnr(image.values, problem.truth),
            "far_db": float(20 * np.log10(max(float(magnitude[~near].max()), 1e-6))),
            "seen": float(np.sum(seen)) if seen else float("nan"),
            "seconds": seconds,
        }
    return scores


def _objects(run: Run, name: str, cases: dict[str, Case]) -> str:
    """Table and figure of extended objects, by the label of each case."""
    cells = [ObjectCell(case, seed) for case in cases.values() for seed in range(run.seeds)]
    found = report.resumed(score_object, cells, run.pieces)
    text = _table(found, cases, "object", OBJECT_COLUMNS)
    if run.draw:
        _draw_objects(run.pictures, name, cases)
    return text


def _draw_objects(pictures: Path, name: str, cases: dict[str, Case]) -> None:
    problems = {label: object_scene(case, 0) for label, case in cases.items()}
    _same_scene_picture(problems, pictures / f"imaging-{name}.png", "outline")


def _table(
    found: dict[Any, dict[str, dict[str, float]]], cases: dict[str, Any], kind: str, columns: Sequence[Column]
) -> str:
    """A line for every case and row, with the mean over the seeds and its interval."""
    lines = []
    for label, case in cases.items():
        scores = [score for cell, score in found.items() if cell.case == case]
        for row in SHOWN:
            some = [score[row] for score in scores if row in score]
            if some:
                values = [
                    report.interval(np.array([s[c.name] for s in some], dtype=float), c.digits)
                    for c in columns
                ]
                lines.append([label, row, str(len(some)), *values])
    return report.table((kind, "method", "seeds", *(c.title for c in columns)), lines)


TWO_CANS = "two cans 68.58 cm apart"
CASES = {
    "objects": {name: Case(name, 0, 360, 1) for name in OBJECTS},
    "skip-cans": {f"skip {s} deg": Case(TWO_CANS, 0, 360, s) for s in (10, 20, 30)},
    "partial": {f"0 to {a} deg": Case(TWO_CANS, 0, a, 1) for a in (90, 180, 270)},
}


def objects(run: Run) -> str:
    """(3) Can in a cardboard box, two bottles, two cans, metal box: 360 views."""
    return _objects(run, "objects", CASES["objects"])


def skip_cans(run: Run) -> str:
    """(4) Skip angles of 10, 20 and 30 degrees on the two cans."""
    return _objects(run, "skip-cans", CASES["skip-cans"])


def partial(run: Run) -> str:
    """(5) 90, 180 and 270 degrees of a turn on the two cans: does the second one stay visible?"""
    return _objects(run, "partial", CASES["partial"])


TAGS = ("container-90", "container-180", "helmet-120", "helmet-linear")


class TagCell(NamedTuple):
    """A layout in the field's scene, and a seed."""

    case: str
    seed: int


TAG_COLUMNS = (
    Column("where_mm", "localisation (mm)", 1),
    Column("detected", "detected (%)", 0),
    Column("false", "false", 2),
    Column("held_out", "held-out residual (%)", 1),
    Column("lpips", "LPIPS", 3),
    Column("psnr_db", "PSNR (dB)", 1),
    Column("seconds", "seconds", 2),
)


def score_tag(cell: TagCell) -> dict[str, dict[str, float]]:
    """The members of `TAG_COLUMNS` of every row, for a tag on its object, clutter removed."""
    problem = field_problem(cell.case, cell.seed)
    scores = {}
    for row in (row for row in SHOWN if row in asked_rows):
        image, seconds = problem.image(row)
        found = localise(pick_peaks(image, MOST_PEAKS), problem.points)
        scores[row] = {
            "where_mm": found.rmse_m * 1e3,
            "detected": 100 * found.detected / len(problem.points),
            "false": float(found.false),
            "held_out": held_out_percent(problem, row),
            "lpips": perceptual(image, problem.truth),
            "psnr_db": psnr(image.values, problem.truth),
            "seconds": seconds,
        }
    return scores


def tags(run: Run) -> str:
    """(6) The mug's and the helmet's tags, on their objects, in a room, 15 dB SNR, 360 views."""
    cells = [TagCell(layout, seed) for layout in TAGS for seed in range(run.seeds)]
    found = report.resumed(score_tag, cells, run.pieces)
    text = _table(found, {layout: layout for layout in TAGS}, "tag", TAG_COLUMNS)
    if run.draw:
        _draw_tags(run.pictures)
    return text


def _draw_tags(pictures: Path) -> None:
    problems = {layout: field_problem(layout, 0) for layout in TAGS}
    _same_scene_picture(problems, pictures / "imaging-tags.png")


def _same_scene_picture(problems: dict[str, Problem], path: Path, truth: str = "truth") -> None:
    pictures = [[p.truth, *(np.abs(p.image(r)[0].values) for r in SHOWN)] for p in problems.values()]
    extents = [p.grid.extent for p in problems.values()]
    report.picture_grid(pictures, extents, list(problems), [truth, *SHOWN], path)


def methods(run: Run) -> str:
    """The same scenes in every method, for docs/imaging.md."""
    if run.draw:
        _draw_methods(run.pictures)
    return f"Four points, {GRID.extent} m, dB below each maximum; noise 0.1 where none is said.\n"


def _draw_methods(pictures: Path) -> None:
    problems = {
        "360 views": random_points(4, 360, 0.1, 1),
        "36 views, noise 0.316": random_points(4, 36, 0.316, 1),
        "12 views": random_points(4, 12, 0.1, 1),
    }
    _same_scene_picture(problems, pictures / "imaging-methods.png")


FIGURES: dict[str, Callable[[Path], None]] = {
    **{name: partial_of(_draw_objects, name=name, cases=cases) for name, cases in CASES.items()},
    "tags": _draw_tags,
    "methods": _draw_methods,
}
"""Figures that need no table, drawn into a folder."""

EXPERIMENTS: dict[str, tuple[str, Callable[[Run], str], tuple[str, ...]]] = {
    "methods": ("The same scene in every method", methods, ("imaging-methods",)),
    "points": ("Reflectors in noise", reflectors.points, ()),
    "paper": ("The paper's table and skip angles", reflectors.paper, ()),
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
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    report.Pieces.add_options(parser)
    parser.add_argument("--write", action="store_true", help="put table and figure into docs/")
    parser.add_argument("--no-pictures", action="store_true", help="leave the figures as they are")
    parser.add_argument("--figures", action="store_true", help="draw the figures alone")
    parser.add_argument(
        "--rows", help="of points, objects and tags: compute and write these rows only, e.g. 'ATS field'"
    )
    options = parser.parse_args()
    if options.rows:
        asked_rows[:] = options.rows.split(",")
    if options.list:
        for name, (title, _, _) in EXPERIMENTS.items():
            print(f"{name:12} {title}")
        return
    unknown = set(options.experiment) - set(EXPERIMENTS)
    if unknown:
        parser.error(f"no experiment {', '.join(sorted(unknown))}; there are {', '.join(EXPERIMENTS)}")
    pictures = report.PICTURES if options.write else Path.cwd()
    seeds = 1 if options.quick else options.seeds
    if options.figures:
        for name in options.experiment or FIGURES:
            if name not in FIGURES:
                parser.error(f"the figure of {name} needs its table; there are {', '.join(FIGURES)}")
            FIGURES[name](pictures)
            if options.write:
                report.write_figure_note("imaging", name)
        return
    for name in options.experiment or EXPERIMENTS:
        title, work, figures = EXPERIMENTS[name]
        pieces = report.Pieces.of(options)
        draw = not options.no_pictures
        run = Run(seeds, options.quick, options.jobs, pictures, draw, pieces, tuple(asked_rows))
        text = work(run)
        arguments = f"{name} --quick" if options.quick else f"{name} --seeds {seeds}"
        made = f"`python tests/benchmarks/bench_imaging.py {arguments}`, "
        made += "; ".join(sorted(pieces.made) or [report.made_with()]) + ".\n\n"
        shown = "".join(f"\n![{title}](../pictures/{figure}.png)\n" for figure in figures)
        print(f"{title}\n\n{made}{text}", flush=True)
        if options.write and options.rows:
            report.write_rows("imaging", name, text, asked_rows, "; ".join(sorted(pieces.made)), list(ROWS))
        elif options.write:
            report.write_block("imaging", name, title, made + text + shown)


if __name__ == "__main__":
    main()
