"""Volumes by all methods: how well they predict held-out views, and the time and memory of the 3-D fit.

Run `python tests/benchmarks/bench_volume_fit.py --write`; `--heights 100 --levels 100` times the full size.
Scenes are appended to `--keep FILE` and not repeated, so that a run can be stopped and continued.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from imaging_report import heading, interval, table

from tagid.geometry import Aperture, ImageGrid, VolumeGrid
from tagid.imaging.ats.volume import fit_volume
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.pipeline.join import join
from tagid.pipeline.volume import METHODS, VolumeSettings, reconstruct_volume
from tests.unit.imaging_scenes import record, turn

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results" / "volume-ats.md"
SETS = {"3 heights, 0 to 0.3 m": (0.0, 0.15, 0.3), "5 heights, -0.2 to 0.2 m": (-0.2, -0.1, 0.0, 0.1, 0.2)}
VIEWS, LEVEL_DB = 36, 20
POINTS = np.array([[0.1, 0.05, 0.08], [-0.08, 0.02, -0.11], [0.02, -0.12, 0.0]])
TEXT = """{head}
## Held-out residual

Share of the energy of held-out views that a volume leaves unexplained, in percent (1 in 12 views held out,
one complex factor fitted). {views} views per height at 1 m, {level} dB summed echo to noise of one sample,
volumes of 0.24 x 0.24 x 0.24 m in 32 x 32 x 16 voxels; mean and 95 % interval over {seeds} seeds. Noise is
the least that any volume can reach. Points: five at random places. Shell: 80 points on a cylinder of 60 mm
radius. Rod: 30 points on a tilted line. Rows: a tag of four reflectors in two rows.

{residuals}
ATS is below backprojection in {better} of {count} scenes, and below sparse recovery in {sparse} of {count}.

## Time and memory

Three points, {heights} antenna heights, 360 views each, 320 samples per scan, into 128 x 128 x {levels}
voxels on {cores} cores, without the held-out residual, which takes as much again.

| | |
|---|---|
| fit with its backprojection | {seconds:.0f} s, {used:.0f} s of processor time |
| of this the backprojection | {first:.0f} s of processor time |
| voxels that were fitted | {active:,} of {voxels:,} |
| peak memory of the process | {memory:.2f} GB |
| largest error of the brightest voxels' places | {error:.1f} mm |
| processor time at 100 heights and 100 levels | {whole} |
"""


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


def residuals(kind: str, heights: tuple[float, ...], seed: int) -> dict[str, float]:
    """Held-out residual of every method, %, and the noise in it."""
    points, amplitudes = scene(kind, seed)
    clean = record(points, amplitudes, turn(VIEWS, 1.0, heights[0]), start_m=0.5)
    noise = float(np.abs(clean.samples).max()) * 10 ** (-LEVEL_DB / 20)
    parts = [
        record(points, amplitudes, turn(VIEWS, 1.0, h), start_m=0.5, noise=noise, seed=100 * seed + k)
        for k, h in enumerate(heights)
    ]
    one, found = join(parts), {}
    for method in METHODS:
        made = reconstruct_volume(one, VolumeSettings(method, 0.24, 32, (-0.12, 0.12), 16))
        held_out = made.volume.settings["held_out"]
        found[method] = 100 * held_out["residual"]
        found["noise"] = 100 * (held_out["noise"] or float("nan"))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--heights", type=int, default=10)
    parser.add_argument("--levels", type=int, default=20)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    known: dict[str, dict[str, float]] = {}
    if given.keep and given.keep.exists():
        known = dict(json.loads(line) for line in given.keep.read_text().splitlines())

    def found_in(name: str, kind: str, seed: int) -> dict[str, float]:
        key = f"{name} {kind} {seed}"
        if key not in known:
            known[key] = residuals(kind, SETS[name], seed)
            if given.keep:
                with given.keep.open("a") as file:
                    file.write(json.dumps([key, known[key]]) + "\n")
        return known[key]

    rows, better, sparser, count = [], 0, 0, 0
    for name in SETS:
        for kind in ("points", "shell", "rod", "rows"):
            found = [found_in(name, kind, seed) for seed in range(given.seeds)]
            better += sum(one["ats"] < one["bp"] for one in found)
            sparser += sum(one["ats"] < one["sparse"] for one in found)
            count += len(found)
            columns = [np.array([one[key] for one in found]) for key in (*METHODS, "noise")]
            rows.append([name, kind, *(interval(each, 1) for each in columns)])
            print(rows[-1], flush=True)
    made, facts = timed(given.heights, given.levels)
    text = TEXT.format(
        head=heading(
            "Volumes by analysis through synthesis",
            f"python tests/benchmarks/bench_volume_fit.py --seeds {given.seeds} --heights {given.heights} "
            f"--levels {given.levels} --write",
            f"0 to {given.seeds - 1}",
        ),
        views=VIEWS,
        level=LEVEL_DB,
        seeds=given.seeds,
        residuals=table(["antennas", "scene", "bp", "sparse", "ATS", "noise"], rows),
        better=better,
        sparse=sparser,
        count=count,
        **made,
        **facts,
    )
    print(text)
    if given.write:
        RESULTS.write_text(text, encoding="utf-8")


def timed(count: int, levels: int) -> tuple[dict[str, object], dict[str, float]]:
    """Time, memory and error of one fit."""
    angles = np.arange(360) * 2 * np.pi / 360
    one = join(
        [
            record(POINTS, [1, 1, 1], Aperture.turntable(angles, 1.0, float(h)), bins=320, start_m=0.2)
            for h in np.linspace(-0.25, 0.25, count)
        ]
    )
    plain = PreprocessSettings("none", False, extent_m=0.4, heights_m=(-0.2, 0.2))
    scans = preprocess(one, settings=plain)
    matched = preprocess(one, settings=PreprocessSettings("none", True, extent_m=0.4, heights_m=(-0.2, 0.2)))
    grid = VolumeGrid(ImageGrid(0.4, 128), -0.2, 0.2, levels)
    marks: list[float] = []
    begun, busy = time.perf_counter(), time.process_time()

    def progress(done: float, total: float, remark: str) -> None:
        if done <= 0.35:
            marks[:] = [time.process_time() - busy]

    made = fit_volume(matched, scans, grid, progress=progress)
    seconds, used = time.perf_counter() - begun, time.process_time() - busy
    places, values = grid.points(), np.abs(made.values).ravel()
    errors = []
    for point in POINTS:
        near = np.flatnonzero(np.linalg.norm(places - point, axis=1) < 0.03)
        errors.append(1e3 * float(np.linalg.norm(places[near[np.argmax(values[near])]] - point)))
    # The backprojection grows with views and voxels; the fit sees as many views and at most as many voxels.
    larger = 100 * 100 / (count * levels)
    most = made.settings["most_active"] / max(int(made.settings["active_voxels"]), 1)
    whole = marks[0] * larger + (used - marks[0]) * max(most, 1.0)
    said = "measured" if larger == 1 else f"at most {whole:.0f} s, extrapolated"
    counts = {
        "heights": count,
        "levels": levels,
        "cores": len(os.sched_getaffinity(0)),
        "voxels": grid.voxels,
    }
    facts = {
        "seconds": seconds,
        "used": used,
        "first": marks[0],
        "active": made.settings["active_voxels"],
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "error": max(errors),
    }
    return {**counts, "whole": said}, facts


if __name__ == "__main__":
    main()
