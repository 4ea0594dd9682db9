"""The cores of this computer: one process each, one thread in each, and none that can end the batch.

A worker that dies (out of memory, a fault in native code) costs the item that killed it, nothing else.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import resource_tracker
from multiprocessing.connection import wait as wait_for

from tagid.batch.inputs import Source
from tagid.batch.job import Job, Outcome
from tagid.batch.work import failed_record, unexpected, work
from tagid.errors import TagidError

AHEAD = 2
"""Items handed out for each worker: one at work, one waiting, so that none idles and memory is bounded."""
TICK_S = 0.25
"""How often a runner that waits gives its caller the chance to stop, s."""
_THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)

Tasks = Iterator[tuple[int, Source] | None]
"""Positions and inputs; None where nothing is there yet but more may come (a watched folder)."""
Results = Generator[tuple[int, Source, Outcome] | None, None, None]
"""What became of each, in any order; None every `TICK_S` or so where nothing did."""

_job: Job | None = None


def cores() -> int:
    """Cores that this process may use."""
    with contextlib.suppress(AttributeError, OSError):
        return len(os.sched_getaffinity(0)) or 1
    return os.cpu_count() or 1


def run_local(tasks: Tasks, job: Job, workers: int) -> Results:
    """Work on all tasks and give each result as it comes; close the iterator to stop.

    At most `AHEAD` tasks a worker are taken from `tasks` before their results are given.
    """
    pool = _Pool(job, workers)
    with one_thread_each():
        try:
            yield from pool.run(tasks)
        finally:
            pool.stop()


class _Pool:
    def __init__(self, job: Job, workers: int) -> None:
        self._job = job
        self._workers = workers
        self._executor: ProcessPoolExecutor | None = None
        self._under_way: dict[Future[Outcome], tuple[int, Source]] = {}

    def run(self, tasks: Tasks) -> Results:
        more = True
        while more or self._under_way:
            idle = False
            while more and not idle and len(self._under_way) < AHEAD * self._workers:
                task = next(tasks, _END)
                more = task is not _END
                idle = task is None
                if isinstance(task, tuple):
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
                    position, source = self._under_way.pop(future)
                    yield position, source, _outcome(source, future)

    def _submit(self, task: tuple[int, Source]) -> None:
        with _no_interrupt():
            if self._executor is None:
                self._executor = _executor(self._job, self._workers)
            try:
                self._under_way[self._executor.submit(_work, task[1])] = task
            except BrokenProcessPool as error:
                # It died between two items; what is under way will say the same.
                future: Future[Outcome] = Future()
                future.set_exception(error)
                self._under_way[future] = task

    def _after_a_death(self, done: set[Future[Outcome]]) -> Results:
        """A worker died and took the pool along: do what was under way one by one, to find the culprit."""
        left = []
        for future, task in list(self._under_way.items()):
            if future in done and not isinstance(future.exception(), BrokenProcessPool):
                yield *task, _outcome(task[1], future)
            else:
                left.append(task)
        self._under_way.clear()
        self.stop()
        for position, source in left:
            with _no_interrupt():
                alone = _executor(self._job, 1)
                future = alone.submit(_work, source)
            try:
                while not wait([future], timeout=TICK_S).done:
                    yield None
                yield position, source, _outcome(source, future)
            except BrokenProcessPool:
                error = TagidError(
                    "the process that worked on this file died (out of memory, or a fault in a library)",
                    "Look into the file with `tagid show`; the others are not affected.",
                )
                yield position, source, Outcome(failed_record(source, error))
            finally:
                _stop(alone)

    def stop(self) -> None:
        """End the workers at once; what they were at is lost."""
        if self._executor is not None:
            _stop(self._executor)
            self._executor = None
        self._under_way.clear()


def _outcome(source: Source, future: Future[Outcome]) -> Outcome:
    """What a worker gave, or the item's failure where its result could not even be sent here.

    Raises BrokenProcessPool.
    """
    try:
        return future.result()
    except BrokenProcessPool:
        raise
    except Exception as error:
        return Outcome(failed_record(source, unexpected(source, error)))


_END = object()


def _executor(job: Job, workers: int) -> ProcessPoolExecutor:
    # Spawned, not forked: a fork would copy the parent's threads' locks and its open database.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, context, initializer=_begin, initargs=(job,))


@contextlib.contextmanager
def _no_interrupt() -> Iterator[None]:
    """Processes started meanwhile get neither SIGINT nor SIGHUP, which a terminal sends to all its processes:
    the parent decides when they end."""
    # Starting it unblocks Ctrl-C, and with it the first process that is started after.
    resource_tracker.ensure_running()
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


@contextlib.contextmanager
def one_thread_each() -> Iterator[None]:
    """Processes started meanwhile run their linear algebra on one thread: the cores are busy with items."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _begin(job: Job) -> None:
    """Set up a worker process."""
    global _job
    _job = job
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    """A killed parent cannot stop its workers; they see that it is gone."""
    wait_for([sentinel])
    os._exit(1)


def _work(source: Source) -> Outcome:
    if _job is None:
        raise RuntimeError("the worker was not set up")
    return work(source, _job)


Runner = Callable[[Tasks, Job], Results]
"""Anything that works on tasks: the local cores, a cluster."""
