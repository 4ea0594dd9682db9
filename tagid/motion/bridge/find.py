"""Finds bridges over Bluetooth by name and service, with clear errors if that fails.

Other devices (a Foldio turntable) advertise the same serial service, and two bridges may have the same name.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from tagid.errors import DeviceError, DeviceGoneError, DeviceTimeoutError, UsageError
from tagid.motion.bridge.protocol import NUS
from tagid.secret import masked

if TYPE_CHECKING:
    from bleak.backends.client import BaseBleakClient
    from bleak.backends.device import BLEDevice
    from bleak.backends.scanner import AdvertisementData, BaseBleakScanner

_ADAPTER = (
    "Switch Bluetooth on (Linux: `bluetoothctl power on`, and the service `bluetooth` must run), or plug in "
    "an adapter for Bluetooth 4.0 or newer."
)
_RESTART = "Restart this computer's Bluetooth: `sudo systemctl restart bluetooth`."
_BLUEZ: Final = {
    "org.bluez.Error.InProgress": "Another program on this computer is using Bluetooth for a search or a "
    f"connection: end it. {_RESTART}",
    "org.bluez.Error.NotReady": _ADAPTER,
    "ServiceUnknown": _ADAPTER,
    "org.bluez was not provided": _ADAPTER,
    "org.freedesktop.DBus.Error.AccessDenied": "Add yourself to the group bluetooth "
    "(sudo usermod -aG bluetooth $USER) and log in again.",
    "org.freedesktop.DBus.Error.NoReply": _RESTART,
}
"""Errors of BlueZ that concern this computer and not the device, and their remedies."""
_BUSY: Final = "org.bluez.Error.InProgress"
_BUSY_PAUSES_S: Final = (1.0, 2.0)
"""Pauses before it is tried again."""
_START_S: Final = 10.0
"""Longest time in which the system starts or ends a search, s."""


@dataclass(frozen=True)
class Backends:
    """The pair of bleak backends to use; None for the platform's own."""

    scanner: type[BaseBleakScanner] | None = None
    client: type[BaseBleakClient] | None = None


@dataclass(frozen=True)
class Heard:
    """A device that advertises the serial service."""

    name: str
    address: str
    rssi: int
    device: Any


@contextmanager
def bluetooth_errors(doing: str) -> Iterator[None]:
    """Convert the errors of bleak and the system, raised while `doing` something, to tagid errors.

    Raises:
        DeviceError: no adapter, no permission, or any other Bluetooth failure.
        DeviceTimeoutError: no answer in time.
    """
    from bleak.exc import BleakBluetoothNotAvailableError, BleakDeviceNotFoundError, BleakError

    doing = masked(doing)
    try:
        yield
    except BleakBluetoothNotAvailableError as error:
        raise DeviceError(f"Bluetooth is not available while {doing}: {_line(error)}", _ADAPTER) from error
    except BleakDeviceNotFoundError as error:
        raise DeviceGoneError(
            f"the device does not answer while {doing}", "Move it closer and check its power."
        ) from error
    except BleakError as error:
        text = _line(error)
        for mark, remedy in _BLUEZ.items():
            if mark in text:
                raise DeviceError(f"Bluetooth is not available while {doing}: {text}", remedy) from error
        if "NSUFFICIENT_AUTH" in text.upper() or "NotPermitted" in text or "0x05" in text:
            raise DeviceError(
                f"the device does not know this computer while {doing}",
                "Pair with the bridge's pass-key first.",
            ) from error
        raise DeviceError(
            f"Bluetooth failed while {doing}: {text}", f"Try again; then power-cycle the device. {_RESTART}"
        ) from error
    except TimeoutError as error:
        raise DeviceTimeoutError(
            f"no answer over Bluetooth while {doing}", "Move the device closer and check its power."
        ) from error
    except OSError as error:
        raise DeviceError(f"Bluetooth is not available while {doing}: {_line(error)}", _ADAPTER) from error


def _line(error: BaseException) -> str:
    return str(error).partition("\n")[0] or type(error).__name__


async def unless_busy(action: Callable[[], Awaitable[None]]) -> None:
    """Await an action; again after a pause if the system is busy with another search or connection."""
    from bleak.exc import BleakError

    for pause_s in _BUSY_PAUSES_S:
        try:
            await action()
            return
        except BleakError as error:
            if _BUSY not in str(error):
                raise
        await asyncio.sleep(pause_s)
    await action()


@asynccontextmanager
async def scanning(
    seen: Callable[[BLEDevice, AdvertisementData], None], backends: Backends, doing: str
) -> AsyncIterator[None]:
    """Call `seen` for every advertisement while the block runs. Raises the errors of `bluetooth_errors`."""
    from bleak import BleakScanner

    with bluetooth_errors(doing):
        scanner = BleakScanner(seen, backend=backends.scanner)
        async with asyncio.timeout(_START_S):
            await unless_busy(scanner.start)
        try:
            yield
        finally:
            async with asyncio.timeout(_START_S):
                await scanner.stop()


async def find(wanted: str, seconds: float, backends: Backends) -> Heard:
    """The one device with that name or address.

    A search by name always lasts the full time, because only then is the name known to be unique; a search by
    address ends when the device is found.

    Raises:
        DeviceGoneError: no such device; the message lists those found.
        UsageError: several bridges have that name.
        DeviceError: no Bluetooth.
    """
    heard: dict[str, Heard] = {}
    by_address = asyncio.Event()

    def seen(device: BLEDevice, advertisement: Any) -> None:
        if NUS not in [item.lower() for item in advertisement.service_uuids]:
            return
        name = advertisement.local_name or device.name or ""
        heard[device.address] = Heard(name, device.address, advertisement.rssi, device)
        if device.address.lower() == wanted.lower():
            by_address.set()

    async with scanning(seen, backends, f"looking for {wanted}"):
        with suppress(TimeoutError):
            await asyncio.wait_for(by_address.wait(), seconds)
    matching = [
        item for item in heard.values() if wanted.lower() in (item.name.lower(), item.address.lower())
    ]
    if len(matching) > 1:
        addresses = ", ".join(sorted(item.address for item in matching))
        raise UsageError(
            f"{len(matching)} bridges have the name {masked(wanted)!r}: {addresses}",
            "Give the address instead of the name, or provision one of them with another name.",
        )
    if not matching:
        others = ", ".join(sorted(f"{item.name or '?'} ({item.address})" for item in heard.values()))
        raise DeviceGoneError(
            f"no bridge called {masked(wanted)!r} within {seconds:g} s; found: {others or 'none'}",
            "Check the bridge's power and name, and that no other computer is connected to it.",
        )
    return matching[0]
