"""The guardian's program: plain Python without the package, so that it starts in about 20 ms.

`tagid.motion.guardian` starts it and writes its parameters as one line of JSON to its standard input, where
other users cannot read them, and then heartbeats. It answers on standard output, one byte for each event.
"""

import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

BOOT_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
"""It continues while the computer sleeps."""
OWNER_S = 1.0
"""Time that a driver has to stop the device by itself on request, before the command is started."""
COMMAND_S = 120.0
PAUSES_S = (0.0, 0.03, 0.12)
"""Pauses before the three stops: the first may complete a truncated command."""
LOOK_S = 0.1
REMEDY = "It may still be turning: switch it off."
LOG_WARNING = 12
"""A user's message (8) that is a warning (4)."""


def now() -> float:
    return time.clock_gettime(BOOT_CLOCK)


def tell(mark: bytes) -> None:
    with suppress(OSError):
        os.write(1, mark)


def say(text: str) -> None:
    """Tell the user: on the driver's standard error, which may be closed by now, and in the system's log.

    Neither may hold the guardian up: a terminal that the user has stopped takes no more.
    """
    with suppress(OSError, ValueError):
        if select.select([], [2], [], LOOK_S)[1]:
            os.write(2, f"tagid: {text}\n".encode())
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as log:
        log.setblocking(False)
        log.sendto(f"<{LOG_WARNING}>tagid: {text}".encode(), "/dev/log")


def peer(line: socket.socket) -> tuple[int, int]:
    """Process and user at the other end of a socket, as the kernel reports them."""
    credentials = line.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    pid, uid, _ = struct.unpack("3i", credentials)
    return pid, uid


class Watch(NamedTuple):
    """Parameters of a guardian; it gets them as JSON.

    Attributes:
        name: of the device (port or address) in messages.
        limit_s: longest time between two heartbeats, s.
        port: file descriptor of the open port, which the guardian shares; -1 for none.
        halt: bytes that stop the device, hexadecimal; written three times.
        command: words of a command that stops the device if there is no port to share; () for none.
        command_input: its standard input, which no other user can read.
        aliases: all other names under which `ask_to_stop` finds the guardian.
        sockets: names of the abstract sockets on which a stop is requested.
        errors: file descriptor of the driver's standard error; -1 for none.
    """

    name: str
    limit_s: float
    port: int = -1
    halt: str = ""
    command: Sequence[str] = ()
    command_input: str = ""
    aliases: Sequence[str] = ()
    sockets: Sequence[str] = ()
    errors: int = -1


class Guard:
    def __init__(self, watch: Watch) -> None:
        self.watch = watch
        self.servers: list[socket.socket] = []
        for name in watch.sockets:
            server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            server.bind("\0" + name)
            server.listen(16)
            server.setblocking(False)
            self.servers.append(server)
        self.askers: list[socket.socket] = []
        self.command: subprocess.Popen[bytes] | None = None
        self.command_at: float | None = None
        self.command_until = 0.0

    def run(self) -> None:
        """Watch until the driver says farewell, or has ended and the device is stopped."""
        tell(b"r")
        limit = self.watch.limit_s
        heard, tripped, ended = now(), False, False
        while not ended or self.command is not None or self.command_at is not None:
            wait = 3600.0 if tripped else max(0.0, heard + limit - now())
            if self.command is not None or self.command_at is not None:
                wait = min(wait, LOOK_S)
            inputs: list[Any] = ([] if ended else [0]) + self.servers
            ready = select.select(inputs, [], [], wait)[0]
            asked = any(self.accept(server) for server in self.servers if server in ready)
            gone = False
            if 0 in ready:
                data = os.read(0, 4096)
                if b"x" in data:
                    self.answer(b"stopped")
                    break
                ended = gone = not data
                if data and now() - heard <= limit:
                    heard = now()
                    tell(b"e")
            late = not tripped and not ended and now() - heard > limit
            if asked or gone or late:
                # Before the halt: the driver must not take the device's answer to its bytes for an error.
                tell(b"a" if asked else b"t")
                self.stop(OWNER_S if asked and not ended else 0.0)
                tripped = True
                if gone:
                    say(f"{self.watch.name}: its program ended without a stop; its guardian stops it")
            self.look_after_command()
        self.end_command()

    def accept(self, server: socket.socket) -> bool:
        """Take a request to stop from this user or root; any other is closed unheard."""
        try:
            line = server.accept()[0]
        except OSError:
            return False
        if peer(line)[1] not in (os.getuid(), 0):
            line.close()
            return False
        self.askers.append(line)
        return True

    def answer(self, text: bytes) -> None:
        while self.askers:
            with self.askers.pop() as line, suppress(OSError):
                line.sendall(text)

    def stop(self, owner_s: float) -> None:
        """Write the halt bytes three times, or start the command after `owner_s`."""
        failure: OSError | None = None
        for pause in PAUSES_S:
            time.sleep(pause)
            if self.watch.port >= 0:
                try:
                    os.write(self.watch.port, bytes.fromhex(self.watch.halt))
                    failure = None
                except OSError as error:
                    failure = error
        if failure is not None:
            self.answer(b"failed")
            say(f"cannot stop {self.watch.name} ({failure}). {REMEDY}")
        if not self.watch.command:
            self.answer(b"stopped")
        elif self.command is None and self.command_at is None:
            self.command_at = now() + owner_s
        for line in self.askers:
            with suppress(OSError):
                line.sendall(b"wait ")

    def look_after_command(self) -> None:
        """Start the command when it is due, and report how it ended."""
        if self.command_at is not None and now() >= self.command_at:
            self.command_at, self.command_until = None, now() + COMMAND_S
            try:
                self.command = subprocess.Popen(
                    self.watch.command, stdin=subprocess.PIPE, stdout=2, start_new_session=True
                )
            except OSError as error:
                say(f"the command that stops {self.watch.name} does not start ({error})")
                self.report(1)
                return
            assert self.command.stdin is not None
            with suppress(OSError), self.command.stdin as line:
                line.write(self.watch.command_input.encode())
        if self.command is not None:
            code = self.command.poll()
            if code is not None:
                self.report(code)
            elif now() > self.command_until:
                self.command.kill()
                self.report(self.command.wait())

    def report(self, code: int) -> None:
        self.command = None
        self.answer(b"failed" if code else b"stopped")
        if code:
            say(f"{self.watch.name} could not be stopped. {REMEDY}")

    def end_command(self) -> None:
        """The driver has stopped the device: the command must not interfere with what follows."""
        if self.command is not None:
            self.command.kill()
            self.command.wait()


def main() -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP, signal.SIGPIPE):
        signal.signal(number, signal.SIG_IGN)
    text = b""
    while not text.endswith(b"\n"):
        data = os.read(0, 65536)
        if not data:
            sys.exit(1)
        text += data
    watch = Watch(**json.loads(text))
    if watch.errors >= 0:
        os.dup2(watch.errors, 2)
        os.close(watch.errors)
    Guard(watch).run()


if __name__ == "__main__":
    main()
