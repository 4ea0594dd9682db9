"""PSNR, MSE and localisation of every imaging method on point scenes, and the seconds each takes.

Run `python tests/benchmarks/bench_reconstruction.py --jobs 2` for a table of images without restoring beam,
`--quick` for a short look, and `--seconds` for the processor times of backprojection, FISTA and ATS on the
same data in one run, and of the estimate of the pulse.

Scenes: 1 to 4 points of unit amplitude, uniform within +-0.22 m, radar at 1 m; 0.7 m and 96 x 96 pixels. The
analytic sinogram is divided by its peak, then complex noise is added: "noise" is its standard deviation per
complex sample. The settings of ATS were tuned on other scenes (generator seeds 5, 1000, 1001) than those of
the table (seeds 20000 and up). BP gets matched-filtered scans, the others not, as in the tool itself.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # train/ is not installed

from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.geometry import Aperture, ImageGrid
from tagid.imaging.ats.fit import fit
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.sparse import omp, sparse_recovery
from tagid.imaging.types import BasebandScans, Image
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tagid.waveform import nominal_pulse, pulse_at
from train.metrics import blank, localise, lpips, mse, pick_peaks, psnr, truth_image

GRID = ImageGrid(0.7, 96)
AXIS_DISTANCE_M = 1.0
POINTS = (1, 2, 3, 4)
NOISES = (0.0, 0.1, 0.316)
VIEWS = (360, 36, 18, 12)
MOST_PEAKS = 8
FIRST_SEED = 20_000

Method = Callable[[BasebandScans, BasebandScans], Image]
METHODS: dict[str, Method] = {
    "blank": lambda raw, matched: blank(GRID),
    "BP": lambda raw, matched: backproject(matched, GRID),
    "FISTA": lambda raw, matched: sparse_recovery(raw, GRID),
    "OMP": lambda raw, matched: omp(raw, GRID, MOST_PEAKS, stop=4.5),
    "ATS": lambda raw, matched: fit(raw, GRID).image,
}


def simulate(points: np.ndarray, views: int, noise: float, rng: np.random.Generator) -> Capture:
    """Analytic range profiles (views, bins) complex64 of unit points (n, 2), peak-normalised, with noise."""
    angles = np.arange(views) * 2 * np.pi / views
    antenna = Aperture.turntable(angles, AXIS_DISTANCE_M).positions
    reach = GRID.extent / np.sqrt(2) + 0.25
    ranges = np.arange(AXIS_DISTANCE_M - reach, AXIS_DISTANCE_M + reach, RANGE_STEP_M)
    there = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    distance = np.linalg.norm(antenna[:, None] - there[None], axis=2)
    echo = np.zeros((views, len(ranges)), dtype=np.complex128)
    for one in distance.T:
        echo += pulse_at(nominal_pulse(), 2 * (ranges[None] - one[:, None]) / SPEED_OF_LIGHT)
    echo /= np.abs(echo).max()
    drawn = rng.standard_normal((2, *echo.shape))
    echo += noise / np.sqrt(2) * (drawn[0] + 1j * drawn[1])
    return Capture(
        echo.astype(np.complex64), float(ranges[0]), RANGE_STEP_M, angles, axis_distance_m=AXIS_DISTANCE_M
    )


@dataclass(frozen=True)
class Scene:
    """Random points, how they are recorded, and the model of LPIPS, if any."""

    count: int
    views: int
    noise: float
    seed: int
    lpips: Path | None = None


class Scores(NamedTuple):
    """Scores of one image, in the order of the table's columns."""

    psnr_db: float
    mse: float
    rmse_m: float
    detected: float
    false: float
    lpips: float


@dataclass(frozen=True, eq=False)
class Prepared:
    """True points (count, 2), m, and scans without and with matched filter."""

    points: np.ndarray
    raw: BasebandScans
    matched: BasebandScans


def prepared(scene: Scene) -> Prepared:
    """A scene's scans; there is no clutter, so no background is removed."""
    rng = np.random.default_rng([FIRST_SEED + scene.seed, scene.count])
    points = rng.uniform(-0.22, 0.22, (scene.count, 2))
    capture = simulate(points, scene.views, scene.noise, rng)
    raw = preprocess(capture, settings=PreprocessSettings("none", False, extent_m=GRID.extent))
    matched = preprocess(capture, settings=PreprocessSettings("none", True, extent_m=GRID.extent))
    return Prepared(points, raw, matched)


def score_scene(scene: Scene) -> dict[str, Scores]:
    """The scores of every method."""
    made = prepared(scene)
    truth = truth_image(made.points, GRID)
    scores = {}
    for name, method in METHODS.items():
        image = method(made.raw, made.matched)
        found = localise(pick_peaks(image, MOST_PEAKS), made.points)
        scores[name] = Scores(
            psnr_db=psnr(image.values, truth),
            mse=mse(image.values, truth),
            rmse_m=found.rmse_m,
            detected=found.detected / scene.count,
            false=float(found.false),
            lpips=lpips(image.values, truth, scene.lpips) if scene.lpips else float("nan"),
        )
    return scores


def interval(values: np.ndarray, scale: float, digits: int) -> str:
    """Mean and half-width of the 95 % interval (1.96 standard errors), "-" where nothing is known."""
    known = values[np.isfinite(values)] * scale
    if len(known) == 0:
        return "-"
    half = 1.96 * known.std(ddof=1) / np.sqrt(len(known)) if len(known) > 1 else 0.0
    return f"{known.mean():.{digits}f} ± {half:.{digits}f}"


def print_scores(seeds: int, jobs: int, model: Path | None) -> None:
    """The markdown table: every noise and number of views, over 1 to 4 points and all seeds."""
    print(f"Mean and 95 % interval over {len(POINTS)} x {seeds} scenes of 1 to 4 points.\n")
    columns = ("noise", "views", "method", "PSNR (dB)", "MSE x 1000", "localisation (mm)", "detected (%)")
    print("| " + " | ".join((*columns, "false", "LPIPS")) + " |")
    print("|" + "---|" * (len(columns) + 2))
    context = multiprocessing.get_context("spawn")
    with context.Pool(jobs) as pool:
        for noise in NOISES:
            for views in VIEWS:
                scenes = [Scene(n, views, noise, seed, model) for n in POINTS for seed in range(seeds)]
                results = pool.map(score_scene, scenes, chunksize=1)
                for name in METHODS:
                    table = np.array([result[name] for result in results])
                    scales = ((1, 1), (1e3, 2), (1e3, 1), (100, 0), (1, 2), (1, 3))
                    cells = [interval(column, *how) for column, how in zip(table.T, scales, strict=True)]
                    print(f"| {noise} | {views} | {name} | {' | '.join(cells)} |", flush=True)


def print_seconds(repeats: int) -> None:
    """Processor seconds of BP, FISTA and ATS on the same scans in turn, preprocessing not counted."""
    print("Processor time; ratio: median over the scenes of ATS and FISTA measured one after the other.\n")
    print("| views | BP (s) | FISTA (s) | ATS (s) | ATS / FISTA |")
    print("|---|---|---|---|---|")
    for views in VIEWS:
        took: dict[str, list[float]] = {name: [] for name in ("BP", "FISTA", "ATS")}
        for seed in range(repeats):
            made = prepared(Scene(1 + seed % 4, views, 0.316, seed))
            for name in took:
                METHODS[name](made.raw, made.matched)
                start = time.process_time()
                METHODS[name](made.raw, made.matched)
                took[name].append(time.process_time() - start)
        ratio = np.median(np.array(took["ATS"]) / np.array(took["FISTA"]))
        cells = [f"{np.median(took[name]):.3f}" for name in took]
        print(f"| {views} | {' | '.join(cells)} | {ratio:.1f} |", flush=True)


def print_pulse_seconds() -> None:
    """Processor seconds of `--pulse estimate` beside those of the image without it."""
    from imaging_unknowns import RAILS, RailCell, rail_capture, recorded_points

    print("\nProcessor time of the image at defaults, and what the estimate of the pulse adds.\n")
    print("| recording | method | image (s) | estimate (s) | estimate / image |")
    print("|---|---|---|---|---|")
    captures = {f"path: {RAILS[0]}": rail_capture(RailCell(RAILS[0], 0))[0]}
    captures["turntable, 36 views"] = recorded_points(36, 0)
    for name, capture in captures.items():
        for method in ("sparse", "ats"):
            seconds = []
            for pulse in ("nominal", "estimate"):
                settings = ImagingSettings(
                    method=method, free_extent=True, free_pixels=True, pulse=pulse, background="none"
                )
                start = time.process_time()
                reconstruct(capture, settings)
                seconds.append(time.process_time() - start)
            added = seconds[1] - seconds[0]
            row = (name, method, f"{seconds[0]:.2f}", f"{added:.2f}", f"{added / seconds[0]:.2f}")
            print(f"| {' | '.join(row)} |", flush=True)


def main() -> None:
    """Parse the command line and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="2 seeds instead of --seeds")
    parser.add_argument("--seeds", type=int, default=5, help="scenes of each number of points")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--lpips", type=Path, help="ONNX model of LPIPS; without it the column stays empty")
    parser.add_argument("--seconds", action="store_true", help="print the times instead")
    options = parser.parse_args()
    command = "python tests/benchmarks/bench_reconstruction.py " + " ".join(sys.argv[1:])
    cores = f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    print(f"`{command.strip()}`, {datetime.now(UTC):%Y-%m-%d}, {platform.machine()}, {cores}, ", end="")
    print(f"Python {platform.python_version()}, numpy {np.__version__}\n")
    if options.seconds:
        print_seconds(12)
        print_pulse_seconds()
    else:
        print_scores(2 if options.quick else options.seeds, options.jobs, options.lpips)


if __name__ == "__main__":
    main()
