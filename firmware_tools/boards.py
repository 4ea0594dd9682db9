"""The serial ports on which a board may be, and what each chip is called, wired and flashed like.

A wrong choice of port is answered with the list of what is there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from tagid.errors import DeviceGoneError, UsageError

_ADAPTERS: Final = {
    (0x303A, None): "Espressif USB",
    (0x10C4, 0xEA60): "CP210x",
    (0x1A86, 0x7523): "CH340",
    (0x1A86, 0x55D4): "CH9102",
    (0x0403, 0x6001): "FT232",
    (0x0403, 0x6015): "FT-X",
}
"""USB numbers of the serial adapters that ESP32 boards carry; 303A is Espressif's own number."""


@dataclass(frozen=True)
class Chip:
    """What differs between the chips.

    Attributes:
        name: as esptool says it.
        image_id: chip number in the header of an image (ESP-IDF `esp_chip_id_t`).
        offset: where a complete image starts in flash.
        pins: default wiring, keys of the configuration file.
    """

    name: str
    image_id: int
    offset: int
    pins: dict[str, int]


# Free on the common modules, no strapping pins, none of UART0: MicroPython keeps its prompt there, and
# a 3 in the stream of a robot (its mode Full) would be a Ctrl-C.
CHIPS: Final = {
    "esp32": Chip("ESP32", 0, 0x1000, {"uart_tx": 17, "uart_rx": 16, "brc_pin": 25, "index_pin": 27}),
    "esp32c3": Chip("ESP32-C3", 5, 0x0, {"uart_tx": 6, "uart_rx": 7, "brc_pin": 4, "index_pin": 5}),
}


@dataclass(frozen=True)
class Port:
    """A serial port: its device file, and what its adapter is called."""

    path: str
    adapter: str
    likely: bool


def ports() -> list[Port]:
    """Every serial port with a USB device behind it, boards first."""
    from serial.tools import list_ports

    found = []
    for item in list_ports.comports():
        if item.vid is None:
            continue
        name = _ADAPTERS.get((item.vid, item.pid)) or _ADAPTERS.get((item.vid, None))
        found.append(Port(item.device, name or item.description or "?", name is not None))
    return sorted(found, key=lambda port: (not port.likely, port.path))


def choose_port(given: str | None) -> str:
    """The port to use: the one given, or the only one with a board's adapter.

    Raises:
        DeviceGoneError: there is no board.
        UsageError: there are several.
    """
    if given:
        return given
    found = ports()
    likely = [port for port in found if port.likely]
    if len(likely) == 1:
        return likely[0].path
    if likely:
        names = ", ".join(f"{port.path} ({port.adapter})" for port in likely)
        raise UsageError(f"{len(likely)} boards are plugged in: {names}", "Choose one with --port.")
    others = ", ".join(port.path for port in found) or "none"
    raise DeviceGoneError(
        f"no board is plugged in (USB serial ports: {others})",
        "Plug the ESP32 in with a USB cable that carries data, or give its port with --port.",
    )
