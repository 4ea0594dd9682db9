"""Client and emulator over a real pseudo-terminal, with USB and UART frames."""

from __future__ import annotations

import os
import socket
from itertools import pairwise
from pathlib import Path

import pytest
from radar_ends import THREE_FRAGMENTS, check, core, pty

from tagid.errors import DeviceError, DeviceGoneError, DeviceTimeoutError, PortInUseError
from tagid.radar.discovery import discover
from tagid.radar.emulation.emulator import ServeOptions
from tagid.radar.emulation.firmware import Firmware, Identity
from tagid.radar.framing import Framing
from tagid.radar.p440 import P440
from tagid.radar.status import RadarStatus
from tagid.radar.urls import open_link
from tagid.recording.radars import open_radar
from tests.emulators import SerialEmulator

BOTH = pytest.mark.parametrize("framing", list(Framing))


@BOTH
def test_all_scans_come_over_a_serial_port_and_noise_costs_only_what_it_hits(framing: Framing) -> None:
    """Garbage before frames, sync words in it, and half a frame: everything else arrives."""
    with pty(framing) as device, open_radar(device.url, 0.5) as radar:
        assert radar.set_config(THREE_FRAGMENTS) == THREE_FRAGMENTS.quantised()
        got = list(radar.scans(60))
        check(got, got[0].scan_id, radar.config.samples)
        assert (len(got), radar.statistics.lost_scans, radar.statistics.malformed) == (60, 0, 0)
        run = radar.scans(40)
        got = [next(run)]
        for noise in (b"\x00\xff\x17", b"\xa5\xa5\x00", b"\xa5\xa5\x05\xac\xf2\x01" + bytes(500)):
            device.order(lambda noise=noise: device.wire._frames.append(noise))
            got += [next(run) for _ in range(5)]
        got += list(run)
        check(got, got[0].scan_id, radar.config.samples)
        assert len(got) + radar.statistics.lost_scans == 40
        assert radar.statistics.lost_scans <= 2
        assert radar.statistics.skipped_bytes > 0


def test_a_slow_uart_paces_the_scans_and_is_not_taken_for_silence() -> None:
    """At 115200 baud one message takes 127 ms, far longer than the scan itself."""
    emulator = SerialEmulator(core(), ServeOptions(rate=1.0), Framing.UART, baud=115_200)
    with emulator as device, P440(open_link(device.url)(), timeout=0.2) as radar:
        got = list(radar.scans(4))
        assert len(got) == 4
        clock = [scan.radar_time_ms for scan in got]
        assert min(b - a for a, b in pairwise(clock)) >= 120


def test_old_firmware_is_understood_over_the_wire() -> None:
    firmware = Firmware(status_bytes=32, sleep_confirm_bytes=8)
    with pty(the_core=core(firmware)) as device, open_radar(device.url) as radar:
        assert radar.get_sleep_mode() == 0
        status = radar.status()
        assert (status.serial, status.package, status.temperature_c) == (0x440, "", 41.25)


def test_a_port_that_is_taken_missing_or_no_port_is_named(tmp_path: Path) -> None:
    with pty() as device, open_radar(device.url), pytest.raises(PortInUseError):
        open_radar(device.url)
    with pytest.raises(DeviceGoneError, match="no serial port"):
        open_radar(f"serial://{tmp_path}/ttyACM7")
    (tmp_path / "file").write_bytes(b"x")
    with pytest.raises(DeviceError) as caught:
        open_radar(f"serial://{tmp_path}/file")
    assert caught.value.remedy


def test_a_serial_port_without_a_radar_stays_silent() -> None:
    master, slave = os.openpty()
    try:
        radar = P440(open_link(f"serial://{os.ttyname(slave)}")(), timeout=0.05)
        with pytest.raises(DeviceTimeoutError), radar:
            pass
    finally:
        os.close(master)
        os.close(slave)


@BOTH
def test_find_asks_serial_ports_by_their_usb_number_and_those_it_is_told(framing: Framing) -> None:
    with pty(framing, core(identity=Identity(serial=5))) as device:
        listed = discover(
            (), (), lambda: [(device.url, "P440 on USB"), ("serial:///dev/nothing", "P440 on USB")]
        )
        assert [(r.url, r.status.serial if r.status else None) for r in listed.radars] == [
            (device.url, 5),
            ("serial:///dev/nothing", None),
        ]
        assert "no serial port" in listed.radars[1].problem
        assert discover((), (device.url,), list).radars[0].kind == "serial"


def test_find_ends_within_three_seconds_however_many_are_silent() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute:
        mute.bind(("127.0.0.1", 0))
        port = mute.getsockname()[1]
        silent = [f"127.0.0.{k}:{port}" for k in range(1, 9)]
        search = discover(silent, (), list)
    assert search.radars == ()
    assert len(search.asked) == 8
    assert search.seconds < 3.0


def test_a_question_that_fails_unforeseen_is_that_candidates_problem(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def dies(radar: P440) -> RadarStatus:
        raise MemoryError

    monkeypatch.setattr(P440, "status", dies)
    with pty() as device:
        (radar,) = discover((), (device.url,), list).radars
    assert radar.problem == "could not be asked: MemoryError()"
    assert capfd.readouterr().err == ""
