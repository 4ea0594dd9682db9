"""Child processes: the only module that starts them.

A child finds modules where its parent does and never in the current folder: `python -m`, `python -c` and the
children of multiprocessing would look there first. A child ends when its parent ends, however that ends; only
the guardian of a motion device outlives it. `python -m tagid.processes MODULE ...` runs a module in this way.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import shutil
import signal
import site
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import wait as wait_for
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import Any, Final, NoReturn

from tagid.workers import Worker

_ROOT: Final = str(Path(__file__).resolve().parents[1])
_END_S: Final = 5.0
"""Time in which a child whose parent has ended may end by itself."""
_environment = threading.Lock()


def python(module: str, *words: str) -> list[str]:
    """The command line of a module of this program, run by this Python; start it with `environment`."""
    return [sys.executable, "-P", "-m", module, *words]


def environment(**more: str) -> dict[str, str]:
    """This process's environment and more for a child: its import path has no empty or relative folder."""
    return {**os.environ, **_import_path(), **more}


def _import_path() -> dict[str, str]:
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    folders = [folder for folder in given if Path(folder).is_absolute()]
    installed = [*site.getsitepackages(), site.getusersitepackages()]
    if _ROOT in sys.path and _ROOT not in (*folders, *map(os.path.realpath, installed)):
        folders.insert(0, _ROOT)  # a clone, in which tagid was started by `python -m tagid`
    return {"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(folders)}


def start(module: str, *words: str, attached: bool = True, **options: Any) -> subprocess.Popen[Any]:
    """Start a module as a child that ends when its standard input, a pipe from this process, is closed.

    `attached` is False for a module that reads its standard input and ends with it by itself; `options` are
    those of `subprocess.Popen`.
    """
    command = python(__name__, module, *words) if attached else python(module, *words)
    return subprocess.Popen(command, stdin=subprocess.PIPE, env=environment(), **options)


def replace(module: str, *words: str) -> NoReturn:
    """Run a module in place of this process."""
    os.execve(sys.executable, python(module, *words), environment())


def start_alone(program: Path, *, scope: bool, **options: Any) -> subprocess.Popen[bytes] | None:
    """Start a Python file of the standard library only, as a child that outlives this process.

    With `scope` it is in a scope and cgroup of its own, so that what ends this process's cgroup (too much
    memory, the end of a service or a session) does not end the child; None without systemd-run. `options` are
    those of `subprocess.Popen`.
    """
    command = [sys.executable, "-I", "-S", str(program)]
    more: dict[str, str] = {}
    if scope:
        folders = os.environ.get("PATH", os.defpath).split(os.pathsep)
        systemd_run = shutil.which(
            "systemd-run", path=os.pathsep.join(place for place in folders if Path(place).is_absolute())
        )
        if systemd_run is None:
            return None
        user = [] if os.geteuid() == 0 else ["--user"]
        # In a scope systemd-run replaces itself by the command, which keeps its process, pipes and port.
        quiet = ["--scope", "--quiet", "--collect", "--no-ask-password", "--description=tagid guardian"]
        command = [systemd_run, *user, *quiet, "--", *command]
        runtime = Path(f"/run/user/{os.geteuid()}")
        if user and "XDG_RUNTIME_DIR" not in os.environ and runtime.is_dir():
            more["XDG_RUNTIME_DIR"] = str(runtime)  # where cron and su do not tell it
    return subprocess.Popen(command, env=environment(**more), start_new_session=True, **options)


class _Process(SpawnProcess):
    """A child of multiprocessing."""

    def start(self) -> None:
        with _child_environment():
            super().start()

    def run(self) -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            Worker(lambda: _end_with(parent.sentinel), "parent", lambda error: os._exit(1)).start()
        super().run()


class _Context(SpawnContext):
    Process = _Process


def spawn_context() -> SpawnContext:
    """The context of multiprocessing for pools: new interpreters, as a fork copies locks and databases."""
    start_resource_tracker()
    return _Context()


def start_resource_tracker() -> None:
    """Start multiprocessing's own helper, unless it runs. It unblocks SIGINT in this thread."""
    with _child_environment():
        resource_tracker.ensure_running()


@contextmanager
def _child_environment() -> Iterator[None]:
    with _environment, environment_set(_import_path()):
        yield


@contextmanager
def environment_set(values: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables while the block runs."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _end_with(sentinel: int) -> NoReturn:
    """End this process at once when its parent has ended."""
    wait_for([sentinel])
    os._exit(1)


def _end_with_input() -> NoReturn:
    """End this process when its standard input ends."""
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_END_S)
    os._exit(1)


def main(words: Sequence[str]) -> None:
    """Run the module `words[0]`, which ends with the standard input."""
    Worker(_end_with_input, "parent").start()
    sys.argv = list(words)
    runpy.run_module(words[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main(sys.argv[1:])
