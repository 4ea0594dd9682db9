"""The client of one bridge: bytes to and from the robot, and commands with answers; asynchronous as bleak."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any, Final, Self

from tagid.errors import DeviceError, DeviceGoneError, DeviceRejectedError, DeviceTimeoutError
from tagid.motion.bridge.find import Backends, Heard, bluetooth_errors, unless_busy
from tagid.motion.bridge.protocol import (
    COMMAND,
    CONTROL,
    EVENT,
    INFO,
    NUS,
    NUS_RX,
    NUS_TX,
    PROTOCOL,
    BridgeInfo,
    BridgeStatus,
    Event,
    Flag,
    Op,
    Reply,
    Status,
    decode_event,
    encode,
)

_TRUST_S, _TRUST_LOOKS = 1.0, 20
_MEANING: Final[dict[int, tuple[str, str]]] = {
    Status.UNKNOWN: ("does not know this command", "Its firmware is older: `tagid-firmware verify`."),
    Status.BAD_ARGUMENT: ("reports that the argument is out of range", "See docs/bridge.md for the bounds."),
    Status.NOT_PAIRED: (
        "is not paired with this computer",
        "Pair with the bridge's pass-key first (LE Secure Connections).",
    ),
    Status.BUSY: ("is busy with another command", "Try again when it has ended; disarm before a self-test."),
    Status.NO_PIN: ("has no pin configured for this", "Set the pin: `tagid-firmware provision`."),
    Status.NO_ECHO: (
        "received no echo on its serial line",
        "Connect TX and RX for this test, and check both pins.",
    ),
    Status.NOT_PROVISIONED: ("has no valid configuration", "Write one: `tagid-firmware provision`."),
    Status.TRIPPED: ("has stopped the robot (dead-man)", "Arm it again before driving."),
}


class Bridge:
    """A connected bridge; use it as an async context manager.

    Args:
        heard: device returned by `find`.
        on_bytes: called with bytes from the robot.
        on_event: called with every unsolicited event.
        on_lost: called once when the link ends without `close`.
        passkey: six digits for pairing; None if the bridge is open or already paired.
        timeout: timeout for one answer, s.
    """

    def __init__(
        self,
        heard: Heard,
        *,
        on_bytes: Callable[[bytes], None] = lambda data: None,
        on_event: Callable[[Event], None] = lambda event: None,
        on_lost: Callable[[], None] = lambda: None,
        passkey: str | None = None,
        backends: Backends,
        timeout: float = 5.0,
    ) -> None:
        from bleak import BleakClient

        self._heard = heard
        self._on_bytes, self._on_event, self._on_lost = on_bytes, on_event, on_lost
        self._passkey = passkey
        self._timeout = timeout
        self._seq = 0
        self._waiting: dict[tuple[int, int], asyncio.Future[Reply]] = {}
        self._closing = False
        self._client = BleakClient(
            heard.device, lambda _: self._lost(), timeout=timeout, backend=backends.client
        )
        self.info: BridgeInfo

    def __repr__(self) -> str:
        return f"{self._heard.name or 'bridge'} ({self._heard.address})"

    @property
    def mtu(self) -> int:
        """Maximum packet size of the link, bytes; three of them are overhead."""
        # Read from the characteristic: BlueZ reports the client's own value only after extra requests.
        line = self._client.services.get_characteristic(NUS_RX)
        return 23 if line is None else int(line.max_write_without_response_size) + 3

    async def __aenter__(self) -> Self:
        try:
            await self._open()
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.close()

    async def _open(self) -> None:
        with bluetooth_errors(f"connecting to {self!r}"):
            await unless_busy(self._client.connect)
            services = {service.uuid.lower() for service in self._client.services}
            if not {NUS, CONTROL} <= services:
                raise DeviceError(
                    f"{self!r} is not a tagid bridge: it lacks the bridge's control service",
                    "Choose another name; other devices advertise the same serial service.",
                )
            self.info = await self.read_info()
            if self.info.protocol != PROTOCOL:
                raise DeviceError(
                    f"{self!r} speaks protocol {self.info.protocol}, this tagid speaks {PROTOCOL}",
                    "Install its firmware: run `tagid-firmware build` and `tagid-firmware provision`.",
                )
            await self._pair()
            await self._client.start_notify(EVENT, self._event)
            await self._client.start_notify(NUS_TX, lambda _, data: self._on_bytes(bytes(data)))

    async def _pair(self) -> None:
        if Flag.PASSKEY not in self.info.flags or Flag.TRUSTED in self.info.flags:
            return
        from bleak.exc import BleakError

        from tagid.motion.bridge.pairing import answering

        try:
            async with answering(self._passkey):
                await self._client.pair()
        except NotImplementedError:  # macOS pairs on the first protected write
            return
        except (BleakError, TimeoutError) as error:
            raise DeviceRejectedError(
                f"{self!r} refused the pairing",
                "Give its pass-key, the six digits on its label. After a wrong one it waits, longer each "
                "time; after five it rejects new computers until `tagid-firmware provision` writes another "
                "pass-key. The computer must support LE Secure Connections (Bluetooth 4.2).",
            ) from error
        # The bridge trusts a computer once it has stored the bond, shortly after pairing ends.
        for _ in range(_TRUST_LOOKS):
            self.info = await self.read_info()
            if Flag.TRUSTED in self.info.flags:
                return
            await asyncio.sleep(_TRUST_S / _TRUST_LOOKS)

    async def read_info(self) -> BridgeInfo:
        """Version and configuration of the bridge. Raises DeviceError."""
        with bluetooth_errors(f"reading the version of {self!r}"):
            data = bytes(await self._client.read_gatt_char(INFO))
        try:
            return BridgeInfo.from_bytes(data)
        except ValueError as error:
            raise DeviceError(f"{self!r}: {error}", "Its firmware is damaged: provision it again.") from error

    def _event(self, _: Any, data: bytearray) -> None:
        event = decode_event(bytes(data))
        if isinstance(event, Reply):
            future = self._waiting.pop((event.op, event.seq), None)
            if future is not None and not future.done():
                future.set_result(event)
        elif event is not None:
            self._on_event(event)

    def _lost(self) -> None:
        for future in self._waiting.values():
            if not future.done():
                future.set_exception(
                    DeviceGoneError(f"the link to {self!r} is lost", "Move it closer; check its power.")
                )
        self._waiting.clear()
        if not self._closing:
            self._closing = True
            self._on_lost()

    async def request(
        self, op: Op, *arguments: int, data: bytes = b"", timeout: float | None = None
    ) -> bytes:
        """The payload of the answer.

        Raises:
            DeviceRejectedError: the bridge answers an error status.
            DeviceTimeoutError, DeviceGoneError: no answer, no link.
        """
        reply = await self.ask(op, *arguments, data=data, timeout=timeout)
        if reply.status != Status.OK:
            newer = (f"answers status {reply.status}", "Its firmware is newer than this tagid.")
            what, remedy = _MEANING.get(reply.status, newer)
            raise DeviceRejectedError(f"{self!r} {what} ({op.name})", remedy)
        return reply.payload

    async def ask(self, op: Op, *arguments: int, data: bytes = b"", timeout: float | None = None) -> Reply:
        """The answer, whatever its status."""
        self._seq = (self._seq + 1) & 0xFF
        key = int(op), self._seq
        future: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
        self._waiting[key] = future
        try:
            with bluetooth_errors(f"sending {op.name} to {self!r}"):
                await self._client.write_gatt_char(
                    COMMAND, encode(op, self._seq, *arguments, data=data), response=True
                )
            return await asyncio.wait_for(future, timeout or self._timeout)
        except TimeoutError as error:
            raise DeviceTimeoutError(
                f"{self!r} did not answer {op.name}", "Move it closer; if this persists, power-cycle it."
            ) from error
        finally:
            self._waiting.pop(key, None)

    async def write(self, data: bytes) -> None:
        """Send bytes to the robot, split into packets; keep each robot command within one packet."""
        size = self.mtu - 3
        with bluetooth_errors(f"writing to {self!r}"):
            for start in range(0, len(data), size):
                await self._client.write_gatt_char(NUS_RX, data[start : start + size], response=False)

    async def status(self) -> BridgeStatus:
        """Counters and state. Raises DeviceError."""
        data = await self.request(Op.STATUS)
        try:
            return BridgeStatus.from_bytes(data)
        except ValueError as error:
            raise DeviceError(
                f"{self!r}: {error}", "Its firmware is another version: `tagid-firmware verify`."
            ) from error

    async def close(self) -> None:
        """Close the link; an armed bridge then stops the robot."""
        self._closing = True
        with contextlib.suppress(Exception):
            await self._client.disconnect()
