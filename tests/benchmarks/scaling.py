"""Items a second of `tagid report` with 1 and 2 workers, here and on a Dask cluster, and the overhead.

The overhead is measured on files that end at once (they are no captures): all the time is then spent on
handing items out and taking results back. Real items are counted from the first result on, so that starting
the processes is left out. Each figure is the best of some runs: other load can only slow a run down.
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
from pathlib import Path

from tagid.batch.cluster import run_cluster
from tagid.batch.inputs import Source
from tagid.batch.job import Job
from tagid.batch.local import Results, Task, Tasks, run_local
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
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table

OBJECTS = ("helmet-120", "container-90", "helmet-linear", "container-180")
Runner = Callable[[Tasks, Job], Results]


@contextlib.contextmanager
def dask(*words: str, ready: str) -> Iterator[str]:
    """A Dask process; yields what it says when it is ready."""
    command = [sys.executable, "-m", f"distributed.cli.{words[0]}", *words[1:]]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
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


def add_options(parser: argparse.ArgumentParser) -> None:
    """What is read."""
    parser.add_argument("--items", type=int, help="captures; 40, or 8 for a look")
    parser.add_argument("--views", type=int, default=36)


def workers(run: Run) -> Iterator[Table]:
    """A row for one and two workers, here and on a cluster."""
    given, repeats = run.options, run.number(3)
    items = given.items or (8 if run.quick else 40)
    run.seeds = "0, 1, 2, ... (one per capture)"
    enrolled = RegistryContents(1, list(builtin_layouts().values()), [])
    job = Job(ReadingSetup(LoadSettings.of(load_config()), ImagingSettings(method="bp"), enrolled))
    real = []
    for seed in range(items):
        scene = scene_from_name(OBJECTS[seed % 4], seed)
        capture, _ = simulate_capture(scene, Acquisition(views=given.views, snr_db=20.0), seed)
        write_capture(run.folder / f"{seed}.tagid.h5", capture)
        real.append(Source.of(str(run.folder / f"{seed}.tagid.h5")))
    (run.folder / "none.npz").write_bytes(b"no capture")
    empty = [Source.of(str(run.folder / "none.npz"))] * (10 * items)
    rows = []
    for kind in ("local", "Dask"):
        for count in (1, 2):
            with contextlib.ExitStack() as stack:
                runner: Runner = partial(run_local, workers=count)
                if kind == "Dask":
                    runner = stack.enter_context(cluster(count, run.folder))
                rates = [rate(runner, real, job) for _ in range(repeats)]
                idle = [rate(runner, empty, job) for _ in range(repeats)]
            work, overhead = min(cpu for _, cpu in rates), 1 / max(r for r, _ in idle)
            fastest = max(r for r, _ in rates)
            rows.append((kind, count, f"{fastest:.2f}", f"{1e3 * work:.0f}", f"{1e3 * overhead:.2f}"))
    columns = ("", "workers", "items/s", "work of an item, ms of one core", "overhead of an item, ms")
    yield Table(columns, rows)
