"""Scenes of the imaging benchmarks with their truths, the methods compared, and how an image is scored.

Shared by all imaging experiments, so that every table has the same rows and means the same by them.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.geometry import Aperture, ImageGrid
from tagid.imaging.ats.adapt import settings_of
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.coupled import coupled_recovery
from tagid.imaging.facts import facts_of, is_coupled
from tagid.imaging.heldout import check
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.restore import restore
from tagid.imaging.types import BasebandScans, Image
from tagid.pipeline.reconstruct import METHODS, make_image
from tagid.simulate import (
    Acquisition,
    Recording,
    Scene,
    Wobble,
    scene_from_name,
)
from tagid.simulate import simulate_capture as record_scene
from tagid.waveform import nominal_pulse, pulse_at
from tests.benchmarks.electromagnetic import ConductingCylinder, cardboard_box, metal_box
from tests.benchmarks.identification_scenes import least_gap_m
from tests.benchmarks.measure import timed
from tests.benchmarks.provenance import SHARED
from tests.benchmarks.run import Run
from train.metrics import blank, lpips, truth_image

GRID = ImageGrid(0.7, 96)
AXIS_DISTANCE_M = 1.0
FIRST_SEED = 20_000
perceptual = partial(lpips, model=SHARED / "data" / "lpips" / "lpips_sq.onnx")
"""LPIPS of the values of an image against the drawn truth."""


class Row(NamedTuple):
    """A method of the tables, its preset, and the steps of its fit; 0: as many as it takes by itself."""

    method: str = ""
    preset: str = ""
    steps: int = 0


ROWS = {
    "blank": Row(),
    "BP": Row("bp-raw"),
    "matched-filter BP": Row("bp"),
    "range-Doppler": Row("range-doppler"),
    "polar format": Row("polar"),
    "FISTA": Row("sparse"),
    "OMP": Row("omp"),
    "ATS paper": Row("ats", "paper"),
    "ATS field": Row("ats", "field"),
    "ATS 300 steps": Row("ats", "field", 300),
}
"""Rows of the tables. FISTA, OMP and ATS field are shown with the restoring beam, as `tagid reconstruct`
does. "ATS 300 steps" is among reflectors only."""
SLOW = "ATS paper"
"""Row that is computed last, as its images take many seconds each."""


def is_sharp(row: str) -> bool:
    method, preset, _ = ROWS.get(row, ROWS["blank"])
    return bool(method) and METHODS[method].sparse and preset != "paper"


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rows", help="these methods alone, e.g. 'BP,ATS field'")


def chosen(run: Run, rows: Sequence[str]) -> list[str]:
    """The rows that are asked for, the slow one last."""
    asked = run.options.rows.split(",") if run.options.rows else rows
    return sorted((row for row in rows if row in asked), key=SLOW.__eq__)


@dataclass(frozen=True, eq=False)
class Problem:
    """One scene as every method gets it; the seed is of methods with random weights.

    Attributes:
        truth: (pixels, pixels) what the magnitude should look like.
        points, amplitudes: (n, 2) m and (n,) complex, true ones; empty for extended objects.
        background: what is removed from the scans before imaging; point scenes hold no clutter.
        made: images made already, before the restoring beam.
    """

    capture: Capture
    grid: ImageGrid
    truth: np.ndarray
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    amplitudes: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=complex))
    seed: int = 0
    background: str = "none"
    made: dict[Row, tuple[Image, float]] = field(default_factory=dict)

    def scans(self, matched: bool) -> BasebandScans:
        settings = PreprocessSettings(self.background, matched, extent_m=self.grid.extent)
        return preprocess(self.capture, settings=settings)

    def image(self, row: str, bare: bool = False) -> tuple[Image, float]:
        """Image of a row, with its beam or bare, and its processor seconds, preprocessing not counted."""
        made_by = method, preset, steps = ROWS[row]
        if not method:
            return blank(self.grid), 0.0
        scans = self.scans(METHODS[method].matched_filter)
        if made_by not in self.made:
            how = (scans, self.grid, method, self.seed, preset or "field")
            image, _, seconds = timed(partial(make_image, *how, ats=AtsSettings(steps=steps)))
            self.made[made_by] = image, seconds
        image, seconds = self.made[made_by]
        if is_sharp(row) and not bare:
            image = restore(image, scans.wavenumber)
        return image, seconds


def echoes(points: np.ndarray, angles: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """(n, views, bins) analytic echo of a unit point at each of (n, 2), m."""
    antenna = Aperture.turntable(angles, AXIS_DISTANCE_M).positions
    out = []
    for x, y in points:
        distance = np.linalg.norm(antenna - np.array([x, y, 0.0]), axis=1)
        out.append(pulse_at(nominal_pulse(), 2 * (ranges[None] - distance[:, None]) / SPEED_OF_LIGHT))
    return np.array(out)


def window(extent_m: float) -> np.ndarray:
    """Ranges of the bins that hold a square of that side, m."""
    reach = extent_m / np.sqrt(2) + 0.25
    return np.arange(AXIS_DISTANCE_M - reach, AXIS_DISTANCE_M + reach, RANGE_STEP_M)


def point_problem(
    points: np.ndarray,
    views: int,
    noise: float,
    rng: np.random.Generator,
    grid: ImageGrid = GRID,
    amplitudes: np.ndarray | None = None,
) -> Problem:
    """Points; the sinogram divided by its peak, then complex noise of that standard deviation added.

    Amplitudes are 1 where none are given.
    """
    amplitudes = np.ones(len(points), dtype=complex) if amplitudes is None else amplitudes
    angles = np.arange(views) * 2 * np.pi / views
    ranges = window(GRID.extent)
    clean = np.tensordot(amplitudes, echoes(points, angles, ranges), axes=1)
    clean /= np.abs(clean).max()
    drawn = rng.standard_normal((2, *clean.shape))
    samples = clean + noise / np.sqrt(2) * (drawn[0] + 1j * drawn[1])
    capture = Capture(
        samples.astype(np.complex64), float(ranges[0]), RANGE_STEP_M, angles, axis_distance_m=AXIS_DISTANCE_M
    )
    return Problem(capture, grid, truth_image(points, grid), points, amplitudes)


def drawn_points(views: int, noise: float, seed: int, count: int | None = None) -> Problem:
    """Two to four points, or so many, within +-0.22 m, 5 cm apart or more, of 0.5 to 1 and any phase."""
    rng = np.random.default_rng([FIRST_SEED + seed, views, 31])
    count = 2 + seed % 3 if count is None else count
    while True:
        points = rng.uniform(-0.22, 0.22, (count, 2))
        if least_gap_m(points) > 0.05:
            break
    amplitudes = rng.uniform(0.5, 1, count) * np.exp(2j * np.pi * rng.random(count))
    return point_problem(points, views, noise, rng, amplitudes=amplitudes)


def held_out_percent(problem: Problem, row: str) -> float:
    """Held-out residual of a row of `ROWS`, per cent; nan for a method whose image predicts no scans.

    The published method is among those: its image predicts scans through its own model of rays alone.
    """
    method, preset, steps = ROWS[row]
    if not method or preset == "paper" or method == "range-doppler":
        return float("nan")
    scans, raw = problem.scans(METHODS[method].matched_filter), problem.scans(False)
    # With the prior and the views a step of the image of all views.
    facts = facts_of(problem.image(row, bare=True)[0].settings if method == "ats" else {})
    coupled = is_coupled(facts)
    ats = settings_of(facts, AtsSettings(steps=steps))

    def make(some: BasebandScans) -> Image:
        if coupled:
            return coupled_recovery(some, problem.grid)
        return make_image(some, problem.grid, method, problem.seed, ats=ats)

    def predicted(every: BasebandScans, unseen: np.ndarray) -> float:
        # The fit is more than its image: what no turn changes.
        return fit(every, problem.grid, replace(ats, seed=problem.seed), unseen=unseen).held_out

    field = method == "ats" and not coupled
    fitted = method not in ("bp", "bp-raw")
    checked = check(scans, raw, problem.grid, make if fitted else None, predicted if field else None)
    return 100 * checked["residual"] if checked is not None else float("nan")


def random_points(count: int, views: int, noise: float, seed: int) -> Problem:
    """`count` points uniform within +-0.22 m, as in docs/results/imaging.md since the first table."""
    rng = np.random.default_rng([FIRST_SEED + seed, count])
    return point_problem(rng.uniform(-0.22, 0.22, (count, 2)), views, noise, rng)


def close_points(views: int, noise: float, seed: int, apart_m: float, grid: ImageGrid) -> Problem:
    """Two points `apart_m` apart in a random direction at a random place within the grid's inner half."""
    rng = np.random.default_rng([FIRST_SEED + seed, 77])
    reach = 0.15 * grid.extent / GRID.extent
    middle, angle = rng.uniform(-reach, reach, 2), rng.uniform(0, np.pi)
    half = apart_m / 2 * np.array([np.cos(angle), np.sin(angle)])
    return point_problem(np.array([middle - half, middle + half]), views, noise, rng, grid)


def cramer_rao_mm(points: np.ndarray, views: int, noise: float, amplitudes: np.ndarray) -> float:
    """Root of the mean Cramér-Rao bound of the squared distance error over the points, mm.

    Unknown are x, y and the complex amplitude of every point; F = 2 / noise^2 Re(J^H J) with J the derivative
    of the samples (Kay, Fundamentals of Statistical Signal Processing, 1993, section 15.7).
    """
    angles = np.arange(views) * 2 * np.pi / views
    ranges, step = window(GRID.extent), 1e-5
    at = echoes(points, angles, ranges)
    peak = np.abs(np.tensordot(amplitudes, at, axes=1)).max()
    columns = []
    for i in range(len(points)):
        for axis in (0, 1):
            moved = [points.copy(), points.copy()]
            moved[0][i, axis] += step
            moved[1][i, axis] -= step
            plus, minus = (echoes(m[i : i + 1], angles, ranges)[0] for m in moved)
            columns.append(amplitudes[i] * (plus - minus) / (2 * step))
        columns += [at[i], 1j * at[i]]
    jacobian = np.stack([c.ravel() for c in columns], axis=1) / peak
    bound = np.linalg.inv(2 / noise**2 * (jacobian.conj().T @ jacobian).real)
    item = [bound[4 * i, 4 * i] + bound[4 * i + 1, 4 * i + 1] for i in range(len(points))]
    return float(1e3 * np.sqrt(np.mean(item)))


CAN, BOTTLE = (0.033, 0.122), (0.033, 0.2)
"""Radius and height, m, of a 0.33 l drink can and of a 400 ml spray bottle."""


class Object(NamedTuple):
    """An extended object: bodies for the simulator, the outline that reflects, the side of its image, m.

    The outline is circles (x, y, radius) and sides of squares about the origin, m.
    """

    bodies: tuple[object, ...]
    circles: tuple[tuple[float, float, float], ...] = ()
    squares: tuple[float, ...] = ()
    extent_m: float = 0.7

    @property
    def grid(self) -> ImageGrid:
        """Pixels as large as those of the point scenes."""
        return ImageGrid(self.extent_m, round(96 * self.extent_m / 0.7))

    def outline(self, grid: ImageGrid, sigma_m: float = 0.01) -> np.ndarray:
        """(pixels, pixels) outline drawn as a line of Gaussian profile, as points are."""
        x, y = np.meshgrid(grid.axis, grid.axis)
        off = np.full(x.shape, np.inf)
        for cx, cy, radius in self.circles:
            off = np.minimum(off, np.abs(np.hypot(x - cx, y - cy) - radius))
        for side in self.squares:
            dx, dy = np.abs(x) - side / 2, np.abs(y) - side / 2
            outside = np.hypot(np.maximum(dx, 0), np.maximum(dy, 0))
            off = np.minimum(off, np.abs(outside + np.minimum(np.maximum(dx, dy), 0)))
        return np.exp(-(off**2) / (2 * sigma_m**2))


def _pair(shape: tuple[float, float], apart_m: float, extent_m: float) -> Object:
    places = (-apart_m / 2, apart_m / 2)
    bodies = tuple(ConductingCylinder(*shape, (x, 0.0)) for x in places)
    return Object(bodies, tuple((x, 0.0, shape[0]) for x in places), (), extent_m)


OBJECTS = {
    "can in a cardboard box": Object(
        (ConductingCylinder(*CAN, (0.0, 0.0)), *cardboard_box(0.25, 0.25)),
        ((0.0, 0.0, CAN[0]),),
        (0.25,),
        0.5,
    ),
    "two bottles 17.78 cm apart": _pair(BOTTLE, 0.1778, 0.5),
    "two cans 68.58 cm apart": _pair(CAN, 0.6858, 1.0),
    "metal box of 24.13 cm": Object(metal_box(0.2413, 0.2413), (), (0.2413,), 0.5),
}


@cache
def _object_echo(name: str) -> tuple[Capture, float]:
    """A whole turn of 360 scans of an object without noise, and the peak of its envelope."""
    acquisition = Acquisition(views=360, axis_distance_m=AXIS_DISTANCE_M, recording=Recording("float32"))
    capture, truth = record_scene(Scene("object", OBJECTS[name].bodies), acquisition)
    return capture, truth.levels.reflector


def object_problem(name: str, angles_deg: np.ndarray, seed: int) -> Problem:
    """An object at some angles, degrees, of a whole turn, at 20 dB; the seed draws the noise."""
    whole, peak = _object_echo(name)
    rng = np.random.default_rng([FIRST_SEED + seed, 71])
    noise = peak * 10 ** (-20.0 / 20) * rng.standard_normal(whole.samples.shape)
    capture = replace(whole, samples=(whole.samples + noise).astype(np.float32))
    chosen = capture.select(np.asarray(angles_deg, dtype=np.intp))
    thing = OBJECTS[name]
    return Problem(chosen, thing.grid, thing.outline(thing.grid), seed=seed)


def wobbling_problem(views: int, error_m: float, wobble: float, seed: int) -> tuple[Problem, np.ndarray]:
    """Three points, 20 dB SNR, the axis distance wrong by `error_m`, angles as if the turn were even.

    Returns:
        The problem, and the four complex harmonics w of the angle error Re sum w_k exp(j k angle), rad. The
        error's mean over the turn is no wobble: it turns the image, and so it has turned the truth here.
    """
    rng = np.random.default_rng([FIRST_SEED + seed, 55])
    points = rng.uniform(-0.15, 0.15, (3, 2))
    acquisition = Acquisition(
        views=views,
        axis_distance_m=AXIS_DISTANCE_M,
        axis_distance_error_m=error_m,
        snr_db=20.0,
        snr_reference="summed",
        wobble=Wobble(speed=wobble),
    )
    capture, truth = record_scene(Scene.of_points(points), acquisition, seed=seed)
    angles = np.arange(views) * 2 * np.pi / views
    error = truth.angles_rad - angles
    mean = float(error.mean())
    turned = points @ np.array([[np.cos(mean), np.sin(mean)], [-np.sin(mean), np.cos(mean)]])
    waves = np.exp(-1j * np.outer(np.arange(1, 5), angles))
    even = replace(capture, angles_rad=angles)
    return Problem(even, GRID, truth_image(turned, GRID), turned, seed=seed), 2 / views * (waves @ error)


def field_problem(layout: str, seed: int) -> Problem:
    """A tag on its object in a room with clutter, 15 dB SNR, 360 views, the mean over angle subtracted."""
    scene = scene_from_name(layout)
    acquisition = Acquisition(views=360, axis_distance_m=AXIS_DISTANCE_M, snr_db=15.0, snr_reference="summed")
    capture, truth = record_scene(scene, acquisition, seed=FIRST_SEED + seed)
    grid = ImageGrid(0.4, 96)
    points = truth.positions_m[:, :2]
    drawn = truth_image(points, grid, np.abs(truth.amplitudes) / np.abs(truth.amplitudes).max())
    return Problem(capture, grid, drawn, points, seed=seed, background="mean")
