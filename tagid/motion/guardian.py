"""A helper process that stops a device when its driver dies, hangs or is suspended, or on request.

The driver sends heartbeats. A missed heartbeat (kill -9, SIGSTOP, Ctrl-Z, a computer that slept), a broken
pipe, and `tagid motion stop` from another process all have the same effect: the helper writes the halt bytes
to the shared port, or starts the command that stops the device. It answers every heartbeat, so that the
driver in turn notices a dead guardian. Where the system has systemd it runs in a cgroup of its own.

`motion stop` finds the guardian by the names of its abstract sockets, which no environment variable changes;
both sides ask the kernel for the other's user. `guard` is the program that runs in the helper process.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import secrets
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Final

from tagid import processes
from tagid.errors import DeviceError
from tagid.motion import guard
from tagid.motion.device import MotionStoppedError, PausedError
from tagid.motion.guard import Watch
from tagid.ports import holders
from tagid.workers import Worker

_START_S: Final = 5.0
_DEAF_S: Final = 1.0
"""A guardian that answers no heartbeat for this time is considered dead."""
_SCOPE_S: Final = 2.0
"""Longest wait for systemd to start the guardian in a cgroup of its own; then it starts without one."""
_ASK_S: Final = 3.0
_AGAIN_S: Final = 0.01
_COMMAND_S: Final = guard.OWNER_S + guard.COMMAND_S + 5.0
_SOCKETS: Final = Path("/proc/net/unix")
_FAREWELL: Final = b"x"
_BEAT: Final = b"."
_TRIPPED, _ASKED = b"t", b"a"


class Guardian:
    """Monitors this process from now until `release`.

    Raises DeviceError if the helper does not start; then the device must not move.
    """

    def __init__(self, watch: Watch) -> None:
        self._watch = watch
        stops = watch.port >= 0 or bool(watch.command)
        self._process = (_start(watch, scope=True) if stops else None) or _start(watch, scope=False)
        if self._process is None:
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
                f"{self._watch.name} was stopped by another process", "`tagid motion stop` requested it."
            )
        if _TRIPPED in marks:
            raise PausedError(
                f"this program was paused for more than {self._watch.limit_s:g} s and {self._watch.name} was "
                "stopped; its angle is lost from then on",
                "Record again; keep this computer awake and less busy.",
            )
        now = time.monotonic()
        if marks:
            self._heard = now
        if process.poll() is not None or now - self._heard > max(_DEAF_S, self._watch.limit_s):
            raise DeviceError(
                f"the helper process that monitors {self._watch.name} has ended, so the motion was stopped",
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
            if self._watch.command and not farewell:
                # It waits for the command that stops the device, and tells how that ended.
                with contextlib.suppress(RuntimeError):
                    Worker(partial(_reap, process), "guardian").start()
                return
            process.kill()
            process.wait()


def _reap(process: subprocess.Popen[bytes]) -> None:
    process.wait()


def _start(watch: Watch, scope: bool) -> subprocess.Popen[bytes] | None:
    """The guardian's process once it watches; None if it does not start in time."""
    errors = -1
    with contextlib.suppress(OSError):  # standard error may be closed
        errors = os.dup(2)
    names = {_socket_name(name) for name in (watch.name, *watch.aliases) if name}
    linux = sys.platform.startswith("linux")
    sockets = [f"{name}-{secrets.token_hex(8)}" for name in names] if linux else []
    watch = watch._replace(sockets=sockets, errors=errors)
    try:
        process = processes.start_alone(
            Path(guard.__file__),
            scope=scope,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            pass_fds=[number for number in (watch.port, errors) if number >= 0],
        )
    except OSError as error:
        raise DeviceError(
            f"the helper process that stops the motion in an emergency does not start ({error})",
            "Nothing was moved. Free memory and processes, then try again.",
        ) from error
    finally:
        if errors >= 0:
            os.close(errors)
    if process is None:
        return None
    assert process.stdin is not None and process.stdout is not None and process.stderr is not None
    os.set_blocking(process.stdin.fileno(), False)
    with contextlib.suppress(OSError):
        os.write(process.stdin.fileno(), json.dumps(watch._asdict()).encode() + b"\n")
    ready, _, _ = select.select([process.stdout], [], [], _SCOPE_S if scope else _START_S)
    if ready and os.read(process.stdout.fileno(), 1) == b"r":
        process.stderr.close()  # it writes to this process's own
        return process
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    # Something that it started may still hold the pipe.
    os.set_blocking(process.stderr.fileno(), False)
    logging.getLogger("tagid").debug("no guardian, scope=%s: %r", scope, process.stderr.read(1000))
    for pipe in (process.stdin, process.stdout, process.stderr):
        pipe.close()
    return None


def _socket_name(name: str) -> str:
    """The common part of the names of a device's guardians; the same for a port and for links to it."""
    real = os.path.realpath(name) if name.startswith("/") else name.lower()
    return f"tagid-stop-{hashlib.sha256(real.encode()).hexdigest()[:16]}"


def _guardians(name: str) -> Iterator[str]:
    """Names of the sockets of all guardians of a device, and of whoever pretends to be one."""
    mark = f"@{_socket_name(name)}-"
    # Any user may give a socket any name: with spaces, line ends and bytes that are not text.
    for line in _SOCKETS.read_text(errors="replace").split("\n"):
        address = line.rpartition(" ")[2]
        if address.startswith(mark):
            yield address


def ask_to_stop(name: str) -> bool:
    """Ask the guardians of other processes to stop a device; False if none confirms, or whatever fails.

    A guardian of this user is believed; root believes those of all users that hold the device's port.
    """
    try:
        confirmed = [_confirms(line) for line in _connected(name)]
        return any(confirmed)
    except Exception:
        # The caller must still come to stop the device directly.
        logging.getLogger("tagid").debug("asking the guardians of %s", name, exc_info=True)
        return False


def _connected(name: str) -> list[socket.socket]:
    """Connections to all guardians that are to be believed; each connection is a request to stop."""
    lines: list[socket.socket] = []
    holding: set[int] | None = None
    until, pending = time.monotonic() + _ASK_S, list(_guardians(name))
    while pending:
        address = pending.pop(0)
        with contextlib.ExitStack() as unless_trusted, contextlib.suppress(OSError):
            line = unless_trusted.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            line.setblocking(False)
            try:
                line.connect("\0" + address[1:])
            except BlockingIOError:  # others wait for it as well
                if time.monotonic() < until:
                    pending.append(address)
                    time.sleep(_AGAIN_S)
                continue
            pid, uid = guard.peer(line)
            if uid != os.getuid() and os.getuid() == 0 and holding is None:
                holding = {holder.pid for holder in holders(name)}
            if uid == os.getuid() or pid in (holding or ()):
                unless_trusted.pop_all()
                lines.append(line)
    return lines


def _confirms(line: socket.socket) -> bool:
    answer = b""
    with line, contextlib.suppress(OSError):
        line.settimeout(_ASK_S)
        while piece := line.recv(64):
            answer += piece
            line.settimeout(_COMMAND_S)  # a command is running
    return answer.endswith(b"stopped")
