"""A board that runs MicroPython, accessed with mpremote's transport over its USB port."""

from __future__ import annotations

import contextlib
import hashlib
import io
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

from firmware_tools.build import EXTRA, MPY_VERSION
from tagid.errors import DeviceError, DeviceGoneError, DeviceRejectedError, MissingExtraError
from tagid.ports import open_port

_BAUD: Final = 115200
_READ_S: Final = 1.0
_LISTEN_S: Final = 1.0
_OLDEST: Final = (1, 22)
"""First MicroPython on ESP-IDF 5, whose watchdog timeout can be extended after it was started."""
_ROM: Final = re.compile(rb"invalid header|flash read err|ets_main\.c|No bootable app|csum err|rst:0x")
_LISTS: Final = "`tagid-firmware verify` without --port lists the ports"


@dataclass(frozen=True)
class Python:
    """Version information of the board's MicroPython."""

    version: str
    machine: str
    mpy: int
    free_bytes: int


class Board:
    """A board in its raw prompt; the program that ran there is stopped. Use `open_board`."""

    def __init__(self, transport: Any, port: str) -> None:
        self._transport = transport
        self.port = port

    def python(self) -> Python:
        """Version and kind. Raises DeviceRejectedError if it is too old for the bridge."""
        version, machine, mpy, free = self.evaluate(
            "(lambda s,g:('.'.join(str(i) for i in s.implementation[1][:3]),"
            "getattr(s.implementation,'_machine',s.platform),getattr(s.implementation,'_mpy',0),g.mem_free()))"
            "(__import__('sys'),__import__('gc'))"
        )
        python = Python(str(version), str(machine), int(mpy), int(free))
        numbers = tuple(int(part) for part in re.findall(r"\d+", python.version)[:2])
        if numbers < _OLDEST or python.mpy & 0xFF != MPY_VERSION:
            raise DeviceRejectedError(
                f"the board on {self.port} runs MicroPython {python.version} (bytecode {python.mpy & 0xFF}), "
                f"too old for the bridge: it needs {_OLDEST[0]}.{_OLDEST[1]} (bytecode {MPY_VERSION})",
                "Flash a newer image: `tagid-firmware flash IMAGE`.",
            )
        return python

    def evaluate(self, expression: str) -> Any:
        """Evaluate an expression on the board. Raises DeviceError."""
        with self._errors("asking"):
            return self._transport.eval(expression)

    def run(self, code: str) -> None:
        """Run statements on the board. Raises DeviceError."""
        with self._errors("running a command"):
            self._transport.exec(code)

    def _exists(self, path: str) -> bool:
        code = f"import os\ntry:\n os.stat({path!r})\n there=1\nexcept OSError:\n there=0"
        self._transport.exec(code)
        return bool(self._transport.eval("there"))

    def hash_of(self, path: str) -> str | None:
        """SHA-256 of a file on the board, hex; None if there is none."""
        with self._errors(f"reading {path}"):
            if not self._exists(path):
                return None
            return bytes(self._transport.fs_hashfile(path, "sha256")).hex()

    def read(self, path: str) -> bytes | None:
        """Content of a small file on the board; None if there is none."""
        with self._errors(f"reading {path}"):
            if not self._exists(path):
                return None
            return bytes(self._transport.fs_readfile(path))

    def write(self, path: str, data: bytes, progress: Callable[[int], None] = lambda done: None) -> None:
        """Write a file atomically: to a temporary name, checked by its hash, then renamed.

        Raises DeviceError if it cannot be written or reads back differently.
        """
        folder = path.rpartition("/")[0]
        with self._errors(f"writing {path}"):
            if folder and not self._exists(folder):
                self._transport.fs_mkdir(folder)
            beside = path + ".new"
            self._transport.fs_writefile(beside, data, progress_callback=lambda done, total: progress(done))
            if bytes(self._transport.fs_hashfile(beside, "sha256")) != hashlib.sha256(data).digest():
                raise DeviceError(
                    f"{path} reads back from {self.port} differently than written",
                    "Run this again; if this persists, the board's flash is worn: use another board.",
                )
            # FAT does not rename over a file.
            self.remove(path)
            self._transport.exec(f"os.rename({beside!r},{path!r})")

    def remove(self, path: str) -> None:
        """Remove a file if it exists."""
        self.run(f"import os\ntry:\n os.remove({path!r})\nexcept OSError:\n pass")

    def restart(self) -> None:
        """Reset the board, so that it starts the new files."""
        with contextlib.suppress(Exception):
            self._transport.exec_raw_no_follow("import machine\nmachine.reset()")
            time.sleep(0.1)

    @contextmanager
    def _errors(self, doing: str) -> Iterator[None]:
        from mpremote.transport import TransportError

        try:
            with contextlib.redirect_stdout(io.StringIO()):
                yield
        except TransportError as error:
            text = str(error).strip().rpartition("\n")[2] or "no answer"
            raise DeviceError(
                f"the board on {self.port} failed while {doing}: {text}",
                "Run this again; the previous files on the board are unchanged.",
            ) from error
        except OSError as error:
            raise DeviceGoneError(
                f"the board on {self.port} disappeared while {doing}: {error}",
                "Plug it in and run this again; the previous files on the board are unchanged.",
            ) from error


@contextmanager
def open_board(port: str, timeout: float = 10.0) -> Iterator[Board]:
    """A board on a port, with its program stopped and its prompt active.

    Raises:
        MissingExtraError: mpremote is not installed.
        PortInUseError, DeviceGoneError, DeviceError: the port.
        DeviceError: no MicroPython found; the message identifies an empty or incomplete flash.
    """
    try:
        from mpremote.transport import TransportError
        from mpremote.transport_serial import SerialTransport
    except ImportError as error:
        raise MissingExtraError("talking to a board needs mpremote", EXTRA) from error
    open_port(port, _BAUD, 1.0, _LISTS).close()
    said, heard = io.StringIO(), b""
    transport = None
    try:
        with contextlib.redirect_stdout(said):
            transport = SerialTransport(port, _BAUD, timeout=_READ_S)
            # On a pty mpremote would wait forever for a board that never stops sending.
            transport.is_pty = False
            heard = _listen(transport)
            if _ROM.search(heard):
                raise TransportError("the loader speaks")
            transport.enter_raw_repl(timeout_overall=timeout)
    except (TransportError, OSError) as error:
        heard += said.getvalue().encode("latin-1", "replace")
        if transport is not None:
            with contextlib.suppress(Exception):
                transport.close()
        raise _no_prompt(port, heard) from error
    try:
        yield Board(transport, port)
    finally:
        with contextlib.suppress(Exception):
            transport.exit_raw_repl()
        with contextlib.suppress(Exception):
            transport.close()


def _listen(transport: Any) -> bytes:
    """Output of the board without a request: a chip without a program repeats its error message forever."""
    data = b""
    end = time.monotonic() + _LISTEN_S
    quiet = time.monotonic() + _LISTEN_S / 4
    while time.monotonic() < min(end, quiet):
        if transport.serial.in_waiting:
            data += transport.serial.read(min(transport.serial.in_waiting, 4096))
            quiet = time.monotonic() + _LISTEN_S / 4
        time.sleep(0.01)
    return data


def _no_prompt(port: str, heard: bytes) -> DeviceError:
    if _ROM.search(heard):
        return DeviceError(
            f"the flash of the board on {port} is empty or incomplete: its loader finds no program",
            "Write the image again: `tagid-firmware flash IMAGE`.",
        )
    return DeviceError(
        f"the board on {port} does not answer as MicroPython",
        "Write MicroPython first: `tagid-firmware flash IMAGE`; if it is there, press RESET and try again.",
    )
