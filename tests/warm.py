"""A process that has imported `tagid` once and forks one child for each command line.

Each command still runs in a process of its own, with its own environment, folder and streams; only the time
of importing is saved. Run as a script, it reads requests on its standard input, one JSON object a line, with
`argv`, `env`, `cwd`, `out` and `err` (files for the streams), and answers each with the exit status.
"""

from __future__ import annotations

import atexit
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

PRELOADED = (
    "typer.rich_utils", "rich.live", "rich.progress", "sqlite3", "h5py", "onnxruntime", "PIL.Image",
    "scipy.linalg", "scipy.ndimage", "scipy.optimize", "scipy.signal", "scipy.special",
    "tagid.cli.app", "tagid.pipeline.identify", "tagid.pipeline.reconstruct", "tagid.recording.recorder",
    "tagid.tags.enrolling.registry",
)  # fmt: skip
"""Modules that the commands import late. That they do so is tested elsewhere, in fresh interpreters."""

LIMIT_S = 120.0
"""A command that runs longer hangs, s."""


class WarmProcess:
    """Runs command lines of `tagid` in forks of one warm interpreter.

    Args:
        environment: of the warm interpreter, which is what its modules see while they are imported.
    """

    def __init__(self, environment: dict[str, str]) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="tagid-warm-")
        self._child = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )

    def run(self, argv: list[str], env: dict[str, str], cwd: Path) -> subprocess.CompletedProcess[str]:
        """The ended command: its exit status, negative for a signal, and what it wrote."""
        assert self._child.stdin and self._child.stdout
        out, err = (Path(self._folder.name) / name for name in ("out", "err"))
        request = {"argv": argv, "env": env, "cwd": str(cwd), "out": str(out), "err": str(err)}
        self._child.stdin.write(json.dumps(request) + "\n")
        self._child.stdin.flush()
        status = int(self._child.stdout.readline())
        return subprocess.CompletedProcess(argv, status, out.read_text(), err.read_text())

    def close(self) -> None:
        """End the warm interpreter."""
        assert self._child.stdin and self._child.stdout
        self._child.stdin.close()
        self._child.wait(timeout=30)
        self._child.stdout.close()
        self._folder.cleanup()


def _serve() -> None:
    import importlib

    for name in PRELOADED:
        importlib.import_module(name)
    answers = os.fdopen(os.dup(1), "w")
    requests = os.fdopen(os.dup(0), "r")
    for line in requests:
        request = json.loads(line)
        child = os.fork()
        if child == 0:
            os.close(requests.fileno())
            os.close(answers.fileno())
            _run(request)
        print(_ended(child), file=answers, flush=True)


def _ended(child: int) -> int:
    """The exit status of a child, which is killed where it hangs."""
    limit = time.monotonic() + LIMIT_S
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > limit:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.005)


def _run(request: dict[str, Any]) -> None:
    """Becomes the command line of a request; does not return."""
    os.environ.clear()
    os.environ.update(request["env"])
    os.chdir(request["cwd"])
    for descriptor, path, flags in (
        (0, os.devnull, os.O_RDONLY),
        (1, request["out"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
        (2, request["err"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
    ):
        opened = os.open(path, flags, 0o600)
        os.dup2(opened, descriptor)
        os.close(opened)
    sys.argv = ["tagid", *request["argv"]]
    status = 1
    try:
        from tagid.cli.app import main

        main()
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


if __name__ == "__main__":
    _serve()
