"""Frames of the bridge's control service, version 2 (docs/bridge.md): only bytes and values, no radio.

All integers are little-endian. The length of received data is checked before decoding.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Final, Self

NUS: Final = "6e400001-b5a3-f393-e0a9-e50e24dcca9e"
NUS_RX: Final = "6e400002-b5a3-f393-e0a9-e50e24dcca9e"
NUS_TX: Final = "6e400003-b5a3-f393-e0a9-e50e24dcca9e"
CONTROL: Final = "7d1c0001-3a6e-4f52-9b0d-7461676964b1"
COMMAND: Final = "7d1c0002-3a6e-4f52-9b0d-7461676964b1"
EVENT: Final = "7d1c0003-3a6e-4f52-9b0d-7461676964b1"
INFO: Final = "7d1c0004-3a6e-4f52-9b0d-7461676964b1"

PROTOCOL: Final = 2


class Op(IntEnum):
    VERSION = 0x01
    STATUS = 0x02
    ARM = 0x03
    HEARTBEAT = 0x04
    DISARM = 0x05
    BRC = 0x06
    ECHO = 0x07
    LOOPBACK = 0x08
    BAUD = 0x09
    TIME = 0x0A


class Status(IntEnum):
    OK = 0
    UNKNOWN = 1
    BAD_ARGUMENT = 2
    NOT_PAIRED = 3
    BUSY = 4
    NO_PIN = 5
    NO_ECHO = 6
    NOT_PROVISIONED = 7
    TRIPPED = 8


class Flag(IntFlag):
    PROVISIONED = 1
    PASSKEY = 2
    TRUSTED = 4
    BRC = 8
    INDEX = 16
    AFTER_WATCHDOG = 32


_ARGUMENTS: Final = {Op.ARM: "<H", Op.BRC: "<HBH", Op.LOOPBACK: "<H", Op.BAUD: "<I"}
_TRIPPED, _INDEX, _OVERFLOW = 0xC1, 0xC2, 0xC3
_CAUSES: Final = {1: "silence of the host", 2: "a lost link", 3: "a firmware fault"}
_DIRECTIONS: Final = {0: "to the robot", 1: "from the robot", 2: "index pulses"}


def encode(op: Op, seq: int, *arguments: int, data: bytes = b"") -> bytes:
    """A command.

    >>> encode(Op.ARM, 7, 400).hex()
    '03079001'
    """
    return bytes((op, seq & 0xFF)) + struct.pack(_ARGUMENTS.get(op, "<"), *arguments) + data


@dataclass(frozen=True)
class Reply:
    """The answer to command `op` with sequence number `seq`."""

    op: int
    seq: int
    status: int
    payload: bytes


@dataclass(frozen=True)
class Tripped:
    """The dead-man stopped the robot: why, and after how many ms of silence."""

    cause: str
    silent_ms: int


@dataclass(frozen=True)
class IndexPulse:
    """A pulse of the index sensor: number, stamp on the bridge's clock (us), age when reported (us)."""

    number: int
    stamp_us: int
    age_us: int


@dataclass(frozen=True)
class Overflow:
    """Bytes (or pulses) lost in one direction since the bridge's power-up."""

    direction: str
    lost: int


Event = Reply | Tripped | IndexPulse | Overflow


def decode_event(data: bytes) -> Event | None:
    """Decode a message of EVENT; None if it is not part of this protocol.

    >>> decode_event(bytes.fromhex("8407000100000000000000")).payload.hex()
    '0100000000000000'
    >>> decode_event(b"\\xc1\\x01")
    """
    kind = data[0] if data else 0
    if kind == _TRIPPED and len(data) == 6:
        cause, silent = struct.unpack("<BI", data[1:])
        return Tripped(_CAUSES.get(cause, f"cause {cause}"), silent)
    if kind == _INDEX and len(data) == 17:
        return IndexPulse(*struct.unpack("<IQI", data[1:]))
    if kind == _OVERFLOW and len(data) == 6:
        direction, lost = struct.unpack("<BI", data[1:])
        return Overflow(_DIRECTIONS.get(direction, f"direction {direction}"), lost)
    if 0x80 < kind < 0xC0 and len(data) >= 3:
        return Reply(kind & 0x7F, data[1], data[2], bytes(data[3:]))
    return None


@dataclass(frozen=True)
class BridgeInfo:
    """Information that a bridge reports without pairing.

    Attributes:
        version: firmware version, e.g. "1.0.0".
        flags: configuration and state.
    """

    protocol: int
    version: str
    flags: Flag
    name: str
    chip: str
    micropython: str

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Raises ValueError if the bytes are too few."""
        if len(data) < 5:
            raise ValueError(f"the bridge's information has {len(data)} bytes")
        name, chip, python = (data[5:].decode("utf-8", "replace") + ";;").split(";")[:3]
        return cls(data[0], ".".join(map(str, data[1:4])), Flag(data[4] & 63), name, chip, python)


_STATUS: Final = struct.Struct("<BQ9IHHIH")


@dataclass(frozen=True)
class BridgeStatus:
    """Counters since power-up, and the state of the dead-man.

    Attributes:
        state: "idle", "armed" or "tripped".
        uptime_us: the bridge's clock.
        to_robot, from_robot: bytes transferred.
        lost_to_robot, lost_from_robot: bytes dropped because a queue was full.
        notify_retries: notifications that the radio rejected and that were resent.
        trips: number of dead-man stops.
        index_count, index_lost: pulses seen; pulses overwritten before they were reported.
        bad_commands: commands that were malformed or too many.
        queue_free, mtu, baud: free space towards the robot (bytes), largest packet, baud rate of the line.
        longest_round_ms: longest pass of the firmware's loop; the watchdog must allow several of them.
    """

    state: str
    uptime_us: int
    to_robot: int
    from_robot: int
    lost_to_robot: int
    lost_from_robot: int
    notify_retries: int
    trips: int
    index_count: int
    index_lost: int
    bad_commands: int
    queue_free: int
    mtu: int
    baud: int
    longest_round_ms: int

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Raises ValueError if the length is wrong."""
        if len(data) != _STATUS.size:
            raise ValueError(f"the bridge's status has {len(data)} bytes, not {_STATUS.size}")
        state, *rest = _STATUS.unpack(data)
        return cls(("idle", "armed", "tripped")[state] if state < 3 else f"state {state}", *rest)
