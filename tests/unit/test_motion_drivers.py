"""Drivers of the robot and of the tables on emulators in memory; and what every commanded device shares:
however its thread or its start fails, it is halted, once and first."""

from __future__ import annotations

import math
import os
import select
import threading
import time
import tty
from typing import Any

import numpy as np
import pytest

from tagid.angles.align import measured_angles
from tagid.angles.clock import fit_clock
from tagid.angles.period import MIN_TURNS
from tagid.errors import DeviceError, DeviceGoneError
from tagid.metadata import ResolvedMotion, Track
from tagid.motion.calibration import wheel_base_from
from tagid.motion.device import MotionStoppedError, PausedError
from tagid.motion.driven import AngleReading, DrivenMotion
from tagid.motion.emulation.roomba import RoombaCore, World
from tagid.motion.emulation.table import ComximCore
from tagid.motion.links import SerialLink
from tagid.motion.roomba import messages as oi
from tagid.motion.roomba.client import OpenInterface
from tagid.motion.roomba.messages import Mode, Packet
from tagid.motion.roomba.odometry import SpinOdometry
from tagid.motion.tables import polled
from tagid.motion.tables.polled import PolledTable
from tagid.motion.urls import open_motion
from tagid.station.errors import OverloadedError, begin
from tagid.workers import Worker


class MemoryLink:
    """A link to an emulated device, whose clock stands until the test advances it."""

    def __init__(self, core: RoombaCore | ComximCore) -> None:
        self.core, self.now_s = core, 0.0
        self.answers = b""

    def write(self, data: bytes) -> None:
        self.answers += self.core.handle(data, self.now_s)

    def read(self, timeout: float) -> bytes:
        answers, self.answers = self.answers, b""
        return answers

    def arm(self, timeout_s: float) -> None:
        """Nothing watches a device in memory."""

    def beat(self) -> None:
        """As `arm`."""

    disarm = wake = close = beat


@pytest.mark.parametrize("mode_offset", [-1, 0, 1])
def test_safe_mode_is_recognised_whatever_the_firmware_adds(mode_offset: int) -> None:
    core = RoombaCore(world=World(mode_offset=mode_offset))
    robot = OpenInterface(MemoryLink(core))
    assert robot.wake().mode_offset == mode_offset
    robot.safe()
    assert core.mode is Mode.SAFE


@pytest.mark.parametrize("direction", [1, -1])
def test_a_positive_direction_is_counter_clockwise_and_the_odometry_agrees(direction: int) -> None:
    core, odometry = RoombaCore(), SpinOdometry(direction)
    link = MemoryLink(core)
    robot = OpenInterface(link)
    robot.wake()
    robot.safe()
    for moment_s in (0.0, 4.0):
        link.now_s = moment_s
        values = robot.query([Packet.LEFT_ENCODER, Packet.RIGHT_ENCODER])
        odometry.add(values[Packet.LEFT_ENCODER], values[Packet.RIGHT_ENCODER])
        robot.spin(direction, 57)
    turned = core.body.heading_rad
    assert math.copysign(1, turned) == direction and abs(turned) > 1
    assert odometry.angle_rad == pytest.approx(turned, rel=0.1)


@pytest.mark.parametrize(("contacts", "charging"), [(1, 0), (2, 0), (0, 2)])
def test_a_full_robot_on_its_base_is_on_the_charger(contacts: int, charging: int) -> None:
    """Bit 0: internal charger, bit 1: home base; a full battery is not being charged."""

    class Answers(MemoryLink):
        def write(self, data: bytes) -> None:
            if data.startswith(bytes([oi.Op.QUERY_LIST])):
                values = {Packet.MODE: Mode.PASSIVE, Packet.VOLTAGE: 16_000}
                values |= {Packet.CHARGER: contacts, Packet.CHARGING_STATE: charging}
                self.answers = b"".join(oi.pack_packet(packet, values) for packet in data[2:])

    assert OpenInterface(Answers(RoombaCore())).status().on_charger


def test_wheels_that_disagree_widen_the_angle_by_half_of_their_difference() -> None:
    odometry, difference = SpinOdometry(1), SpinOdometry(1)
    for item, left, right in ((odometry, -900, 1000), (difference, 0, 100)):
        item.add(0, 0)
        item.add(left, right)
    assert odometry.sigma_rad == pytest.approx(difference.angle_rad / 2, rel=0.01)


@pytest.mark.parametrize("direction", ["ccw", "cw"])
@pytest.mark.parametrize("backwards", [False, True])
def test_a_tables_angle_goes_on_beyond_a_turn(
    monkeypatch: pytest.MonkeyPatch, direction: str, backwards: bool
) -> None:
    monkeypatch.setattr(polled, "POLL_S", 1e-3)
    core = ComximCore(backwards=backwards)
    table = open_motion(f"comxim+serial:///dev/x?direction={direction}&turns=2&reversed={int(backwards)}")
    assert isinstance(table, PolledTable)
    table._link = link = MemoryLink(core)
    table._begin()
    rows = []
    while link.now_s < 40:
        link.now_s += 0.5  # 9 degrees
        rows += [(angle, math.radians(core.table.angle_deg)) for _, angle, _ in table._poll()]
    reported, true = np.array(rows).T
    assert abs(true[-1] - true[0]) > 2 * math.pi
    assert math.copysign(1, reported[-1]) == table.direction
    np.testing.assert_allclose(reported - reported[0], true - true[0], atol=0.01)


def test_a_turn_is_recorded_even_if_the_device_overestimates_its_angle_by_three_sigma() -> None:
    robot = open_motion("roomba+serial:///dev/x")
    assert robot.scale_sigma > 0.03
    assert robot.turns / (1 + 3 * robot.scale_sigma) > MIN_TURNS


def test_a_wheel_base_is_as_uncertain_as_the_turn_it_was_measured_on() -> None:
    turn_rad = 2 * math.pi * 1.03
    resolved = ResolvedMotion(
        checked_by_radar=True, radar_turn_in_own_rad=turn_rad, radar_turn_sigma_rad=0.01 * turn_rad,
        wheel_base_mm=235.0, robot="robot", turns=2.0,
    )  # fmt: skip
    name, calibration = wheel_base_from(resolved)
    assert (name, calibration.turns) == ("robot", 2.0)
    assert calibration.wheel_base_mm == pytest.approx(1.03 * 235.0)
    assert calibration.sigma == pytest.approx(0.01)


def test_an_angle_whose_scale_the_radar_did_not_measure_grows_uncertain_with_it() -> None:
    times_s = 0.02 * np.arange(500)
    arrivals = 10**18 + (times_s * 1e9).astype(np.int64)
    track = Track(arrivals, 0.7 * times_s, np.full(500, 1e-3), {"scale_sigma": 0.06})
    noise = np.random.default_rng(1).standard_normal((500, 32))
    measured = measured_angles(noise, fit_clock(1e3 * times_s), arrivals, track)
    assert not measured.info.checked_by_radar and measured.info.scale == 1.0
    assert measured.sigma_rad[0] < 0.01
    assert measured.sigma_rad[-1] == pytest.approx(0.06 * 0.7 * times_s[-1], rel=0.01)


def test_a_device_that_is_started_again_begins_a_new_track() -> None:
    motion = Scripted()
    for _ in range(2):
        started_ns = time.time_ns()
        motion.start()
        while not motion.turned_rad:
            time.sleep(1e-3)
        motion.stop()
        assert motion.track().host_time_ns[0] >= started_ns


class Scripted(DrivenMotion):
    """A device whose steps fail as told."""

    kind = "scripted"
    stops_by = "hold it"

    def __init__(self, max_seconds: float = 300.0, **errors: BaseException) -> None:
        super().__init__("the thing", 1, 10.0, max_seconds=max_seconds)
        self.errors, self.calls = errors, list[str]()

    def _step(self, name: str) -> None:
        self.calls.append(name)
        if name in self.errors:
            raise self.errors[name]

    def _poll(self) -> list[AngleReading]:
        time.sleep(1e-3)
        if "poll" in self.errors and self._readings:
            raise self.errors["poll"]
        return [(time.time_ns(), 0.5, 1e-3)]

    def _begin(self) -> None:
        self._step("begin")

    def _halt(self) -> None:
        self._step("halt")

    def _close(self) -> None:
        self._step("close")

    def describe(self) -> dict[str, Any]:
        return {}

    def halt_now(self) -> None:
        """Nothing."""


def run_to_its_end(motion: DrivenMotion) -> None:
    motion.start()
    worker = motion._worker
    assert worker.join(20)


@pytest.mark.parametrize("fault", [ZeroDivisionError, SystemExit])
def test_an_exception_in_the_thread_halts_and_is_told(fault: type[BaseException]) -> None:
    motion = Scripted(poll=fault("a fault of the program"))
    run_to_its_end(motion)
    assert motion.calls == ["begin", "halt"], "halted before anybody asked"
    with pytest.raises(DeviceError, match=f"{fault.__name__}: a fault of the program"):
        motion.check()
    motion.stop()
    assert motion.calls[-1] == "close"


@pytest.mark.parametrize("error", [DeviceError("the start failed"), KeyboardInterrupt(), OSError("port")])
def test_a_start_that_fails_halts_and_lets_go(error: BaseException) -> None:
    motion = Scripted(begin=error)
    with pytest.raises(type(error)):
        motion.start()
    assert motion.calls == ["begin", "halt", "close"]


@pytest.mark.parametrize("error", [RuntimeError("can't start new thread"), MemoryError()])
def test_a_thread_that_does_not_start_halts_with_a_remedy(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def start(thread: threading.Thread) -> None:
        raise error

    monkeypatch.setattr(threading.Thread, "start", start)
    motion = Scripted()
    with pytest.raises(DeviceError, match="thread that drives the thing does not start") as caught:
        motion.start()
    assert "Free memory and processes" in caught.value.remedy
    assert motion.calls == ["begin", "halt", "close"]
    with pytest.raises(OverloadedError):
        begin(Worker(lambda: None, "any"))


def test_it_turns_no_longer_than_max_seconds() -> None:
    motion = Scripted(max_seconds=0.05)
    run_to_its_end(motion)
    assert motion.calls == ["begin", "halt"]
    with pytest.raises(MotionStoppedError, match="has turned for"):
        motion.check()


@pytest.mark.parametrize("cause", [DeviceGoneError("the cable is out", "Check it."), KeyError("x")])
def test_a_halt_that_fails_says_first_that_it_may_still_turn(cause: Exception) -> None:
    motion = Scripted(poll=cause, halt=KeyError("no answer"))
    run_to_its_end(motion)
    with pytest.raises(DeviceError, match=r"^It may still be turning: hold it\. .*") as error:
        motion.stop()
    assert isinstance(error.value, DeviceGoneError) == isinstance(cause, DeviceGoneError)


def test_a_pause_marks_the_angle_as_lost() -> None:
    motion = Scripted(poll=PausedError("paused"))
    run_to_its_end(motion)
    track = motion.track()
    assert track.sigma_rad[-1] == pytest.approx(math.pi) and track.sigma_rad[-2] < 0.01


def waiting(master: int) -> bytes:
    """What has arrived; b"" where nothing has."""
    return os.read(master, 100) if select.select([master], [], [], 1.0)[0] else b""


def test_a_link_closed_without_disarming_stops_the_device() -> None:
    """The error path of every driver: whatever happened, the guardian has the last word."""
    master, slave = os.openpty()
    tty.setraw(slave)
    for disarmed in (False, True):
        link = SerialLink(os.ttyname(slave), 115200, b"HALT")
        link.arm(30.0)
        if disarmed:
            link.write(b"last words")
            link.disarm()
        else:
            link.close()
            assert waiting(master) == b"HALT" * 3, "the guardian has ended, so all of it is there"
    link.close()
    assert waiting(master) == b"last words"
    for descriptor in (master, slave):
        os.close(descriptor)
