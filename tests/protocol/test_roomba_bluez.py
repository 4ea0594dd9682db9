"""The production path on Linux: stock bleak with its BlueZ backend against a private `org.bluez`."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("bleak", reason="needs bleak")
if shutil.which("dbus-daemon") is None:
    pytest.skip("needs dbus-daemon (apt install dbus)", allow_module_level=True)

from robots import comes_to_rest, turned

from tagid.errors import DeviceError
from tagid.motion.emulation.roomba import RoombaHost
from tagid.motion.roomba.device import Roomba
from tagid.motion.roomba.messages import Mode
from tagid.motion.urls import open_motion
from tests.processes import wait_until

pytestmark = pytest.mark.realtime

ROOT = Path(__file__).resolve().parents[2]
BUSY = "org.bluez.Error.InProgress"
FAKE = Path(__file__).with_name("fake_bluez.py")
BUS = """<!DOCTYPE busconfig PUBLIC "-//freedesktop//DTD D-Bus Bus Configuration 1.0//EN"
 "http://www.freedesktop.org/standards/dbus/1.0/busconfig.dtd">
<busconfig><type>system</type><listen>unix:path={socket}</listen><auth>EXTERNAL</auth>
<policy context="default"><allow user="*"/><allow own="*"/>
<allow send_destination="*" eavesdrop="true"/><allow eavesdrop="true"/></policy></busconfig>"""


@pytest.fixture
def bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TAGID_CONFIG", str(tmp_path / "config.toml"))
    monkeypatch.setenv("TAGID_DATA", str(tmp_path))
    socket, conf = tmp_path / "bus", tmp_path / "bus.conf"
    conf.write_text(BUS.format(socket=socket))
    words = ["dbus-daemon", f"--config-file={conf}", "--nofork", "--nopidfile"]
    daemon = subprocess.Popen(words, stderr=subprocess.DEVNULL)
    wait_until(socket.exists, daemon)
    monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", f"unix:path={socket}")
    yield
    daemon.terminate()
    daemon.wait(10)


@contextmanager
def bluez(host: RoombaHost, passkey: str, *errors: str) -> Iterator[None]:
    """A private BlueZ, whose first searches fail with these errors."""
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    process = subprocess.Popen(
        [sys.executable, str(FAKE), host.port.path, passkey, *errors],
        stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield
    finally:
        process.terminate()
        process.communicate(timeout=10)


def test_a_robot_turns_over_bluez_after_pairing_by_passkey(bus: None) -> None:
    with RoombaHost() as host, bluez(host, "482913"):
        motion = open_motion("roomba+ble://robot-1?passkey=482913&wait=1&step=3")
        assert isinstance(motion, Roomba)
        motion.start()
        turned(motion, 0.3)
        motion.stop()
        assert comes_to_rest(host, 2)
        assert host.core.mode is Mode.PASSIVE and host.core.body.heading_rad > 0.25


def test_an_unpaired_host_is_refused(bus: None) -> None:
    with RoombaHost() as host, bluez(host, "482913"):
        with pytest.raises(DeviceError) as error:
            open_motion("roomba+ble://robot-1?passkey=111111&wait=1").start()
        assert "pass-key" in error.value.remedy
        assert host.core.mode is Mode.OFF


def test_a_busy_bluetooth_is_tried_again(bus: None) -> None:
    with RoombaHost() as host, bluez(host, "482913", BUSY, BUSY):
        motion = open_motion("roomba+ble://robot-1?passkey=482913&wait=1")
        assert isinstance(motion, Roomba)
        assert motion.describe()["charge"] is not None


@pytest.mark.parametrize(
    ("error", "remedy"), [(BUSY, "systemctl restart bluetooth"), ("org.bluez.Error.NotReady", "power on")]
)
def test_an_error_of_this_computer_is_not_blamed_on_the_bridge(bus: None, error: str, remedy: str) -> None:
    with RoombaHost() as host, bluez(host, "482913", *[error] * 3):
        with pytest.raises(DeviceError) as raised:
            open_motion("revopoint+ble://robot-1?wait=1").start()
        assert remedy in raised.value.remedy and "bridge" not in raised.value.remedy


def test_without_bluez_the_remedy_names_bluetooth(bus: None) -> None:
    with pytest.raises(DeviceError) as error:
        open_motion("roomba+ble://robot-1?wait=1").start()
    assert "Bluetooth" in error.value.remedy
