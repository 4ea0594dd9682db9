"""A batch on a Dask cluster: items are sent over the network and results returned as from local cores.

The scheduler reassigns the items of a worker that dies. Linear algebra runs on one thread per item, so the
numbers are identical to those of a local run.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Awaitable, Coroutine, Generator
from typing import Any, TypeVar

from tagid._version import __version__
from tagid.batch.inputs import Source
from tagid.batch.job import Answered, Job, Outcome
from tagid.batch.local import TICK_S, Done, Results, Task, Tasks
from tagid.batch.work import failed_record, unexpected, work
from tagid.counting import counted
from tagid.errors import ClusterError, MissingExtraError, TagidError

CONNECT_S = 10.0
"""Timeout for the connection and the handshake with the scheduler, s."""
WORKERS_S = 90.0
"""Longest time without a worker, and longest silence of the scheduler, s: workers restart within a minute."""
WORKERS_EVERY_S = 2.0
CLOSE_S = 2.0
"""Longest time for the farewell to the scheduler, s."""
AHEAD = 6
"""Items in flight per thread: enough to hide network latency, few enough to bound memory."""

_T = TypeVar("_T")


def run_cluster(tasks: Tasks, job: Job, address: str, verbose: bool = False) -> Results:
    """Process all tasks on a cluster and yield each result as it arrives; close the iterator to stop.

    At most `AHEAD` tasks per worker thread are taken before their results are yielded. Workers must be able
    to open the files under the same absolute paths or URLs. The address is that of the scheduler, e.g.
    tcp://10.0.0.1:8786; `verbose` shows Dask's own log.

    Raises:
        MissingExtraError: `distributed` is not installed.
        ClusterError: no scheduler, no worker, another tagid version on the workers, or the scheduler is lost.
    """
    try:
        import distributed
    except ImportError:
        raise MissingExtraError(
            "`dask` needs distributed, which is not installed",
            "Install it with `pip install 'tagid[cluster]'`.",
        ) from None
    if not verbose:
        for name in ("distributed", "distributed.core", "distributed.client", "tornado.application"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    # The event loop runs in this thread, for `TICK_S` at a time: the caller can stop whatever it waits for.
    loop = asyncio.new_event_loop()
    # Of several items that fail with the connection, the first one ends the run.
    loop.set_exception_handler(lambda _, fault: logging.getLogger("tagid").debug("%s", fault))
    cluster = _Cluster(distributed, address)
    try:
        yield from _ticks(loop, cluster.connect())
        yield from _process(loop, cluster, tasks, job)
    finally:
        loop.run_until_complete(cluster.close())
        loop.close()


def _ticks(loop: asyncio.AbstractEventLoop, work: Coroutine[Any, Any, _T]) -> Generator[None, None, _T]:
    """The result of a coroutine; yields about every `TICK_S` until it is there."""
    task = loop.create_task(work)
    while not loop.run_until_complete(asyncio.wait([task], timeout=TICK_S))[0]:
        yield None
    return task.result()


def _process(loop: asyncio.AbstractEventLoop, cluster: _Cluster, tasks: Tasks, job: Job) -> Results:
    cluster.share(job)
    observer = loop.create_task(cluster.observe())
    under_way: dict[asyncio.Task[Outcome], Task] = {}
    more = True
    while more or under_way:
        idle = False
        while more and not idle and len(under_way) < AHEAD * cluster.threads:
            task = next(tasks, _END)
            more = task is not _END
            idle = task is None
            if isinstance(task, Task):
                under_way[loop.create_task(cluster.item(task.source))] = task
        waited = asyncio.wait([observer, *under_way], timeout=TICK_S, return_when=asyncio.FIRST_COMPLETED)
        loop.run_until_complete(waited)
        if observer.done():
            observer.result()
        done = [item for item in under_way if item.done()]
        if not done:
            yield None
        for item in done:
            yield Done(under_way.pop(item), item.result())


class _Cluster:
    """Dask's client; every wait for the scheduler has a limit, or `observe` ends it.

    Attributes:
        threads: number of threads of all workers that were there last.
    """

    def __init__(self, distributed: Any, address: str) -> None:
        self.threads = 1
        self._distributed, self._address = distributed, address
        self._killed: type[BaseException] = distributed.scheduler.KilledWorker
        self._client: Any = None
        self._shared: Any = None
        self._job: Job
        self._changed = asyncio.Condition()
        self._running = self._suspects = 0

    async def connect(self) -> None:
        """Raises ClusterError without a scheduler or a worker, or if a worker has another tagid."""
        try:
            async with asyncio.timeout(CONNECT_S + 1):
                self._client = self._distributed.Client(
                    self._address or "no address",
                    timeout=CONNECT_S,
                    set_as_default=False,
                    name="tagid-report",
                    asynchronous=True,
                )
                await self._client
        except Exception as error:  # of many kinds, for addresses of many kinds
            raise ClusterError(
                f"no Dask scheduler answers at {self._address}: {str(error)[:200] or 'no answer'}",
                "Start one with `dask scheduler` and give the address that it prints, "
                "e.g. tcp://10.0.0.1:8786.",
            ) from None
        try:
            await self._client.wait_for_workers(1, timeout=WORKERS_S)
            async with asyncio.timeout(WORKERS_S):
                versions = await self._client.run(_version, on_error="return")
        except TimeoutError:
            raise self._no_workers() from None
        except OSError as error:
            raise self._gone() from error
        for worker, version in versions.items():
            # A worker that dies meanwhile raises OSError; its successor is as the others.
            if isinstance(version, Exception) and not isinstance(version, OSError):
                raise ClusterError(
                    f"the workers at {self._address} cannot run tagid: {type(version).__name__}: "
                    f"{str(version)[:200]}",
                    f"Install tagid {__version__} with the extra `cluster` on each of them.",
                )
            if isinstance(version, str) and version != __version__:
                raise ClusterError(
                    f"worker {worker} has tagid {version}, here is {__version__}",
                    "Install the same on all of them.",
                )

    def share(self, job: Job) -> None:
        """Send the settings once to each worker that needs them."""
        # A task, not scattered data: if the worker that holds it dies, the scheduler computes it again.
        self._job = job
        self._shared = self._client.submit(_same, job, pure=False)

    async def observe(self) -> None:
        """Count the workers until it is cancelled. Raises ClusterError: no workers, or no scheduler.

        Time is counted in rounds, because the event loop stands still while its caller works.
        """
        absent = 0
        while True:
            request = asyncio.ensure_future(self._client.nthreads())
            for _ in range(round(WORKERS_S / WORKERS_EVERY_S)):
                if (await asyncio.wait([request], timeout=WORKERS_EVERY_S))[0]:
                    break
            else:
                request.cancel()
                raise self._gone(f" (no answer for {WORKERS_S:g} s)")
            try:
                self.threads = sum(request.result().values()) or self.threads
                absent = 0 if request.result() else absent + 1
            except OSError as error:
                raise self._gone() from error
            if absent > WORKERS_S / WORKERS_EVERY_S:
                raise self._no_workers()
            await asyncio.sleep(WORKERS_EVERY_S)

    async def item(self, source: Source) -> Outcome:
        """The outcome of one item. Raises ClusterError if the scheduler is lost.

        If the workers that had it die, it and the others that they had are tried again alone, one at a time.
        """
        try:
            return await self._result(source)
        except self._killed:
            self._suspects += 1
        try:
            return await self._result(source, alone=True)
        except self._killed as killed:
            died = counted(killed.args[2] + 1, "worker")
            error = TagidError(
                f"{died} died with this file alone (out of memory, or a fault in a library)",
                "Inspect the file with `tagid show`; other files are not affected.",
            )
            return Answered(failed_record(source, error))

    @contextlib.asynccontextmanager
    async def _place(self, alone: bool) -> AsyncIterator[None]:
        """The right to run an item, with others while none is suspected, or while nothing else runs."""
        async with self._changed:
            await self._changed.wait_for(lambda: not (self._running if alone else self._suspects))
            self._running += 1
        try:
            yield
        finally:
            async with self._changed:
                self._running -= 1
                self._suspects -= alone
                self._changed.notify_all()

    async def _result(self, source: Source, alone: bool = False) -> Outcome:
        """The outcome of an item. Raises KilledWorker, and ClusterError if the scheduler is lost."""
        async with self._place(alone):
            shared = self._shared
            future = self._client.submit(_work, source, shared, pure=False)
            try:
                return await future  # type: ignore[no-any-return]
            except self._killed as killed:
                if killed.args[0] == shared.key and alone:
                    raise ClusterError(
                        f"the workers at {self._address} die before they work on a file",
                        "Their log tells why. Finished items are kept: add `resume`.",
                    ) from killed
                if killed.args[0] == shared.key and self._shared is shared:
                    self.share(self._job)
                raise
            except Exception as error:
                # What the task raised is kept in its future; anything else concerns the connection.
                if future.status != "error":
                    raise self._gone() from error
                return Answered(failed_record(source, unexpected(source, error)))

    async def close(self) -> None:
        """Say goodbye to the scheduler, if it listens, and end everything that is still waiting."""
        if self._client is not None:
            await _limited(self._client.close(timeout=CLOSE_S))
        rest = asyncio.all_tasks() - {asyncio.current_task()}
        for task in rest:
            task.cancel()
        if rest:
            await asyncio.wait(rest, timeout=CLOSE_S)

    def _no_workers(self) -> ClusterError:
        return ClusterError(
            f"the cluster at {self._address} has no workers",
            f"Start some with `dask worker {self._address} --nthreads 1`; finished items are kept, "
            "add `resume`.",
        )

    def _gone(self, how: str = "") -> ClusterError:
        return ClusterError(
            f"the connection to the Dask scheduler at {self._address} was lost{how}",
            "Finished items are kept: start the cluster again and add `resume`.",
        )


_END = object()


async def _limited(farewell: Awaitable[Any]) -> None:
    with contextlib.suppress(Exception):  # of a connection that is lost already
        await asyncio.wait_for(farewell, CLOSE_S)


def _same(job: Job) -> Job:
    return job


def _version() -> str:
    return __version__


def _work(source: Source, job: Job) -> Outcome:
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        return work(source, job)
