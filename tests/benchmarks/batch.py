"""Memory and rate of `tagid report` over thousands of captures: neither may depend on how many went before.

Every file is a recording of its own (one of 40 simulated scenes with fresh noise), read, identified and drawn
as the command does it, in processes with one thread each. After each part of the run the script prints the
rate (by the clock, and items per second of processor time, which other load on the machine disturbs less) and
the memory of the parent and of its workers together.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

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
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

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
        self.rows: list[tuple[str, ...]] = []
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
                numbers = (f"{value:.2f}" for value in rate)
                self.rows.append((str(done), *numbers, *(f"{value:.0f}" for value in memory)))
                cpu, clock = 0.0, time.perf_counter()


def add_options(parser: argparse.ArgumentParser) -> None:
    """What is read."""
    parser.add_argument("--items", type=int, help="captures; 600, or 20 for a look")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--workers", type=int, default=cores())


def report(run: Run) -> Iterator[Table]:
    """A row for each tenth of the run."""
    given = run.options
    items = given.items or (20 if run.quick else 600)
    run.seeds = "0 to 39, one per scene"
    enrolled = RegistryContents(1, list(builtin_layouts().values()), [])
    job = Job(ReadingSetup(LoadSettings.of(load_config()), ImagingSettings(method="bp"), enrolled))
    folder = run.folder / "captures"
    folder.mkdir()
    write_captures(folder, items, given.views)
    meter = Meter(items, given.workers)
    began = time.perf_counter()
    out = run.folder / "report"
    finished = run_batch(BatchPlan(collect([str(folder)]), out), job, meter)
    total = time.perf_counter() - began
    page = (out / "report.html").stat().st_size / 1e6
    (first, first_cpu), (last, last_cpu) = meter.rates[0], meter.rates[-1]
    writing = total - sum(items / PARTS / rate for rate, _ in meter.rates)
    parent, workers = zip(*meter.memories, strict=True)
    below = (
        f"All {items} items took {total:.0f} s, of which {writing:.1f} s for starting and writing the "
        f"files; statuses {finished.summary['by_status']}; the page is {page:.1f} MB. Rate, last to first "
        f"part: {last / first:.3f} by the clock, {last_cpu / first_cpu:.3f} by processor time. Memory, "
        f"last less first part: parent {parent[-1] - parent[0]:+.1f} MB, workers "
        f"{workers[-1] - workers[0]:+.1f} MB; peak {max(map(sum, meter.memories)):.0f} MB."
    )
    columns = ("items", "items/s", "items/s of one core", "parent MB", "workers MB")
    yield Table(columns, meter.rows, below=below)
