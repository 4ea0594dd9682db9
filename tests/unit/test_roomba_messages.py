"""The Open Interface byte for byte, its frames out of noise, odometry, and the emulated robot against it."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tagid.errors import UsageError
from tagid.motion.emulation.body import BodySettings
from tagid.motion.emulation.roomba import SLEEP_AFTER_S, RoombaCore
from tagid.motion.roomba import messages as oi
from tagid.motion.roomba.client import StreamDecoder
from tagid.motion.roomba.device import HALT
from tagid.motion.roomba.messages import Mode, Op, Packet
from tagid.motion.roomba.odometry import MM_PER_COUNT, SpinOdometry

WATCHED = (Packet.BUMPS_AND_DROPS, Packet.MODE, Packet.LEFT_ENCODER, Packet.RIGHT_ENCODER)


def test_commands_are_those_of_the_document() -> None:
    # Create 2 OI specification: Drive Direct example.
    assert oi.drive_direct(-200, 500) == bytes([145, 255, 56, 1, 244])
    assert [oi.packet_size(group) for group in (0, 1, 2, 3, 4, 5, 6, 100, 101, 106, 107)] == [
        26, 10, 6, 10, 14, 12, 52, 80, 28, 12, 9,
    ]  # fmt: skip
    assert len(oi.stream_frame(WATCHED, {})) == 13  # for turning
    assert oi.command(Op.STOP) == b"\xad"
    assert oi.command(Op.QUERY_LIST, 2, 7, 43) == bytes([149, 2, 7, 43])
    with pytest.raises(UsageError):
        oi.drive_direct(501, 0)


@settings(max_examples=200, deadline=None)
@given(
    values=st.lists(st.tuples(*[st.integers(-32768, 32767)] * 2), min_size=1, max_size=8),
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


def test_a_frame_with_a_wrong_bit_is_no_frame() -> None:
    """The sum of all bytes is zero; a frame that passes without it would be an angle out of noise."""
    right = oi.stream_frame(WATCHED, {43: 1000, 44: -1000, 35: 2})
    assert len(StreamDecoder(WATCHED).feed(right)) == 1
    for place in range(13):
        frame, decoder = bytearray(right), StreamDecoder(WATCHED)
        frame[place] ^= 0x04
        assert decoder.feed(bytes(frame) + bytes(40)) == [] and decoder.dropped >= 1, place


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


START_SAFE = bytes((128, 131))


def drive(velocity: int, radius: int) -> bytes:
    return struct.pack(">Bhh", 137, velocity, radius)


@pytest.mark.parametrize(
    ("radius", "sign"), [(1, 1), (-1, -1), (-32768, 0), (32767, 0), (500, 1), (-500, -1)]
)
def test_the_special_radii_of_drive(radius: int, sign: int) -> None:
    """OI specification, Drive: 1 turns counter-clockwise, -1 clockwise, 8000 and 7FFF hex go straight."""
    core = RoombaCore(BodySettings(encoder_noise=0))
    core.handle(START_SAFE + drive(171, radius), 0.0)
    core.advance(2.0)
    # Packets 41 and 42, the velocities asked for: a radius of 32 m would hide in the wheels' speed steps.
    wanted = struct.unpack(">hh", core.handle(bytes((149, 2, 41, 42)), 2.0))
    if sign == 0:
        assert wanted == (171, 171)
    left, right = core.body.encoders()
    heading = core.body.heading_rad
    assert core.body.moving
    assert (abs(heading) < 1e-9) if sign == 0 else math.copysign(1, heading) == sign
    if abs(radius) == 1:
        assert left == pytest.approx(-right, abs=1)
        assert abs(heading) == pytest.approx(2 * 171 / 117.5, rel=0.05)
    elif sign == 0:
        assert left == right > 0
    else:
        assert left > 0 and right > 0 and (right > left) == (sign > 0)


def test_passive_sleeps_after_five_minutes_and_only_a_pulse_wakes_it() -> None:
    core = RoombaCore()
    core.handle(bytes([128]), 0.0)
    core.advance(SLEEP_AFTER_S - 1)
    assert not core.asleep and core.mode is Mode.PASSIVE
    core.advance(SLEEP_AFTER_S + 1)
    assert core.asleep and core.mode is Mode.OFF
    assert core.handle(bytes((128, 149, 1, 35)), SLEEP_AFTER_S + 2) == b"" and core.asleep
    core.pulse_brc()
    assert core.handle(bytes((128, 149, 1, 35)), SLEEP_AFTER_S + 3) == bytes([Mode.PASSIVE])
    # A pulse or a command restarts the five minutes.
    core.advance(2 * SLEEP_AFTER_S)
    assert not core.asleep


def test_a_stream_and_safe_mode_keep_it_awake() -> None:
    streaming, safe = RoombaCore(), RoombaCore()
    streaming.handle(bytes((128, 148, 1, 35)), 0.0)
    safe.handle(START_SAFE, 0.0)
    for core in (streaming, safe):
        core.advance(2 * SLEEP_AFTER_S)
        assert not core.asleep


def test_the_halt_stops_it_amid_a_command_that_was_cut() -> None:
    command = drive(100, 1)
    for cut in range(6):
        core = RoombaCore()
        core.handle(START_SAFE + command + command[:cut], 0.0)
        core.handle(HALT * 2, 0.5)
        core.advance(1.0)
        assert not core.body.moving and core.mode is Mode.PASSIVE, cut
