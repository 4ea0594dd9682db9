"""Experiments on what nobody tells the imaging: axis distance, wobble of the turn, and the pulse."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tagid.capture import Capture, Pulse
from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.errors import DataError
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.autofocus import focus_axis_distance
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.pulsefit import estimate_pulse
from tagid.imaging.restore import restore
from tagid.pipeline.reconstruct import METHODS, Reconstruction, make_image, reconstruct
from tagid.pipeline.settings import ImagingSettings
from tagid.report.axes import Axes
from tagid.report.canvas import Canvas
from tagid.report.colours import BLUE, INK, ORANGE
from tagid.simulate import Acquisition, Scene
from tagid.simulate import simulate_capture as record_scene
from tagid.waveform import nominal_pulse, pulse_at
from tests.benchmarks.imaging_scenes import AXIS_DISTANCE_M, FIRST_SEED, GRID, wobbling_problem
from tests.benchmarks.measure import timed
from tests.benchmarks.pictures import picture_grid
from tests.benchmarks.provenance import SHARED
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table, column, grouped, interval, rms
from train.distributions import PulseDistribution
from train.metrics import localise, pick_peaks, psnr, truth_image
from train.scenes import draw_pulse

MEASURED = SHARED / "data" / "p440" / "pulse.npz"


class Cell(NamedTuple):
    """A scene of three points with an assumed axis distance wrong by up to 3 cm and, optionally, wobble."""

    views: int
    wobble: float
    seed: int


Recovered = dict[str, Any]
"""What came out, mm, mrad and dB: how wrong the axis distance was stated ("told"), what remains of it after
the autofocus ("focused") and after ATS ("fitted"), and its standard error ("sigma"); RMS of the angle error
over the turn ("wobble") and what ATS leaves of it ("wobble_left"); "z": (8,) error of every part of the four
harmonics over its standard error; "psnr": BP as told and focused, ATS as told, focused and calibrated."""


def recover(cell: Cell) -> Recovered:
    """One scene through autofocus and joint calibration."""
    reported = float(np.random.default_rng([FIRST_SEED + cell.seed, 8]).uniform(-0.03, 0.03))
    problem, truth = wobbling_problem(cell.views, reported, cell.wobble, cell.seed)
    raw, matched = problem.scans(False), problem.scans(True)
    sharp, focus = focus_axis_distance(raw, problem.grid, 0.04)
    focused = matched.with_aperture(sharp.aperture)
    what = ("axis", "wobble") if cell.wobble else ("axis",)
    plain = fit(raw, problem.grid, AtsSettings())
    ahead = fit(sharp, problem.grid, AtsSettings())
    joint = fit(raw, problem.grid, AtsSettings(calibrate=what))
    known = joint.calibration
    error = known.wobble - truth if cell.wobble else np.zeros(4, dtype=complex)
    parts = np.concatenate([error.real, error.imag]) / np.tile(known.wobble_sigma, 2)
    images = [backproject(matched, problem.grid).values, backproject(focused, problem.grid).values]
    images += [restore(r.image, raw.wavenumber).values for r in (plain, ahead, joint)]
    return {
        "told": reported * 1e3,
        "focused": (focus.axis_distance_m - AXIS_DISTANCE_M) * 1e3,
        "fitted": (joint.image.settings["axis_distance_m"] - AXIS_DISTANCE_M) * 1e3,
        "sigma": known.sigma_m * 1e3,
        "wobble": float(np.sqrt((np.abs(truth) ** 2).sum() / 2)) * 1e3,
        "wobble_left": float(np.sqrt((np.abs(error) ** 2).sum() / 2)) * 1e3,
        "z": parts.tolist(),
        "psnr": [psnr(values, problem.truth) for values in images],
    }


def calibration(run: Run) -> Iterator[Table]:
    """Axis distance told wrong by up to 3 cm, a turn that wobbles by 2 %: what comes back, how surely."""
    seeds = run.drawn(10)
    lines, spots = [], []
    for wobble, views in product((0.0, 0.02), (36,) if run.quick else (36, 360)):
        results = [*run.each(recover, [Cell(views, wobble, s) for s in seeds]).values()]
        # The same errors in every case: a little apart, so that their bars are seen.
        apart = 0.7 * len(lines)
        spots += [(r["told"] + apart, r["focused"], r["fitted"], r["sigma"]) for r in results]
        lines.append(_line(views, wobble, results))
    figure = ""
    if run.pictures:
        _recovered_picture(spots, run.pictures / "imaging-calibration.png")
        figure = "![Error of the axis distance before and after](../pictures/imaging-calibration.png)"
    columns = (
        "wobble (% of speed) | views | seeds | axis told wrong, rms (mm) | after autofocus, rms (mm) | "
        "after ATS, rms (mm) | stated ± (mm) | axis in 95 % bars | rms z | angle error, rms (mrad) | "
        "after ATS (mrad) | wobble in 95 % bars | rms z | BP as told (dB) | BP focused (dB) | "
        "ATS as told (dB) | ATS focused (dB) | ATS calibrated (dB)"
    )
    yield Table(columns, lines, below=figure)


def _line(views: int, wobble: float, recovered: list[Recovered]) -> list[str]:
    def held(z: np.ndarray) -> list[str]:
        return [f"{int((np.abs(z) < 1.96).sum())} of {z.size}", f"{rms(z):.2f}"]

    def size(name: str, digits: int) -> str:
        return f"{rms(column(recovered, name)):.{digits}f}"

    middle = ["0", "-", "-", "-"]
    if wobble:
        middle = [size("wobble", 1), size("wobble_left", 1), *held(column(recovered, "z").ravel())]
    return [
        f"{100 * wobble:g}",
        str(views),
        str(len(recovered)),
        *(size(name, digits) for name, digits in (("told", 1), ("focused", 2), ("fitted", 2), ("sigma", 2))),
        *held(column(recovered, "fitted") / column(recovered, "sigma")),
        *middle,
        *(interval(values, 1) for values in column(recovered, "psnr").T),
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


class PulseCell(NamedTuple):
    """Three points recorded with a pulse of some kind, at so many views and dB of SNR a sample."""

    kind: str
    views: int
    snr_db: float
    seed: int


def pulse_of(kind: str, seed: int) -> Pulse | None:
    """The nominal pulse (None), one drawn from those the detector is trained on, or a measured one."""
    if kind == "nominal":
        return None
    if kind == "drawn":
        return draw_pulse(PulseDistribution(nominal=0.0), np.random.default_rng([FIRST_SEED + seed, 9]))
    with np.load(MEASURED, allow_pickle=False) as file:
        names = sorted(name for name in file if name != "dt_ns")
        return Pulse(file[names[seed % len(names)]], float(file["dt_ns"]) * 1e-9)


def try_pulses(cell: PulseCell) -> dict[str, Any]:
    """One recording imaged with the nominal, the true and the estimated pulse.

    "likeness" is the largest normalised correlation with the true pulse, of the nominal and of the one used;
    "psnr", dB, and "where", localisation error in mm, are of (methods, pulses).
    """
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
    quality, where = (np.full((len(PULSE_ROWS), 3), np.nan) for _ in range(2))
    for i, method in enumerate(PULSE_ROWS):
        for j, used in enumerate((None, pulse, estimate.pulse if estimate.taken else None)):
            if j and used is None:  # the nominal pulse again
                quality[i, j], where[i, j] = quality[i, 0], where[i, 0]
                continue
            settings = PreprocessSettings("none", METHODS[method].matched_filter, extent_m=GRID.extent)
            scans = preprocess(replace(capture, pulse=used), settings=settings)
            scans = focus_axis_distance(scans, GRID, 0.03)[0]
            image = make_image(scans, GRID, method)
            if METHODS[method].sparse:
                image = restore(image, scans.wavenumber)
            quality[i, j] = psnr(image.values, truth)
            where[i, j] = localise(pick_peaks(image, len(points)), points).rmse_m * 1e3
    received = pulse or nominal_pulse()
    likeness = [_likeness(received, other) for other in (nominal_pulse(), estimate.pulse)]
    return {"taken": estimate.taken, "likeness": likeness, "psnr": quality.tolist(), "where": where.tolist()}


def _likeness(a: Pulse, b: Pulse) -> float:
    """Largest magnitude of the correlation of two analytic pulses, both of norm 1."""
    time = np.arange(-2000, 2001) * 4e-12
    x, y = (np.fft.fft(pulse_at(p, time), 8192) for p in (a, b))
    return float(np.abs(np.fft.ifft(x * y.conj())).max() * 8192 / np.linalg.norm(x) / np.linalg.norm(y))


def pulses(run: Run) -> Iterator[Table]:
    """Scenes recorded with other pulses than the nominal one, imaged with nominal, true, estimated pulse."""
    seeds = run.drawn(10)
    cases = [
        (k, v, s) for k in ("nominal", "drawn", "measured") for v, s in ((36, 20.0), (36, 10.0), (12, 20.0))
    ]
    lines = []
    for kind, views, snr_db in cases[::3] if run.quick else cases:
        results = [*run.each(try_pulses, [PulseCell(kind, views, snr_db, s) for s in seeds]).values()]
        like = [interval(values, 3) for values in column(results, "likeness").T]
        quality, where = column(results, "psnr"), column(results, "where")
        taken = f"{column(results, 'taken').sum():.0f} of {len(results)}"
        for i, method in enumerate(PULSE_ROWS):
            worst = f"{(quality[:, i, 2] - quality[:, i, 0]).min():+.1f}"
            first = [kind, str(views), f"{snr_db:g}", taken, *like, METHODS[method].title]
            seen, places = ([interval(values[:, i, j], 1) for j in range(3)] for values in (quality, where))
            lines.append([*first, *seen, worst, *places])
    columns = (
        "pulse | views | SNR (dB) | taken | likeness of nominal | of estimate | method | "
        "PSNR nominal (dB) | true | estimated | worst change (dB) | localisation nominal (mm) | true | "
        "estimated"
    )
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
        delays = 2 * (ranges - distance[:, None]) / SPEED_OF_LIGHT
        samples += amplitude * pulse_at(nominal_pulse(), delays).real
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
    try:
        result, _, seconds = timed(lambda: image_rail(cell))
    except DataError:
        return {"delay_mm": np.nan, "detected": 0.0, "where_mm": np.nan, "seconds": np.nan, "refused": 1.0}
    focus, image = result.region.focus, result.image
    located = localise(pick_peaks(image, 2, separation_m=0.3) + image.centre_m, RAIL_POINTS, 0.15)
    return {
        "delay_mm": 1e3 * (focus.delay_m - delay) if focus is not None else float("nan"),
        "detected": located.detected,
        "where_mm": located.rmse_m * 1e3,
        "seconds": seconds,
        "refused": 0.0,
    }


def rails(run: Run) -> Iterator[Table]:
    """Two reflectors 2 to 4 m from a path of 3.4 m, 600 positions, path delay unknown within 1 m."""
    seeds = run.drawn(10)
    paths = RAILS[:1] if run.quick else RAILS
    results = run.each(score_rail, [RailCell(p, s, m) for p in paths for m in RAIL_ROWS for s in seeds])
    lines = []
    for (path, method), some in grouped(results, lambda c: (c.path, c.method)).items():
        seen = f"{100 * column(some, 'detected').mean() / len(RAIL_POINTS):.0f}"
        refused = f"{column(some, 'refused').sum():.0f}"
        values = [interval(column(some, name), 1) for name in ("where_mm", "seconds")]
        first = [path, str(len(some)), f"{rms(column(some, 'delay_mm')):.1f}", METHODS[method].title]
        lines.append([*first, refused, seen, *values])
    figure = ""
    if run.pictures:
        images = [[image_rail(RailCell(p, 0, m)).image for m in RAIL_ROWS] for p in paths]
        pictures = [[np.abs(image.values) for image in row] for row in images]
        titles = [METHODS[method].title for method in RAIL_ROWS]
        extents = [row[-1].grid.extent for row in images]
        picture_grid(pictures, extents, list(paths), titles, run.pictures / "imaging-rails.png")
        figure = "![Paths at metre scale in every method](../pictures/imaging-rails.png)"
    columns = (
        "path | seeds | delay, rms error (mm) | method | refused | within 15 cm (%) | "
        "localisation (mm) | seconds"
    )
    yield Table(columns, lines, below=figure, shown=lambda line: line[0] == RAILS[0])
