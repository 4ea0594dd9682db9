"""Runs a virtual bridge in its own process and communicates with it; for emulators and tests.

Two processes, because a hanging firmware or a killed host must not affect the other.
"""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, Self

from tagid import processes
from tagid.errors import DeviceTimeoutError
from tagid.workers import Worker


class BoardProcess:
    """One virtual bridge; use it as a context manager.

    Args:
        config: the configuration file's keys, or None for an unprovisioned bridge.
        uart: path of the robot's tty, or "loop".
        options: further command line arguments, see `python -m firmware_tools.virtual --help`.
        timeout: timeout for its start and each answer, s.

    Raises DeviceTimeoutError if it does not start.
    """

    def __init__(
        self, config: Mapping[str, Any] | None, uart: str = "loop", *options: str, timeout: float = 30.0
    ) -> None:
        self._config, self._uart, self._options, self._timeout = config, uart, options, timeout
        self._lines: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.changes: list[dict[str, Any]] = []
        """Reports other than answers: pins and the watchdog."""
        self.hci = ""
        """Address at which a host finds its controller, a bumble transport."""
        self.address = ""

    def __enter__(self) -> Self:
        self._folder = tempfile.TemporaryDirectory(prefix="tagid-bridge-")
        words = ["--uart", self._uart, *self._options]
        if self._config is not None:
            path = Path(self._folder.name) / "config.json"
            path.write_text(json.dumps(dict(self._config)), encoding="utf-8")
            words += ["--config", str(path)]
        self.process: subprocess.Popen[str] = processes.start(
            "firmware_tools.virtual",
            *words,
            attached=False,
            stdout=subprocess.PIPE,
            text=True,
            cwd=self._folder.name,
        )
        lines = self.process.stdout
        assert lines is not None
        Worker(lambda: self._read(lines), "board", lambda error: self._lines.put(None)).start()
        try:
            ready = self.wait_for("ready")
        except BaseException:
            self.__exit__()
            raise
        self.hci, self.address = ready["hci"], ready["address"]
        if "--reboot" not in self._options:
            self._folder.cleanup()  # the board has copied its configuration; a killed host leaves nothing
        return self

    def __exit__(self, *error: object) -> None:
        assert self.process.stdin is not None and self.process.stdout is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        try:
            self.process.wait(self._timeout)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.process.stdout.close()
        if self._folder is not None:
            self._folder.cleanup()

    def _read(self, stream: IO[str]) -> None:
        try:
            for line in stream:
                self._lines.put(json.loads(line))
        except ValueError:  # closed during the read
            pass
        self._lines.put(None)

    def wait_for(self, key: str) -> dict[str, Any]:
        """The next report that has `key`, e.g. "pin" or "watchdog"."""
        until = time.monotonic() + self._timeout
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, until - time.monotonic()))
            except queue.Empty:
                raise DeviceTimeoutError("the virtual bridge does not answer", "Check its output.") from None
            if line is None:
                raise DeviceTimeoutError("the virtual bridge has ended", "Check its output.")
            if key in line:
                return line
            self.changes.append(line)

    def command(self, text: str) -> int:
        """Execute a command (cut, drop, index, stall MS); return its time on this machine's clock, us."""
        assert self.process.stdin is not None
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()
        return int(self.wait_for("done")["us"])
