"""Memory and rate of `tagid report` over thousands of captures: neither may depend on how many went before.

Every file is a recording of its own (one of 40 simulated scenes with fresh noise), read, identified and drawn
as the command does it, in processes with one thread each. After each part of the run the script prints the
rate (by the clock, and items per second of processor time, which other load on the machine disturbs less) and
the memory of the parent and of its workers together.

Run: python tests/benchmarks/bench_report.py --items 10000
Short: python tests/benchmarks/bench_report.py --items 400
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from tagid.batch.inputs import collect
from tagid.batch.job import Job
from tagid.batch.local import Results, Tasks, cores, run_local
from tagid.batch.run import BatchPlan, run_batch
from tagid.config import load_config
from tagid.enrolling.registry import RegistryContents
from tagid.operate.turn import ReadingSetup
from tagid.pipeline.prepared import LoadSettings
from tagid.pipeline.settings import ImagingSettings
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.tags.layouts.layout import builtin_layouts

OBJECTS = ("helmet-120", "container-90", "helmet-linear", "container-180")
PARTS = 10


def write_captures(folder: Path, count: int, views: int) -> None:
    """`count` NPZ files of different content, in folders of a thousand."""
    scenes = []
    for seed in range(40):
        scene = scene_from_name(OBJECTS[seed % 4], seed)
        scenes.append(simulate_capture(scene, Acquisition(views=views, snr_db=20.0), seed)[0])
    rng = np.random.default_rng(0)
    for number in range(count):
        capture = scenes[number % len(scenes)]
        samples = np.asarray(capture.samples, dtype=np.float32)
        noise = 0.05 * samples.std() * rng.standard_normal(samples.shape, dtype=np.float32)
        place = folder / f"{number // 1000:03d}"
        place.mkdir(exist_ok=True)
        np.savez(
            place / f"{number:06d}.npz",
            samples=samples + noise,
            range_start_m=capture.range_start_m,
            range_step_m=capture.range_step_m,
            angles_rad=capture.angles_rad,
            axis_distance_m=capture.axis_distance_m,
        )


def memory_mb(process: int | str = "self") -> float:
    """Resident memory of a process, MB."""
    text = Path(f"/proc/{process}/status").read_text()
    return next(int(line.split()[1]) for line in text.splitlines() if line.startswith("VmRSS")) / 1024


def children() -> Iterator[int]:
    """Numbers of this process' own children."""
    for task in Path("/proc/self/task").iterdir():
        yield from (int(word) for word in (task / "children").read_text().split())


class Meter:
    """Stands between the batch and its workers and measures each part of the run."""

    def __init__(self, items: int, jobs: int) -> None:
        self.items, self.jobs = items, jobs
        self.rates: list[tuple[float, float]] = []
        self.memories: list[tuple[float, float]] = []

    def __call__(self, tasks: Tasks, job: Job) -> Results:
        done, cpu, clock = 0, 0.0, time.perf_counter()
        for result in run_local(tasks, job, self.jobs):
            yield result
            if result is None:
                continue
            done += 1
            cpu += result.outcome.cpu_s
            if done % (self.items // PARTS) == 0:
                part = self.items // PARTS
                self.rates.append((part / (time.perf_counter() - clock), part / cpu))
                self.memories.append((memory_mb(), sum(memory_mb(child) for child in children())))
                rate, memory = self.rates[-1], self.memories[-1]
                print(
                    f"| {done} | {rate[0]:.2f} | {rate[1]:.2f} | {memory[0]:.0f} | {memory[1]:.0f} |",
                    flush=True,
                )
                cpu, clock = 0.0, time.perf_counter()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--items", type=int, default=10_000)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--jobs", type=int, default=cores())
    arguments = parser.parse_args()
    print(
        f"Machine: {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"numpy {np.__version__}. Date: {datetime.now(UTC):%Y-%m-%d}."
    )
    print(f"Command: `python {' '.join(sys.argv)}`\n")
    settings = ImagingSettings(method="bp")
    enrolled = RegistryContents(1, list(builtin_layouts().values()), [])
    job = Job(ReadingSetup(LoadSettings.of(load_config()), settings, enrolled))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "captures"
        folder.mkdir()
        write_captures(folder, arguments.items, arguments.views)
        meter = Meter(arguments.items, arguments.jobs)
        print("| items | items/s | items/s of one core | parent MB | workers MB |\n|---|---|---|---|---|")
        began = time.perf_counter()
        out = Path(name) / "report"
        finished = run_batch(BatchPlan(collect([str(folder)]), out), job, meter)
        total = time.perf_counter() - began
        page = (out / "report.html").stat().st_size / 1e6
    (first, first_cpu), (last, last_cpu) = meter.rates[0], meter.rates[-1]
    writing = total - sum(arguments.items / PARTS / rate for rate, _ in meter.rates)
    print(f"\nall {arguments.items} items in {total:.0f} s; start and writing the files took {writing:.1f} s")
    print(f"statuses: {finished.summary['by_status']}; page {page:.1f} MB")
    by_clock, by_cpu = last / first, last_cpu / first_cpu
    print(f"rate, last to first part: {by_clock:.3f} by the clock, {by_cpu:.3f} by processor time")
    parent, workers = zip(*meter.memories, strict=True)
    grown = f"parent {parent[-1] - parent[0]:+.1f} MB, workers {workers[-1] - workers[0]:+.1f} MB"
    print(f"memory, last less first part: {grown}; peak {max(map(sum, meter.memories)):.0f} MB")


if __name__ == "__main__":
    main()
