"""The emulated robot against the Open Interface document: special radii, sleep, and the end of a stop."""

from __future__ import annotations

import math
import struct

import pytest

from tagid.motion.emulation.body import BodySettings
from tagid.motion.emulation.roomba import SLEEP_AFTER_S, RoombaCore
from tagid.motion.roomba.device import HALT
from tagid.motion.roomba.messages import Mode

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
        assert left == pytest.approx(-right, abs=1) and abs(heading) == pytest.approx(
            2 * 171 / 117.5, rel=0.05
        )
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


@pytest.mark.parametrize("cut", range(6))
def test_the_halt_stops_it_amid_a_command_that_was_cut(cut: int) -> None:
    core = RoombaCore()
    command = drive(100, 1)
    core.handle(START_SAFE + command + command[:cut], 0.0)
    core.handle(HALT * 2, 0.5)
    core.advance(1.0)
    assert not core.body.moving and core.mode is Mode.PASSIVE
