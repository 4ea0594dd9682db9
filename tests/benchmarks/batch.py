"""`tagid report` over many captures: memory and rate, which may not depend on how many went before; and
items a second with 1 and 2 workers, here and on a Dask cluster.

Every file is a recording of its own, read, identified and drawn as the command does it, in processes with
one thread each. Rates are by the clock, and in items per second of processor time, which other load disturbs
less; memory is that of the parent and of its workers together.

The overhead of an item is measured on files that end at once (they are no captures): all the time is then
spent on handing items out and taking results back. Real items are counted from the first result on, so that
starting the processes is left out. Each figure is the best of some runs: other load can only slow a run down.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from tagid.batch.cluster import run_cluster
from tagid.batch.inputs import Source, collect
from tagid.batch.job import Job
from tagid.batch.local import Results, Task, Tasks, cores, run_local
from tagid.batch.run import BatchPlan, run_batch
from tagid.capture import Capture
from tagid.config import load_config
from tagid.enrolling.registry import RegistryContents
from tagid.operate.turn import ReadingSetup
from tagid.pipeline.prepared import LoadSettings
from tagid.pipeline.settings import ImagingSettings
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.storage.hdf5 import write_capture
from tagid.tags.layouts.layout import builtin_layouts
from tests.benchmarks.measure import memory_mb
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

OBJECTS = ("helmet-120", "container-90", "helmet-linear", "container-180")
PARTS, VIEWS = 10, 12
WORKER_VIEWS = 36
Runner = Callable[[Tasks, Job], Results]


def job() -> Job:
    enrolled = RegistryContents(1, list(builtin_layouts().values()), [])
    return Job(ReadingSetup(LoadSettings.of(load_config()), ImagingSettings(method="bp"), enrolled))


def recorded(seed: int, views: int) -> Capture:
    """One of the four objects."""
    scene = scene_from_name(OBJECTS[seed % 4], seed)
    return simulate_capture(scene, Acquisition(views=views, snr_db=20.0), seed)[0]


def write_captures(folder: Path, count: int) -> None:
    """`count` NPZ files of different content, in folders of a thousand."""
    scenes = [recorded(seed, VIEWS) for seed in range(40)]
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
    parser.add_argument("--items", type=int, help="captures; 600 (40 of `scaling`), or fewer for a look")


def report(run: Run) -> Iterator[Table]:
    items = run.options.items or (20 if run.quick else 600)
    run.seeds = "0 to 39, one per scene"
    folder = run.folder / "captures"
    folder.mkdir()
    write_captures(folder, items)
    meter = Meter(items, cores())
    began = time.perf_counter()
    out = run.folder / "report"
    finished = run_batch(BatchPlan(collect([str(folder)]), out), job(), meter)
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
    yield Table("items | items/s | items/s of one core | parent MB | workers MB", meter.rows, below=below)


@contextlib.contextmanager
def dask(*words: str, ready: str) -> Iterator[str]:
    """A Dask process; yields what it says when it is ready."""
    command = [sys.executable, "-m", f"distributed.cli.{words[0]}", *words[1:]]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        result = next(match for line in process.stderr if (match := re.search(ready, line)))
        reader = threading.Thread(target=process.stderr.read)
        reader.start()
        try:
            yield result[1]
        finally:
            process.kill()
            reader.join()


@contextlib.contextmanager
def cluster(workers: int, folder: Path) -> Iterator[Runner]:
    """A scheduler and workers of one thread each on loopback."""
    where = ("--host", "127.0.0.1", "--no-dashboard")
    with contextlib.ExitStack() as stack:
        address = stack.enter_context(
            dask("dask_scheduler", *where, "--port", "0", ready=r"Scheduler at:\s+(tcp://\S+)")
        )
        for number in range(workers):
            options = ("--nthreads", "1", "--no-nanny", "--local-directory", str(folder / str(number)))
            stack.enter_context(dask("dask_worker", address, *where, *options, ready=r"(Registered) to:"))
        yield partial(run_cluster, address=address)


def rate(runner: Runner, sources: list[Source], job: Job) -> tuple[float, float]:
    """(items a second from the first result to the last, processor seconds of the work of an item)."""
    times, cpu = [], 0.0
    for result in runner(iter([Task(i, source) for i, source in enumerate(sources)]), job):
        if result is not None:
            times.append(time.perf_counter())
            cpu += result.outcome.cpu_s
    # The first results of all workers come together; the clock runs from a moment when all are at work.
    start = len(times) // 10
    return (len(times) - 1 - start) / (times[-1] - times[start]), cpu / len(times)


def workers(run: Run) -> Iterator[Table]:
    repeats, items = run.number(3), run.options.items or (8 if run.quick else 40)
    run.seeds = "0, 1, 2, ... (one per capture)"
    real = []
    for seed in range(items):
        path = run.folder / f"{seed}.tagid.h5"
        write_capture(path, recorded(seed, WORKER_VIEWS))
        real.append(Source.of(str(path)))
    (run.folder / "none.npz").write_bytes(b"no capture")
    empty = [Source.of(str(run.folder / "none.npz"))] * (10 * items)
    rows = []
    for kind, count in product(("local", "Dask"), (1, 2)):
        with contextlib.ExitStack() as stack:
            runner: Runner = partial(run_local, workers=count)
            if kind == "Dask":
                runner = stack.enter_context(cluster(count, run.folder))
            rates = [rate(runner, real, job()) for _ in range(repeats)]
            idle = [rate(runner, empty, job()) for _ in range(repeats)]
        work, overhead = min(cpu for _, cpu in rates), 1 / max(r for r, _ in idle)
        rows.append((kind, count, f"{max(rates)[0]:.2f}", f"{1e3 * work:.0f}", f"{1e3 * overhead:.2f}"))
    yield Table(" | workers | items/s | work of an item, ms of one core | overhead of an item, ms", rows)
