"""An emulated device whose serial line is one Bluetooth characteristic, on its own virtual controller."""

from __future__ import annotations

import asyncio
import threading
import time
from typing import Any, Final

from tagid.errors import DeviceTimeoutError
from tagid.motion.ble import virtual_bluetooth
from tagid.motion.emulation.pty import SerialCore, raise_failure
from tagid.workers import Worker

_START_S: Final = 20.0
_TICK_S: Final = 0.01
_INTERVAL_MS: Final = 20.0


class GattPort:
    """Serves a core on one characteristic from a thread; a context manager.

    Attributes:
        hci: address of its controller for a host.
        lock: held while the core is used; hold it to inspect the core.

    Raises MissingExtraError without the firmware tools, DeviceError at the end of the block if the thread
    has died.
    """

    def __init__(self, core: SerialCore, name: str, service: str, characteristic: str) -> None:
        self._air_parts = virtual_bluetooth("air")
        self._core, self._name = core, name
        self._uuids = service, characteristic
        self.lock = threading.Lock()
        self.hci = ""
        self._ready = threading.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._end: asyncio.Event | None = None
        self.worker = Worker(lambda: asyncio.run(self._serve()), "gatt-port", lambda _: self._ready.set())

    def __enter__(self) -> GattPort:
        self.worker.start()
        if not self._ready.wait(_START_S) or self.worker.failure is not None:
            raise DeviceTimeoutError(
                "the emulated table does not start", "Try again."
            ) from self.worker.failure
        return self

    def __exit__(self, *_: object) -> None:
        if self._loop is not None and self._end is not None:
            self._loop.call_soon_threadsafe(self._end.set)
        self.worker.join(5)
        raise_failure(self.worker)

    async def _serve(self) -> None:
        from bumble import hci
        from bumble.core import UUID, AdvertisingData
        from bumble.device import Device
        from bumble.gatt import Characteristic, CharacteristicValue, Service
        from bumble.host import Host

        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        air = self._air_parts.Air(0.0, 2.0)
        controller = self._air_parts.make_controller("table", air)
        host = Host()
        host.controller = controller
        device = Device(name=self._name, address=hci.Address("F0:F1:F2:F3:F4:02"), host=host)
        kind = Characteristic.Properties
        line: Any = Characteristic(
            UUID(self._uuids[1]),
            kind.WRITE_WITHOUT_RESPONSE | kind.NOTIFY,
            Characteristic.WRITEABLE,
            CharacteristicValue(write=lambda connection, value: self._written(device, line, bytes(value))),
        )
        device.add_service(Service(UUID(self._uuids[0]), [line]))
        await device.power_on()
        data = bytes(AdvertisingData([(AdvertisingData.COMPLETE_LOCAL_NAME, self._name.encode())]))
        await device.start_advertising(
            auto_restart=True,
            advertising_data=data,
            advertising_interval_min=_INTERVAL_MS,
            advertising_interval_max=_INTERVAL_MS,
        )
        server = self._air_parts.HciServer(air, controller)
        port = await server.start("127.0.0.1", 0)
        self.hci = f"tcp-client:127.0.0.1:{port}"
        self._ready.set()
        while not self._end.is_set():
            with self.lock:
                out = self._core.advance(time.monotonic())
            await self._tell(device, line, out)
            await asyncio.sleep(_TICK_S)
        await server.close()
        await asyncio.sleep(0)

    def _written(self, device: Any, line: Any, data: bytes) -> None:
        with self.lock:
            out = self._core.handle(data, time.monotonic())
        task = asyncio.get_running_loop().create_task(self._tell(device, line, out))
        task.add_done_callback(lambda done: done.exception())

    async def _tell(self, device: Any, line: Any, data: bytes) -> None:
        for connection in list(device.connections.values()):
            size = connection.att_mtu - 3
            for at in range(0, len(data), size):
                await device.notify_subscriber(connection, line, data[at : at + size])
