"""The robot's driver over a real pty against the emulated robot: what it says, and what makes it stop."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import serial
from robots import comes_to_rest, turned

from tagid.errors import DeviceError, DeviceGoneError, DeviceTimeoutError, PortInUseError
from tagid.motion.device import MotionStoppedError, PausedError
from tagid.motion.emulation.body import BodySettings
from tagid.motion.emulation.roomba import RoombaHost, World, happen
from tagid.motion.roomba.device import Roomba
from tagid.motion.roomba.messages import Mode
from tagid.motion.urls import open_motion
from tagid.pipeline.turn import resolve_turn
from tagid.recording.plan import RecordingPlan
from tagid.recording.radars import open_radar
from tagid.recording.recorder import Watch, record

pytestmark = pytest.mark.realtime


@pytest.fixture
def host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RoombaHost]:
    monkeypatch.setenv("TAGID_DATA", str(tmp_path / "data"))
    with RoombaHost(BodySettings(seed=1, first_count=32_700)) as there:
        yield there


def robot_at(host: RoombaHost, options: str = "") -> Roomba:
    motion = open_motion(f"roomba+serial://{host.port.path}{options}")
    assert isinstance(motion, Roomba)
    return motion


def truth_at_last_reading(host: RoombaHost, motion: Roomba) -> float:
    ago = (time.time_ns() - motion.track().host_time_ns[-1]) * 1e-9
    with host.port.lock:
        return host.core.body.heading_at(time.monotonic() - ago)


@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_it_turns_the_way_it_was_told_and_says_how_far(host: RoombaHost, direction: str) -> None:
    motion = robot_at(host, f"?step=3&direction={direction}")
    motion.start()
    turned(motion, 0.5)
    motion.stop()
    assert np.sign(host.core.body.heading_rad) == (1 if direction == "ccw" else -1)
    assert motion.turned_rad == pytest.approx(truth_at_last_reading(host, motion), abs=np.radians(5))
    assert host.core.mode is Mode.PASSIVE and comes_to_rest(host, 2)
    track = motion.track()
    assert np.all(np.diff(track.host_time_ns) >= 0) and track.sigma_rad.max() < np.radians(1)
    assert np.median(np.abs(np.diff(track.angles_rad))) == pytest.approx(np.radians(41.7) * 0.015, rel=0.2)
    motion.stop()  # a second time is harmless


@pytest.mark.parametrize(
    ("event", "cause"),
    [("wheel-drop", "dropped wheel"), ("bump", "bumped"), ("cliff", "cliff"), ("charger", "charger")],
)
def test_what_happens_to_it_stops_it_with_its_cause(host: RoombaHost, event: str, cause: str) -> None:
    motion = robot_at(host, "?step=3")
    motion.start()
    turned(motion, 0.1)
    with host.port.lock:
        happen(host.core.world, event)
    with pytest.raises(MotionStoppedError, match=cause):
        turned(motion, 3)
    motion.stop()
    assert host.core.mode is Mode.PASSIVE and comes_to_rest(host, 2)


def test_a_cable_that_falls_silent_is_told_within_half_a_second(host: RoombaHost) -> None:
    motion = robot_at(host)
    motion.start()
    turned(motion, 0.1)
    with host.port.lock:  # no more bytes pass, while the robot keeps running
        host.port._core = SimpleNamespace(
            baud=115200,
            handle=lambda data, now_s: b"",
            advance=lambda now_s: host.core.advance(now_s) and b"",
        )
    cut = time.monotonic()
    with pytest.raises(DeviceTimeoutError, match="link is lost"):
        while time.monotonic() < cut + 5:
            motion.check()
            time.sleep(0.005)
    # The cable is cut, so nobody knows whether it stands: that comes first.
    with pytest.raises(DeviceTimeoutError, match=r"^It may still be turning: lift it"):
        motion.stop()
    motion.stop()


def test_falling_back_to_passive_is_noticed_also_where_the_firmware_counts_from_one(tmp_path: Path) -> None:
    with RoombaHost(world=World(mode_offset=1)) as host:
        motion = robot_at(host)
        motion.start()
        turned(motion, 0.1)
        motion.check()
        with host.port.lock:
            host.core.handle(bytes([128]), time.monotonic())
        with pytest.raises(MotionStoppedError, match="left Safe mode"):
            turned(motion, 3)
        motion.stop()


@pytest.mark.parametrize(
    ("world", "cause"),
    [
        (World(on_charger=True), "on its charger"),
        (World(wheel_drop=1), "dropped wheel"),
        (World(charge=100), "battery"),
        (World(temperature_c=70), "degC"),
    ],
)
def test_a_robot_that_may_not_turn_is_not_moved(world: World, cause: str) -> None:
    with RoombaHost(world=world) as host:
        motion = robot_at(host)
        with pytest.raises(DeviceError, match=cause) as error:
            motion.start()
        assert error.value.remedy
        assert host.core.mode is Mode.PASSIVE
        assert host.core.body.heading_rad == 0


def test_garbage_before_and_between_frames_costs_nothing(host: RoombaHost) -> None:
    """A stream that nobody stopped, and the robot's own log near its charger, which is counted."""
    with serial.Serial(host.port.path, 115200) as wire:
        wire.write(bytes([128, 148, 2, 43, 44]) + b"\x00\xff garbage \x13\x05")
    text = b"bat:   min 7  sec 41   mV 14980  mA -310  deg-C 23 \r\n"
    motion = robot_at(host, "?step=3")
    motion.start()
    turned(motion, 0.1)
    os.write(host.port._master, text)
    turned(motion, 0.3)
    motion.stop()
    assert motion.track().info["bytes_dropped"] == len(text)
    assert motion.turned_rad == pytest.approx(truth_at_last_reading(host, motion), abs=np.radians(5))


def test_the_wrong_rate_is_told_with_its_remedy(host: RoombaHost) -> None:
    with pytest.raises(DeviceError) as error:
        robot_at(host, "?baud=19200").start()
    assert "baud" in error.value.remedy


def test_19200_baud_works_where_the_robot_has_it() -> None:
    with RoombaHost(baud=19200) as host:
        motion = robot_at(host, "?baud=19200")
        motion.start()
        turned(motion, 0.2)
        motion.stop()
        assert motion.track().info["bytes_dropped"] == 0


def test_ports_that_cannot_be_opened(host: RoombaHost, tmp_path: Path) -> None:
    with pytest.raises(DeviceGoneError, match="no serial port"):
        open_motion("roomba+serial:///dev/ttyNOWHERE").start()
    plain = tmp_path / "file"
    plain.touch()
    with pytest.raises(DeviceError):
        open_motion(f"roomba+serial://{plain}").start()
    motion = robot_at(host)
    motion.start()
    with pytest.raises(PortInUseError, match="another program"):
        robot_at(host).start()
    motion.stop()
    assert comes_to_rest(host, 2)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open every port")
def test_no_permission(host: RoombaHost) -> None:
    Path(host.port.path).chmod(0)
    with pytest.raises(DeviceError, match="permission") as error:
        robot_at(host).start()
    assert "dialout" in error.value.remedy


def test_wheels_that_are_blocked_are_told_within_seconds() -> None:
    with RoombaHost(BodySettings(blocked=True)) as host:
        motion = robot_at(host)
        begin = time.monotonic()
        motion.start()
        with pytest.raises(MotionStoppedError, match="nothing turns"):
            turned(motion, 0.1)
        assert time.monotonic() - begin < 15
        motion.stop()
        assert host.core.mode is Mode.PASSIVE


def test_a_drive_command_after_the_farewell_goes_nowhere(host: RoombaHost) -> None:
    """A thread that was held up before it reads must not set the wheels in motion again."""
    motion = robot_at(host, "?step=3")
    motion.start()
    turned(motion, 0.1)
    oi = motion._oi
    assert oi is not None
    held, resumed = threading.Event(), threading.Event()

    def hold(timeout: float) -> list[tuple[int, dict[int, int]]]:
        held.set()
        resumed.wait(30)
        return []

    # Two threads that read one port steal each other's bytes, so the thread is held before it reads.
    oi.frames = hold  # type: ignore[method-assign]
    assert held.wait(10)
    motion._halt()
    driven: list[int] = []
    oi.spin = lambda direction, speed_mm_s: driven.append(speed_mm_s)  # type: ignore[method-assign]
    motion._spin(57)
    assert not driven
    with host.port.lock:
        assert host.core.mode is Mode.PASSIVE
    resumed.set()
    with contextlib.suppress(DeviceError):  # how long the thread was held decides whether it has an error
        motion.stop()
    assert comes_to_rest(host, 2)
    assert host.core.mode is Mode.PASSIVE


def test_a_program_that_is_paused_while_it_reads_does_not_blame_the_link(host: RoombaHost) -> None:
    motion = robot_at(host, "?step=3")
    motion.start()
    turned(motion, 0.1)
    assert motion._oi is not None

    def late(timeout: float) -> list[tuple[int, dict[int, int]]]:
        time.sleep(1.0)
        return []

    motion._oi.frames = late  # type: ignore[method-assign]
    with pytest.raises(PausedError, match="this program was paused for"):
        turned(motion, 3.0)
    with contextlib.suppress(DeviceError):
        motion.stop()
    assert comes_to_rest(host, 2)


def test_a_radar_that_fails_leaves_a_robot_that_stands(host: RoombaHost, tmp_path: Path) -> None:
    """The radar's packets stop in the middle of the turn."""
    radar = open_radar(f"emulator://helmet-120?rate=1&turned_by={host.truth.address}", 0.3)
    motion = robot_at(host, "?step=3")

    def silence() -> None:
        turned(motion, 0.2)
        radar._link.receive = lambda timeout: time.sleep(min(timeout, 0.05))  # type: ignore[attr-defined]

    threading.Thread(target=silence, daemon=True).start()
    plan = RecordingPlan(None, 1.0, motion="roomba+serial://" + host.port.path, resume_s=0.2)
    with pytest.raises(DeviceError) as error:
        record(radar, motion, plan, tmp_path / "scan.tagid.h5", Watch(resolve=resolve_turn))
    assert "radar" in error.value.message
    assert comes_to_rest(host, 2)
    assert host.core.mode is Mode.PASSIVE
