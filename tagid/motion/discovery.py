"""Finds robots and tables: serial ports with a likely adapter, and Bluetooth devices.

Nothing is sent to a port: a search must not wake or move an unknown device.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import quote

from tagid.motion.ble import BleAddress, backends_of
from tagid.motion.bridge.find import bluetooth_errors, scanning
from tagid.motion.bridge.protocol import NUS

_ADAPTERS: Final = {
    (0x1A86, 0x7523): ("comxim+serial", "CH340 adapter: a Comxim table, or a robot's cable"),
    (0x0403, 0x6001): ("roomba+serial", "FTDI adapter: a robot's cable"),
    (0x0403, 0x6015): ("roomba+serial", "FTDI adapter: a robot's cable"),
    (0x10C4, 0xEA60): ("roomba+serial", "CP210x adapter: a robot's cable, or an ESP32 board"),
    (0x303A, 0x1001): ("", "ESP32 board on USB: a bridge to provision, not a robot"),
    (0x1027, 0x0005): ("", "P440 radar, not a robot"),
    (0x1027, 0x0003): ("", "P410 radar, not a robot"),
}
"""Scheme of the URL and probable type by USB vendor and product; "" if it is not a motion device."""
_OPEN_S: Final = 60.0
"""Longest time to open and close a controller, s."""
REVOPOINT: Final = "REVO_DUAL_AXIS_TABLE"
"""Advertised name of the dual-axis table."""


@dataclass(frozen=True)
class MotionDevice:
    """A device that may rotate an object.

    Attributes:
        url: value for --motion; "" if it is not a motion device.
        what: probable type.
        where: port or address.
        signal_dbm: Bluetooth signal strength; None on a cable.
    """

    url: str
    what: str
    where: str
    signal_dbm: int | None = None


def serial_devices() -> list[MotionDevice]:
    """Every serial port: those of USB adapters, and those of the computer itself (a Raspberry Pi's UART)."""
    from serial.tools import list_ports

    devices = []
    for port in sorted(list_ports.comports(), key=lambda port: (port.vid is None, port.device)):
        scheme, what = "roomba+serial", port.description or "USB adapter"
        if port.vid is None:
            what = "serial port of this computer: a robot's cable, if one is connected"
        elif (port.vid, port.pid) in _ADAPTERS:
            scheme, what = _ADAPTERS[port.vid, port.pid]
        devices.append(MotionDevice(scheme and f"{scheme}://{port.device}", what, port.device))
    return devices


async def _listen(seconds: float, hci: str | None) -> list[MotionDevice]:
    heard: dict[str, MotionDevice] = {}

    def seen(device: Any, advertisement: Any) -> None:
        name = advertisement.local_name or device.name or ""
        tail = f"?hci={hci}" if hci else ""
        if NUS in [uuid.lower() for uuid in advertisement.service_uuids]:
            url = f"roomba+ble://{quote(name or device.address)}{tail}"
            what = f"{name or 'no name'}: a bridge, or another device with a serial service"
        elif name.startswith(REVOPOINT):
            url, what = f"revopoint+ble://{device.address}{tail}", f"{name}: a dual-axis table"
        else:
            return
        heard[device.address] = MotionDevice(url, what, device.address, advertisement.rssi)

    async with (
        backends_of(BleAddress("", hci=hci)) as backends,
        scanning(seen, backends, "looking for devices"),
    ):
        await asyncio.sleep(seconds)
    return sorted(heard.values(), key=lambda device: -(device.signal_dbm or 0))


def bluetooth_devices(seconds: float, hci: str | None = None) -> list[MotionDevice]:
    """Bridges and tables that advertise within a few seconds, strongest first. Raises DeviceError."""
    with bluetooth_errors("looking for devices"):
        return asyncio.run(asyncio.wait_for(_listen(seconds, hci), seconds + _OPEN_S))
