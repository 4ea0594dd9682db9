"""The fill level of a local UDP receiver's queue, so that an emulator without a clock does not overrun it.

UDP has no back-pressure; on loopback, Linux shows the receiver's queue in /proc/net/udp.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

_TABLE: Final = Path("/proc/net/udp")


def queued_bytes(address: tuple[str, int]) -> int | None:
    """Bytes waiting in the receive queue of a UDP port on this machine; None if that cannot be seen.

    A row is "sl local_address rem_address st tx_queue:rx_queue ...", numbers in hexadecimal (Linux, proc(5)).
    """
    host, port = address
    if not host.startswith("127."):
        return None
    try:
        rows = _TABLE.read_text(encoding="ascii").splitlines()[1:]
    except (OSError, UnicodeDecodeError):
        return None
    for row in rows:
        columns = row.split()
        try:
            if int(columns[1].rpartition(":")[2], 16) == port:
                return int(columns[4].partition(":")[2], 16)
        except (IndexError, ValueError):
            return None
    return None
