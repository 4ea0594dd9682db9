"""MicroPython's `bluetooth.BLE` on a bumble device: the same calls, events, buffers and errors.

Calls come from the firmware's thread, bumble runs in the event loop; only queued calls are shared.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import json
import secrets
import struct
import threading
import traceback
import uuid
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

from bumble import att, gatt, keys, pairing, smp
from bumble.core import UUID
from bumble.device import Connection, Device

from firmware_tools.virtual.board import Board

_CONNECT, _DISCONNECT, _WRITE, _MTU, _ENCRYPTION = 1, 2, 3, 21, 28
_GET_SECRET, _SET_SECRET, _PASSKEY = 29, 30, 31
_WRITE_PAIRED = 0x3000
_ENOMEM = 12
_IN_FLIGHT = 12
"""Notifications that the stack holds before it rejects the next, like NimBLE with about twelve buffers."""
_PER_EVENT = 6
"""Notifications per connection event."""
_OUR_SECRET = 1
_NIMBLE_BOND = struct.Struct("<7sBH6x8s16s")
"""Start of NimBLE's `ble_store_value_sec` (host/ble_store.h): peer, key size, ediv, rand, long-term key."""
_ADVERTISE_MS = 20.0


class MicroUUID:
    """`bluetooth.UUID`: from text to the bytes of a packet (little-endian)."""

    def __init__(self, text: str) -> None:
        self._bytes = uuid.UUID(text).bytes[::-1]

    def __bytes__(self) -> bytes:
        return self._bytes


class _Bonds(keys.KeyStore):
    """Bumble's key store, backed by the firmware's secret events."""

    def __init__(self, ask: Callable[[int, tuple[Any, ...]], Awaitable[Any]]) -> None:
        self._ask = ask

    async def update(self, name: str, keys: keys.PairingKeys) -> None:
        value = _nimble_bond(name, keys) + json.dumps(keys.to_dict(), default=int).encode()
        await self._ask(_SET_SECRET, (_OUR_SECRET, _peer(name), value))

    async def get(self, name: str) -> keys.PairingKeys | None:
        value = await self._ask(_GET_SECRET, (_OUR_SECRET, 0, _peer(name)))
        if value is None:
            return None
        return keys.PairingKeys.from_dict(json.loads(value[_NIMBLE_BOND.size :]))

    async def delete(self, name: str) -> None:
        await self._ask(_SET_SECRET, (_OUR_SECRET, _peer(name), None))


def _peer(name: str) -> bytes:
    """NimBLE's `ble_addr_t` of "AA:BB:CC:DD:EE:FF" or "AA:BB:CC:DD:EE:FF/P": type and address."""
    address, _, public = name.partition("/")
    return bytes([not public]) + bytes.fromhex(address.replace(":", ""))[::-1]


def _nimble_bond(name: str, keys: keys.PairingKeys) -> bytes:
    """The value that NimBLE would pass to the firmware for these keys.

    bumble leaves ediv and rand of its own legacy keys zero; NimBLE draws them at random.
    """
    if keys.ltk is not None:
        return _NIMBLE_BOND.pack(_peer(name), 16, 0, bytes(8), keys.ltk.value)
    stored = keys.ltk_central or keys.ltk_peripheral
    ltk = bytes(16) if stored is None else stored.value
    return _NIMBLE_BOND.pack(_peer(name), 16, secrets.randbits(16), secrets.token_bytes(8), ltk)


class _Delegate(pairing.PairingDelegate):
    """Displays the number that the firmware gives."""

    def __init__(self, radio: VirtualBle) -> None:
        super().__init__(pairing.PairingDelegate.DISPLAY_OUTPUT_ONLY)
        self._radio = radio

    async def generate_passkey(self) -> int:
        return await self._radio.passkey()


class VirtualBle:
    """`bluetooth.BLE` of one board.

    Args:
        board: the board whose thread serves the events.
        device: bumble's device, not yet powered on.
        loop: the event loop in which bumble runs.
        air: receives the scan response, which virtual controllers do not transmit.
    """

    def __init__(self, board: Board, device: Device, loop: asyncio.AbstractEventLoop, air: Any) -> None:
        self._board = board
        self._device = device
        self._loop = loop
        self._air = air
        self._handler: Callable[[int, tuple[Any, ...]], Any] = lambda event, data: None
        self._settings: dict[str, Any] = {}
        self._characteristics: dict[int, gatt.Characteristic[bytes]] = {}
        self._values: dict[int, bytearray] = {}
        self._append: dict[int, bool] = {}
        self._sizes: dict[int, int] = {}
        self._connection: Connection | None = None
        self._trusted = False
        self._asked: asyncio.Future[int] | None = None
        self.on_advertise: Callable[[], None] = lambda: None
        self._outstanding = 0
        self._outbox: asyncio.Queue[tuple[int, bytes]] = asyncio.Queue()
        self._sender_task: asyncio.Task[None] | None = None
        self._lock = threading.Lock()
        device.on("connection", self._connected)

    # Called by the firmware.

    def active(self, on: bool) -> None:
        self._device.keystore = _Bonds(self._ask)
        self._wait(self._device.power_on())
        self._call(self._start_sender)

    def irq(self, handler: Callable[[int, tuple[Any, ...]], Any]) -> None:
        self._handler = handler

    def config(self, **settings: Any) -> None:
        self._settings.update(settings)
        if self._settings.get("mitm"):
            delegate = _Delegate(self)
            config = pairing.PairingConfig(
                sc=bool(self._settings.get("le_secure")), mitm=True, bonding=True, delegate=delegate
            )
            self._device.pairing_config_factory = lambda connection: config
        if "mtu" in settings:
            self._device.gatt_server.max_mtu = settings["mtu"]

    def gatts_register_services(self, services: Any) -> tuple[tuple[int, ...], ...]:
        handles = []
        for service, characteristics in services:
            value_handles = []
            made = []
            for uuid_, flags, *_ in characteristics:
                handle = len(self._characteristics) + 1
                made.append(self._characteristic(handle, uuid_, flags))
                value_handles.append(handle)
            handles.append(tuple(value_handles))
            self._call(self._device.add_service, gatt.Service(UUID.from_bytes(bytes(service)), made))
        return tuple(handles)

    def gatts_set_buffer(self, handle: int, size: int, append: bool = False) -> None:
        self._sizes[handle] = size
        self._append[handle] = append

    def gatts_read(self, handle: int) -> bytes:
        value = bytes(self._values[handle])
        if self._append.get(handle):
            self._values[handle].clear()
        return value

    def gatts_write(self, handle: int, data: bytes) -> None:
        self._values[handle][:] = data

    def gatts_notify(self, connection: int, handle: int, data: bytes) -> None:
        with self._lock:
            if self._outstanding >= _IN_FLIGHT:
                raise OSError(_ENOMEM)
            self._outstanding += 1
        self._call(self._outbox.put_nowait, (handle, bytes(data)))

    def gap_advertise(self, interval_us: int, data: bytes, *, resp_data: bytes) -> None:
        self._call(self._air.set_scan_response, self._device.random_address, resp_data)
        # Faster than the firmware requests, to shorten tests; on a board the rate depends on the power.
        start = self._device.start_advertising(
            advertising_data=data,
            scan_response_data=resp_data,
            advertising_interval_min=_ADVERTISE_MS,
            advertising_interval_max=_ADVERTISE_MS,
        )
        self._wait(start)
        self._call(self.on_advertise)

    def gap_passkey(self, connection: int, action: int, passkey: int) -> None:
        self._call(self._answer, passkey)

    def gap_disconnect(self, handle: int) -> None:
        async def end() -> None:
            if self._connection is not None:
                await self._connection.disconnect()

        asyncio.run_coroutine_threadsafe(end(), self._loop)

    def break_next_event(self) -> None:
        """Deliver the next event to the firmware with data that make its handler fail."""
        self._event(_MTU, ())

    # Called in the event loop.

    async def passkey(self) -> int:
        """The firmware's pass-key, requested through its event; if it refuses, it disconnects."""
        self._asked = self._loop.create_future()
        assert self._connection is not None
        self._event(_PASSKEY, (self._connection.handle, 3, 0))
        return await self._asked

    def _answer(self, passkey: int) -> None:
        if self._asked is not None and not self._asked.done():
            self._asked.set_result(passkey)

    async def _sender(self) -> None:
        """Remove notifications from the stack, a fixed number per connection event."""
        sent = 0
        while True:
            handle, data = await self._outbox.get()
            if self._connection is not None:
                await self._device.notify_subscriber(self._connection, self._characteristics[handle], data)
            sent += 1
            if sent % _PER_EVENT == 0:
                await asyncio.sleep(self._air.interval_s)
            with self._lock:
                self._outstanding -= 1

    def _start_sender(self) -> None:
        self._sender_task = self._loop.create_task(self._sender())
        self._sender_task.add_done_callback(self._sender_ended)

    def _sender_ended(self, task: asyncio.Task[None]) -> None:
        """Without its sender the radio is full for ever: the board ends, as it does without its firmware."""
        if not task.cancelled():
            traceback.print_exception(task.exception())
            self._board.end(1)

    def _characteristic(self, handle: int, uuid_: MicroUUID, flags: int) -> gatt.Characteristic[bytes]:
        def write(connection: Connection, value: bytes) -> None:
            if flags & _WRITE_PAIRED and not self._trusted:
                raise att.ATT_Error(att.ErrorCode.INSUFFICIENT_AUTHENTICATION, 0)
            data = bytes(value)
            self._board.interrupt(lambda: self._written(connection.handle, handle, data))

        self._values[handle] = bytearray()
        permissions = gatt.Characteristic.READABLE | gatt.Characteristic.WRITEABLE
        value: gatt.CharacteristicValue[bytes] = gatt.CharacteristicValue(
            read=lambda connection: bytes(self._values[handle]), write=write
        )
        made: gatt.Characteristic[bytes] = gatt.Characteristic(
            UUID.from_bytes(bytes(uuid_)), gatt.Characteristic.Properties(flags & 0x1E), permissions, value
        )
        self._characteristics[handle] = made
        return made

    def _written(self, connection: int, handle: int, data: bytes) -> None:
        """Runs in the firmware's thread: the value is set when its event is served, as on an ESP32."""
        room = self._sizes.get(handle, 20)
        if self._append.get(handle):
            self._values[handle] += data[: room - len(self._values[handle])]
        else:
            self._values[handle][:] = data[:room]
        self._handler(_WRITE, (connection, handle))

    def _connected(self, connection: Connection) -> None:
        self._connection = connection
        self._trusted = False
        address = bytes(connection.peer_address)
        connection.on("disconnection", lambda reason: self._disconnected(connection, address))
        connection.on(
            "connection_att_mtu_update", lambda: self._event(_MTU, (connection.handle, connection.att_mtu))
        )
        connection.on("connection_encryption_change", lambda: self._encrypted(connection))
        self._event(_CONNECT, (connection.handle, 1, address))

    def _disconnected(self, connection: Connection, address: bytes) -> None:
        self._connection = None
        self._trusted = False
        self._event(_DISCONNECT, (connection.handle, 1, address))

    def _encrypted(self, connection: Connection) -> None:
        """Bumble calls every encrypted link authenticated; only one with a pass-key, or its key, is."""
        session = self._device.smp_manager.sessions.get(connection.handle)
        if session is not None and not session.completed:
            self._now(connection, session.pairing_method != smp.PairingMethod.JUST_WORKS)
            return

        async def look() -> None:
            store = self._device.keystore
            bond = await store.get(str(connection.peer_address)) if store else None
            self._now(connection, bool(bond and bond.ltk and bond.ltk.authenticated))

        self._loop.create_task(look())

    def _now(self, connection: Connection, authenticated: bool) -> None:
        self._trusted = bool(connection.encryption) and authenticated
        data = (connection.handle, int(connection.encryption), int(authenticated), 1, 16)
        self._event(_ENCRYPTION, data)

    def _event(self, event: int, data: tuple[Any, ...]) -> None:
        self._board.interrupt(lambda: self._handler(event, data))

    async def _ask(self, event: int, data: tuple[Any, ...]) -> Any:
        """Deliver an event and return its answer."""
        answer: concurrent.futures.Future[Any] = concurrent.futures.Future()
        self._board.interrupt(lambda: answer.set_result(self._handler(event, data)))
        return await asyncio.wrap_future(answer)

    def _wait(self, work: Coroutine[Any, Any, Any]) -> None:
        """Run `work` in the loop and serve interrupts until it is done, because it may raise events."""
        done = asyncio.run_coroutine_threadsafe(work, self._loop)
        while not done.done():
            self._board.sleep_ms(1)
        done.result()

    def _call(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._loop.call_soon_threadsafe(function, *arguments)
