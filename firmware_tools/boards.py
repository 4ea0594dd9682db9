"""Serial ports that may have a board, and the names, default pins and flash offsets of each chip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from tagid.errors import DeviceGoneError, UsageError

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
