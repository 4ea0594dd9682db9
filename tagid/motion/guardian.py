"""A helper process that stops the robot where its driver dies: kill -9 runs no handler, but it closes pipes.

It shares the driver's open port and does nothing until the pipe to it breaks without a farewell.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from typing import Final

_FAREWELL: Final = b"x"
# Plain Python without the package, so that it stands after some 20 ms.
_PROGRAM: Final = """
import os, signal, sys, time
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_IGN)
port, halt = int(sys.argv[1]), bytes.fromhex(sys.argv[2])
os.write(1, b"r")
if os.read(0, 1) != b"x":
    for pause in (0, 0.03, 0.12):
        time.sleep(pause)
        os.write(port, halt)
"""


class Guardian:
    """Watches over this process from now until `release`.

    Args:
        port: file descriptor of the open port.
        halt: bytes that stop the robot; written three times, because the first may complete a cut command.
    """

    def __init__(self, port: int, halt: bytes) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        if os.name != "posix":
            return
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _PROGRAM, str(port), halt.hex()],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(port,),
            start_new_session=True,
        )
        assert self._process.stdout is not None
        self._process.stdout.read(1)  # it stands; only now may something move

    def release(self, farewell: bool = True) -> None:
        """All is still: nothing is left to do; without a farewell it stops the robot first."""
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None and process.stdout is not None
        with contextlib.suppress(OSError):
            process.stdin.write(_FAREWELL * farewell)
            process.stdin.close()
        process.stdout.close()
        try:
            process.wait(timeout=2)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
