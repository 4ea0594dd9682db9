"""The batch on a real Dask cluster: a scheduler and two workers in processes of their own, on loopback."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from report_batches import HOSTILE, a_job, add_hostile_files, check_hostile, keep, lines, timeless

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
            if match := re.search(ready, line):
                self.said = match
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
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, list[Process]]]:
    """Address of a scheduler, and its process and two workers of one thread, which nannies start again.

    A worker that reads bad.tagid.h5 dies, and the scheduler gives an item up with the first one that dies.
    """
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(
        "import os, sys\nsys.addaudithook(lambda event, words: os._exit(9)"
        " if event == 'open' and str(words[0]).endswith('bad.tagid.h5') else None)\n"
    )
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    where = ("--host", "127.0.0.1", "--no-dashboard")
    with contextlib.ExitStack() as stack:
        scheduler = Process("dask_scheduler", *where, "--port", "0", ready=r"Scheduler at:\s+(tcp://\S+)")
        stack.callback(scheduler.end)
        address = scheduler.said[1]
        processes = [scheduler]
        with monkeypatch.context() as patched:
            patched.setenv("PYTHONPATH", str(tmp_path / "site"), prepend=os.pathsep)
            for number in range(2):
                folder = tmp_path / f"worker-{number}"
                options = ("--nthreads", "1", "--local-directory", str(folder))
                processes.append(Process("dask_worker", address, *where, *options, ready=r"Registered to:\s"))
                stack.callback(processes[-1].end)
        yield address, processes


def answers(folder: Path) -> list[dict[str, Any]]:
    return [timeless(item) for item in lines(folder) if not item["file"].endswith("bad.tagid.h5")]


def pictures(folder: Path) -> list[str]:
    return re.findall(r'<script type="text/plain".*', (folder / "report.html").read_text())


def test_a_cluster_gives_the_local_answers_though_workers_die_and_files_are_hostile(
    make_report, captures: Path, tmp_path: Path, cluster, caplog: pytest.LogCaptureFixture
) -> None:
    from tagid.batch.cluster import run_cluster

    keep(captures, "bad", "helmet-120", "empty")
    for name in ("helmet-120", "empty"):
        shutil.copy(captures / f"{name}.tagid.h5", captures / f"{name}-again.tagid.h5")
    add_hostile_files(captures)
    address, (scheduler, *workers) = cluster
    finished = []

    def kill_one(done: int, of: int, rate: float, remaining: float | None) -> None:
        finished.append(done)
        if done == 3:
            workers[0].process.kill()

    runner = partial(run_cluster, address=address)
    job = a_job(pictures=True)
    make_report(captures, out=tmp_path / "dask", runner=runner, hooks=Hooks(kill_one), job=job)
    assert workers[0].process.poll() is not None
    assert finished == list(range(1, 6 + len(HOSTILE)))
    check_hostile(tmp_path / "dask")
    # The capture that kills workers fails alone.
    dead = [item for item in lines(tmp_path / "dask") if item["error"] and "died" in item["error"]["message"]]
    assert [Path(item["file"]).name for item in dead] == ["bad.tagid.h5"]
    assert "1 worker died with this file alone" in dead[0]["error"]["message"]
    make_report(captures, out=tmp_path / "local", job=job)
    assert answers(tmp_path / "dask") == answers(tmp_path / "local")
    assert pictures(tmp_path / "dask") == pictures(tmp_path / "local") != []

    (captures / "bad.tagid.h5").unlink()
    caplog.clear()
    hooks = Hooks(lambda done, of, rate, remaining: scheduler.process.kill())
    with pytest.raises(ClusterError, match="the connection to the Dask scheduler"):
        make_report(captures, runner=runner, hooks=hooks)
    assert not caplog.records


def test_a_silent_scheduler_is_told_and_a_stop_ends_the_wait(
    make_report, captures: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tagid.batch import cluster

    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        asked = iter((False, True))
        runner = partial(cluster.run_cluster, address=address)
        stopped = make_report(captures, runner=runner, hooks=Hooks(stopped=lambda: next(asked)))
        assert stopped.interrupted and stopped.summary["items"] == 0
        monkeypatch.setattr(cluster, "CONNECT_S", 0.2)
        with pytest.raises(ClusterError, match="no Dask scheduler answers"):
            make_report(captures, runner=runner)


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
