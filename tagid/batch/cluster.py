"""A batch on a Dask cluster: items are sent over the network and results returned as from local cores.

The scheduler reassigns the items of a worker that dies. Linear algebra runs on one thread per item, so the
numbers are identical to those of a local run.
"""

from __future__ import annotations

import logging
import queue
import time
from typing import Any

from tagid import __version__
from tagid.batch.inputs import Source
from tagid.batch.job import Answered, Job, Outcome
from tagid.batch.local import TICK_S, Done, Results, Task, Tasks
from tagid.batch.work import failed_record, unexpected, work
from tagid.errors import ClusterError, MissingExtraError, TagidError

CONNECT_S = 10.0
WORKERS_S = 30.0
"""Timeout for the scheduler and for the first worker, s."""
WORKERS_EVERY_S = 2.0
AHEAD = 6
"""Items in flight per thread: enough to hide network latency, few enough to bound memory."""
RETRIES = 3
"""Number of workers that may die while working on an item before it counts as failed; the scheduler's
default."""


def run_cluster(tasks: Tasks, job: Job, address: str, verbose: bool = False) -> Results:
    """Process all tasks on a cluster and yield each result as it arrives; close the iterator to stop.

    At most `AHEAD` tasks per worker thread are taken from `tasks` before their results are yielded.

    Args:
        tasks: the items; workers must be able to open the files under the same absolute paths or URLs.
        job: settings, sent once to each worker.
        address: address of the scheduler, e.g. tcp://10.0.0.1:8786.
        verbose: show Dask's own log.

    Raises:
        MissingExtraError: `distributed` is not installed.
        ClusterError: no scheduler, no worker, another tagid version on the workers, or the scheduler is lost.
    """
    try:
        import distributed
    except ImportError:
        raise MissingExtraError(
            "--dask needs distributed, which is not installed",
            "Install it with `pip install 'tagid[cluster]'`.",
        ) from None
    if not verbose:
        for name in ("distributed", "distributed.core", "distributed.client", "tornado.application"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    client = _connect(distributed, address)
    try:
        yield from _Remote(distributed, client, address).run(tasks, job)
    finally:
        client.close(timeout=5)


def _connect(distributed: Any, address: str) -> Any:
    try:
        client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False, name="tagid-report")
    except (OSError, ValueError, TimeoutError) as error:
        raise ClusterError(
            f"no Dask scheduler answers at {address}: {str(error)[:200]}",
            "Start one with `dask scheduler` and give the address that it prints, e.g. tcp://10.0.0.1:8786.",
        ) from None
    try:
        client.wait_for_workers(1, timeout=WORKERS_S)
        versions = client.run(_version)
    except TimeoutError:
        client.close(timeout=5)
        raise ClusterError(
            f"the cluster at {address} has no workers",
            f"Start some with `dask worker {address} --nthreads 1`.",
        ) from None
    except Exception as error:  # a worker without tagid raises exceptions of many kinds
        client.close(timeout=5)
        raise ClusterError(
            f"the workers at {address} cannot run tagid: {type(error).__name__}: {str(error)[:200]}",
            f"Install tagid {__version__} with the extra `cluster` on each of them.",
        ) from None
    others = {worker: version for worker, version in versions.items() if version != __version__}
    if others:
        client.close(timeout=5)
        worker, version = next(iter(others.items()))
        raise ClusterError(
            f"worker {worker} has tagid {version}, here is {__version__}", "Install the same on all of them."
        )
    return client


class _Remote:
    def __init__(self, distributed: Any, client: Any, address: str) -> None:
        self._distributed, self._client, self._address = distributed, client, address
        self._finished: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._under_way: dict[Any, tuple[Task, Any]] = {}
        self._count, self._count_until = 1, 0.0

    def run(self, tasks: Tasks, job: Job) -> Results:
        # A task, not scattered data: if the worker that holds it dies, the scheduler computes it again.
        shared = self._client.submit(_same, job, pure=False)
        more = True
        while more or self._under_way:
            idle = False
            room = AHEAD * self._threads()
            while more and not idle and len(self._under_way) < room:
                task = next(tasks, _END)
                more = task is not _END
                idle = task is None
                if isinstance(task, Task):
                    self._submit(task, shared)
            if not more and not self._under_way:
                return
            try:
                key = self._finished.get(timeout=TICK_S)
            except queue.Empty:
                self._check()
                yield None
                continue
            task, future = self._under_way.pop(key)
            yield Done(task, self._outcome(task.source, future))

    def _threads(self) -> int:
        """Number of threads of all workers, refreshed every few seconds because workers join and leave."""
        if time.monotonic() > self._count_until:
            workers = self._client.scheduler_info(n_workers=-1)["workers"]
            self._count = max(1, sum(int(worker["nthreads"]) for worker in workers.values()))
            self._count_until = time.monotonic() + WORKERS_EVERY_S
        return self._count

    def _submit(self, task: Task, shared: Any) -> None:
        future = self._client.submit(_work, task.source, shared, pure=False)
        self._under_way[future.key] = (task, future)
        future.add_done_callback(lambda done: self._finished.put(done.key))

    def _outcome(self, source: Source, future: Any) -> Outcome:
        try:
            return future.result(timeout=CONNECT_S)  # type: ignore[no-any-return]
        except self._distributed.scheduler.KilledWorker:
            error = TagidError(
                f"{RETRIES + 1} workers died with this file (out of memory, or a fault in a library)",
                "Inspect the file with `tagid show`; other files are not affected.",
            )
            return Answered(failed_record(source, error))
        except (self._distributed.client.FutureCancelledError, TimeoutError, OSError) as fault:
            raise self._gone() from fault
        except Exception as error:
            return Answered(failed_record(source, unexpected(source, error)))

    def _check(self) -> None:
        if self._client.status not in ("running", "connecting"):
            raise self._gone()

    def _gone(self) -> ClusterError:
        return ClusterError(
            f"the connection to the Dask scheduler at {self._address} was lost",
            "Finished items are kept: start the cluster again and add --resume.",
        )


_END = object()


def _same(job: Job) -> Job:
    return job


def _version() -> str:
    return __version__


def _work(source: Source, job: Job) -> Outcome:
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        return work(source, job)
