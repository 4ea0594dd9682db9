"""Time and memory of a volume by backprojection, from many turns at different heights.

Run `python tests/benchmarks/bench_volume.py --write`; `--heights 4` measures a part.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from imaging_report import heading

from tagid.geometry import Aperture, ImageGrid, VolumeGrid
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.volume import backproject_volume
from tagid.pipeline.join import join
from tests.unit.imaging_scenes import record

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results" / "volume.md"
POINTS = np.array([[0.1, 0.05, 0.08], [-0.08, 0.02, -0.11], [0.02, -0.12, 0.0]])
TEXT = """{head}
Three points, {heights} antenna heights from -0.25 to 0.25 m at 1 m, {views} views each, {bins} samples per
scan: {pairs:.3g} pairs of view and voxel into 128 x 128 x {levels} voxels of 0.4 m, on {cores} cores.
The time by the clock holds for the load of that moment; processor time over cores is that of an idle machine.

| | |
|---|---|
| preprocessing | {before:.1f} s |
| backprojection | {seconds:.1f} s, {used:.1f} s of processor time |
| pairs per second of processor time | {rate:.3g} |
| peak memory of the process | {memory:.2f} GB |
| largest error of the brightest voxels' places | {error:.1f} mm |
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--heights", type=int, default=100)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    angles = np.arange(360) * 2 * np.pi / 360
    heights = np.linspace(-0.25, 0.25, given.heights)
    one = join(
        [
            record(POINTS, [1, 1, 1], Aperture.turntable(angles, 1.0, float(h)), bins=320, start_m=0.2)
            for h in heights
        ]
    )
    begun = time.perf_counter()
    settings = PreprocessSettings("none", True, extent_m=0.4, heights_m=(-0.2, 0.2))
    scans = preprocess(one, settings=settings)
    before = time.perf_counter() - begun
    grid = VolumeGrid(ImageGrid(0.4, 128), -0.2, 0.2, 100)
    begun, busy = time.perf_counter(), time.process_time()
    made = backproject_volume(scans, grid)
    seconds, used = time.perf_counter() - begun, time.process_time() - busy
    error = 0.0
    for point in POINTS:
        axis = grid.square.axis
        near = [int(np.argmin(np.abs(axis - c))) for c in point[:2]]
        level = int(np.argmin(np.abs(grid.heights - point[2])))
        part = np.abs(
            made.values[level - 8 : level + 9, near[1] - 5 : near[1] + 6, near[0] - 5 : near[0] + 6]
        )
        z, y, x = np.unravel_index(int(part.argmax()), part.shape)
        place = [axis[near[0] - 5 + x], axis[near[1] - 5 + y], grid.heights[level - 8 + z]]
        error = max(error, float(np.linalg.norm(np.array(place) - point)))
    pairs = one.views * grid.voxels
    text = TEXT.format(
        head=heading("Volumes", "python tests/benchmarks/bench_volume.py --write", "none drawn"),
        heights=given.heights,
        views=360,
        bins=320,
        pairs=pairs,
        levels=100,
        cores=len(os.sched_getaffinity(0)),
        before=before,
        seconds=seconds,
        used=used,
        rate=pairs / used,
        memory=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        error=1e3 * error,
    )
    print(text)
    if given.write:
        RESULTS.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
