"""A backend for bleak over bumble, so that a stock BleakClient reaches a virtual controller."""

from __future__ import annotations

import asyncio
import secrets
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any, ClassVar

from bleak.assigned_numbers import CharacteristicPropertyName
from bleak.backends.characteristic import BleakGATTCharacteristic
from bleak.backends.client import BaseBleakClient
from bleak.backends.scanner import AdvertisementData, BaseBleakScanner
from bleak.backends.service import BleakGATTService, BleakGATTServiceCollection
from bleak.exc import BleakDeviceNotFoundError, BleakError
from bumble import core, hci, pairing
from bumble.core import UUID, AdvertisingData
from bumble.device import Connection, Device, Peer
from bumble.host import Host
from bumble.keys import KeyStore, MemoryKeyStore
from bumble.transport import open_transport

from firmware_tools.virtual.air import COMMAND_TIMEOUT_S

_MTU = 247
_PROPERTIES: dict[int, CharacteristicPropertyName] = {
    1: "broadcast",
    2: "read",
    4: "write-without-response",
    8: "write",
    16: "notify",
    32: "indicate",
}
_SERVICES = (
    AdvertisingData.COMPLETE_LIST_OF_128_BIT_SERVICE_CLASS_UUIDS,
    AdvertisingData.INCOMPLETE_LIST_OF_128_BIT_SERVICE_CLASS_UUIDS,
)


def _text(value: UUID) -> str:
    return str(uuid.UUID(bytes=bytes(reversed(value.to_bytes(force_128=True)))))


class _Keyboard(pairing.PairingDelegate):
    """Answers with the user's pass-key; without one it has no keyboard."""

    def __init__(self, passkey: str | None) -> None:
        capability = self.NO_OUTPUT_NO_INPUT if passkey is None else self.KEYBOARD_INPUT_ONLY
        super().__init__(capability)
        self._passkey = passkey

    async def get_number(self) -> int | None:
        return None if self._passkey is None else int(self._passkey)


class BumbleScanner(BaseBleakScanner):
    """Reports advertisements on the virtual link."""

    device: ClassVar[Device]

    def __init__(
        self, detection_callback: Any, service_uuids: Any, scanning_mode: Any, **options: Any
    ) -> None:
        super().__init__(detection_callback, service_uuids)

    def _seen(self, heard: Any) -> None:
        services = [_text(item) for kind in _SERVICES for uuids in heard.data.get_all(kind) for item in uuids]
        name = heard.data.get(AdvertisingData.Type.COMPLETE_LOCAL_NAME)
        advertisement = AdvertisementData(name, {}, {}, services, None, heard.rssi, (heard,))
        address = heard.address.to_string(False)
        device = self.create_or_update_device(address, address, name, heard.address, advertisement)
        if self.is_allowed_uuid(services):
            self.call_detection_callbacks(device, advertisement)

    async def start(self) -> None:
        self.seen_devices = {}
        self.device.on("advertisement", self._seen)
        await self.device.start_scanning(active=True)

    async def stop(self) -> None:
        await self.device.stop_scanning()
        self.device.remove_listener("advertisement", self._seen)


class BumbleClient(BaseBleakClient):
    device: ClassVar[Device]

    def __init__(self, address_or_ble_device: Any, **options: Any) -> None:
        super().__init__(
            address_or_ble_device,
            disconnected_callback=options["disconnected_callback"],
            timeout=options["timeout"],
        )
        self._connection: Connection | None = None

    @property
    def name(self) -> str:
        return self.address

    @property
    def mtu_size(self) -> int:
        return self._connection.att_mtu if self._connection else 23

    @property
    def is_connected(self) -> bool:
        return self._connection is not None

    def _gone(self, reason: int) -> None:
        self._connection = None
        if self._disconnected_callback:
            self._disconnected_callback()

    async def _wait_until_heard(self) -> None:
        """Connecting to an address that does not exist would never end."""
        heard = asyncio.Event()

        def listen(advertisement: Any) -> None:
            if advertisement.address.to_string(False) == self.address:
                heard.set()

        self.device.on("advertisement", listen)
        await self.device.start_scanning(active=False)
        try:
            await asyncio.wait_for(heard.wait(), self._timeout)
        except TimeoutError as error:
            raise BleakDeviceNotFoundError(self.address) from error
        finally:
            await self.device.stop_scanning()
            self.device.remove_listener("advertisement", listen)

    async def connect(self, pair: bool, **options: Any) -> None:
        await self._wait_until_heard()
        try:
            connection = await self.device.connect(hci.Address(self.address), timeout=self._timeout)
        except (core.TimeoutError, TimeoutError) as error:
            raise BleakDeviceNotFoundError(self.address, str(error)) from error
        self._connection = connection
        connection.on("disconnection", self._gone)
        try:
            if pair:
                await self.pair()
            peer = Peer(connection)
            await peer.request_mtu(_MTU)
            self.services = await self._discover(peer)
        except (core.BaseBumbleError, asyncio.CancelledError, TimeoutError) as error:
            raise BleakError(f"the link to {self.address} broke while connecting") from error

    async def _discover(self, peer: Peer) -> BleakGATTServiceCollection:
        await peer.discover_services()
        collection = BleakGATTServiceCollection()
        for service in peer.services:
            wrapped = BleakGATTService(service, service.handle, _text(service.uuid))
            collection.add_service(wrapped)
            for item in await service.discover_characteristics():
                properties = [name for bit, name in _PROPERTIES.items() if item.properties & bit]
                collection.add_characteristic(
                    BleakGATTCharacteristic(
                        item, item.handle, _text(item.uuid), properties, lambda: self.mtu_size - 3, wrapped
                    )
                )
        return collection

    async def disconnect(self) -> None:
        if self._connection is not None:
            await self._connection.disconnect()

    async def pair(self, *args: Any, **options: Any) -> None:
        """Pair, or encrypt with the key of an earlier pairing. Raises BleakError if that fails."""
        connection = self._needed()
        store = self.device.keystore
        try:
            if store is not None and await store.get(str(connection.peer_address)) is not None:
                await connection.encrypt()
            else:
                await connection.pair()
        except (core.BaseBumbleError, asyncio.CancelledError) as error:
            raise BleakError(f"pairing failed: {error or 'the bridge ended the link'}") from error

    def _needed(self) -> Connection:
        if self._connection is None:
            raise BleakError("Not connected")
        return self._connection

    async def _do(self, work: Callable[[], Awaitable[Any]]) -> Any:
        """Await what `work` starts; a lost link starts nothing. Raises BleakError."""
        self._needed()
        try:
            return await work()
        except core.ProtocolError as error:
            raise BleakError(error.error_name or f"error {error.error_code}") from error
        except (core.BaseBumbleError, asyncio.CancelledError) as error:
            raise BleakError(str(error) or "the link broke") from error

    async def read_gatt_char(self, characteristic: BleakGATTCharacteristic, **options: Any) -> bytearray:
        return bytearray(await self._do(lambda: characteristic.obj.read_value()))

    async def write_gatt_char(
        self, characteristic: BleakGATTCharacteristic, data: Any, response: bool
    ) -> None:
        await self._do(lambda: characteristic.obj.write_value(bytes(data), with_response=response))

    async def start_notify(
        self, characteristic: BleakGATTCharacteristic, callback: Any, **options: Any
    ) -> None:
        def received(value: bytes) -> None:
            callback(bytearray(value))

        await self._do(lambda: characteristic.obj.subscribe(received))

    async def _unused(self, *args: Any, **options: Any) -> Any:
        """bleak demands it; no part of tagid calls it."""
        raise NotImplementedError

    unpair = stop_notify = read_gatt_descriptor = write_gatt_descriptor = _unused


@asynccontextmanager
async def open_backend(
    where: str,
    passkey: str | None = None,
    store: KeyStore | None = None,
    address: str | None = None,
    secure: bool = True,
) -> AsyncIterator[tuple[type[BaseBleakScanner], type[BaseBleakClient]]]:
    """(scanner, client) backends on the controller at `where`, e.g. "tcp-client:127.0.0.1:4711".

    Args:
        where: a bumble transport.
        passkey: six digits entered on this host; None: a host without a keyboard.
        store: keys of earlier pairings; None: none.
        address: address of this host; None: random, so that two hosts on one link never share one.
        secure: whether it supports LE Secure Connections; otherwise it uses legacy pairing.
    """
    async with await open_transport(where) as transport:
        host_address = address or "F2:" + ":".join(f"{byte:02X}" for byte in secrets.token_bytes(5))
        device = Device(
            name="host", address=hci.Address(host_address), host=Host(transport.source, transport.sink)
        )
        device.command_timeout = COMMAND_TIMEOUT_S
        device.keystore = store or MemoryKeyStore()
        config = pairing.PairingConfig(sc=secure, mitm=passkey is not None, delegate=_Keyboard(passkey))
        device.pairing_config_factory = lambda connection: config
        await device.power_on()
        yield (
            type("Scanner", (BumbleScanner,), {"device": device}),
            type("Client", (BumbleClient,), {"device": device}),
        )
