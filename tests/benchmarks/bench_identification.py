"""How often the reader is right: simulated scenes of the four layouts, untagged and unenrolled objects.

Run `python tests/benchmarks/bench_identification.py --scenes 400 --jobs 2`; it prints what docs/results.md
shows.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import sys
import time
from collections import Counter
from datetime import UTC, datetime

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.simulate.acquisition import Acquisition, Placement, Wobble
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_layout, scene_from_name
from tagid.simulate.scene import Scene
from tagid.tags.layout import builtin_layouts
from tagid.tags.matcher import Reading, read_tag

VIEWS = (360, 36, 18)
SNRS_DB = (20, 10, 5, 0)
OUTCOMES = ("correct", "ambiguous", "unknown", "no_tag", "wrong")
UNENROLLED = ("two-far", "three-right-angle", "four-square", "mirror-like", "three-random", "four-random")
UNTAGGED = ("can", "box", "untagged", "empty")
LAYOUTS = list(builtin_layouts().values())


def unenrolled(kind: str, rng: np.random.Generator) -> np.ndarray:
    """(K, 2) reflectors, m, of a tag that nobody enrolled."""
    fixed = {
        "two-far": [[0.07, 0.0], [-0.07, 0.0]],
        "three-right-angle": [[0.08, 0.0], [0.0, 0.08], [-0.08, 0.0]],
        "four-square": [[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0], [0.0, -0.1]],
        "mirror-like": [[0.045, 0.0], [0.0, 0.045], [-0.09, -0.02]],
    }
    if kind in fixed:
        return np.array(fixed[kind])
    count = 3 if kind == "three-random" else 4
    while True:
        points = rng.uniform(-0.11, 0.11, (count, 2))
        gap = np.linalg.norm(points[:, None] - points[None], axis=2) + np.eye(count)
        if gap.min() > 0.04:
            return points


def read_scene(scene: Scene, views: int, snr_db: float, seed: int) -> tuple[Reading, Acquisition, float]:
    """One reading with everything random drawn from the seed, and the seconds it took after the recording."""
    rng = np.random.default_rng(10_000 + seed)
    radius, turn = 0.01 * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
    acquisition = Acquisition(
        views=views,
        snr_db=float(snr_db),
        placement=Placement((radius * np.cos(turn), radius * np.sin(turn)), rng.uniform(0, 2 * np.pi)),
        wobble=Wobble(speed=0.01),
        axis_distance_error_m=rng.uniform(-0.015, 0.015),
    )
    capture, _ = simulate_capture(scene, acquisition, seed)
    start = time.perf_counter()
    scans = preprocess(capture, None, PreprocessSettings(matched_filter=False, extent_m=0.3))
    return read_tag(scans, LAYOUTS), acquisition, time.perf_counter() - start


def one(task: tuple[str, int, int, int]) -> tuple[str, int, int, str, float, str]:
    """(group, views, snr, outcome, seconds, detail) of one scene."""
    name, views, snr_db, seed = task
    if name in UNENROLLED:
        positions = unenrolled(name, np.random.default_rng(seed))
        scene = scene_from_layout(positions, name, seed)
    else:
        scene = scene_from_name(name, seed)
    reading, _, seconds = read_scene(scene, views, snr_db, seed)
    outcome = reading.status
    if outcome == "identified":
        outcome = "correct" if reading.layout == name else "wrong"
    group = "unenrolled" if name in UNENROLLED else "untagged" if name in UNTAGGED else "tagged"
    e = reading.evidence
    detail = (
        f"{name} seed {seed} -> {reading.nearest} {reading.status} nats {e.nats:.0f} share {e.share:.2f} "
        f"weak {e.weakest:.2f} free {e.free_share:.2f}/{e.free_nats:.0f} "
        f"miss {e.missing} extra {e.extra} disp {e.displacement_m * 1e3:.1f} "
        f"margin {e.margin_share:.2f}/{e.margin_nats:.0f} {reading.reason}"
    )
    return group, views, snr_db, outcome, seconds, detail


def wilson(hits: int, total: int) -> tuple[float, float]:
    """95 % interval of a proportion (Wilson 1927)."""
    z = 1.959964
    p, w = hits / total, z * z / total
    middle, half = (p + w / 2) / (1 + w), z * np.sqrt(p * (1 - p) / total + w / (4 * total)) / (1 + w)
    return max(0.0, middle - half), min(1.0, middle + half)


def cell(hits: int, total: int) -> str:
    low, high = wilson(hits, total)
    return f"{100 * hits / total:.1f} % ({100 * low:.1f}..{100 * high:.1f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--scenes", type=int, default=400, help="tagged scenes a cell, a quarter of each layout"
    )
    parser.add_argument("--others", type=int, default=200, help="untagged and unenrolled scenes a cell, each")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--views", type=int, nargs="*", default=VIEWS)
    parser.add_argument("--snr", type=int, nargs="*", default=SNRS_DB)
    parser.add_argument("--detail", nargs="*", default=[], help="outcomes to list on stderr, e.g. wrong")
    arguments = parser.parse_args()
    names = [layout.name for layout in LAYOUTS]
    tasks = []
    for views in arguments.views:
        for snr_db in arguments.snr:
            tasks += [(names[i % 4], views, snr_db, i) for i in range(arguments.scenes)]
            for group in (UNENROLLED, UNTAGGED):
                tasks += [(group[i % len(group)], views, snr_db, i) for i in range(arguments.others)]
    with multiprocessing.get_context("fork").Pool(arguments.jobs) as pool:
        results = []
        for result in pool.imap(one, tasks, chunksize=8):
            results.append(result)
            if result[3] in arguments.detail:
                print(*result[:4], result[5], file=sys.stderr, flush=True)
    print(
        f"Machine: {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()},", end=" "
    )
    print(f"numpy {np.__version__}. Date: {datetime.now(UTC):%Y-%m-%d}.")
    print(f"Command: `python {' '.join(sys.argv)}`\n")
    for group in ("tagged", "unenrolled", "untagged"):
        rows = [r for r in results if r[0] == group]
        if not rows:
            continue
        columns = OUTCOMES if group == "tagged" else OUTCOMES[1:]
        print(
            f"{group.capitalize()} objects\n\n| views | SNR dB | scenes | {' | '.join(columns)} | seconds |"
        )
        print("|" + "---|" * (len(columns) + 4))
        for views in arguments.views:
            for snr_db in arguments.snr:
                some = [r for r in rows if r[1:3] == (views, snr_db)]
                count = Counter(r[3] for r in some)
                cells = " | ".join(cell(count[name], len(some)) for name in columns)
                seconds = np.median([r[4] for r in some])
                print(f"| {views} | {snr_db} | {len(some)} | {cells} | {seconds:.2f} |")
        print()


if __name__ == "__main__":
    main()
