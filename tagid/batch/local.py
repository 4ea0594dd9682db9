"""A batch on the cores of this computer: one single-threaded worker process per core.

A worker that dies (out of memory, a fault in native code) loses only the item that it was working on.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

from tagid import processes
from tagid.batch.inputs import Source
from tagid.batch.job import Answered, Job, Outcome
from tagid.batch.work import failed_record, unexpected, work
from tagid.constants import BLAS_THREADS
from tagid.errors import TagidError

AHEAD = 2
"""Items in flight per worker: one in progress and one waiting, so that no worker is idle and memory is
bounded."""
TICK_S = 0.25
"""Interval at which a waiting runner lets its caller stop it, s."""
_THREADS = ("OMP_NUM_THREADS", "NUMEXPR_NUM_THREADS", *BLAS_THREADS)


@dataclass(frozen=True)
class Task:
    """An input and its position among the items of the report."""

    position: int
    source: Source


@dataclass(frozen=True)
class Done:
    task: Task
    outcome: Outcome


Tasks = Iterator[Task | None]
"""None if there is no task at the moment but more may arrive (a watched folder)."""
Results = Generator[Done | None, None, None]
"""Result of each item, in any order; None about every `TICK_S` while there is no result."""

_job: Job | None = None


def cores() -> int:
    """Number of cores that this process may use."""
    with contextlib.suppress(AttributeError, OSError):
        return len(os.sched_getaffinity(0)) or 1
    return os.cpu_count() or 1


def run_local(tasks: Tasks, job: Job, workers: int) -> Results:
    """Process all tasks and yield each result as it arrives; close the iterator to stop.

    At most `AHEAD` tasks per worker are taken from `tasks` before their results are yielded.
    """
    pool = _Pool(job, workers)
    # Every core already has a worker: each runs linear algebra on one thread.
    with processes.environment_set(dict.fromkeys(_THREADS, "1")):
        try:
            yield from pool.run(tasks)
        finally:
            pool.stop()


class _Pool:
    def __init__(self, job: Job, workers: int) -> None:
        self._job = job
        self._workers = workers
        self._executor: ProcessPoolExecutor | None = None
        self._under_way: dict[Future[Outcome], Task] = {}

    def run(self, tasks: Tasks) -> Results:
        more = True
        while more or self._under_way:
            idle = False
            while more and not idle and len(self._under_way) < AHEAD * self._workers:
                task = next(tasks, _END)
                more = task is not _END
                idle = task is None
                if isinstance(task, Task):
                    self._submit(task)
            done, _ = wait(self._under_way, timeout=TICK_S, return_when=FIRST_COMPLETED)
            if not done:
                if not self._under_way:
                    time.sleep(TICK_S if idle else 0)
                yield None
            elif any(isinstance(future.exception(), BrokenProcessPool) for future in done):
                yield from self._after_a_death(done)
            else:
                for future in done:
                    task = self._under_way.pop(future)
                    yield Done(task, _outcome(task.source, future))

    def _submit(self, task: Task) -> None:
        with _no_interrupt():
            if self._executor is None:
                self._executor = _executor(self._job, self._workers)
            try:
                self._under_way[self._executor.submit(_work, task.source)] = task
            except BrokenProcessPool as error:
                # It died between two items; the items in progress will raise the same error.
                future: Future[Outcome] = Future()
                future.set_exception(error)
                self._under_way[future] = task

    def _after_a_death(self, done: set[Future[Outcome]]) -> Results:
        """A worker died and broke the pool: process the items in flight one by one to find the cause."""
        unfinished = []
        for future, task in list(self._under_way.items()):
            if future in done and not isinstance(future.exception(), BrokenProcessPool):
                yield Done(task, _outcome(task.source, future))
            else:
                unfinished.append(task)
        self._under_way.clear()
        self.stop()
        for task in unfinished:
            with _no_interrupt():
                alone = _executor(self._job, 1)
                future = alone.submit(_work, task.source)
            try:
                while not wait([future], timeout=TICK_S).done:
                    yield None
                yield Done(task, _outcome(task.source, future))
            except BrokenProcessPool:
                error = TagidError(
                    "the process that worked on this file died (out of memory, or a fault in a library)",
                    "Inspect the file with `tagid show`; other files are not affected.",
                )
                yield Done(task, Answered(failed_record(task.source, error)))
            finally:
                _stop(alone)

    def stop(self) -> None:
        """Terminate the workers; items in progress are lost."""
        if self._executor is not None:
            _stop(self._executor)
            self._executor = None
        self._under_way.clear()


def _outcome(source: Source, future: Future[Outcome]) -> Outcome:
    """A worker's result, or the item's failure if its result could not be transferred.

    Raises BrokenProcessPool.
    """
    try:
        return future.result()
    except BrokenProcessPool:
        raise
    except Exception as error:
        return Answered(failed_record(source, unexpected(source, error)))


_END = object()


def _executor(job: Job, workers: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(workers, processes.spawn_context(), initializer=_begin, initargs=(job,))


@contextlib.contextmanager
def _no_interrupt() -> Iterator[None]:
    """Context in which new processes block SIGINT and SIGHUP, which a terminal sends to all its processes.

    The parent decides when they end.
    """
    # Start the tracker first: starting it unblocks SIGINT, also in the first process created afterwards.
    processes.start_resource_tracker()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _stop(executor: ProcessPoolExecutor) -> None:
    processes = list((executor._processes or {}).values())
    for process in processes:
        process.terminate()
    executor.shutdown(wait=True, cancel_futures=True)


def _begin(job: Job) -> None:
    global _job
    _job = job


def _work(source: Source) -> Outcome:
    if _job is None:
        raise RuntimeError("the worker was not set up")
    return work(source, _job)


Runner = Callable[[Tasks, Job], Results]
"""Anything that processes tasks: the local cores, a cluster."""
