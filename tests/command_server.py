"""Runs `tagid` commands in processes of their own without their imports.

Imports are nine tenths of the second that a short command takes, and the tests run hundreds of commands. A
server that has imported tagid forks for each one; the child takes the folder, environment and files that
it is given and runs `python -m tagid` as a fresh interpreter does. Tests of the start itself, of late
imports and of signals start an interpreter.

The server is this file as a script: it takes connections on the Unix socket whose descriptor is its first
argument, remembers results in the folder that is its second, and ends with its standard input.
"""

from __future__ import annotations

import json
import os
import pkgutil
import runpy
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

IMPORTS = (
    "tagid.cli.app", "tagid.operate.workplace", "tagid.pipeline.reconstruct", "tagid.reading.reader",
    "tagid.report.table", "tagid.simulate", "tagid.storage.exporters", "tagid.storage.history",
    "PIL.Image", "importlib.metadata", "numpy.fft", "numpy.ma", "numpy.random", "pydantic.plugin._loader",
    "rich.console", "rich.progress", "rich.table", "sqlite3", "tomli_w", "tomllib", "typer._adapters",
)  # fmt: skip
"""What most commands import. None of it starts a thread, or reads what a test changes in the environment."""
LIMIT_S = 300.0


@dataclass
class Ran:
    """An ended command."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        return json.loads(self.out)


class CommandServer:
    """Client side; use as a context manager around the tests of one process."""

    def __init__(self, folder: Path, environment: dict[str, str], remembered: Path) -> None:
        self._address = str(folder / "socket")
        self._environment = environment
        self._remembered = remembered
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> CommandServer:
        return self

    def __exit__(self, *error: object) -> None:
        if self._process is not None:
            assert self._process.stdin is not None
            self._process.stdin.close()
            self._process.wait()

    def run(self, words: list[str], folder: Path, environment: dict[str, str]) -> Ran:
        """`python -m tagid WORDS` in a folder, with this environment; killed after `LIMIT_S`."""
        self._start()
        request = {"words": words, "folder": str(folder), "environment": environment}
        with (
            socket.socket(socket.AF_UNIX) as connection,
            tempfile.TemporaryFile() as out,
            tempfile.TemporaryFile() as err,
        ):
            connection.settimeout(LIMIT_S)
            connection.connect(self._address)
            socket.send_fds(connection, [b"\n"], [out.fileno(), err.fileno()])
            connection.sendall(json.dumps(request).encode())
            connection.shutdown(socket.SHUT_WR)
            answer = connection.makefile("r")
            child = int(answer.readline())
            try:
                code = int(answer.readline())
            except TimeoutError:
                os.kill(child, signal.SIGKILL)
                raise subprocess.TimeoutExpired(words, LIMIT_S) from None
            texts = []
            for file in (out, err):
                file.seek(0)
                texts.append(file.read().decode().replace("\r\n", "\n"))
        return Ran(code, *texts)

    def _start(self) -> None:
        if self._process is not None:
            return
        with socket.socket(socket.AF_UNIX) as listening:
            listening.bind(self._address)
            listening.listen(8)
            self._process = subprocess.Popen(
                [sys.executable, __file__, str(listening.fileno()), str(self._remembered)],
                stdin=subprocess.PIPE,
                env=self._environment,
                pass_fds=[listening.fileno()],
            )


def _serve(listening: socket.socket) -> list[str]:
    """Handle connections for ever; returns the words of a command in each process that is to run one."""
    with selectors.DefaultSelector() as ready:
        ready.register(listening, selectors.EVENT_READ)
        ready.register(0, selectors.EVENT_READ)
        while True:
            if any(key.fd == 0 for key, _ in ready.select()):
                sys.exit()
            connection, _ = listening.accept()
            # A process between the two waits for the command; nobody waits for it.
            between = os.fork()
            if between == 0:
                break
            connection.close()
            os.waitpid(between, 0)
    if os.fork():
        os._exit(0)
    listening.close()
    return _handle(connection)


def _handle(connection: socket.socket) -> list[str]:
    _, descriptors, _, _ = socket.recv_fds(connection, 1, 2)
    with connection.makefile("r") as stream:
        request = json.load(stream)
    child = os.fork()
    if child:
        connection.sendall(f"{child}\n".encode())
        status = os.waitpid(child, 0)[1]
        connection.sendall(f"{os.waitstatus_to_exitcode(status)}\n".encode())
        os._exit(0)
    connection.close()
    silent = os.open(os.devnull, os.O_RDONLY)
    for source, target in zip((silent, *descriptors), (0, 1, 2), strict=True):
        os.dup2(source, target)
        os.close(source)
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    return [str(word) for word in request["words"]]


def main() -> None:
    listening = socket.socket(fileno=int(sys.argv[1]))
    for name in IMPORTS:
        with suppress(ImportError):  # those of other packages are theirs to change
            import_module(name)
    for command in pkgutil.iter_modules(import_module("tagid.cli").__path__, "tagid.cli."):
        import_module(command.name)
    import_module("remembered").remember(Path(sys.argv[2]))
    words = _serve(listening)
    # As `python -m tagid` has it: the current folder, not this file's, is where modules are found first.
    sys.path[0] = ""
    sys.argv = ["tagid", *words]
    runpy.run_module("tagid", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
