"""Bluetooth as a byte link: bleak's event loop runs on its own thread, so that drivers can be synchronous.

To a driver, the bridge in front of a robot and a table with a serial characteristic look the same. Virtual
controllers come from the firmware tools, which the package does not import: they register as entry points.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
from abc import abstractmethod
from collections.abc import AsyncIterator, Callable, Coroutine
from concurrent.futures import Future
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from importlib import metadata
from typing import Any, Final, TypeVar

from tagid import processes
from tagid.config import load_config
from tagid.errors import (
    ConfigError,
    DeviceError,
    DeviceGoneError,
    DeviceRejectedError,
    DeviceTimeoutError,
    MissingExtraError,
    TagidError,
)
from tagid.motion.bridge.client import Bridge
from tagid.motion.bridge.find import Backends, bluetooth_errors, find, scanning, unless_busy
from tagid.motion.bridge.protocol import Event, Op, Tripped
from tagid.motion.guard import Watch
from tagid.motion.links import WAKE_S, ByteLink
from tagid.motion.urls import Options
from tagid.secret import Secret, masked
from tagid.workers import Worker

T = TypeVar("T")
_OPEN_S: Final = 60.0
_WRITE_S: Final = 2.0
_RELAXED_MS: Final = 5000
"""Dead-man timeout while nothing moves: queries may take long."""
_WAKE_MS: Final = round(1000 * WAKE_S)
_PREFIXES: Final = 64
"""Longest prefix of a name under which a guardian is found; advertised names have up to 29 bytes."""
_GUARD_S: Final = 2 * _WRITE_S
"""Maximum time between two heartbeats to the helper process: a write may take _WRITE_S."""


@dataclass(frozen=True)
class BleAddress:
    """Address of a Bluetooth device.

    Attributes:
        target: name or address.
        passkey: six digits to pair with; None if none is needed.
        hci: a separate controller instead of the system's, as a bumble transport, e.g. usb:0.
        seconds: duration of the search, s.
    """

    target: str
    passkey: Secret | None = None
    hci: str | None = None
    seconds: float = 5.0

    @property
    def digits(self) -> str | None:
        """The pass-key, to be entered."""
        return None if self.passkey is None else self.passkey.reveal()


GROUP: Final = "tagid.virtual_bluetooth"
"""`backend`: open_backend(where, passkey) for bleak; `air`: a module with Air, HciServer and make_controller;
`board`: BoardProcess(config, uart), the bridge's firmware without a board."""


def virtual_bluetooth(part: str) -> Any:
    """A member of the group. Raises MissingExtraError if there is no provider, or it lacks its packages."""
    why = ""
    for entry in metadata.entry_points(group=GROUP, name=part):
        try:
            return entry.load()
        except ImportError as error:
            why = f": {error}"
    raise MissingExtraError(
        f"this installation has no virtual Bluetooth controllers{why}",
        "In a checkout of tagid: pip install ./firmware_tools",
    )


def ble_address(options: Options, default: str = "") -> BleAddress:
    """Take the Bluetooth options of a URL: passkey, hci, wait. Raises UsageError, ConfigError.

    The pass-key may be given in the configuration (motion.passkey) or the environment, where it does not
    appear on the command line.
    """
    target = options.target or default
    if not target:
        raise options.wrong("the device name is missing")
    config = load_config(tolerant=options.stopping)
    passkey = options.secret() or config["motion.passkey"]
    url, key = config.values["motion.url"], config.values["motion.passkey"]
    in_file = key.source == "file" or (url.source == "file" and url.value.holds_key)
    path = config.path
    if (
        passkey is not None and in_file and not options.stopping
        and path.exists() and path.stat().st_mode & 0o077
    ):  # fmt: skip
        raise ConfigError(
            f"{path} holds the bridge's pass-key and other users can read it", f"Run: chmod 600 {path}"
        )
    digits = "" if passkey is None else passkey.reveal()
    if passkey is not None and not (len(digits) == 6 and digits.isascii() and digits.isdecimal()):
        if not options.stopping:
            raise options.wrong("the pass-key is not six digits")
        passkey = None
    seconds = options.number("wait", 5.0, 0.5, 60)
    return BleAddress(target, passkey, options.text("hci"), seconds)


@asynccontextmanager
async def backends_of(address: BleAddress) -> AsyncIterator[Backends]:
    """bleak's backends for an address. Raises MissingExtraError, DeviceError."""
    if address.hci is None:
        yield Backends()
        return
    open_backend = virtual_bluetooth("backend")
    async with AsyncExitStack() as stack:
        try:
            pair = await stack.enter_async_context(open_backend(address.hci, address.digits))
        except (OSError, ValueError, TimeoutError) as error:
            raise DeviceError(
                f"no Bluetooth controller at {address.hci}: {error}", "Check hci=, or omit it."
            ) from error
        yield Backends(*pair)


class _Loop:
    """An event loop on a thread.

    Args:
        failed: called with the error if the thread dies.

    Raises DeviceError if the thread does not start.
    """

    def __init__(self, failed: Callable[[TagidError], None]) -> None:
        self._loop = asyncio.new_event_loop()
        self._worker = Worker(self._loop.run_forever, "bluetooth", lambda error: failed(self._dead(error)))
        try:
            self._worker.start()
        except RuntimeError as error:
            self._loop.close()
            raise self._dead(error) from error

    @staticmethod
    def _dead(error: BaseException) -> DeviceError:
        return DeviceError(
            f"the thread that speaks Bluetooth has ended: {error}",
            "Free memory and processes, then try again.",
        )

    def run(self, work: Coroutine[Any, Any, T], timeout: float, what: str) -> T:
        """Run work on the loop; return its result. Raises DeviceTimeoutError, and the errors of the work."""
        if self._worker.failure is not None:
            work.close()
            raise self._dead(self._worker.failure)
        future: Future[T] = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(timeout)
        except TimeoutError:
            raise DeviceTimeoutError(f"{what} takes too long", "Move the device closer.") from None
        finally:
            future.cancel()  # no effect once it is done

    def close(self, opened: AsyncExitStack) -> None:
        """Close what was opened on the loop, then stop it and wait for it."""

        async def cancel_all() -> None:
            tasks = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

        with contextlib.suppress(TagidError, OSError):
            self.run(opened.aclose(), 10, "closing")
        if not self._loop.is_closed():
            with contextlib.suppress(TagidError):
                self.run(cancel_all(), _WRITE_S, "ending")
            self._loop.call_soon_threadsafe(self._loop.stop)
            if self._worker.join(_WRITE_S):
                self._loop.close()


class _Inbox:
    """Bytes passed from the loop's thread to the driver's thread."""

    def __init__(self) -> None:
        self._pieces: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._error: TagidError | None = None
        self.put = self._pieces.put

    def fail(self, error: TagidError) -> None:
        self._error = self._error or error
        self.put(b"")  # wakes the driver

    def raise_failure(self) -> None:
        if self._error is not None:
            raise self._error

    def take(self, timeout: float) -> bytes:
        data = b""
        with contextlib.suppress(queue.Empty):
            data = self._pieces.get(timeout=0 if self._error is not None else timeout)
            while True:
                data += self._pieces.get_nowait()
        if not data:
            self.raise_failure()
        return data


class _BleLink(ByteLink):
    """A link over Bluetooth; it is open when its creation returns.

    Args:
        address: of the device.
    """

    def __init__(self, address: BleAddress) -> None:
        self._address = address
        self._inbox = _Inbox()
        self._stack = AsyncExitStack()
        self._loop = _Loop(self._inbox.fail)
        try:
            self._loop.run(self._open(), _OPEN_S, f"connecting to {address.target}")
        except BaseException:
            self._loop.close(self._stack)
            raise

    @abstractmethod
    async def _open(self) -> None:
        """Find the device and connect."""

    def __repr__(self) -> str:
        return self._address.target

    def read(self, timeout: float) -> bytes:
        return self._inbox.take(timeout)


class BridgeLink(_BleLink):
    """The robot behind a bridge.

    Args:
        address: address of the bridge.
        on_event: called on the loop's thread for index pulses and lost bytes.

    Raises:
        DeviceError and its subclasses: no adapter, no bridge, pairing refused. UsageError: ambiguous name.
    """

    def __init__(self, address: BleAddress, on_event: Callable[[Event], None] = lambda event: None) -> None:
        self._on_event = on_event
        self._armed = self._relaxed = False
        self.bridge: Bridge
        super().__init__(address)

    async def _open(self) -> None:
        backends = await self._stack.enter_async_context(backends_of(self._address))
        heard = await find(self._address.target, self._address.seconds, backends)
        self._aliases = (heard.name, heard.address)
        self.bridge = await self._stack.enter_async_context(
            Bridge(
                heard,
                on_bytes=self._inbox.put,
                on_event=self._event,
                on_lost=self._lost,
                passkey=self._address.digits,
                backends=backends,
            )
        )

    def _lost(self) -> None:
        self._inbox.fail(
            DeviceGoneError(
                f"the link to the bridge {self._address.target} is lost", "Move it closer; check its power."
            )
        )

    def _event(self, event: Event) -> None:
        if isinstance(event, Tripped):
            self._relaxed = False
            if self._armed:
                self._inbox.fail(
                    DeviceError(
                        f"the bridge stopped the robot ({event.cause}, {event.silent_ms} ms)",
                        "This computer was too slow or too far away; try again.",
                    )
                )
        self._on_event(event)

    def request(self, op: Op, *arguments: int, timeout: float = 5.0) -> bytes:
        """Send a request to the bridge itself. Raises DeviceError and its subclasses."""
        self._inbox.raise_failure()
        return self._loop.run(
            self.bridge.request(op, *arguments, timeout=timeout), timeout + 1, f"asking {self!r}"
        )

    def write(self, data: bytes) -> None:
        self._inbox.raise_failure()
        if not self._armed and not self._relaxed:
            # The first byte would arm the bridge with its short default timeout.
            self.request(Op.ARM, _RELAXED_MS)
            self._relaxed = True
        self._loop.run(self.bridge.write(data), _WRITE_S, f"writing to {self!r}")

    def arm(self, timeout_s: float) -> None:
        """Arm the bridge's dead-man; only writes reset it, so a driver that hangs also stops the robot.

        The helper process stops nothing here; it only receives the request of `tagid motion stop`.
        """
        self._guard(Watch(self._address.target, _GUARD_S, aliases=self._aliases))
        self.request(Op.ARM, round(timeout_s * 1000))
        self._armed = True

    def disarm(self) -> None:
        """The robot is stopped in Passive mode: end the dead-man."""
        self._armed = self._relaxed = False
        super().disarm()
        self.request(Op.DISARM)

    def wake(self) -> None:
        """Hold BRC low for one second, if the bridge has that wire."""
        with contextlib.suppress(DeviceRejectedError):
            self.request(Op.BRC, _WAKE_MS, 1, 0)

    def close(self) -> None:
        self._release()
        if self._relaxed and not self._armed:
            with contextlib.suppress(TagidError):
                self.disarm()
        self._loop.close(self._stack)


class CharacteristicLink(_BleLink):
    """A device whose serial line is one characteristic, used for writes and notifications.

    Args:
        address: its name or address; a name prefix is enough.
        service, characteristic: UUIDs.
        url: of the device, for the command that reconnects and stops it if this process dies.

    Raises:
        DeviceError and its subclasses: no adapter, no such device.
    """

    def __init__(self, address: BleAddress, service: str, characteristic: str, url: str) -> None:
        self._service, self._characteristic, self._url = service, characteristic, url
        self._closing = False
        super().__init__(address)

    async def _open(self) -> None:
        from bleak import BleakClient

        backends = await self._stack.enter_async_context(backends_of(self._address))
        wanted = self._address.target.lower()

        discovered: asyncio.Future[Any] = asyncio.get_running_loop().create_future()

        def seen(device: Any, advertisement: Any) -> None:
            name = (advertisement.local_name or device.name or "").lower()
            if (device.address.lower() == wanted or name.startswith(wanted)) and not discovered.done():
                # All names that the lines above accept.
                prefixes = (name[:end] for end in range(1, _PREFIXES))
                self._aliases = (device.address, name, *prefixes)
                discovered.set_result(device)

        async with scanning(seen, backends, f"looking for {self._address.target}"):
            await asyncio.wait([discovered], timeout=self._address.seconds)
        if not discovered.done():
            raise DeviceGoneError(
                f"no device called {masked(self._address.target)!r} within {self._address.seconds:g} s",
                "Switch it on, and check that no other program or phone is connected to it.",
            )
        device = discovered.result()
        with bluetooth_errors(f"connecting to {self._address.target}"):
            self._client = BleakClient(device, self._lost, backend=backends.client)
            await unless_busy(self._client.connect)
            self._stack.push_async_callback(self._client.disconnect)
            if self._service not in {service.uuid.lower() for service in self._client.services}:
                raise DeviceError(f"{self._address.target} is another device", "Choose another name.")
            await self._client.start_notify(
                self._characteristic, lambda _, data: self._inbox.put(bytes(data))
            )

    def _lost(self, _: Any) -> None:
        if not self._closing:
            self._inbox.fail(
                DeviceGoneError(f"the link to {self._address.target} is lost", "Move it closer.")
            )

    def write(self, data: bytes) -> None:
        self._inbox.raise_failure()

        async def send() -> None:
            with bluetooth_errors(f"writing to {self!r}"):
                await self._client.write_gatt_char(self._characteristic, data, response=False)

        self._loop.run(send(), _WRITE_S, f"writing to {self!r}")

    def arm(self, timeout_s: float) -> None:
        """Start the helper that stops the table if this process dies; the table itself has no dead-man."""
        self._guard(
            Watch(
                self._address.target,
                max(timeout_s, _GUARD_S),
                command=processes.python("tagid.motion.emergency"),
                command_input=f"{self._url}\n",
                aliases=self._aliases,
            )
        )

    def wake(self) -> None:
        """Does nothing: the device does not sleep."""

    def close(self) -> None:
        self._closing = True
        self._loop.close(self._stack)
        self._release(farewell=False)
