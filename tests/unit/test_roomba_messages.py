"""The Open Interface byte for byte, frames out of noise, and odometry with the right sign."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tagid.errors import UsageError
from tagid.motion.emulation.body import BodySettings
from tagid.motion.emulation.roomba import RoombaCore
from tagid.motion.roomba import messages as oi
from tagid.motion.roomba.client import StreamDecoder
from tagid.motion.roomba.messages import Op, Packet
from tagid.motion.roomba.odometry import MM_PER_COUNT, SpinOdometry

WATCHED = (Packet.BUMPS_AND_DROPS, Packet.MODE, Packet.LEFT_ENCODER, Packet.RIGHT_ENCODER)


def test_commands_are_those_of_the_document() -> None:
    # Create 2 OI specification: Drive Direct example, stream example, checksum rule.
    assert oi.drive_direct(-200, 500) == bytes([145, 255, 56, 1, 244])
    assert bytes([19, 5, 29, 2, 25, 13, 0, 163]) == oi.stream_frame([29, 13], {29: 537})
    assert [oi.packet_size(group) for group in (0, 1, 2, 3, 4, 5, 6, 100, 101, 106, 107)] == [
        26, 10, 6, 10, 14, 12, 52, 80, 28, 12, 9,
    ]  # fmt: skip
    assert oi.command(Op.STOP) == b"\xad"
    assert oi.command(Op.QUERY_LIST, 2, 7, 43) == bytes([149, 2, 7, 43])
    with pytest.raises(UsageError):
        oi.drive_direct(501, 0)


def test_the_frame_for_turning_has_13_bytes() -> None:
    assert len(oi.stream_frame(WATCHED, {})) == 13


@settings(max_examples=200, deadline=None)
@given(
    values=st.lists(
        st.tuples(st.integers(-32768, 32767), st.integers(-32768, 32767)), min_size=1, max_size=8
    ),
    noise=st.lists(st.binary(max_size=40), min_size=9, max_size=9),
    cut=st.integers(1, 7),
)
def test_frames_are_found_among_any_bytes(
    values: list[tuple[int, int]], noise: list[bytes], cut: int
) -> None:
    """Two frames after each noise: it may swallow the first by claiming its length, never the second."""
    wire = b""
    for index, (left, right) in enumerate(values):
        frame = oi.stream_frame(WATCHED, {43: left, 44: right, 35: 2})
        wire += noise[index] + frame + frame
    wire += bytes(32)
    decoder = StreamDecoder(WATCHED)
    results = []
    for at in range(0, len(wire), cut):
        results += decoder.feed(wire[at : at + cut])
    positions = [(frame[43], frame[44]) for frame in results]
    position = -1
    for pair in values:
        assert pair in positions[position + 1 :] or pair in positions[: position + 1]
        position = positions.index(pair)
    assert len(results) * 13 + decoder.dropped <= len(wire)


def test_nothing_is_a_frame_that_was_not_asked_for() -> None:
    decoder = StreamDecoder(WATCHED)
    other = oi.stream_frame([7, 35, 44, 43], {})
    assert decoder.feed(other + b"\x13" * 50) == []
    assert decoder.feed(oi.stream_frame(WATCHED, {43: 7}))[-1][43] == 7


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("signed", [True, False])
def test_the_angle_follows_the_command_whatever_the_firmware_counts(direction: int, signed: bool) -> None:
    odometry = SpinOdometry(direction)
    per_turn = math.pi * 235 / MM_PER_COUNT
    for step in range(0, int(3 * per_turn), 7):
        left = -direction * step if signed else step
        right = direction * step if signed else step
        wrap = [((32_700 + way + 32768) & 0xFFFF) - 32768 for way in (left, right)]
        odometry.add(*wrap)
    assert odometry.angle_rad == pytest.approx(direction * 3 * 2 * math.pi, rel=2e-3)
    assert odometry.sigma_rad < math.radians(0.1)


@pytest.mark.parametrize("place", range(13))
def test_a_frame_with_a_wrong_bit_is_no_frame(place: int) -> None:
    """The sum of all bytes is zero; a frame that passes without it would be an angle out of noise."""
    frame = bytearray(oi.stream_frame(WATCHED, {43: 1000, 44: -1000, 35: 2}))
    assert len(StreamDecoder(WATCHED).feed(bytes(frame))) == 1
    frame[place] ^= 0x04
    decoder = StreamDecoder(WATCHED)
    assert decoder.feed(bytes(frame) + bytes(40)) == [] and decoder.dropped >= 1


def test_the_emulated_robot_tells_distance_and_angle_since_they_were_last_asked_for() -> None:
    """Packets 19 and 20 (Open Interface): a circle of 500 mm radius, asked about ten times per second."""
    core = RoombaCore(BodySettings(lag_s=0.0, encoder_noise=0.0), now_s=0.0)
    core.handle(bytes([Op.START, Op.SAFE]), 0.0)
    right, left = 200, 114
    core.handle(bytes([Op.DRIVE_DIRECT]) + struct.pack(">hh", right, left), 0.0)
    ask = bytes([Op.QUERY_LIST, 2, Packet.DISTANCE, Packet.ANGLE])
    reported = np.array([struct.unpack(">hh", core.handle(ask, 0.1 * k)) for k in range(1, 101)])
    ways = np.array(core.body.ways_mm())
    assert abs(reported[:, 0].sum() - ways.mean()) < 1  # what rounding left of one answer comes with the next
    turned = np.degrees((ways[1] - ways[0]) / core.body.settings.wheel_base_mm)
    assert abs(reported[:, 1].sum() - turned) < 1.01
    assert turned == pytest.approx(np.degrees(core.body.heading_rad), rel=1e-6)
    assert reported[:, 1].sum() > 150  # counter-clockwise is positive
    assert struct.unpack(">hh", core.handle(ask, 10.0)) == (0, 0)
    # One alone does not reset the other.
    core.handle(bytes([Op.SENSORS, Packet.DISTANCE]), 12.0)
    (angle,) = struct.unpack(">h", core.handle(bytes([Op.SENSORS, Packet.ANGLE]), 12.0))
    assert angle > 20
    core.handle(bytes([Op.DRIVE_DIRECT]) + struct.pack(">hh", -200, -200), 12.0)
    core.handle(ask, 12.0)
    distance, angle = struct.unpack(">hh", core.handle(ask, 13.0))
    assert (distance < -190, angle) == (True, 0)
