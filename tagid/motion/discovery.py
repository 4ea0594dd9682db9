"""Which robots and tables are there: serial ports with a likely adapter, and Bluetooth devices.

Nothing is sent to a port: an unknown device must not be woken, let alone moved, by being looked for.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import quote

from tagid.motion.ble import BleAddress, backends_of
from tagid.motion.bridge.find import bluetooth_errors
from tagid.motion.bridge.protocol import NUS

_ADAPTERS: Final = {
    (0x1A86, 0x7523): "CH340 adapter: a Comxim table, or a robot's cable",
    (0x0403, 0x6001): "FTDI adapter: a robot's cable",
    (0x0403, 0x6015): "FTDI adapter: a robot's cable",
    (0x10C4, 0xEA60): "CP210x adapter: a robot's cable, or an ESP32 board",
    (0x303A, 0x1001): "ESP32 board on USB: a bridge to provision, not a robot",
}
REVOPOINT: Final = "REVO_DUAL_AXIS_TABLE"
"""Advertised name of the dual-axis table."""


@dataclass(frozen=True)
class Found:
    """Something that may turn an object.

    Attributes:
        url: what to give as --motion; "" where it is no device to turn with.
        what: what it seems to be.
        where: port or address.
        signal_dbm: strength over Bluetooth; None on a cable.
    """

    url: str
    what: str
    where: str
    signal_dbm: int | None = None


def serial_devices() -> list[Found]:
    """Serial ports of USB adapters."""
    from serial.tools import list_ports

    found = []
    for port in sorted(list_ports.comports()):
        if port.vid is None:
            continue
        what = _ADAPTERS.get((port.vid, port.pid or 0), f"{port.description or 'USB adapter'}")
        comxim = (port.vid, port.pid) == (0x1A86, 0x7523)
        url = f"comxim+serial://{port.device}" if comxim else f"roomba+serial://{port.device}"
        found.append(Found("" if "ESP32 board on USB" in what else url, what, port.device))
    return found


async def _listen(seconds: float, hci: str | None) -> list[Found]:
    from bleak import BleakScanner

    heard: dict[str, Found] = {}

    def seen(device: Any, advertisement: Any) -> None:
        name = advertisement.local_name or device.name or ""
        tail = f"?hci={hci}" if hci else ""
        if NUS in [one.lower() for one in advertisement.service_uuids]:
            url = f"roomba+ble://{quote(name or device.address)}{tail}"
            what = f"{name or 'no name'}: a bridge, or another device with a serial service"
        elif name.startswith(REVOPOINT):
            url, what = f"revopoint+ble://{device.address}{tail}", f"{name}: a dual-axis table"
        else:
            return
        heard[device.address] = Found(url, what, device.address, advertisement.rssi)

    async with backends_of(BleAddress("", hci=hci)) as backends:
        with bluetooth_errors("looking for devices"):
            async with BleakScanner(seen, backend=backends.scanner):
                await asyncio.sleep(seconds)
    return sorted(heard.values(), key=lambda one: -(one.signal_dbm or 0))


def bluetooth_devices(seconds: float, hci: str | None = None) -> list[Found]:
    """Bridges and tables that advertise within some seconds, strongest first. Raises DeviceError."""
    return asyncio.run(_listen(seconds, hci))
