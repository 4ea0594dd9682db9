"""Revopoint's dual-axis table over Bluetooth: `+CT,` commands and `+QT,` queries on one characteristic.

`revopoint+ble://?period=30`, or with a name or address; only its turning axis is used.
"""

from __future__ import annotations

from typing import Final

from tagid.motion.ble import CharacteristicLink, ble_address
from tagid.motion.discovery import REVOPOINT
from tagid.motion.tables.polled import PolledTable
from tagid.motion.urls import Options

SERVICE: Final = "0000ffe0-0000-1000-8000-00805f9b34fb"
CHARACTERISTIC: Final = "0000ffe1-0000-1000-8000-00805f9b34fb"
FASTEST_S, SLOWEST_S = 17.5, 90.0


class Revopoint(PolledTable):
    kind = "revopoint"
    prefix, accepted = "+CT,", "+OK"
    angle_query, angle_name = b"+QT,CHANGEANGLE;", "+DATA"
    warning = "If Bluetooth is lost, or this program hangs, it may not stop: then switch it off"

    def _set_going(self) -> None:
        self._command(f"TURNSPEED={self.nominal_s:.1f}")
        # Revopoint's own app sends positive angles for "clockwise" (docs/motion.md).
        self._command(f"TURNCONTINUE={-self.commanded}")

    def _tell_stop(self) -> None:
        self._command("STOP")


def open_ble(options: Options) -> Revopoint:
    """Options: period (17.5 to 90 s per turn), direction, reversed, turns, hci, wait."""
    address = ble_address(options, REVOPOINT)
    table = Revopoint(
        lambda: CharacteristicLink(address, SERVICE, CHARACTERISTIC, options.url),
        address.target,
        options.direction(),
        options.number("period", 30.0, FASTEST_S, SLOWEST_S),
        options.number("turns", None, 0.01, 20),
    )
    table.reversed = options.reversed(address.target)
    return table
