"""Experiments on reflectors: localisation beside its bound, resolution, detections, amplitudes, prediction.

Unit points uniform within +-0.22 m, radar at 1 m; 0.7 m and 96 x 96 pixels. The analytic sinogram is divided
by its peak; "noise" is the standard deviation of the complex noise of one sample. The paper's CN(0, 0.1) does
not say whether 0.1 is standard deviation or variance: both stand here, 0.1 and 0.316. Every method is judged
at its own resolution; one table compares pictures at equal resolution, between the oracle and the blank
image.
"""

from __future__ import annotations

from collections.abc import Iterator
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
    is_sharp,
    perceptual,
)
from tests.benchmarks.measure import timed
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, column, grouped, interval
from train.metrics import blank, localise, pick_peaks, psnr, truth_image

__all__ = ["add_options", "paper", "points", "resolution"]

CASES = ((360, 0.316), (36, 0.316), (12, 0.1))
"""Views, and standard deviation of the noise."""
APART_MM = (15, 20, 30)
FINE = ImageGrid(GRID.extent / 2, GRID.pixels)
"""Pixels of 3.6 mm, on which no method's resolution is that of its pixels."""
MOST_PEAKS = 8


class PointCell(NamedTuple):
    """A scene of two to four reflectors, seen by one row of the tables."""

    views: int
    noise: float
    seed: int
    row: str


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
    """The members of `OWN` and `EQUAL`, and the Cramér-Rao bound of the distance of detected reflectors.

    Missed are reflectors that no peak is near, false peaks that are near none; for the amplitudes one common
    factor is fitted; PSNR and LPIPS are at equal resolution, seconds of processor time.
    """
    problem = drawn_points(cell.views, cell.noise, cell.seed)
    wavenumber = problem.scans(False).wavenumber
    sharp = is_sharp(cell.row)
    if cell.row in ("oracle", "blank"):
        seconds = float("nan")
        base = oracle(problem, wavenumber) if cell.row == "oracle" else blank(problem.grid)
    else:
        (base, _), _, seconds = timed(lambda: problem.image(cell.row, bare=True))
    shown = restore(base, wavenumber) if sharp else base
    located = localise(pick_peaks(base, MOST_PEAKS), problem.points)
    truth = truth_image(problem.points, problem.grid, problem.amplitudes, beam_sigma_m(wavenumber))
    return {
        "where_mm": 1e3 * located.rmse_m,
        "missed": float(located.missed),
        "false": float(located.false),
        "amplitude_db": amplitude_error_db(shown, problem) if np.any(base.values) else float("nan"),
        "bound_mm": cramer_rao_mm(problem.points, cell.views, cell.noise, problem.amplitudes),
        "held_out": held_out_percent(problem, cell.row) if cell.row in ROWS else float("nan"),
        "psnr_db": psnr(shown.values, truth),
        "lpips": perceptual(shown.values, truth),
        "seconds": seconds,
    }


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


OWN = {
    "where_mm": ("localisation (mm)", 2),
    "missed": ("missed per scene", 1),
    "false": ("false per scene", 1),
    "amplitude_db": ("amplitude error (dB)", 1),
    "held_out": ("held-out residual (%)", 1),
    "seconds": ("seconds", 2),
}
EQUAL = {"psnr_db": ("PSNR (dB)", 1), "lpips": ("LPIPS", 3)}


def points(run: Run) -> Iterator[Table]:
    """Two to four reflectors of 0.5 to 1 in noise: headline figures, and pictures at equal resolution."""
    seeds, every = run.drawn(10), (*ROWS, "oracle")
    rows, cases = chosen(run, every), CASES[1:2] if run.quick else CASES
    cells = [PointCell(*case, seed, row) for row in rows for case in cases for seed in seeds]
    scores = grouped(run.each(score_points, cells), lambda c: (c.views, c.noise, c.row))
    base, equal = [], []
    for views, noise in cases:
        for row in (row for row in every if row in rows):
            some = scores[views, noise, row]
            own, alike = (
                [interval(column(some, name), digits) for name, (_, digits) in columns.items()]
                for columns in (OWN, EQUAL)
            )
            first = [f"{views}", f"{noise:g}", row, str(len(some))]
            if row not in ("blank", "oracle"):
                base.append([*first, f"{own[0]} ({column(some, 'bound_mm').mean():.2f})", *own[1:]])
            equal.append([*first, *alike])
    heading = ("views", "noise", "method", "seeds")
    yield Table(
        (*heading, *(title for title, _ in OWN.values())),
        base,
        "At each method's own resolution: single pixels for FISTA, OMP and ATS. In brackets the Cramér-Rao "
        "bound. Seconds of processor time.",
        shown=lambda line: line[0] == "36",
    )
    yield Table(
        (*heading, *(title for title, _ in EQUAL.values())),
        equal,
        "At equal resolution: FISTA, OMP, ATS and the oracle (true positions and amplitudes) with the same "
        "beam, as wide as the core of the others' point response; truth drawn with that beam.",
        name="equal",
        shown=lambda line: line[0] == "36",
    )


SKIPS_DEG = (1, 10, 20, 30)


def score_paper(cell: tuple[int, int, int, str]) -> dict[str, float]:
    """PSNR and LPIPS against points as wide as the beam, of pictures as every method shows them.

    A cell is the number of reflectors, the degrees between views, the seed, and the row of the tables.
    """
    count, skip_deg, seed, row = cell
    problem = drawn_points(360 // skip_deg, 0.316, seed, count)
    wavenumber = problem.scans(False).wavenumber
    image, seconds = problem.image(row)
    truth = truth_image(problem.points, problem.grid, problem.amplitudes, beam_sigma_m(wavenumber))
    quality = psnr(image.values, truth)
    return {"psnr": quality, "lpips": perceptual(image.values, truth), "seconds": seconds}


def paper(run: Run) -> Iterator[Table]:
    """The table and the skip angles of the paper: one to four reflectors in noise of variance 0.1."""
    seeds, rows, counts = run.drawn(10), chosen(run, ("BP", "FISTA", SLOW, "ATS field")), (1, 2, 3, 4)
    cells = [
        (count, skip, seed, row)
        for row in rows
        for count in counts
        for skip in SKIPS_DEG
        for seed in seeds
        if row != SLOW or seed == 0
    ]
    scores = grouped(run.each(score_paper, cells), lambda c: (c[0], c[3], c[1]))
    lines = []
    for count in counts:
        for row in rows:
            some = [scores[count, row, skip] for skip in SKIPS_DEG]
            means = [(column(item, "psnr").mean(), column(item, "lpips").mean()) for item in some]
            lines.append([str(count), row, *(f"{quality:.1f} / {seen:.3f}" for quality, seen in means)])
    columns = ("reflectors", "method", *(f"every {skip} deg" for skip in SKIPS_DEG))
    note = "PSNR, dB, and LPIPS, means over the seeds (of the published method one); noise of 0.316."
    yield Table(columns, lines, note)


def score_close(cell: tuple[int, int, str]) -> dict[str, float]:
    """Whether exactly two reflectors, so many mm apart, are seen, each within 8 mm, and how far off, mm."""
    apart_mm, seed, row = cell
    problem = close_points(36, 0.1, seed, apart_mm / 1000, FINE)
    image, _ = problem.image(row, bare=True)
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
    seeds = run.drawn(10)
    rows = chosen(run, tuple(row for row in ROWS if row != "blank"))
    cells = [(apart, seed, row) for row in rows for apart in APART_MM for seed in seeds]
    scores = grouped(run.each(score_close, cells), lambda c: (c[2], c[0]))
    lines = []
    for row in (row for row in ROWS if row in rows):
        line = [row, str(len(seeds))]
        for apart in APART_MM:
            some = scores[row, apart]
            resolved = column(some, "resolved").sum()
            where = f" ({np.nanmean(column(some, 'where_mm')):.1f})" if resolved else ""
            line.append(f"{resolved:.0f}{where}")
        lines.append(line)
    columns = ("method", "pairs", *(f"{apart} mm apart" for apart in APART_MM))
    note = "Pairs of which both are seen and nothing else; in brackets their localisation error, mm."
    yield Table(columns, lines, note)
