"""A board: its serial port, its chip, and its MicroPython, accessed with mpremote's transport."""

from __future__ import annotations

import contextlib
import hashlib
import io
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

from firmware_tools.build import EXTRA, MPY_VERSION
from tagid.errors import DeviceError, DeviceGoneError, DeviceRejectedError, MissingExtraError, UsageError
from tagid.ports import open_port

_BAUD: Final = 115200
_READ_S: Final = 1.0
_LISTEN_S: Final = 1.0
_OLDEST: Final = (1, 22)
"""First MicroPython on ESP-IDF 5, whose watchdog timeout can be extended after it was started."""
_ROM: Final = re.compile(rb"invalid header|flash read err|ets_main\.c|No bootable app|csum err|rst:0x")
_LISTS: Final = "`tagid-firmware verify` without --port lists the ports"


_ADAPTERS: Final = {
    (0x303A, None): "Espressif USB",
    (0x10C4, 0xEA60): "CP210x",
    (0x1A86, 0x7523): "CH340",
    (0x1A86, 0x55D4): "CH9102",
    (0x0403, 0x6001): "FT232",
    (0x0403, 0x6015): "FT-X",
}
"""USB numbers of the serial adapters on ESP32 boards; 303A is Espressif's own number."""


@dataclass(frozen=True)
class Chip:
    """Properties that differ between the chips.

    Attributes:
        name: name as in esptool.
        image_id: chip number in the header of an image (ESP-IDF `esp_chip_id_t`).
        offset: where a complete image starts in flash.
        pins: default wiring, keys of the configuration file.
        outputs: GPIO numbers usable as outputs, without those of the flash memory and of UART0 (the prompt).
        inputs: GPIO numbers usable as inputs.
        uarts: UARTs besides UART0.
    """

    name: str
    image_id: int
    offset: int
    pins: dict[str, int]
    outputs: frozenset[int]
    inputs: frozenset[int]
    uarts: frozenset[int]

    def problem_of(self, config: Mapping[str, Any]) -> str:
        """The first key of a configuration that this chip does not support, with the reason; "" if none."""
        if config["uart_id"] not in self.uarts:
            free = ", ".join(map(str, sorted(self.uarts)))
            return (
                f"uart_id is {config['uart_id']}, but on the {self.name} the robot's line can be UART {free}"
            )
        for key, able, what in (
            ("uart_tx", self.outputs, "an output"),
            ("brc_pin", self.outputs, "an output"),
            ("uart_rx", self.inputs, "an input"),
            # The index sensor is an open collector and needs the pin's pull-up, which input-only pins lack.
            ("index_pin", self.outputs, "an input with a pull-up"),
        ):
            if config[key] is not None and config[key] not in able:
                return f"{key} is {config[key]}, which is no free pin of the {self.name} for {what}"
        return ""


# ESP32 datasheet, pin overview: 34 to 39 are inputs without pulls, 6 to 11 belong to the flash, 1 and 3 to
# UART0; 20, 24 and 28 to 31 do not exist. ESP32-C3 datasheet: 11 to 17 belong to the flash, 18 and 19 to USB,
# 20 and 21 to UART0.
_ESP32: Final = frozenset({0, 2, 4, 5, *range(12, 20), 21, 22, 23, 25, 26, 27, 32, 33})
_C3: Final = frozenset(range(11))

# Free on common modules: no strapping pins, and none of UART0, on which MicroPython keeps its prompt and
# a 3 in the stream of a robot (its mode Full) would be a Ctrl-C.
CHIPS: Final = {
    "esp32": Chip(
        "ESP32",
        0,
        0x1000,
        {"uart_tx": 17, "uart_rx": 16, "brc_pin": 25, "index_pin": 27},
        _ESP32,
        _ESP32 | set(range(34, 40)),
        frozenset({1, 2}),
    ),
    "esp32c3": Chip(
        "ESP32-C3",
        5,
        0x0,
        {"uart_tx": 6, "uart_rx": 7, "brc_pin": 4, "index_pin": 5},
        _C3,
        _C3,
        frozenset({1}),
    ),
}


@dataclass(frozen=True)
class Port:
    """A serial port: its device file and the name of its adapter."""

    path: str
    adapter: str
    likely: bool


def ports() -> list[Port]:
    """Every serial port with a USB device behind it, boards first."""
    from serial.tools import list_ports

    listed = []
    for item in list_ports.comports():
        if item.vid is None:
            continue
        name = _ADAPTERS.get((item.vid, item.pid)) or _ADAPTERS.get((item.vid, None))
        listed.append(Port(item.device, name or item.description or "?", name is not None))
    return sorted(listed, key=lambda port: (not port.likely, port.path))


def choose_port(given: str | None) -> str:
    """The port to use: the one given, or the only one with a board's adapter.

    Raises:
        DeviceGoneError: there is no board.
        UsageError: there are several.
    """
    if given:
        return given
    available = ports()
    likely = [port for port in available if port.likely]
    if len(likely) == 1:
        return likely[0].path
    if likely:
        names = ", ".join(f"{port.path} ({port.adapter})" for port in likely)
        raise UsageError(f"{len(likely)} boards are connected: {names}", "Choose one with --port.")
    others = ", ".join(port.path for port in available) or "none"
    raise DeviceGoneError(
        f"no board is connected (USB serial ports: {others})",
        "Connect the ESP32 with a USB data cable, or give its port with --port.",
    )


@dataclass(frozen=True)
class Python:
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
