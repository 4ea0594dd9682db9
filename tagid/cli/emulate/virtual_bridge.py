"""The bridge's unmodified firmware in front of an emulated robot, on a virtual Bluetooth controller.

It is part of `tagid emulate`, because it needs the firmware tools.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from tagid.errors import DeviceError, UsageError
from tagid.workers import Worker

if TYPE_CHECKING:
    from tagid.motion.emulation.host import RoombaHost

BRC_PIN = 6


@contextmanager
def bridge_before(host: RoombaHost, name: str, passkey: str | None) -> Iterator[tuple[str, Worker]]:
    """A bridge connected to the robot's UART and BRC pin; yields its controller's address and its thread.

    Raises MissingExtraError, UsageError.
    """
    from tagid.motion.links import require

    require("bumble", "virtual", "an emulated bridge")
    from tagid.motion.virtual import virtual_bluetooth

    board_process = virtual_bluetooth("board")
    if passkey is not None and not (len(passkey) == 6 and passkey.isdecimal()):
        raise UsageError("the pass-key is not six digits", "Give --passkey 123456.")
    config: dict[str, Any] = {
        "name": name,
        "passkey": passkey,
        "uart_tx": 4,
        "uart_rx": 5,
        "brc_pin": BRC_PIN,
        "index_pin": 7,
    }
    with board_process(config, host.port.path) as board:

        def watch_brc() -> None:
            while True:
                try:
                    change = board.wait_for("pin")
                except DeviceError:
                    if board.process.poll() is not None:
                        raise
                    continue
                if change.get("pin") == BRC_PIN and not change.get("value"):
                    with host.port.lock:
                        host.core.pulse_brc()

        worker = Worker(watch_brc, "brc")
        worker.start()
        yield board.hci, worker
