"""A helper process that stops a device when its driver dies, hangs or is suspended, or on request.

The driver sends heartbeats. A missed heartbeat (kill -9, SIGSTOP, Ctrl-Z, a computer that slept), a broken
pipe, and `tagid motion stop` from another process all have the same effect: the helper writes the halt bytes
to the shared port, or starts the command that stops the device. It answers every heartbeat, so that the
driver in turn notices a dead guardian.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import select
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tagid.errors import DeviceError
from tagid.motion.device import MotionStoppedError, PausedError

PAUSES_S: Final = (0.0, 0.03, 0.12)
"""Pauses before the three stops: the first may complete a truncated command."""
_START_S: Final = 5.0
_DEAF_S: Final = 1.0
"""A guardian that answers no heartbeat for this time is considered dead."""
_ASK_S: Final = 3.0
_FAREWELL: Final = b"x"
_BEAT: Final = b"."
_ECHO, _TRIPPED, _ASKED = b"e", b"t", b"a"

# Plain Python without the package, so that it starts in about 20 ms. CLOCK_BOOTTIME continues while the
# computer sleeps. Only processes of the same user can reach the socket: its folder is closed to all others.
_PROGRAM: Final = """
import os, select, signal, socket, subprocess, sys, time
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP, signal.SIGPIPE):
    signal.signal(number, signal.SIG_IGN)
port, halt, limit, path = int(sys.argv[1]), bytes.fromhex(sys.argv[2]), float(sys.argv[3]), sys.argv[4]
pauses, command = [float(pause) for pause in sys.argv[5].split(",")], sys.argv[6:]
clock = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
now = lambda: time.clock_gettime(clock)
server = None
if path:
    try:
        os.unlink(path)
    except OSError:
        pass
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    server.bind(path)
    server.listen(4)

def tell(mark):
    try:
        os.write(1, mark)
    except OSError:
        pass

def stop():
    for pause in pauses:
        time.sleep(pause)
        if port >= 0:
            try:
                os.write(port, halt)
            except OSError:
                pass
    if command:
        null = subprocess.DEVNULL
        subprocess.Popen(command, stdin=null, stdout=null, stderr=null, start_new_session=True)

tell(b"r")
heard, tripped, ended = now(), False, False
while not ended:
    wait = max(0.0, heard + limit - now()) if not tripped else 3600.0
    ready = select.select([0] + ([server] if server else []), [], [], wait)[0]
    asked = None
    if server in ready:
        asked = server.accept()[0]
    if 0 in ready:
        data = os.read(0, 4096)
        if b"x" in data:
            break
        ended = not data
        if data and now() - heard <= limit:
            heard = now()
            tell(b"e")
    late = not tripped and now() - heard > limit
    if asked or ended or late:
        # Told first: the driver must not take the device's answer to the halt bytes for an error of its own.
        tell(b"a" if asked else b"t")
        if not tripped or asked:
            stop()
        tripped = True
    if asked:
        try:
            asked.sendall(b"stopped")
        except OSError:
            pass
        asked.close()
if path:
    try:
        os.unlink(path)
    except OSError:
        pass
"""


@dataclass(frozen=True)
class Watch:
    """Parameters of a guardian.

    Attributes:
        name: of the device (port or address), under which `ask_to_stop` finds the guardian.
        limit_s: longest time between two heartbeats, s.
        port: file descriptor of the open port, which the guardian shares; -1 for none.
        halt: bytes that stop the device, written three times.
        command: words of a command that stops the device if there is no port to share; () for none.
    """

    name: str
    limit_s: float
    port: int = -1
    halt: bytes = b""
    command: Sequence[str] = ()


class Guardian:
    """Monitors this process from now until `release`.

    Raises DeviceError if the helper does not start; then the device must not move.
    """

    def __init__(self, watch: Watch) -> None:
        self._name = watch.name
        self._limit_s = watch.limit_s
        self._process: subprocess.Popen[bytes] | None = None
        if os.name != "posix":
            return
        path = stop_socket(watch.name)
        self._process = subprocess.Popen(
            [
                sys.executable, "-I", "-S", "-c", _PROGRAM, str(watch.port), watch.halt.hex(),
                str(watch.limit_s), str(path or ""), ",".join(map(str, PAUSES_S)), *watch.command,
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            pass_fds=(watch.port,) if watch.port >= 0 else (),
            start_new_session=True,
        )  # fmt: skip
        assert self._process.stdin is not None and self._process.stdout is not None
        os.set_blocking(self._process.stdin.fileno(), False)
        ready, _, _ = select.select([self._process.stdout], [], [], _START_S)
        if not ready or os.read(self._process.stdout.fileno(), 1) != b"r":
            self._process.kill()
            self.release()
            raise DeviceError(
                "the helper process that stops the motion in an emergency does not start",
                "Nothing was moved. Free memory and processes, then try again.",
            )
        self._heard = time.monotonic()
        self.beat()

    def beat(self) -> None:
        """Send a heartbeat; call it several times within the limit.

        Raises:
            PausedError: heartbeats were missed and the guardian has stopped the device.
            MotionStoppedError: another process requested a stop. DeviceError: the guardian is dead.
        """
        process = self._process
        if process is None:
            return
        assert process.stdin is not None and process.stdout is not None
        marks = b""
        with contextlib.suppress(OSError):
            while select.select([process.stdout], [], [], 0)[0]:
                piece = os.read(process.stdout.fileno(), 4096)
                marks += piece
                if not piece:
                    break
        if _ASKED in marks:
            raise MotionStoppedError(
                f"{self._name} was stopped by another process", "`tagid motion stop` requested it."
            )
        if _TRIPPED in marks:
            raise PausedError(
                f"this program was paused for more than {self._limit_s:g} s and {self._name} was stopped; "
                "its angle is lost from then on",
                "Record again; keep this computer awake and less busy.",
            )
        now = time.monotonic()
        if marks:
            self._heard = now
        if process.poll() is not None or now - self._heard > max(_DEAF_S, self._limit_s):
            raise DeviceError(
                f"the helper process that monitors {self._name} has ended, so the motion was stopped",
                "Record again; do not end processes of tagid while it drives.",
            )
        with contextlib.suppress(OSError):
            os.write(process.stdin.fileno(), _BEAT)

    def release(self, farewell: bool = True) -> None:
        """End the guardian after a stop; without a farewell message it stops the device first."""
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None and process.stdout is not None
        with contextlib.suppress(OSError):
            if farewell:
                os.write(process.stdin.fileno(), _FAREWELL)
        with contextlib.suppress(OSError):
            process.stdin.close()
        process.stdout.close()
        try:
            process.wait(timeout=2)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class Guarded:
    """The guardian of a link: None until the link is armed, and after its release."""

    def __init__(self) -> None:
        self._guardian: Guardian | None = None

    def start(self, watch: Watch) -> None:
        """Start the guardian unless it is running. Raises DeviceError if it does not start."""
        if self._guardian is None:
            self._guardian = Guardian(watch)

    def beat(self) -> None:
        """Send a heartbeat to the guardian; raises the errors of `Guardian.beat`."""
        if self._guardian is not None:
            self._guardian.beat()

    def release(self, farewell: bool = True) -> None:
        """End the guardian; without a farewell message it stops the device first."""
        guardian, self._guardian = self._guardian, None
        if guardian is not None:
            guardian.release(farewell)


def runtime_folder() -> Path | None:
    """A folder that only this user can enter, created if missing; None if no safe folder is available."""
    if os.name != "posix":
        return None
    base = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(base) / "tagid" if base else Path(tempfile.gettempdir()) / f"tagid-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return None
    private = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077
    return folder if private else None


def stop_socket(name: str) -> Path | None:
    """The guardian's socket for a device; the same for a port and for links to it."""
    folder = runtime_folder()
    if folder is None:
        return None
    real = os.path.realpath(name) if name.startswith("/") else name.lower()
    return folder / f"stop-{hashlib.sha256(real.encode()).hexdigest()[:16]}"


def ask_to_stop(name: str) -> bool:
    """Ask the guardian of another process to stop a device; False if no guardian monitors it."""
    path = stop_socket(name)
    if path is None or not path.exists():
        return False
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
            line.settimeout(_ASK_S)
            line.connect(str(path))
            return line.recv(16) == b"stopped"
    except OSError:
        return False
