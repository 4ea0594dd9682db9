"""Volumes: time and memory, and how well every method predicts held-out views; and what ignoring the second
antenna costs, from places of points backprojected with and without it.
"""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np

from tagid.capture import Capture
from tagid.geometry import Aperture, ImageGrid, VolumeGrid
from tagid.imaging.ats.volume import fit_volume
from tagid.imaging.backprojection import upsample_at_carrier
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.volume import backproject_volume
from tagid.pipeline.join import join
from tagid.pipeline.volume import METHODS, VolumeSettings, reconstruct_volume
from tests.benchmarks.measure import timed
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, column, grouped, interval
from tests.unit.imaging_scenes import record, turn

SETS = {"3 heights, 0 to 0.3 m": (0.0, 0.15, 0.3), "5 heights, -0.2 to 0.2 m": (-0.2, -0.1, 0.0, 0.1, 0.2)}
KINDS = ("points", "shell", "rod", "rows")
VIEWS, LEVEL_DB = 36, 20
POINTS = np.array([[0.1, 0.05, 0.08], [-0.08, 0.02, -0.11], [0.02, -0.12, 0.0]])
NOTE = """Share of the energy of held-out views that a volume leaves unexplained, in percent (1 in 12 views
held out, one complex factor fitted). {views} views per height at 1 m, {level} dB summed echo to noise of one
sample, volumes of 0.24 x 0.24 x 0.24 m in 32 x 32 x 16 voxels; mean and 95 % interval over {seeds} seeds.
Noise is the least that any volume can reach. Points: five at random places. Shell: 80 points on a cylinder of
60 mm radius. Rod: 30 points on a tilted line. Rows: a tag of four reflectors in two rows."""
TIME_NOTE = """Three points, {heights} antenna heights from -0.25 to 0.25 m at 1 m, 360 views each, 320
samples per scan, into 128 x 128 x {levels} voxels of 0.4 m, on {cores} cores. The time by the clock holds for
the load of that moment; processor time over cores is that of an idle machine."""


def scene(kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3), m, and their amplitudes."""
    rng = np.random.default_rng([31, seed])
    if kind == "points":
        return rng.uniform(-0.09, 0.09, (5, 3)), rng.uniform(0.5, 1, 5)
    if kind == "shell":
        angle, height = rng.uniform(0, 2 * np.pi, 80), rng.uniform(-0.05, 0.05, 80)
        return np.column_stack([0.06 * np.cos(angle), 0.06 * np.sin(angle), height]), np.ones(80)
    if kind == "rod":
        along, middle = np.linspace(-0.06, 0.06, 30)[:, None], rng.uniform(-0.02, 0.02, 3)
        direction = rng.standard_normal(3)
        return middle + along * direction / np.linalg.norm(direction), np.ones(30)
    angle = rng.uniform(0, 2 * np.pi) + np.arange(4) * np.pi / 2 + rng.uniform(-0.4, 0.4, 4)
    rows = rng.choice([-0.03, 0.03], 4)
    return np.column_stack([0.09 * np.cos(angle), 0.09 * np.sin(angle), rows]), rng.uniform(0.8, 1, 4)


class Cell(NamedTuple):
    """A scene, the antenna heights of `SETS` from which it is seen, and a seed."""

    heights: str
    kind: str
    seed: int


def residuals(cell: Cell) -> dict[str, float]:
    """Held-out residual of every method, %, and the noise in it."""
    kind, heights, seed = cell.kind, SETS[cell.heights], cell.seed
    points, amplitudes = scene(kind, seed)
    clean = record(points, amplitudes, turn(VIEWS, 1.0, heights[0]), start_m=0.5)
    noise = float(np.abs(clean.samples).max()) * 10 ** (-LEVEL_DB / 20)
    parts = [
        record(points, amplitudes, turn(VIEWS, 1.0, h), start_m=0.5, noise=noise, seed=100 * seed + k)
        for k, h in enumerate(heights)
    ]
    first, result = join(parts), {}
    for method in METHODS:
        made = reconstruct_volume(first, VolumeSettings(method, 0.24, 32, (-0.12, 0.12), 16))
        held_out = made.volume.settings["held_out"]
        result[method] = 100 * held_out["residual"]
        result["noise"] = 100 * (held_out["noise"] or float("nan"))
    return result


def predicted(run: Run) -> Iterator[Table]:
    seeds, kinds = run.drawn(3), KINDS[:1] if run.quick else KINDS
    results = run.each(residuals, [Cell(*cell) for cell in product(SETS, kinds, seeds)])
    rows = [
        (*place, *(interval(column(some, key), 1) for key in (*METHODS, "noise")))
        for place, some in grouped(results, lambda cell: cell[:2]).items()
    ]
    better, sparser = (sum(r["ats"] < r[other] for r in results.values()) for other in ("bp", "sparse"))
    below = (
        f"ATS is below backprojection in {better} of {len(results)} scenes, and below sparse recovery in "
        f"{sparser} of {len(results)}."
    )
    note = NOTE.format(views=VIEWS, level=LEVEL_DB, seeds=len(seeds))
    yield Table("antennas | scene | bp | sparse | ATS | noise", rows, note, below=below)


def _recorded(run: Run) -> tuple[Capture, VolumeGrid, str]:
    """What is timed: the joined turns, the volume, and a note of their size."""
    heights, levels = (4, 20) if run.quick else (100, 100)
    run.seeds = "none drawn"
    angles = np.arange(360) * 2 * np.pi / 360
    capture = join(
        [
            record(POINTS, [1, 1, 1], Aperture.turntable(angles, 1.0, float(h)), bins=320, start_m=0.2)
            for h in np.linspace(-0.25, 0.25, heights)
        ]
    )
    cores = len(os.sched_getaffinity(0))
    note = TIME_NOTE.format(heights=heights, levels=levels, cores=cores)
    return capture, VolumeGrid(ImageGrid(0.4, 128), -0.2, 0.2, levels), note


def _settings(matched: bool) -> PreprocessSettings:
    return PreprocessSettings("none", matched, extent_m=0.4, heights_m=(-0.2, 0.2))


def _worst_place_mm(values: np.ndarray, grid: VolumeGrid) -> float:
    """Largest distance of a point from the brightest voxel within 3 cm, or two levels, mm."""
    reach = max(0.03, 2 * float(grid.heights[1] - grid.heights[0]))
    positions, magnitude = grid.points(), np.abs(values).ravel()
    errors = []
    for point in POINTS:
        near = np.flatnonzero(np.linalg.norm(positions - point, axis=1) < reach)
        errors.append(1e3 * float(np.linalg.norm(positions[near[np.argmax(magnitude[near])]] - point)))
    return max(errors)


def _rows(values: np.ndarray, grid: VolumeGrid) -> list[tuple[str, str]]:
    memory_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return [
        ("peak memory of the process", f"{memory_gb:.2f} GB"),
        ("largest error of the brightest voxels' places", f"{_worst_place_mm(values, grid):.1f} mm"),
    ]


def backprojected(run: Run) -> Iterator[Table]:
    """Time and memory of a volume by backprojection, from many turns at different heights."""
    capture, grid, note = _recorded(run)
    scans, before, _ = timed(lambda: preprocess(capture, settings=_settings(True)))
    made, seconds, used = timed(lambda: backproject_volume(scans, grid))
    pairs = capture.views * grid.voxels
    rows = [
        ("pairs of view and voxel", f"{pairs:.3g}"),
        ("preprocessing", f"{before:.1f} s"),
        ("backprojection", f"{seconds:.1f} s, {used:.1f} s of processor time"),
        ("pairs per second of processor time", f"{pairs / used:.3g}"),
        *_rows(made.values, grid),
    ]
    yield Table(("", ""), rows, note)


def fitted(run: Run) -> Iterator[Table]:
    """Time, memory and error of one fit, without the held-out residual, which takes as much again."""
    capture, grid, note = _recorded(run)
    scans, matched = (preprocess(capture, settings=_settings(m)) for m in (False, True))
    marks, busy = [0.0], time.process_time()

    def progress(done: float, total: float, remark: str) -> None:
        if done <= 0.35:
            marks[0] = time.process_time() - busy

    made, seconds, used = timed(lambda: fit_volume(matched, scans, grid, progress=progress))
    rows = [
        ("fit with its backprojection", f"{seconds:.0f} s, {used:.0f} s of processor time"),
        ("of this the backprojection", f"{marks[0]:.0f} s of processor time"),
        ("voxels that were fitted", f"{made.settings['active_voxels']:,} of {grid.voxels:,}"),
        *_rows(made.values, grid),
    ]
    yield Table(("", ""), rows, note)


STEP_M = 2.5e-4
SECTORS_DEG = {"full turn": (0, 360), "half turn": (-90, 90), "quarter turn": (-45, 45)}
ANTENNAS_NOTE = """{count} points drawn within 0.13 m of the axis, each alone and without noise; a P440's
band, 1 degree per view, axis distance 1 m to the middle between the antennas. Localisation error of the
backprojected peak in mm, rms (largest), on a grid of 0.25 mm.

The range of the axis is sqrt(1 + (d/2)^2) - 1 m too long for one antenna; "axis moved" takes that much more
axis distance, as a search for it would find."""


def errors_mm(views: Aperture, assumed: Aperture, points: np.ndarray) -> np.ndarray:
    """(points,) distance of the backprojected peak of each point alone from its place, mm."""
    axis = np.arange(-0.012, 0.012 + STEP_M / 2, STEP_M)
    around = np.stack([part.ravel() for part in np.meshgrid(axis, axis)], axis=1)
    errors = []
    for point in points:
        settings = PreprocessSettings("none", True, extent_m=0.4)
        rows, start, step = upsample_at_carrier(
            preprocess(record([point], [1], views), settings=settings), slice(None)
        )
        place = RangeGeometry.of(assumed, around + point, (start, step), rows.shape[1])
        errors.append(1e3 * np.hypot(*around[np.argmax(np.abs(place.gather(rows)))]))
    return np.array(errors)


def antennas(run: Run) -> Iterator[Table]:
    count = run.number(40, 4)
    run.seeds = "0"
    points = np.random.default_rng(0).uniform(-0.09, 0.09, (count, 2)) * np.sqrt(2)
    rows = []
    for apart in (0.1, 0.2, 0.4):
        reach = float(np.hypot(1, apart / 2))
        for name, (first, last) in SECTORS_DEG.items():
            angles = np.deg2rad(np.arange(first, last))
            views = Aperture.turntable(angles, 1.0, 0.0, apart)
            errors = [
                errors_mm(views, assumed, points)
                for assumed in (views, Aperture.turntable(angles, 1.0), Aperture.turntable(angles, reach))
            ]
            cells = [f"{np.sqrt((e**2).mean()):.2f} ({e.max():.2f})" for e in errors]
            rows.append((f"{apart:g} m apart", name, f"{1e3 * (reach - 1):.1f}", *cells))
    columns = (
        "antennas | views | range error of the axis (mm) | both antennas | one, in the middle | "
        "one, axis moved"
    )
    yield Table(columns, rows, ANTENNAS_NOTE.format(count=count))
