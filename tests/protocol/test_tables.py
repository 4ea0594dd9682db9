"""Tables with a wire against their emulators: a Comxim on a pty, a Revopoint over Bluetooth."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from tagid.errors import DeviceError, DeviceGoneError, DeviceRejectedError, DeviceTimeoutError, UsageError
from tagid.motion.device import MotionStoppedError
from tagid.motion.driven import DrivenMotion
from tagid.motion.emulation.gatt import GattPort
from tagid.motion.emulation.pty import PtyPort
from tagid.motion.emulation.table import ComximCore, RevopointCore, Steps, TurningTable
from tagid.motion.tables.polled import PolledTable
from tagid.motion.tables.revopoint import CHARACTERISTIC, SERVICE
from tagid.motion.urls import open_motion


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TAGID_CONFIG", str(tmp_path / "config.toml"))
    monkeypatch.setenv("TAGID_DATA", str(tmp_path))


def turn_and_compare(motion: DrivenMotion, table: TurningTable, radians: float) -> None:
    """Turn by so much; every angle told must be the true one of its moment, up to the first one's."""
    motion.start()
    try:
        deadline = time.monotonic() + 30
        while abs(motion.turned_rad) < radians:
            motion.check()
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        motion.stop()
    track = motion.track()
    moments = time.monotonic() - (time.time_ns() - track.host_time_ns) * 1e-9
    true = np.array([table.state(moment)["angle_rad"] for moment in moments])
    error = (track.angles_rad - track.angles_rad[0]) - (true - true[0])
    # The median, because a busy machine may hold single answers back.
    assert np.median(np.abs(error)) < np.radians(1)
    assert np.sign(track.angles_rad[-1]) == motion.direction
    assert not table.speed_deg_s


@pytest.mark.realtime
@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_a_comxim_table_tells_its_angle(direction: str) -> None:
    core = ComximCore(now_s=time.monotonic())
    with PtyPort(core) as port:
        motion = open_motion(f"comxim+serial://{port.path}?direction={direction}&turns=1")
        assert isinstance(motion, DrivenMotion)
        turn_and_compare(motion, core.table, 0.3)


@pytest.mark.realtime
@pytest.mark.parametrize("steps", Steps)
def test_a_comxim_table_is_commanded_for_seconds_where_it_takes_an_angle(steps: Steps) -> None:
    """If everything on the computer dies at once, the last command ends by itself."""
    core = ComximCore(now_s=time.monotonic(), steps=steps)
    with PtyPort(core) as port:
        # The true table is ten times as fast as told: steps of 11 degrees, renewed every 5.
        motion = open_motion(f"comxim+serial://{port.path}?period=200&turns=0.1")
        assert isinstance(motion, DrivenMotion)
        motion.start()
        ends: set[float | None] = set()
        deadline = time.monotonic() + 30
        while abs(motion.turned_rad) < 0.3:
            motion.check()
            assert time.monotonic() < deadline
            with port.lock:
                ends.add(core.ends_at if core.table.speed_deg_s else 0.0)
                assert core.ends_at is None or core.ends_at - core.table.now_s < 3.0
            time.sleep(0.005)
        motion.stop()
    assert len(ends - {0.0, None}) >= {Steps.ALWAYS: 3, Steps.AT_REST: 2, Steps.NONE: 0}[steps]
    assert (None in ends) == (steps is Steps.NONE)


@pytest.mark.realtime
@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_the_direction_is_that_of_the_makers_documents(direction: str) -> None:
    """SETDIR(0) is left, clockwise; TURNCONTINUE=1 is clockwise (docs/motion.md): byte for byte."""
    sent: list[bytes] = []

    class Link:
        def write(self, data: bytes) -> None:
            sent.append(data)

        def read(self, timeout: float) -> bytes:
            return b"CR+OK;" if b"CT+" in sent[-1][:4] else b"+OK;"

        def beat(self) -> None:
            """Nothing watches."""

    for scheme, clockwise, counter in (
        ("comxim+serial:///dev/x", b"CT+SETDIR(0);", b"CT+SETDIR(1);"),
        ("revopoint+ble://X", b"+CT,TURNCONTINUE=1;", b"+CT,TURNCONTINUE=-1;"),
    ):
        for backwards in (0, 1):
            table = open_motion(f"{scheme}?direction={direction}&reversed={backwards}")
            assert isinstance(table, PolledTable)
            sent.clear()
            table._link = Link()  # type: ignore[assignment]
            table.forget = lambda: None  # type: ignore[method-assign]
            table._set_going()
            asked = (direction == "cw") != bool(backwards)
            assert (clockwise if asked else counter) in sent
            assert (counter if asked else clockwise) not in sent


@pytest.mark.realtime
def test_a_table_that_cannot_turn_is_told_within_seconds() -> None:
    core = ComximCore(now_s=time.monotonic())
    core.table.blocked = True
    with PtyPort(core) as port:
        motion = open_motion(f"comxim+serial://{port.path}")
        begin = time.monotonic()
        motion.start()
        with pytest.raises(MotionStoppedError, match="nothing turns"):
            while time.monotonic() - begin < 15:
                motion.check()
                time.sleep(0.01)
        motion.stop()


def test_the_words_of_the_comxim_table() -> None:
    core = ComximCore(now_s=0.0)
    assert core.handle(b"CT+STARTUP();CT+ACK(1);CT+EVENT(1);", 0.0) == b"CR+OK;CR+OK;"
    assert core.handle(b"CT+GETOFFSETANGLE();", 0.0) == b"OffsetAngle= +0.00\xb0;CR+OK;"
    assert core.handle(b"CT+SETSPEED(0);", 0.0) == b"CR+ERR=81;"
    assert core.handle(b"CT+TRUNSINGLE(0,90);", 0.0) == b"CR+OK;"
    assert core.advance(60.0) == b"CR+EVENT=TB_END;"
    assert core.handle(b"nonsense;", 60.0) == b"CR+ERR=80;"


def test_a_table_that_answers_an_error_is_quoted() -> None:
    with PtyPort(ComximCore(now_s=time.monotonic(), fail=81)) as port:
        motion = open_motion(f"comxim+serial://{port.path}")
        with pytest.raises(DeviceRejectedError, match="error 81") as error:
            motion.start()
    assert error.value.remedy


@pytest.mark.realtime
def test_a_port_that_holds_no_table_is_told() -> None:
    class Mute:
        baud = 115200

        def handle(self, data: bytes, now_s: float) -> bytes:
            return b"\x00\xff noise" * 100

        def advance(self, now_s: float) -> bytes:
            return b""

    with PtyPort(Mute()) as port:
        motion = open_motion(f"comxim+serial://{port.path}")
        with pytest.raises(DeviceTimeoutError, match="does not answer"):
            motion.start()


def test_an_emulated_device_whose_thread_dies_is_told() -> None:
    class Broken(ComximCore):
        def advance(self, now_s: float) -> bytes:
            raise MemoryError("none left")

    with pytest.raises(DeviceError, match="none left"), PtyPort(Broken()) as port:
        assert port.worker.join(5)


@pytest.mark.realtime
def test_a_revopoint_table_over_bluetooth() -> None:
    core = RevopointCore(now_s=time.monotonic())
    with GattPort(core, "REVO_DUAL_AXIS_TABLE", SERVICE, CHARACTERISTIC) as port:
        motion = open_motion(f"revopoint+ble://?hci={port.hci}&period=20&direction=cw")
        assert isinstance(motion, DrivenMotion)
        turn_and_compare(motion, core.table, 0.3)
        with pytest.raises(DeviceGoneError, match="no device called"):
            open_motion(f"revopoint+ble://OTHER?hci={port.hci}&wait=0.5").start()


def test_what_a_revopoint_table_refuses() -> None:
    core = RevopointCore()
    assert core.handle(b"+CT,TURNSPEED=5;", 0.0) == b"+FAIL,ERR=007;"
    assert core.handle(b"+CT,TURNSPEED=30;+CT,TURNCONTINUE=-1;", 0.0) == b"+OK;+OK;"
    assert core.handle(b"+QT,CHANGEANGLE;", 15.3) == b"+DATA=180.00;"


@pytest.mark.parametrize(
    "url",
    ["comxim+serial://", "comxim+serial:///dev/x?speed=0", "revopoint+ble://?period=5",
     "revopoint+ble://?passkey=12", "index+ble://", "roomba+serial:///dev/x?step=1.5",
     "roomba+serial:///dev/x?step=1&rpm=2", "roomba+serial:///dev/x?baud=31250",
     "roomba+serial:///dev/x?nonsense=1", "roomba+ble://"],
)  # fmt: skip
def test_options_that_make_no_sense(url: str) -> None:
    with pytest.raises(UsageError) as error:
        open_motion(url)
    assert error.value.remedy
