"""Everything that goes wrong between a radar and its client, on real sockets and pseudo-terminals."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections import defaultdict
from contextlib import AbstractContextManager

import numpy as np
import pytest
from radar_ends import THREE_FRAGMENTS, check, core, numbered, pty, udp

from tagid.errors import DeviceError, DeviceGoneError, DeviceRestartedError
from tagid.metadata import ScanGap
from tagid.radar import p440
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.firmware import Firmware, Identity
from tagid.radar.framing import Framing, frame
from tagid.radar.links import UdpLink
from tagid.radar.messages import MessageType, encode
from tagid.radar.p440 import P440
from tagid.radar.resume import steady_scans
from tagid.radar.scan_info import SCAN_INFO_HEAD, read_fragment
from tagid.radar.settings import RadarConfig
from tagid.recording.radars import open_radar

T = MessageType
WIRES = pytest.mark.parametrize("wire", ["udp", "usb", "uart"])


def radar_on(wire: str, the_core: EmulatorCore | None = None, rate: float = 0.0) -> AbstractContextManager:
    return udp(the_core, rate) if wire == "udp" else pty(Framing(wire), the_core, rate)


class Witness(UdpLink):
    """Notes which fragments arrived."""

    def __init__(self, address: tuple[str, int]) -> None:
        super().__init__(*address)
        self.parts: dict[tuple[int, int], set[int]] = defaultdict(set)

    def receive(self, timeout: float) -> bytes | None:
        packet = super().receive(timeout)
        if packet is not None and packet.startswith(SCAN_INFO_HEAD):
            fragment = read_fragment(packet)
            assert fragment is not None
            self.parts[fragment.id, fragment.timestamp_ms].add(fragment.part)
        return packet


@pytest.mark.parametrize(
    "faults",
    [{"reorder": 0.5}, {"lose": 0.3, "duplicate": 0.1, "reorder": 0.2, "delay": 0.2, "delay_s": 0.05}],
    ids=lambda faults: " ".join(faults),
)
def test_every_complete_scan_is_delivered_once_and_in_order(faults: dict[str, float]) -> None:
    """Three fragments a scan at 700 scans a second; 50 ms of delay are 35 scans that overtake."""
    with udp(**faults, seed=5) as device:
        link = Witness(device.address)
        with P440(link, timeout=0.7, attempts=10) as radar:
            config = radar.set_config(THREE_FRAGMENTS)
            assert config.samples == 864
            link.parts.clear()
            first_id = radar._talk.next_id  # the CONTROL request's, and so the first scan's
            got = list(radar.scans(400))
            statistics = radar.statistics
        complete = sorted(scan_id for (scan_id, _), parts in link.parts.items() if len(parts) == 3)
        assert [scan.scan_id for scan in got] == complete
        check(got, first_id, config.samples)
        assert statistics.lost_scans == 400 - len(got)
        assert (len(got) < 400) == ("lose" in faults)
        assert (statistics.duplicate > 0) == ("duplicate" in faults)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2"])
def test_packets_of_another_sender_are_dropped_and_counted(host: str) -> None:
    """From another port of the radar's host, and from the radar's port on another host."""
    with udp() as device, P440(UdpLink(*device.address)) as radar:
        port = radar._link.local_port  # type: ignore[attr-defined]
        run = radar.scans(60)
        got = [next(run)]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind((host, 0 if host == device.address[0] else device.address[1]))
            for i in range(20):
                other.sendto(
                    encode(T.SCAN_INFO, i, message_samples=1, total_samples=1, message_count=1),
                    ("127.0.0.1", port),
                )
                other.sendto(encode(T.READY_INFO, 0), ("127.0.0.1", port))
            got += list(run)
        assert len(got) == 60
        assert radar.statistics.foreign == 40


def test_another_program_that_asks_does_not_get_the_scans() -> None:
    """`tagid radar find` during a recording gets its answer, and the recording keeps its scans."""
    with udp(rate=1.0) as device, P440(UdpLink(*device.address)) as radar:
        run = radar.scans(150)
        got = [next(run)]
        link = UdpLink(*device.address)
        assert P440(link).status().serial == 0x440
        link.close()
        got += list(run)
        assert len(got) == 150
        assert radar.statistics.lost_scans == 0


@pytest.mark.parametrize("framing", list(Framing))
def test_a_serial_radar_left_scanning_is_stopped_and_drained(framing: Framing) -> None:
    with pty(framing, rate=1.0) as device:
        killed = os.open(device.wire.path, os.O_RDWR | os.O_NOCTTY)
        os.write(killed, frame(encode(T.CONTROL_REQUEST, 40, scan_count=65_535), framing))
        assert len(os.read(killed, 3000)) > 0
        os.close(killed)  # without a word; the rest of a frame waits in the line
        with open_radar(device.url) as radar:
            got = list(radar.scans(50))
            check(got, got[0].scan_id, radar.config.samples)
            assert (len(got), radar.statistics.lost_scans) == (50, 0)


def test_a_client_that_comes_back_to_its_port_is_not_confused_by_its_old_scans() -> None:
    with udp(rate=1.0) as device:
        killed = UdpLink(*device.address)
        port = killed.local_port
        killed.send(encode(T.CONTROL_REQUEST, 40, scan_count=65_535))
        assert killed.receive(5.0) is not None
        killed.close()
        with P440(UdpLink(*device.address, local_port=port)) as radar:
            got = list(radar.scans(50))
            check(got, got[0].scan_id, radar.config.samples)
            assert (len(got), radar.statistics.lost_scans) == (50, 0)


@WIRES
def test_a_confirm_behind_residual_scans_ends_the_run(wire: str) -> None:
    with radar_on(wire, core(Firmware(residual_scans=7))) as device, open_radar(device.url) as radar:
        for _ in range(3):
            run = radar.scans()
            got = [next(run) for _ in range(20)]
            check(got, got[0].scan_id, radar.config.samples)
            run.close()
            assert not device.core.scanning
        assert radar.statistics.retries == 0
        assert radar.statistics.lost_scans == 0


@WIRES
def test_a_reboot_in_the_middle_is_told_and_the_scans_go_on_after_it(wire: str) -> None:
    the_core = core(identity=Identity(boot_s=0.3))
    with radar_on(wire, the_core, rate=1.0) as device, open_radar(device.url, 0.5) as radar:
        config = radar.set_config(RadarConfig(12_000, 17_000, base_integration_index=6))
        run = radar.scans()
        next(run)
        device.power_cycle()
        with pytest.raises(DeviceRestartedError):
            list(run)
        assert the_core.config != config  # flash does not know our settings
        radar.set_config(config)
        gaps: list[ScanGap] = []
        got = []
        for scan in steady_scans(radar, on_gap=gaps.append):
            got.append(scan)
            if len(got) == 30:
                device.power_cycle()
            if gaps and len(got) > 80:
                break
        assert the_core.config == config
        (gap,) = gaps
        assert gap.restarted
        assert "rebooted" in gap.reason
        check_joined(got, gap, config)


def test_a_reboot_is_waited_for_where_the_port_vanishes_and_ready_info_is_lost(
    tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on USB: the port goes while the radar boots, and READY_INFO is sent into nothing."""
    monkeypatch.setattr(p440, "BOOT_QUIET_S", 0.2)
    the_core = core(identity=Identity(boot_s=0.4))
    with (
        pty(link=tmp_path / "radar", the_core=the_core, rate=1.0) as device,
        open_radar(device.url, 0.5) as radar,
    ):
        kept = radar.set_config(RadarConfig(12_000, 17_000, base_integration_index=6, persist=1))
        timers = [threading.Timer(0.1, device.unplug), threading.Timer(0.8, device.plug)]
        for timer in timers:
            timer.start()
        assert radar.reboot(wait_s=20) == kept
        assert len(list(radar.scans(5))) == 5
        for timer in timers:
            timer.join()


def check_joined(got: list, gap: ScanGap, config: RadarConfig) -> None:
    """Numbers and clock rise, the gap is as wide in both, then comes the radar's new run."""
    ids = np.array([scan.scan_id for scan in got])
    clock = np.array([scan.radar_time_ms for scan in got])
    at = int(np.flatnonzero(ids == gap.after_scan)[0]) + 1
    assert (np.diff(ids) >= 1).all()
    assert (np.diff(clock) >= 0).all()
    assert ids[at] - ids[at - 1] == pytest.approx(gap.seconds / config.scan_period_s, abs=1.5)
    assert clock[at] - clock[at - 1] == pytest.approx(gap.seconds * 1e3, abs=1)
    np.testing.assert_array_equal(got[at].samples, numbered(0, config.samples))
    check(got[at:], got[at].scan_id, config.samples)


def test_scans_go_on_after_a_radar_was_silent_for_a_while() -> None:
    """Nothing for 0.9 s where 0.3 s are too long: asked once more, the radar is there again."""
    with udp(rate=1.0) as device, P440(UdpLink(*device.address), timeout=0.3) as radar:
        gaps: list[ScanGap] = []
        got = []
        for scan in steady_scans(radar, on_gap=gaps.append):
            got.append(scan)
            if len(got) == 30:
                device._server.order(lambda: time.sleep(0.9))
            if gaps and len(got) > 60:
                break
        (gap,) = gaps
        assert "sent nothing" in gap.reason
        assert (np.diff([scan.scan_id for scan in got]) >= 1).all()
        assert (np.diff([scan.radar_time_ms for scan in got]) >= 0).all()


def test_a_plug_that_stays_out_ends_the_run_with_what_happened(tmp_path) -> None:
    link = tmp_path / "radar"
    with pty(link=link) as device, open_radar(device.url, 0.2) as radar:
        run = steady_scans(radar, resume_s=0.3)
        next(run)
        device.unplug()
        with pytest.raises(DeviceGoneError) as caught:
            list(run)
        assert caught.value.remedy


def test_a_radar_that_comes_back_with_other_settings_is_not_recorded() -> None:
    the_core = core(identity=Identity(boot_s=0.1))
    with udp(the_core, rate=1.0) as device, open_radar(device.url, 0.5) as radar:
        run = steady_scans(radar)
        next(run)
        device.order(lambda: setattr(the_core, "_firmware", Firmware(window_step_ps=7_000)))
        device.power_cycle()
        with pytest.raises(DeviceError, match="other settings"):
            list(run)


@pytest.mark.parametrize("wire", ["udp", "uart"])
def test_ids_and_clock_wrap_unnoticed(wire: str) -> None:
    """The clock is 50 ms before 2^32 ms, the ids 30 before 65536."""
    with radar_on(wire, core(booted_s=4294967.296 - 0.05)) as device, open_radar(device.url) as radar:
        radar._talk.next_id = 65_506
        got = list(radar.scans(200))
        assert [scan.scan_id for scan in got] == list(range(65_506, 65_706))
        clock = np.array([scan.radar_time_ms for scan in got])
        assert clock[-1] > 2**32 > clock[0]
        np.testing.assert_allclose(
            clock - clock[0], np.arange(200) * radar.config.scan_period_s * 1e3, atol=1.01
        )
        check(got, 65_506, radar.config.samples)
        assert len(list(radar.scans(3))) == 3


def test_settings_quantised_otherwise_are_read_back_and_lead() -> None:
    with udp(core(Firmware(window_step_ps=4_000))) as device, open_radar(device.url) as radar:
        asked = RadarConfig(13_000, 18_500, base_integration_index=6)
        taken = radar.set_config(asked)
        assert taken.scan_start_ps == 11_999  # 12000 on the radar's own grid
        assert (asked.samples, taken.samples) == (96, 192)
        (scan,) = radar.scans(1)
        assert (scan.scan_start_ps, len(scan.samples)) == (11_999, taken.samples)
        assert radar.asked == asked
