"""Every message of the P440's MRM interface as a big-endian packed numpy dtype, with encoder and decoder.

The client, the emulator and the file importers share this table, so they cannot disagree.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DeviceError

SAMPLES_PER_MESSAGE: Final = 350
"""Samples in one SCAN_INFO; the last one of a scan is zero-padded (P440 MRM API)."""

MAX_MESSAGES_PER_SCAN: Final = 24
"""Maximum number of SCAN_INFO messages per scan; limits the memory that received bytes can allocate."""

MAX_SAMPLES_PER_SCAN: Final = SAMPLES_PER_MESSAGE * MAX_MESSAGES_PER_SCAN

SCAN_FOREVER: Final = 65535
"""Scan count that means "until stopped"."""

OPMODE_MRM: Final = 1

SLEEP_ACTIVE: Final = 0

MAX_PACKET_BYTES: Final = 1452
"""Length of the longest message."""


class Status(enum.IntEnum):
    OK = 0
    GENERIC = 1
    WRONG_OPMODE = 2
    UNSUPPORTED_VALUE = 3
    INVALID_DURING_SLEEP = 4
    WRONG_SIZE = 5
    NOT_ENABLED = 6
    WRONG_BUFFER_SIZE = 7
    UNRECOGNISED = 8
    INTERNAL = 0x80000000


STATUS_TEXT: Final = MappingProxyType(
    {
        Status.OK: "ok",
        Status.GENERIC: "generic failure",
        Status.WRONG_OPMODE: "wrong operating mode (not MRM)",
        Status.UNSUPPORTED_VALUE: "unsupported value",
        Status.INVALID_DURING_SLEEP: "not possible while the radar sleeps",
        Status.WRONG_SIZE: "message of the wrong size",
        Status.NOT_ENABLED: "feature not enabled",
        Status.WRONG_BUFFER_SIZE: "wrong buffer size",
        Status.UNRECOGNISED: "message type not recognised",
        Status.INTERNAL: "internal error of the radar",
    }
)


def status_text(status: int) -> str:
    """Text of a status code; unknown codes are shown in hexadecimal."""
    try:
        return STATUS_TEXT[Status(status)]
    except ValueError:
        return f"unknown status 0x{status:X}"


class MessageType(enum.IntEnum):
    """Message types (P440 MRM API)."""

    SET_CONFIG_REQUEST = 0x1001
    SET_CONFIG_CONFIRM = 0x1101
    GET_CONFIG_REQUEST = 0x1002
    GET_CONFIG_CONFIRM = 0x1102
    CONTROL_REQUEST = 0x1003
    CONTROL_CONFIRM = 0x1103
    SERVER_CONNECT_REQUEST = 0x1004
    SERVER_CONNECT_CONFIRM = 0x1104
    SERVER_DISCONNECT_REQUEST = 0x1005
    SERVER_DISCONNECT_CONFIRM = 0x1105
    SET_FILTER_REQUEST = 0x1006
    SET_FILTER_CONFIRM = 0x1106
    GET_FILTER_REQUEST = 0x1007
    GET_FILTER_CONFIRM = 0x1107
    DETECTION_LIST_INFO = 0x1201
    GET_STATUSINFO_REQUEST = 0xF001
    GET_STATUSINFO_CONFIRM = 0xF101
    REBOOT_REQUEST = 0xF002
    REBOOT_CONFIRM = 0xF102
    SET_OPMODE_REQUEST = 0xF003
    SET_OPMODE_CONFIRM = 0xF103
    GET_OPMODE_REQUEST = 0xF004
    GET_OPMODE_CONFIRM = 0xF104
    SET_SLEEPMODE_REQUEST = 0xF005
    SET_SLEEPMODE_CONFIRM = 0xF105
    GET_SLEEPMODE_REQUEST = 0xF006
    GET_SLEEPMODE_CONFIRM = 0xF106
    SET_BAUD_REQUEST = 0xF00B
    SET_BAUD_CONFIRM = 0xF10B
    INVALID_MESSAGE_CONFIRM = 0xF10C
    SCAN_INFO = 0xF201
    READY_INFO = 0xF202


CONFIG_DTYPE: Final = np.dtype(
    [
        ("node_id", ">u4"),
        ("scan_start_ps", ">i4"),
        ("scan_stop_ps", ">i4"),
        ("resolution_bins", ">u2"),
        ("base_integration_index", ">u2"),
        ("segment_samples", ">u2", (4,)),
        ("segment_multiplier", "u1", (4,)),
        ("antenna_mode", "u1"),
        ("transmit_gain", "u1"),
        ("code_channel", "u1"),
        ("persist", "u1"),
    ]
)
"""The 32-byte configuration block, on the wire and at the head of `.prd`/`.out` files."""

_HEADER: Final[list[Any]] = [("type", ">u2"), ("id", ">u2")]
_STATUS: Final[list[Any]] = [("status", ">u4")]
_FILTER: Final[list[Any]] = [("mask", ">u2"), ("motion_index", "u1"), ("threshold_multiplier", "u1")]
_STATUSINFO: Final[list[Any]] = [
    ("mrm_major", "u1"),
    ("mrm_minor", "u1"),
    ("mrm_build", ">u2"),
    ("kernel_major", "u1"),
    ("kernel_minor", "u1"),
    ("kernel_build", ">u2"),
    ("fpga_version", "u1"),
    ("fpga_year", "u1"),
    ("fpga_month", "u1"),
    ("fpga_day", "u1"),
    ("serial", ">u4"),
    ("board_revision", "u1"),
    ("bit_result", "u1"),
    ("board_type", "u1"),
    ("pulser", "u1"),
    ("temperature_quarter_c", ">i4"),
]

SCAN_INFO_DTYPE: Final = np.dtype(
    [
        *_HEADER,
        ("node_id", ">u4"),
        ("timestamp_ms", ">u4"),
        ("reserved", ">u4", (4,)),
        ("scan_start_ps", ">i4"),
        ("scan_stop_ps", ">i4"),
        ("step_bins", ">u2"),
        ("filter", "u1"),
        ("reserved2", "u1"),
        ("antenna_id", "u1"),
        ("operation_mode", "u1"),
        ("message_samples", ">u2"),
        ("total_samples", ">u4"),
        ("message_index", ">u2"),
        ("message_count", ">u2"),
        ("samples", ">i4", (SAMPLES_PER_MESSAGE,)),
    ]
)
"""One 1452-byte fragment of a scan: a 52-byte header and 350 samples."""

HEADER_DTYPE: Final = np.dtype(_HEADER)

_DETECTION: Final = np.dtype([("index", ">u2"), ("magnitude", ">u2")])


@dataclass(frozen=True)
class MessageSpec:
    """Layout of one message type.

    Attributes:
        dtype: the layout to send, type and id included.
        older: other layouts accepted on receipt; missing fields read as zero.
    """

    type: MessageType
    dtype: np.dtype[np.void]
    older: tuple[np.dtype[np.void], ...] = ()

    @property
    def name(self) -> str:
        return self.type.name

    @property
    def sizes(self) -> tuple[int, ...]:
        """Total sizes that are accepted, bytes."""
        return (self.dtype.itemsize, *(d.itemsize for d in self.older))


def _table() -> dict[int, MessageSpec]:
    t = MessageType
    layouts: dict[MessageType, list[Any]] = {
        t.SET_CONFIG_REQUEST: [("config", CONFIG_DTYPE)],
        t.SET_CONFIG_CONFIRM: _STATUS,
        t.GET_CONFIG_REQUEST: [],
        t.GET_CONFIG_CONFIRM: [("config", CONFIG_DTYPE), ("timestamp_ms", ">u4"), *_STATUS],
        t.CONTROL_REQUEST: [("scan_count", ">u2"), ("reserved", ">u2"), ("interval_us", ">u4")],
        t.CONTROL_CONFIRM: _STATUS,
        t.SERVER_CONNECT_REQUEST: [
            ("ip", ">u4"),
            ("port", ">u2"),
            ("connection_type", "u1"),
            ("reserved", "u1"),
        ],
        t.SERVER_CONNECT_CONFIRM: _STATUS,
        t.SERVER_DISCONNECT_REQUEST: [],
        t.SERVER_DISCONNECT_CONFIRM: _STATUS,
        t.SET_FILTER_REQUEST: _FILTER,
        t.SET_FILTER_CONFIRM: _STATUS,
        t.GET_FILTER_REQUEST: [],
        t.GET_FILTER_CONFIRM: [*_FILTER, *_STATUS],
        t.DETECTION_LIST_INFO: [
            ("count", ">u2"),
            ("reserved", ">u2"),
            ("detections", _DETECTION, (SAMPLES_PER_MESSAGE,)),
        ],
        t.GET_STATUSINFO_REQUEST: [],
        t.GET_STATUSINFO_CONFIRM: [*_STATUSINFO, ("package", "S32"), *_STATUS],
        t.REBOOT_REQUEST: [],
        t.REBOOT_CONFIRM: [],
        t.SET_OPMODE_REQUEST: [("mode", ">u4")],
        t.SET_OPMODE_CONFIRM: [("mode", ">u4"), *_STATUS],
        t.GET_OPMODE_REQUEST: [],
        t.GET_OPMODE_CONFIRM: [("mode", ">u4")],
        t.SET_SLEEPMODE_REQUEST: [("mode", ">u4")],
        t.SET_SLEEPMODE_CONFIRM: _STATUS,
        t.GET_SLEEPMODE_REQUEST: [],
        t.GET_SLEEPMODE_CONFIRM: [("mode", ">u4"), *_STATUS],
        t.SET_BAUD_REQUEST: [("persist", "u1"), ("reserved", "u1"), ("reserved2", ">u2"), ("baud", ">u4")],
        t.SET_BAUD_CONFIRM: _STATUS,
        t.INVALID_MESSAGE_CONFIRM: [("bad_type", ">u2"), ("bad_id", ">u2"), *_STATUS],
        t.READY_INFO: [],
    }
    # Old firmware answers with 32 bytes, without the package string. The vendor's headers have no status in
    # the sleep confirm, but several clients expect one.
    older = {
        t.GET_STATUSINFO_CONFIRM: (np.dtype([*_HEADER, *_STATUSINFO, *_STATUS]),),
        t.GET_SLEEPMODE_CONFIRM: (np.dtype([*_HEADER, ("mode", ">u4")]),),
    }
    table = {int(k): MessageSpec(k, np.dtype([*_HEADER, *v]), older.get(k, ())) for k, v in layouts.items()}
    table[int(t.SCAN_INFO)] = MessageSpec(t.SCAN_INFO, SCAN_INFO_DTYPE)
    return table


MESSAGES: Final = MappingProxyType(_table())
"""Type number -> layout, for every message of the interface."""


class MalformedMessage(DeviceError, ValueError):  # noqa: N818 - named after the bytes, not the exception
    """Bytes that are not a message; counted and dropped, or answered with INVALID_MESSAGE; rarely reported.

    Attributes:
        status: `Status.WRONG_SIZE` or `Status.UNRECOGNISED`, as the radar would report it.
    """

    code = "malformed_message"

    def __init__(self, text: str, status: Status) -> None:
        super().__init__(text, "Check that the device is a P440 in MRM mode.")
        self.status = status


@dataclass(frozen=True, eq=False)
class Message:
    """One decoded message.

    Attributes:
        id: message id, 0..65535; a confirm carries the id of its request.
        fields: structured scalar in the dtype of `MESSAGES[type]`, an independent copy.
    """

    type: MessageType
    id: int
    fields: np.void

    @property
    def name(self) -> str:
        return self.type.name

    def __getitem__(self, field: str) -> int:
        """A field that is an integer; arrays and records are in `fields`."""
        return int(self.fields[field])


Value = int | bytes | np.void | NDArray[np.generic]
"""Of a field: a number, a text, a record, or several numbers."""


def encode(message_type: MessageType, message_id: int, **fields: Value) -> bytes:
    """The bytes of a message; fields that are not given are zero.

    Raises:
        KeyError: a field that the message does not have.
        ValueError: a value that does not fit its field.

    >>> encode(MessageType.CONTROL_REQUEST, 7, scan_count=1).hex()
    '100300070001000000000000'
    """
    return _packed(message_type, MESSAGES[message_type].dtype, {"id": message_id, **fields})


def encode_older(message_type: MessageType, message_id: int, **fields: Value) -> bytes:
    """A message in the layout of older firmware; raises the same errors as `encode`.

    >>> len(encode_older(MessageType.GET_SLEEPMODE_CONFIRM, 1, mode=2))
    8
    """
    return _packed(message_type, MESSAGES[message_type].older[0], {"id": message_id, **fields})


def _packed(message_type: MessageType, dtype: np.dtype[np.void], fields: Mapping[str, Value]) -> bytes:
    record = np.zeros((), dtype)
    for name, value in {"type": int(message_type), **fields}.items():
        if name not in (record.dtype.names or ()):
            raise KeyError(f"{message_type.name} has no field {name}")
        kind = record.dtype[name].base
        if kind.kind in "iu":
            limits = np.iinfo(kind)
            numbers = np.asarray(value)
            if numbers.size and (int(numbers.min()) < limits.min or int(numbers.max()) > limits.max):
                raise ValueError(
                    f"{message_type.name}.{name} is {value!r}, outside {limits.min}..{limits.max}"
                )
        record[name] = value
    return record.tobytes()


def decode(data: bytes) -> Message:
    """One message from the bytes of one packet, which must contain nothing else.

    Raises:
        MalformedMessage: too short, of an unknown type, or not of that type's size.
    """
    if len(data) < HEADER_DTYPE.itemsize:
        raise MalformedMessage(f"{len(data)} bytes are too few for a message", Status.WRONG_SIZE)
    number = int.from_bytes(data[:2], "big")
    spec = MESSAGES.get(number)
    if spec is None:
        raise MalformedMessage(f"message type 0x{number:04X} is unknown", Status.UNRECOGNISED)
    if len(data) == spec.dtype.itemsize:
        record = np.frombuffer(data, spec.dtype, 1).copy()
    else:
        short = next((d for d in spec.older if d.itemsize == len(data)), None)
        if short is None:
            raise MalformedMessage(
                f"{spec.name} has {len(data)} bytes, expected {' or '.join(map(str, spec.sizes))}",
                Status.WRONG_SIZE,
            )
        record = np.zeros(1, spec.dtype)
        old = np.frombuffer(data, short, 1)
        for name in short.names or ():
            record[name] = old[name]
    fields: np.void = record[0]
    return Message(spec.type, int.from_bytes(data[2:4], "big"), fields)
