"""A robot behind the bridge's own firmware on virtual controllers: bleak, two processes, links cut."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bumble", reason="needs bumble: pip install ./firmware_tools")

from robots import comes_to_rest, turned

from firmware_tools.virtual.process import BoardProcess
from tagid.errors import DeviceError, DeviceGoneError
from tagid.motion.emulation.body import BodySettings
from tagid.motion.emulation.roomba import RoombaHost
from tagid.motion.roomba.device import Roomba
from tagid.motion.roomba.messages import Mode
from tagid.motion.tables.index import IndexTable
from tagid.motion.urls import open_motion
from tagid.pipeline.turn import resolve_turn
from tagid.recording.plan import RecordingPlan
from tagid.recording.radars import open_radar
from tagid.recording.recorder import Watch, record
from tagid.storage.importers import read_any

pytestmark = pytest.mark.realtime

PASSKEY = "204816"
CONFIG = {"name": "robot-1", "passkey": PASSKEY, "uart_tx": 4, "uart_rx": 5, "brc_pin": 6, "index_pin": 7}
CUTS = 6


@pytest.fixture(scope="module")
def host() -> Iterator[RoombaHost]:
    with RoombaHost(BodySettings(seed=2, first_count=-32_700)) as there:
        yield there


@pytest.fixture(scope="module")
def board(host: RoombaHost) -> Iterator[BoardProcess]:
    with BoardProcess(CONFIG, host.port.path, "--supervision-ms", "500") as process:
        yield process


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TAGID_CONFIG", str(tmp_path / "config.toml"))
    monkeypatch.setenv("TAGID_DATA", str(tmp_path))


def url_of(board: BoardProcess, options: str = "step=3", passkey: str = PASSKEY) -> str:
    return f"roomba+ble://{board.address}?hci={board.hci}&passkey={passkey}&wait=20&{options}"


def robot(board: BoardProcess) -> Roomba:
    motion = open_motion(url_of(board))
    assert isinstance(motion, Roomba)
    return motion


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Longer than any pause of a busy machine: for tests of what turns, not of what stops it."""
    monkeypatch.setattr("tagid.motion.roomba.device.DEAD_MAN_S", 5.0)
    monkeypatch.setattr("tagid.motion.roomba.device._SILENCE_S", 10.0)


@pytest.mark.usefixtures("patient")
def test_it_turns_and_is_left_in_passive(host: RoombaHost, board: BoardProcess) -> None:
    motion = robot(board)
    before = host.core.body.heading_rad
    motion.start()
    try:
        turned(motion, 0.4)
    finally:
        motion.stop()
    ago = (time.time_ns() - motion.track().host_time_ns[-1]) * 1e-9
    truth = host.core.body.heading_at(time.monotonic() - ago) - before
    # A reading is up to a connection interval old when it arrives.
    assert motion.turned_rad == pytest.approx(truth, abs=np.radians(8))
    assert comes_to_rest(host, 2)
    assert host.core.mode is Mode.PASSIVE
    assert motion.track().info["bytes_dropped"] == 0


class Cutter(threading.Thread):
    """Cuts the link when the robot has turned so far, then watches how late a busy machine wakes sleepers.

    Attributes:
        cut_s: monotonic time of the cut, s; None where the drive ended before it.
        late_s: the longest that a sleep of 5 ms took beyond that in the second after the cut, s.
    """

    def __init__(self, board: BoardProcess, motion: Roomba, angle: float) -> None:
        super().__init__(daemon=True)
        self.board, self.motion, self.angle = board, motion, angle
        self.cut_s: float | None = None
        self.late_s = 0.0
        self.ended = threading.Event()
        self.start()

    def run(self) -> None:
        while abs(self.motion.turned_rad) < self.angle:
            if self.ended.wait(0.002):
                return
        self.cut_s = self.board.command("cut") * 1e-6
        while (now := time.monotonic()) < self.cut_s + 1:
            time.sleep(0.005)
            self.late_s = max(self.late_s, time.monotonic() - now - 0.005)


# bumble leaves a write to a link that is cut unfinished; it ends with the loop.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_links_cut_at_random_moments(
    host: RoombaHost, board: BoardProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A busy machine may keep the robot's words for longer than its silence is borne with.
    monkeypatch.setattr("tagid.motion.roomba.device._SILENCE_S", 10.0)
    rng = random.Random(4)
    cuts: list[float] = []
    for drive in range(6 * CUTS):
        motion = robot(board)
        path = tmp_path / f"{drive}.tagid.h5"
        radar = open_radar(f"emulator://helmet-120?rate=1&turned_by={host.truth.address}")
        cutter = Cutter(board, motion, rng.uniform(0.05, 0.35))
        plan = RecordingPlan(None, 1.0, motion="roomba+ble://robot-1", scans=20_000)
        with pytest.raises(DeviceError) as error:
            record(radar, motion, plan, path, Watch(resolve=resolve_turn))
        cutter.ended.set()
        cutter.join(20)
        assert error.value.exit_code == 4, error.value
        assert comes_to_rest(host, 5)
        if cutter.cut_s is None:
            # A busy machine was there first (late heartbeats trip the dead-man): not one of the cuts.
            continue
        # The bridge, the robot and the air are processes of this machine: its lateness is not theirs.
        cuts.append(host.core.body.still_since_s - cutter.cut_s - 2 * cutter.late_s)
        kept = read_any(path)
        assert not kept.complete
        assert kept.angles_rad is not None and np.ptp(kept.angles_rad) > 0.01
        if len(cuts) == CUTS:
            break
    assert len(cuts) == CUTS
    assert max(cuts) < 0.5


def test_a_wrong_passkey_is_refused(host: RoombaHost, board: BoardProcess) -> None:
    motion = open_motion(url_of(board, passkey="000001"))
    with pytest.raises(DeviceError) as error:
        motion.start()
    assert "pass-key" in error.value.remedy
    assert not host.core.body.moving
    time.sleep(2.1)  # so long the bridge waits after one failed try


def test_a_name_that_nobody_bears(board: BoardProcess) -> None:
    with pytest.raises(DeviceGoneError, match="no bridge called 'robot-9'"):
        open_motion(f"roomba+ble://robot-9?hci={board.hci}&wait=0.5").start()


def test_an_hci_that_is_not_there() -> None:
    with pytest.raises(DeviceError, match="no Bluetooth controller"):
        open_motion("roomba+ble://robot-1?hci=tcp-client:127.0.0.1:1").start()


def test_index_pulses_are_whole_turns(board: BoardProcess) -> None:
    motion = open_motion(
        f"index+ble://{board.address}?hci={board.hci}&passkey={PASSKEY}&wait=20&direction=cw"
    )
    assert isinstance(motion, IndexTable) and not motion.moves
    motion.start()
    stamps = []
    for _ in range(4):
        stamps.append(board.command("index") * 1e-6)
        time.sleep(0.3)
    deadline = time.monotonic() + 10
    while abs(motion.turned_rad) < 3 * 2 * np.pi - 0.01 and time.monotonic() < deadline:
        motion.check()
        time.sleep(0.01)
    motion.stop()
    track = motion.track()
    assert track.angles_rad[-1] == pytest.approx(-6 * np.pi)
    # The pulses' own spacing on the host's time axis; the board tells late when this machine is busy.
    now, wall = time.monotonic(), time.time_ns()
    moments = now - (wall - track.host_time_ns) * 1e-9
    at_turns = np.interp([2 * np.pi, 4 * np.pi, 6 * np.pi], -track.angles_rad, moments)
    np.testing.assert_allclose(np.diff(at_turns), np.diff(stamps)[1:], atol=0.25)
