"""The Open Interface as messages: commands to bytes, sensor packets to numbers.

Pure functions, so that the client, the emulator and the tests agree on every byte (iRobot, "Create 2 Open
Interface (OI) Specification based on the Roomba 600").
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from enum import IntEnum
from typing import Final

from tagid.errors import UsageError

BAUD_CODES: Final = (300, 600, 1200, 2400, 4800, 9600, 14400, 19200, 28800, 38400, 57600, 115200)
"""Baud rates by the code of command 129."""
MAX_SPEED_MM_S: Final = 500
FRAME_S: Final = 0.015
"""Time between stream frames, s."""


class Op(IntEnum):
    RESET = 7
    START = 128
    BAUD = 129
    SAFE = 131
    FULL = 132
    DRIVE = 137
    SENSORS = 142
    DRIVE_DIRECT = 145
    STREAM = 148
    QUERY_LIST = 149
    PAUSE_STREAM = 150
    STOP = 173


class Mode(IntEnum):
    """Modes reported in packet 35."""

    OFF = 0
    PASSIVE = 1
    SAFE = 2
    FULL = 3


class Packet(IntEnum):
    """Sensor packets needed to rotate an object."""

    BUMPS_AND_DROPS = 7
    CLIFF_LEFT = 9
    CLIFF_FRONT_LEFT = 10
    CLIFF_FRONT_RIGHT = 11
    CLIFF_RIGHT = 12
    DISTANCE = 19
    ANGLE = 20
    CHARGING_STATE = 21
    VOLTAGE = 22
    CURRENT = 23
    TEMPERATURE = 24
    CHARGE = 25
    CAPACITY = 26
    CHARGER = 34
    MODE = 35
    LEFT_ENCODER = 43
    RIGHT_ENCODER = 44


PACKETS: Final[Mapping[int, str]] = {
    **dict.fromkeys(range(7, 19), "B"), 19: "h", 20: "h", 21: "B", 22: "H", 23: "h", 24: "b", 25: "H",
    26: "H", **dict.fromkeys(range(27, 32), "H"), 32: "B", 33: "H", **dict.fromkeys(range(34, 39), "B"),
    39: "h", 40: "h", 41: "h", 42: "h", 43: "h", 44: "h", 45: "B", **dict.fromkeys(range(46, 52), "H"),
    52: "B", 53: "B", 54: "h", 55: "h", 56: "h", 57: "h", 58: "B",
}  # fmt: skip
"""struct code of every single packet's value, big-endian; all of 7..18 are bytes."""

GROUPS: Final[Mapping[int, range]] = {
    0: range(7, 27), 1: range(7, 17), 2: range(17, 21), 3: range(21, 27), 4: range(27, 35), 5: range(35, 43),
    6: range(7, 43), 100: range(7, 59), 101: range(43, 59), 106: range(46, 52), 107: range(54, 59),
}  # fmt: skip
"""Group packets and the single packets they contain."""


def members(packet: int) -> range:
    """The single packets of an id. Raises KeyError for an unknown one."""
    if packet in PACKETS:
        return range(packet, packet + 1)
    return GROUPS[packet]


def packet_size(packet: int) -> int:
    """Bytes of a packet's data. Raises KeyError for an unknown one.

    >>> packet_size(100), packet_size(43)
    (80, 2)
    """
    return sum(struct.calcsize(PACKETS[member]) for member in members(packet))


def pack_packet(packet: int, values: Mapping[int, int]) -> bytes:
    """Data of a packet from the values of its single packets; missing values are zero."""
    return b"".join(struct.pack(">" + PACKETS[member], values.get(member, 0)) for member in members(packet))


def unpack_packet(packet: int, data: bytes) -> dict[int, int]:
    """Values of the single packets. Raises ValueError for a wrong length, KeyError for an unknown id."""
    code = ">" + "".join(PACKETS[member] for member in members(packet))
    if len(data) != struct.calcsize(code):
        raise ValueError(f"packet {packet} has {len(data)} bytes, expected {struct.calcsize(code)}")
    return dict(zip(members(packet), struct.unpack(code, data), strict=True))


def command(op: Op, *data: int) -> bytes:
    """A command with its data bytes.

    >>> command(Op.STREAM, 2, 29, 13).hex(" ")
    '94 02 1d 0d'
    """
    return bytes([op, *data])


def drive_direct(right_mm_s: int, left_mm_s: int) -> bytes:
    """Wheel speeds, mm/s, forward positive. Raises UsageError beyond 500 mm/s.

    >>> drive_direct(57, -57).hex(" ")
    '91 00 39 ff c7'
    """
    for speed in (right_mm_s, left_mm_s):
        if not -MAX_SPEED_MM_S <= speed <= MAX_SPEED_MM_S:
            raise UsageError(f"the wheel speed is {speed} mm/s", "Give -500 to 500 mm/s.")
    return struct.pack(">Bhh", Op.DRIVE_DIRECT, right_mm_s, left_mm_s)


HALT: Final = drive_direct(0, 0)
"""Wheels to zero."""


def stream_frame(packets: Iterable[int], values: Mapping[int, int]) -> bytes:
    """A stream frame as the robot sends it: 19, n, (id, data)..., checksum; all bytes sum to 0 mod 256.

    >>> list(stream_frame([29, 13], {29: 537, 13: 0}))
    [19, 5, 29, 2, 25, 13, 0, 163]
    """
    body = b"".join(bytes([packet]) + pack_packet(packet, values) for packet in packets)
    frame = bytes([19, len(body)]) + body
    return frame + bytes([-sum(frame) & 0xFF])
