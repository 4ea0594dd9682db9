"""Experiments on reflectors: localisation beside its bound, resolution, detections, amplitudes, prediction.

Unit points uniform within +-0.22 m, radar at 1 m; 0.7 m and 96 x 96 pixels. The analytic sinogram is divided
by its peak; "noise" is the standard deviation of the complex noise of one sample. The paper's CN(0, 0.1) does
not say whether 0.1 is standard deviation or variance: both stand here, 0.1 and 0.316. Every method is judged
at its own resolution; one table compares pictures at equal resolution, between the oracle and the blank
image.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from tagid.geometry import ImageGrid
from tagid.imaging.restore import beam_sigma_m, restore
from tagid.imaging.types import Image
from tests.benchmarks.imaging_scenes import (
    GRID,
    ROWS,
    SLOW,
    Problem,
    add_options,
    chosen,
    close_points,
    cramer_rao_mm,
    drawn_points,
    held_out_percent,
    perceptual,
)
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, interval
from train.metrics import blank, localise, pick_peaks, psnr, truth_image

__all__ = ["add_options", "paper", "points", "resolution"]

CASES = ((360, 0.316), (36, 0.316), (12, 0.1))
"""Views, and standard deviation of the noise."""
APART_MM = (15, 20, 30)
FINE = ImageGrid(GRID.extent / 2, GRID.pixels)
"""Pixels of 3.6 mm, on which no method's resolution is that of its pixels."""
MOST_PEAKS = 8
POINT_ROWS = tuple(row for row in ROWS if not row.endswith("bare"))


class PointCell(NamedTuple):
    """A scene of two to four reflectors, seen by one row of the tables."""

    views: int
    noise: float
    seed: int
    row: str


@dataclass(frozen=True)
class PointScore:
    """One image of reflectors.

    Attributes:
        where_mm: root mean square distance of the detected reflectors; nan if there are none.
        bound_mm: its Cramér-Rao bound.
        missed, false: reflectors that no peak is near, peaks that are near none.
        amplitude_db: root mean square error of the detected amplitudes, one common factor fitted.
        held_out: residual on views that were left out, per cent; nan where a method predicts no scans.
        psnr_db, lpips: at equal resolution.
        seconds: of processor time.
    """

    where_mm: float
    bound_mm: float
    missed: float
    false: float
    amplitude_db: float
    held_out: float
    psnr_db: float
    lpips: float
    seconds: float


def oracle(problem: Problem, wavenumber: float) -> Image:
    """The true reflectors on the pixels about them, with the beam that every sparse method is shown with."""
    grid = problem.grid
    values = np.zeros((grid.pixels, grid.pixels), dtype=np.complex64)
    for (x, y), amplitude in zip(problem.points, problem.amplitudes, strict=True):
        column, row = ((v / grid.extent + 0.5) * grid.pixels - 0.5 for v in (x, y))
        i, j = int(np.floor(row)), int(np.floor(column))
        for di, up in ((0, 1 - (row - i)), (1, row - i)):
            for dj, along in ((0, 1 - (column - j)), (1, column - j)):
                values[i + di, j + dj] += amplitude * up * along
    return restore(Image(values, grid), wavenumber)


def score_points(cell: PointCell) -> dict[str, float]:
    """The members of `PointScore`."""
    problem = drawn_points(cell.views, cell.noise, cell.seed)
    wavenumber = problem.scans(False).wavenumber
    sharp = f"{cell.row}, bare" in ROWS
    start = time.process_time()
    if cell.row == "oracle":
        base, seconds = oracle(problem, wavenumber), float("nan")
    elif cell.row == "blank":
        base, seconds = blank(problem.grid), float("nan")
    else:
        base, _ = problem.image(f"{cell.row}, bare" if sharp else cell.row)
        seconds = time.process_time() - start
    shown = restore(base, wavenumber) if sharp else base
    where, missed, false, amplitude = float("nan"), float(len(problem.points)), 0.0, float("nan")
    if np.any(base.values):
        located = localise(pick_peaks(base, MOST_PEAKS), problem.points)
        where, missed, false = located.rmse_m * 1e3, float(located.missed), float(located.false)
        amplitude = amplitude_error_db(shown, problem)
    truth = truth_image(problem.points, problem.grid, problem.amplitudes, beam_sigma_m(wavenumber))
    held_out = held_out_percent(problem, cell.row) if cell.row in ROWS else float("nan")
    bound = cramer_rao_mm(problem.points, cell.views, cell.noise, problem.amplitudes)
    quality, seen = psnr(shown.values, truth), perceptual(shown, truth)
    return asdict(PointScore(where, bound, missed, false, amplitude, held_out, quality, seen, seconds))


def amplitude_error_db(shown: Image, problem: Problem, radius_m: float = 0.015) -> float:
    """RMS error, dB, of the brightest pixel near every reflector, relative to the mean error in dB.

    A reflector without any brightness near it counts as 20 dB too faint.
    """
    x, y = np.meshgrid(shown.grid.axis, shown.grid.axis)
    magnitude = np.abs(shown.values)
    errors = []
    for (px, py), amplitude in zip(problem.points, problem.amplitudes, strict=True):
        top = float(magnitude[np.hypot(x - px, y - py) < radius_m].max())
        errors.append(20 * np.log10(max(top / abs(amplitude), 1e-9)))
    errors_db = np.array(errors)
    errors_db = np.maximum(errors_db, errors_db.max() - 20)
    return float(errors_db.std())


def points(run: Run) -> Iterator[Table]:
    """Two to four reflectors of 0.5 to 1 in noise: headline figures, and pictures at equal resolution."""
    seeds = run.number(10)
    run.seeds = f"0 to {seeds - 1}"
    every = (*POINT_ROWS, "oracle")
    rows = chosen(run, every)
    cells = [
        PointCell(views, noise, seed, row)
        for row in rows
        for views, noise in (CASES[1:2] if run.quick else CASES)
        for seed in range(seeds)
    ]
    scores = run.each(score_points, cells)
    base, equal = [], []
    for views, noise in dict.fromkeys((c.views, c.noise) for c in cells):
        for row in (row for row in every if row in rows):
            some = [score for c, score in scores.items() if (c.views, c.noise, c.row) == (views, noise, row)]
            column = {name: np.array([s[name] for s in some], dtype=float) for name in some[0]}
            first = [f"{views}", f"{noise:g}", row, str(len(some))]
            if row not in ("blank", "oracle"):
                where = f"{interval(column['where_mm'], 2)} ({column['bound_mm'].mean():.2f})"
                base.append([*first, where, *(interval(column[n], d) for n, d in OWN[1:])])
            equal.append([*first, *(interval(column[n], d) for n, d in EQUAL)])
    heading = ("views", "noise", "method", "seeds")
    yield Table(
        (*heading, *OWN_TITLES),
        base,
        "At each method's own resolution: single pixels for FISTA, OMP and ATS. In brackets the Cramér-Rao "
        "bound. Seconds of processor time.",
        shown=lambda line: line[0] == "36",
    )
    yield Table(
        (*heading, *EQUAL_TITLES),
        equal,
        "At equal resolution: FISTA, OMP, ATS and the oracle (true positions and amplitudes) with the same "
        "beam, as wide as the core of the others' point response; truth drawn with that beam.",
        name="equal",
        shown=lambda line: line[0] == "36",
    )


OWN = (("where_mm", 2), ("missed", 1), ("false", 1), ("amplitude_db", 1), ("held_out", 1), ("seconds", 2))
OWN_TITLES = (
    "localisation (mm)", "missed per scene", "false per scene", "amplitude error (dB)",
    "held-out residual (%)", "seconds",
)  # fmt: skip
EQUAL = (("psnr_db", 1), ("lpips", 3))
EQUAL_TITLES = ("PSNR (dB)", "LPIPS")


class PaperCell(NamedTuple):
    """So many reflectors, every so many degrees, seen by one row of the tables."""

    count: int
    skip_deg: int
    seed: int
    row: str


SKIPS_DEG = (1, 10, 20, 30)


def score_paper(cell: PaperCell) -> dict[str, float]:
    """PSNR and LPIPS against points as wide as the beam, of pictures as every method shows them."""
    problem = drawn_points(360 // cell.skip_deg, 0.316, cell.seed, cell.count)
    wavenumber = problem.scans(False).wavenumber
    image, seconds = problem.image(cell.row)
    truth = truth_image(problem.points, problem.grid, problem.amplitudes, beam_sigma_m(wavenumber))
    quality = psnr(image.values, truth)
    return {"psnr": quality, "lpips": perceptual(image, truth), "seconds": seconds}


def paper(run: Run) -> Iterator[Table]:
    """The table and the skip angles of the paper: one to four reflectors in noise of variance 0.1."""
    seeds = run.number(10)
    run.seeds = f"0 to {seeds - 1}"
    rows = chosen(run, ("BP", "FISTA", SLOW, "ATS field"))
    cells = [
        PaperCell(count, skip, seed, row)
        for row in rows
        for count in (1, 2, 3, 4)
        for skip in SKIPS_DEG
        for seed in range(seeds)
        if row != SLOW or seed == 0
    ]
    scores = run.each(score_paper, cells)
    lines = []
    for count in (1, 2, 3, 4):
        for row in rows:
            line = [str(count), row]
            for skip in SKIPS_DEG:
                some = [s for c, s in scores.items() if (c.count, c.skip_deg, c.row) == (count, skip, row)]
                means = [float(np.mean([item[name] for item in some])) for name in ("psnr", "lpips")]
                line.append(f"{means[0]:.1f} / {means[1]:.3f}")
            lines.append(line)
    columns = ("reflectors", "method", *(f"every {skip} deg" for skip in SKIPS_DEG))
    note = "PSNR, dB, and LPIPS, means over the seeds (of the published method one); noise of 0.316."
    yield Table(columns, lines, note)


class CloseCell(NamedTuple):
    """Two reflectors so far apart, seen by one row of the tables."""

    apart_mm: int
    seed: int
    row: str


def score_close(cell: CloseCell) -> dict[str, float]:
    """Whether exactly the two are seen, each within 8 mm, and how far off they are, mm."""
    problem = close_points(36, 0.1, cell.seed, cell.apart_mm / 1000, FINE)
    row = f"{cell.row}, bare" if f"{cell.row}, bare" in ROWS else cell.row
    image, _ = problem.image(row)
    located = localise(local_maxima(image), problem.points, 0.008)
    resolved = float(located.missed == 0 and located.false == 0)
    return {"resolved": resolved, "where_mm": located.rmse_m * 1e3 if resolved else float("nan")}


def local_maxima(image: Image, threshold: float = 0.5) -> np.ndarray:
    """(n, 2) pixels that no neighbour exceeds, above `threshold` of the maximum, m.

    `pick_peaks` also takes the flank of a broad spot for a peak once it lies its separation away; between
    points as close as these, only maxima count.
    """
    magnitude = np.abs(image.values)
    bright = magnitude > threshold * magnitude.max()
    rows, columns = np.nonzero(bright & (magnitude == maximum_filter(magnitude, 3)))
    axis = image.grid.axis
    return np.stack([axis[columns], axis[rows]], axis=1)


def resolution(run: Run) -> Iterator[Table]:
    """Two equal reflectors 15 to 30 mm apart, 36 views, noise 0.1, pixels of 3.6 mm."""
    seeds = run.number(10)
    run.seeds = f"0 to {seeds - 1}"
    rows = chosen(run, tuple(row for row in POINT_ROWS if row != "blank"))
    cells = [CloseCell(apart, seed, row) for row in rows for apart in APART_MM for seed in range(seeds)]
    scores = run.each(score_close, cells)
    lines = []
    for row in (row for row in POINT_ROWS if row in rows):
        line = [row, str(seeds)]
        for apart in APART_MM:
            some = [score for c, score in scores.items() if (c.row, c.apart_mm) == (row, apart)]
            where = np.array([s["where_mm"] for s in some], dtype=float)
            resolved = sum(s["resolved"] for s in some)
            line.append(f"{resolved:.0f}" + (f" ({np.nanmean(where):.1f})" if resolved else ""))
        lines.append(line)
    columns = ("method", "pairs", *(f"{apart} mm apart" for apart in APART_MM))
    note = "Pairs of which both are seen and nothing else; in brackets their localisation error, mm."
    yield Table(columns, lines, note)
