"""SCAN_INFO, the message that arrives a thousand times per second, encoded and decoded on a fast path.

The layout is that of `messages.SCAN_INFO_DTYPE`; a test compares the two.
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tagid.constants import BINS_PER_SAMPLE
from tagid.radar.messages import (
    MAX_MESSAGES_PER_SCAN,
    MAX_SAMPLES_PER_SCAN,
    OPMODE_MRM,
    SAMPLES_PER_MESSAGE,
    SCAN_INFO_DTYPE,
    MessageType,
)
from tagid.radar.settings import RadarConfig

SCAN_INFO_BYTES: Final = SCAN_INFO_DTYPE.itemsize
SCAN_INFO_HEAD: Final = int(MessageType.SCAN_INFO).to_bytes(2, "big")
RAW_FILTER: Final = 1

_HEADER: Final = struct.Struct(">HHII16xiiHBBBBHIHH")
_RESERVED: Final = 3
"""Value of the second reserved byte in every recording."""
_BIG: Final = np.dtype(">i4")


class Fragment(NamedTuple):
    """One consistent SCAN_INFO.

    Attributes:
        id: message id of the scan, u16.
        timestamp_ms: radar clock, u32.
        layout: (samples, messages, scan start ps, scan stop ps, antenna, node id), equal throughout a scan.
        part: which message of the scan this is, from 0.
        samples: (350,) or fewer, big-endian i32 counts, a view of the packet.
    """

    id: int
    timestamp_ms: int
    layout: tuple[int, int, int, int, int, int]
    part: int
    samples: NDArray[np.int32]


def read_fragment(packet: bytes) -> Fragment | None:
    """Decode a packet of SCAN_INFO's type; None if its fields or its length are inconsistent.

    A P440 pads the last fragment of a scan to the length of the others; an unpadded last fragment is accepted
    as well.
    """
    if len(packet) < _HEADER.size:
        return None
    (_, scan_id, node, stamp, start, stop, _, _, _, antenna, _, here, total, index, count) = (
        _HEADER.unpack_from(packet)
    )
    if not (1 <= total <= MAX_SAMPLES_PER_SCAN and 1 <= count <= MAX_MESSAGES_PER_SCAN):
        return None
    if count != -(-total // SAMPLES_PER_MESSAGE) or index >= count:
        return None
    if here != min(SAMPLES_PER_MESSAGE, total - index * SAMPLES_PER_MESSAGE):
        return None
    if len(packet) not in (SCAN_INFO_BYTES, _HEADER.size + here * _BIG.itemsize):
        return None
    samples = np.frombuffer(packet, _BIG, here, _HEADER.size)
    return Fragment(scan_id, stamp, (total, count, start, stop, antenna, node), index, samples)


def scan_packets(
    samples: NDArray[np.int32],
    config: RadarConfig,
    scan_id: int,
    timestamp_ms: int,
    filter_bit: int = RAW_FILTER,
) -> list[bytes]:
    """The SCAN_INFO packets of one scan (N,), counts: 1452 bytes each, the last one zero-padded.

    All share the id, u16, and the radar's clock, u32. `filter_bit` is the type of the samples.
    """
    total = len(samples)
    count = -(-total // SAMPLES_PER_MESSAGE)
    padded = np.zeros((count, SAMPLES_PER_MESSAGE), _BIG)
    padded.reshape(-1)[:total] = samples
    packets = []
    for index in range(count):
        header = _HEADER.pack(
            MessageType.SCAN_INFO,
            scan_id,
            config.node_id,
            timestamp_ms,
            config.scan_start_ps,
            config.scan_stop_ps,
            BINS_PER_SAMPLE,
            filter_bit,
            _RESERVED,
            config.antenna_mode,
            OPMODE_MRM,
            min(SAMPLES_PER_MESSAGE, total - index * SAMPLES_PER_MESSAGE),
            total,
            index,
            count,
        )
        packets.append(header + padded[index].tobytes())
    return packets
