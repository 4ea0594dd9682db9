"""The batch on a real Dask cluster: a scheduler and two workers in processes of their own, on loopback."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from report_batches import HOSTILE, add_hostile_files, check_hostile

from tagid.batch.local import run_local
from tagid.batch.run import Hooks
from tagid.errors import ClusterError, MissingExtraError

pytest.importorskip("distributed")


class Process:
    """A Dask process, its output followed to the line that says that it is ready."""

    def __init__(self, module: str, *words: str, ready: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{module}", *words],
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
        )
        assert self.process.stderr is not None
        seen = []
        for line in self.process.stderr:
            seen.append(line)
            if found := re.search(ready, line):
                self.said = found
                break
        else:
            pytest.fail("".join(seen))
        # A full pipe would stop it.
        self._reader = threading.Thread(target=self.process.stderr.read)
        self._reader.start()

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join()
        assert self.process.stderr is not None
        self.process.stderr.close()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[Process]]]:
    """Address of a scheduler with two workers of one thread, and the workers."""
    where = ("--host", "127.0.0.1", "--no-dashboard")
    with contextlib.ExitStack() as stack:
        scheduler = Process("dask_scheduler", *where, "--port", "0", ready=r"Scheduler at:\s+(tcp://\S+)")
        stack.callback(scheduler.end)
        address = scheduler.said[1]
        workers = []
        for number in range(2):
            folder = tmp_path / f"worker-{number}"
            options = ("--nthreads", "1", "--no-nanny", "--local-directory", str(folder))
            workers.append(Process("dask_worker", address, *where, *options, ready=r"Registered to:\s"))
            stack.callback(workers[-1].end)
        yield address, workers


def timeless(folder: Path) -> list[str]:
    records = [json.loads(line) for line in (folder / "items.jsonl").read_text().splitlines()]
    for record in records:
        del record["seconds"], record["time_utc"]
    return [json.dumps(record) for record in records]


def pictures(folder: Path) -> list[str]:
    return re.findall(r'<script type="text/plain".*', (folder / "report.html").read_text())


def test_a_cluster_gives_the_local_answers_though_a_worker_dies_and_files_are_hostile(
    make_report, captures: Path, tmp_path: Path, cluster
) -> None:
    from tagid.batch.cluster import run_cluster

    for number in range(2):
        for name in ("helmet-120", "container-90", "empty"):
            shutil.copy(captures / f"{name}.tagid.h5", captures / f"{name}-{number}.tagid.h5")
    add_hostile_files(captures)
    address, workers = cluster
    finished = []

    def kill_one(done: int, of: int, rate: float, left: float | None) -> None:
        finished.append(done)
        if done == 3:
            workers[0].process.kill()

    make_report(
        captures, out=tmp_path / "dask", runner=partial(run_cluster, address=address), hooks=Hooks(kill_one)
    )
    assert workers[0].process.poll() is not None
    assert finished == list(range(1, 12 + len(HOSTILE)))
    check_hostile(tmp_path / "dask")
    make_report(captures, out=tmp_path / "local", runner=partial(run_local, workers=2))
    assert timeless(tmp_path / "dask") == timeless(tmp_path / "local")
    assert pictures(tmp_path / "dask") == pictures(tmp_path / "local") != []


def test_what_is_no_cluster_is_told(make_report, captures: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tagid.batch import cluster

    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        monkeypatch.setattr(cluster, "CONNECT_S", 0.5)
        address = f"tcp://127.0.0.1:{nobody.getsockname()[1]}"
        with pytest.raises(ClusterError, match="no Dask scheduler answers"):
            make_report(captures, runner=partial(cluster.run_cluster, address=address))
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match="distributed"):
        make_report(captures, runner=partial(cluster.run_cluster, address="tcp://127.0.0.1:1"))
