"""Experiments on what nobody tells the imaging: axis distance, wobble of the turn, and the pulse."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tagid.capture import Capture, Pulse
from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.errors import DataError
from tagid.geometry import ImageGrid
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.autofocus import focus_axis_distance
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.pulsefit import estimate_pulse
from tagid.imaging.restore import restore
from tagid.imaging.types import BasebandScans
from tagid.pipeline.reconstruct import METHODS, Reconstruction, make_image, reconstruct
from tagid.pipeline.settings import ImagingSettings
from tagid.report.axes import Axes
from tagid.report.canvas import Canvas
from tagid.report.colours import BLUE, INK, ORANGE
from tagid.simulate import Acquisition, Scene
from tagid.simulate import simulate_capture as record_scene
from tagid.waveform import nominal_pulse, pulse_at
from tests.benchmarks.imaging_scenes import AXIS_DISTANCE_M, FIRST_SEED, GRID, wobbling_problem
from tests.benchmarks.pictures import picture_grid
from tests.benchmarks.provenance import SHARED
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, interval
from train.distributions import PulseDistribution
from train.metrics import localise, pick_peaks, psnr, truth_image
from train.scenes import draw_pulse

MEASURED = SHARED / "data" / "p440" / "pulse.npz"


class Cell(NamedTuple):
    """A scene of three points with an assumed axis distance wrong by up to 3 cm and, optionally, wobble."""

    views: int
    wobble: float
    seed: int


class Recovered(NamedTuple):
    """What came out; mm, mrad and dB.

    Attributes:
        told: how wrong the axis distance was told.
        focused, fitted, sigma: what is left of it after the autofocus and after ATS, and its standard error.
        wobble, wobble_left: RMS of the angle error over the turn, as it was and what ATS left of it.
        z: (8,) error of every part of the four harmonics over its standard error; nan without wobble.
        psnr: BP as told, BP focused, ATS as told, ATS focused, ATS with calibration.
    """

    told: float
    focused: float
    fitted: float
    sigma: float
    wobble: float
    wobble_left: float
    z: np.ndarray
    psnr: tuple[float, ...]


def recover(cell: Cell) -> Recovered:
    """One scene through autofocus and joint calibration."""
    reported = float(np.random.default_rng([FIRST_SEED + cell.seed, 8]).uniform(-0.03, 0.03))
    problem, truth = wobbling_problem(cell.views, reported, cell.wobble, cell.seed)
    raw, matched = problem.scans(False), problem.scans(True)
    sharp, focus = focus_axis_distance(raw, problem.grid, 0.04)
    focused = matched.with_aperture(sharp.aperture)
    assert focus.axis_distance_m is not None
    what = ("axis", "wobble") if cell.wobble else ("axis",)
    plain = fit(raw, problem.grid, AtsSettings())
    ahead = fit(sharp, problem.grid, AtsSettings())
    joint = fit(raw, problem.grid, AtsSettings(calibrate=what))
    known = joint.calibration
    error = known.wobble - truth if cell.wobble else np.zeros(4, dtype=complex)
    parts = np.concatenate([error.real, error.imag]) / np.tile(known.wobble_sigma, 2)
    images = [backproject(matched, problem.grid).values, backproject(focused, problem.grid).values]
    images += [restore(r.image, raw.wavenumber).values for r in (plain, ahead, joint)]
    return Recovered(
        reported * 1e3,
        (focus.axis_distance_m - AXIS_DISTANCE_M) * 1e3,
        (joint.image.settings["axis_distance_m"] - AXIS_DISTANCE_M) * 1e3,
        known.sigma_m * 1e3,
        float(np.sqrt((np.abs(truth) ** 2).sum() / 2)) * 1e3,
        float(np.sqrt((np.abs(error) ** 2).sum() / 2)) * 1e3,
        parts,
        tuple(psnr(values, problem.truth) for values in images),
    )


def calibration(run: Run) -> Iterator[Table]:
    """Axis distance told wrong by up to 3 cm, a turn that wobbles by 2 %: what comes back, how surely."""
    seeds = run.number(10)
    run.seeds = f"0 to {seeds - 1}"
    lines, spots = [], []
    for wobble in (0.0, 0.02):
        for views in (36,) if run.quick else (36, 360):
            results = [*run.each(recover, [Cell(views, wobble, s) for s in range(seeds)]).values()]
            # The same errors in every case: a little apart, so that their bars are seen.
            apart = 0.7 * len(lines)
            spots += [(r.told + apart, r.focused, r.fitted, r.sigma) for r in results]
            lines.append(_line(views, wobble, results))
    figure = ""
    if run.pictures:
        _recovered_picture(spots, run.pictures / "imaging-calibration.png")
        figure = "![Error of the axis distance before and after](../pictures/imaging-calibration.png)"
    columns = (
        "wobble (% of speed)", "views", "seeds", "axis told wrong, rms (mm)", "after autofocus, rms (mm)",
        "after ATS, rms (mm)", "stated ± (mm)", "axis in 95 % bars", "rms z", "angle error, rms (mrad)",
        "after ATS (mrad)", "wobble in 95 % bars", "rms z", "BP as told (dB)", "BP focused (dB)",
        "ATS as told (dB)", "ATS focused (dB)", "ATS calibrated (dB)",
    )  # fmt: skip
    yield Table(columns, lines, below=figure)


def _line(views: int, wobble: float, recovered: list[Recovered]) -> list[str]:
    def rms(values: list[float] | np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    def held(z: np.ndarray) -> str:
        return f"{int((np.abs(z) < 1.96).sum())} of {z.size}"

    axis = np.array([r.fitted / r.sigma for r in recovered])
    parts = np.concatenate([r.z for r in recovered])
    middle = [f"{rms([r.wobble for r in recovered]):.1f}", f"{rms([r.wobble_left for r in recovered]):.1f}"]
    middle += [held(parts), f"{rms(parts):.2f}"]
    return [
        f"{100 * wobble:g}",
        str(views),
        str(len(recovered)),
        f"{rms([r.told for r in recovered]):.1f}",
        f"{rms([r.focused for r in recovered]):.2f}",
        f"{rms([r.fitted for r in recovered]):.2f}",
        f"{rms([r.sigma for r in recovered]):.2f}",
        held(axis),
        f"{rms(axis):.2f}",
        *(middle if wobble else ["0", "-", "-", "-"]),
        *(interval(np.array([r.psnr[i] for r in recovered]), 1) for i in range(5)),
    ]


def _recovered_picture(spots: list[tuple[float, ...]], path: Path) -> None:
    """Error of the axis distance that is left against the one that was told, with 95 % bars of ATS."""
    canvas = Canvas(820, 480)
    most = 1.1 * max(max(abs(f), abs(a) + 1.96 * s) for _, f, a, s in spots)
    axes = Axes(canvas, (100, 50, 590, 400), (-32.0, 32.0), (-most, most))
    axes.grid()
    axes.curve(np.array([-32.0, 32.0]), np.zeros(2), INK, 1.5)
    for reported, focused, fitted, sigma in spots:
        canvas.circle(axes.place(reported, focused), 4, BLUE)
        axes.curve(np.full(2, reported), fitted + 1.96 * sigma * np.array([-1, 1]), ORANGE, 2)
        canvas.circle(axes.place(reported, fitted), 4, ORANGE)
    for i, (name, colour) in enumerate((("autofocus", BLUE), ("ATS, 95 % bars", ORANGE))):
        canvas.circle((625, 70 + 28 * i), 4, colour)
        canvas.text((648, 70 + 28 * i), name, 17, anchor="lm")
    axes.frame("axis distance told wrong by (mm)", "left (mm)")
    canvas.save(path)


PULSE_ROWS = ("bp", "sparse", "ats")
PULSES = ("nominal", "true", "estimated")


class PulseCell(NamedTuple):
    """Three points recorded with a pulse of some kind, at so many views and dB of SNR a sample."""

    kind: str
    views: int
    snr_db: float
    seed: int


class PulseFound(NamedTuple):
    """What came of one recording.

    Attributes:
        taken: whether the estimate was taken.
        likeness: largest normalised correlation with the true pulse, of the nominal and of the one used.
        psnr: (methods, pulses) dB; where: the same of the localisation error, mm.
    """

    taken: bool
    likeness: tuple[float, float]
    psnr: np.ndarray
    where: np.ndarray


def pulse_of(kind: str, seed: int) -> Pulse | None:
    """The nominal pulse (None), one drawn from those the detector is trained on, or a measured one."""
    if kind == "nominal":
        return None
    if kind == "drawn":
        return draw_pulse(PulseDistribution(nominal=0.0), np.random.default_rng([FIRST_SEED + seed, 9]))
    with np.load(MEASURED, allow_pickle=False) as file:
        names = sorted(name for name in file if name != "dt_ns")
        return Pulse(file[names[seed % len(names)]], float(file["dt_ns"]) * 1e-9)


def try_pulses(cell: PulseCell) -> PulseFound:
    """One recording imaged with the nominal, the true and the estimated pulse."""
    points = np.random.default_rng([FIRST_SEED + cell.seed, 99]).uniform(-0.2, 0.2, (3, 2))
    pulse = pulse_of(cell.kind, cell.seed)
    acquisition = Acquisition(
        views=cell.views,
        axis_distance_m=AXIS_DISTANCE_M,
        snr_db=cell.snr_db,
        snr_reference="summed",
        pulse=pulse,
    )
    capture, _ = record_scene(Scene.of_points(points), acquisition, seed=cell.seed)
    estimate = estimate_pulse(capture, GRID, "none")
    truth = truth_image(points, GRID)
    quality, where = (np.full((len(PULSE_ROWS), len(PULSES)), np.nan) for _ in range(2))
    for i, method in enumerate(PULSE_ROWS):
        for j, used in enumerate((None, pulse, estimate.pulse if estimate.taken else None)):
            if j and used is None:  # the nominal pulse again
                quality[i, j], where[i, j] = quality[i, 0], where[i, 0]
                continue
            scans = _focused(replace(capture, pulse=used), METHODS[method].matched_filter)
            image = make_image(scans, GRID, method)
            if METHODS[method].sparse:
                image = restore(image, scans.wavenumber)
            quality[i, j] = psnr(image.values, truth)
            where[i, j] = localise(pick_peaks(image, len(points)), points).rmse_m * 1e3
    received = pulse or nominal_pulse()
    likeness = (_likeness(received, nominal_pulse()), _likeness(received, estimate.pulse))
    return PulseFound(estimate.taken, likeness, quality, where)


def _focused(capture: object, matched: bool, grid: ImageGrid = GRID) -> BasebandScans:
    settings = PreprocessSettings("none", matched, extent_m=grid.extent)
    return focus_axis_distance(preprocess(capture, settings=settings), grid, 0.03)[0]  # type: ignore[arg-type]


def _likeness(a: Pulse, b: Pulse) -> float:
    """Largest magnitude of the correlation of two analytic pulses, both of norm 1."""
    time = np.arange(-2000, 2001) * 4e-12
    x, y = (np.fft.fft(pulse_at(p, time), 8192) for p in (a, b))
    return float(np.abs(np.fft.ifft(x * y.conj())).max() * 8192 / np.linalg.norm(x) / np.linalg.norm(y))


def pulses(run: Run) -> Iterator[Table]:
    """Scenes recorded with other pulses than the nominal one, imaged with nominal, true, estimated pulse."""
    seeds = run.number(10)
    run.seeds = f"0 to {seeds - 1}"
    kinds = ["nominal", "drawn", *(["measured"] if MEASURED.is_file() else [])]
    cases = [(k, v, s) for k in kinds for v, s in ((36, 20.0), (36, 10.0), (12, 20.0))]
    lines = []
    for kind, views, snr_db in cases[:: len(cases) // len(kinds)] if run.quick else cases:
        cells = [PulseCell(kind, views, snr_db, seed) for seed in range(seeds)]
        results = [*run.each(try_pulses, cells).values()]
        taken = sum(r.taken for r in results)
        like = [interval(np.array([r.likeness[i] for r in results]), 3) for i in (0, 1)]
        change = np.array([r.psnr[:, 2] - r.psnr[:, 0] for r in results])
        for i, method in enumerate(PULSE_ROWS):
            quality = [interval(np.array([r.psnr[i, j] for r in results]), 1) for j in range(3)]
            where = [interval(np.array([r.where[i, j] for r in results]), 1) for j in range(3)]
            worst = f"{change[:, i].min():+.1f}"
            first = [kind, str(views), f"{snr_db:g}", f"{taken} of {len(results)}", *like]
            lines.append([*first, METHODS[method].title, *quality, worst, *where])
    columns = (
        "pulse", "views", "SNR (dB)", "taken", "likeness of nominal", "of estimate", "method",
        "PSNR nominal (dB)", "true", "estimated", "worst change (dB)", "localisation nominal (mm)", "true",
        "estimated",
    )  # fmt: skip
    yield Table(columns, lines, shown=lambda line: line[1:3] == ["36", "20"])


RAIL_ROWS = ("bp", "bp-raw", "range-doppler", "polar", "sparse", "omp", "ats")
RAIL_POINTS = np.array([[-0.6, 2.2], [0.5, 3.6]])
RAILS = ("straight", "off the middle, raised", "bent by 6 cm, heights vary")


class RailCell(NamedTuple):
    """A path of 600 positions past two reflectors, its ranges off by up to a metre, and a method."""

    path: str
    seed: int
    method: str


def rail_capture(cell: RailCell) -> tuple[Capture, float]:
    """960 real RF samples a scan at noise 0.1 of the stronger echo's peak, and the delay put in, m."""
    rng = np.random.default_rng([FIRST_SEED + cell.seed, RAILS.index(cell.path)])
    delay = float(rng.uniform(-0.95, 0.95))
    u = np.linspace(-1, 1, 600)
    x, y, z = 1.7 * u, np.zeros(600), np.zeros(600)
    if cell.path != "straight":
        x, z = x + 0.7, z + 0.4
    if cell.path.startswith("bent"):
        y, z = 0.06 * u**2, z + 0.08 * np.sin(3 * u)
    antenna = np.stack([x, y, z], axis=1)
    ranges = RANGE_STEP_M * np.arange(960)
    samples = 0.1 * rng.standard_normal((600, 960))
    for amplitude, point in zip((1.0, 0.7), RAIL_POINTS, strict=True):
        distance = np.linalg.norm(antenna - np.append(point, 0.0), axis=1) + delay
        samples += (
            amplitude * pulse_at(nominal_pulse(), 2 * (ranges - distance[:, None]) / SPEED_OF_LIGHT).real
        )
    return Capture(samples.astype(np.float32), 0.0, RANGE_STEP_M, antenna_positions_m=antenna), delay


def image_rail(cell: RailCell) -> Reconstruction:
    """One path as `tagid reconstruct` images it without being told where to look."""
    settings = ImagingSettings(method=cell.method, free_extent=True, free_pixels=True)
    return reconstruct(rail_capture(cell)[0], settings)


def score_rail(cell: RailCell) -> dict[str, float]:
    """Error of the path delay (mm), reflectors seen, localisation error (mm), seconds of processor time.

    All but the reflectors, none, are nan where the method refuses the path: polar format sees no side of an
    image that the antenna crosses.
    """
    delay = rail_capture(cell)[1]
    began = time.process_time()
    try:
        result = image_rail(cell)
    except DataError:
        return {"delay_mm": np.nan, "detected": 0.0, "where_mm": np.nan, "seconds": np.nan, "refused": 1.0}
    seconds = time.process_time() - began
    assert result.region is not None
    focus = result.region.focus
    error = 1e3 * (focus.delay_m - delay) if focus is not None else float("nan")
    image = result.image
    located = localise(pick_peaks(image, 2, separation_m=0.3) + image.centre_m, RAIL_POINTS, 0.15)
    return {
        "delay_mm": error,
        "detected": located.detected,
        "where_mm": located.rmse_m * 1e3,
        "seconds": seconds,
        "refused": 0.0,
    }


def rails(run: Run) -> Iterator[Table]:
    """Two reflectors 2 to 4 m from a path of 3.4 m, 600 positions, path delay unknown within 1 m."""
    seeds = run.number(10)
    run.seeds = f"0 to {seeds - 1}"
    paths = RAILS[:1] if run.quick else RAILS
    cells = [RailCell(p, seed, m) for p in paths for m in RAIL_ROWS for seed in range(seeds)]
    results = run.each(score_rail, cells)
    lines = []
    for path in paths:
        for method in RAIL_ROWS:
            some = [results[c] for c in cells if (c.path, c.method) == (path, method)]
            column = {name: np.array([s[name] for s in some], dtype=float) for name in some[0]}
            delay = np.sqrt(np.mean(column["delay_mm"] ** 2))
            refused = f"{column['refused'].sum():.0f}"
            seen = f"{100 * column['detected'].mean() / len(RAIL_POINTS):.0f}"
            values = [interval(column[name], 1) for name in ("where_mm", "seconds")]
            first = [path, str(len(some)), f"{delay:.1f}"]
            lines.append([*first, METHODS[method].title, refused, seen, *values])
    figure = ""
    if run.pictures:
        images = [[image_rail(RailCell(p, 0, m)).image for m in RAIL_ROWS] for p in paths]
        pictures = [[np.abs(image.values) for image in row] for row in images]
        titles = [METHODS[method].title for method in RAIL_ROWS]
        extents = [row[-1].grid.extent for row in images]
        picture_grid(pictures, extents, list(paths), titles, run.pictures / "imaging-rails.png")
        figure = "![Paths at metre scale in every method](../pictures/imaging-rails.png)"
    columns = (
        "path",
        "seeds",
        "delay, rms error (mm)",
        "method",
        "refused",
        "within 15 cm (%)",
        "localisation (mm)",
        "seconds",
    )
    yield Table(columns, lines, below=figure, shown=lambda line: line[0] == RAILS[0])
