"""Client and emulator over real UDP sockets on loopback."""

from __future__ import annotations

import os
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from radar_ends import udp

from tagid.errors import DeviceError, DeviceTimeoutError, PortInUseError, TagidError, UsageError
from tagid.radar import links
from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.emulator import ServeOptions
from tagid.radar.emulation.firmware import SERVER_ONLY
from tagid.radar.emulation.sources import RecordingSource
from tagid.radar.links import UdpLink
from tagid.radar.messages import MessageType, decode, encode
from tagid.radar.p440 import P440
from tagid.radar.settings import RadarConfig
from tagid.recording import radars
from tagid.recording.radars import emulated_object, emulated_recording, open_radar
from tests.emulators import UdpEmulator

T = MessageType
ROOT = Path(os.environ.get("TAGID_SHARED", Path(__file__).resolve().parents[2].parent / "shared"))
RECORDINGS = sorted((ROOT / "data" / "p440").glob("*.out"))


class Noise:
    """Counts that depend on the scan, some beyond full scale."""

    def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
        return np.random.default_rng(index).integers(-400_000, 400_000, config.samples, dtype=np.int32)


def expected(index: int, config: RadarConfig) -> np.ndarray:
    limit = 127 * 2**config.base_integration_index
    return np.clip(Noise().scan(index, 0.0, config), -limit, limit)


def test_every_scan_arrives_over_loopback_as_fast_as_it_can() -> None:
    with udp(EmulatorCore(Noise())) as device, P440(UdpLink(*device.address)) as radar:
        config = radar.set_config(RadarConfig(scan_start_ps=36684, scan_stop_ps=106996))
        got = list(radar.scans(300))
        assert [s.scan_id - got[0].scan_id for s in got] == list(range(300))
        for i, scan in enumerate(got):
            np.testing.assert_array_equal(scan.samples, expected(i, config))
        # Whole milliseconds on the clock of the timing formula.
        clock = np.array([s.radar_time_ms for s in got])
        assert np.ptp(clock - np.arange(300) * config.scan_period_s * 1e3) <= 1.0 + 1e-6
        assert radar.statistics.lost_scans == 0


def test_a_slow_reader_is_not_overrun() -> None:
    with udp() as device, P440(UdpLink(*device.address)) as radar:
        run = radar.scans(400)
        next(run)
        time.sleep(0.3)
        assert len(list(run)) == 399


def test_the_real_timing_is_kept() -> None:
    with udp(rate=1.0) as device, P440(UdpLink(*device.address)) as radar:
        start = time.monotonic()
        got = list(radar.scans(20))
        assert time.monotonic() - start >= 20 * radar.config.scan_period_s * 0.95
        assert len(got) == 20


def test_a_source_slower_than_the_radar_does_not_deafen_it() -> None:
    class Slow(Noise):
        def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
            time.sleep(0.02)
            return super().scan(index, time_s, config)

    core = EmulatorCore(Slow())
    with udp(core, rate=50.0) as device, P440(UdpLink(*device.address)) as radar:
        run = radar.scans()
        assert [next(run).scan_id for _ in range(5)]
        run.close()  # type: ignore[attr-defined]
        assert not core.scanning
        assert radar.statistics.retries == 0


def test_nobody_answers() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute:
        mute.bind(("127.0.0.1", 0))
        radar = P440(UdpLink(*mute.getsockname()), timeout=0.05)
        with pytest.raises(DeviceTimeoutError) as caught, radar:
            pass
        assert "127.0.0.1" in caught.value.message
        assert "192.168.1.1" in caught.value.remedy


def test_a_port_without_a_program_is_named_at_once_unless_it_was_heard() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as former:
        former.bind(("127.0.0.1", 0))
        address = former.getsockname()
        heard = UdpLink(*address)
        heard.send(b"a")
        former.sendto(b"b", former.recvfrom(10)[1])
        assert heard.receive(10.0) == b"b"
    radar = P440(UdpLink(*address), timeout=3600.0)
    with (
        pytest.raises(DeviceTimeoutError, match=f"nothing listens at udp://127.0.0.1:{address[1]}") as caught,
        radar,
    ):
        pass
    assert f"({address[1]}; a P440 listens on 21210)" in caught.value.remedy
    for _ in range(2):
        heard.send(b"a")
        assert heard.receive(0.01) is None, "it may be about to return"
    heard.close()


def test_the_emulator_answers_what_it_does_not_know() -> None:
    with udp() as device, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as raw:
        raw.settimeout(2)
        for request, answer in (
            ("12340007", "f10c00071234000700000008"),
            ("1003000812", "f10c00081003000800000005"),
            ("f10100090000", "f10c0009f101000900000005"),
        ):
            raw.sendto(bytes.fromhex(request), device.address)
            assert raw.recv(2000).hex() == answer
        for kind in MessageType:
            if kind.name.endswith("_REQUEST") and kind is not T.REBOOT_REQUEST:
                raw.sendto(encode(kind, 5), device.address)
                reply = decode(raw.recv(2000))
                assert reply.id == 5
                if kind in SERVER_ONLY:
                    # No radar knows these: clients that try them get, and tolerate, F10C.
                    assert (reply.type, reply["bad_type"]) == (T.INVALID_MESSAGE_CONFIRM, kind)
                else:
                    assert reply.type == kind + 0x100


def test_set_config_stops_a_run_silently() -> None:
    core = EmulatorCore(Noise())
    core.handle(encode(T.CONTROL_REQUEST, 1, scan_count=65_535))
    assert core.scanning
    core.handle(encode(T.SET_CONFIG_REQUEST, 2, config=RadarConfig().to_record()))
    assert not core.scanning


def test_a_port_in_use_is_named() -> None:
    with udp() as device:
        with pytest.raises(PortInUseError, match=str(device.address[1])):
            UdpEmulator(EmulatorCore(Noise()), ServeOptions(port=device.address[1])).__enter__()
        with pytest.raises(PortInUseError):
            UdpLink("127.0.0.1", 21210, local_port=device.address[1])


def test_an_unknown_host_is_named() -> None:
    with pytest.raises(DeviceError, match="no such host"):
        UdpLink("no such host", 21210)


@pytest.mark.skipif(not RECORDINGS, reason="the folder of real recordings is not here")
@pytest.mark.parametrize("path", RECORDINGS, ids=lambda p: p.stem)
def test_a_real_recording_comes_over_the_wire_sample_for_sample(path: Path) -> None:
    """The payloads on the wire equal those in the file, and the client gets back every count."""
    source = emulated_recording(path, loop=False)
    with udp(EmulatorCore(source)) as device, P440(UdpLink(*device.address)) as radar:
        took = radar.set_config(RadarConfig(scan_start_ps=1000, scan_stop_ps=9000))
        assert (took.scan_start_ps, took.scan_stop_ps, took.samples) == (36684, 106996, 1152)
        got = list(radar.scans(source.views))
    np.testing.assert_array_equal([s.samples for s in got], source._samples)
    assert [s.radar_time_ms for s in got] == source._times.tolist()
    core = EmulatorCore(emulated_recording(path, loop=False))
    core.handle(encode(T.CONTROL_REQUEST, 0, scan_count=65_535))
    wire = b"".join(packet for _ in range(source.views) for packet in core.step())
    assert wire == path.read_bytes()[32:]


def test_urls_open_the_same_client(monkeypatch: pytest.MonkeyPatch) -> None:
    config = RadarConfig().quantised()
    samples = np.stack([expected(i, config) for i in range(7)])
    monkeypatch.setattr(
        radars, "emulated_recording", lambda path, loop: RecordingSource(samples, config, loop=loop)
    )
    with open_radar("replay://some/file.tagid.h5") as radar:
        assert len(list(radar.scans())) == 7  # a replay ends by itself
        assert len(list(radar.scans())) == 7
    with open_radar("replay://file?loop=1") as radar:
        got = list(radar.scans(20))
        np.testing.assert_array_equal(got[15].samples, got[1].samples)
        assert (np.diff([s.radar_time_ms for s in got]) > 0).all()
    with open_radar("emulator://helmet-120?seed=1&rpm=2&rate=0") as radar:
        assert len(list(radar.scans(5))) == 5


@pytest.mark.parametrize(
    "url",
    ["192.168.1.100", "tcp://x", "serial://", "serial://ttyACM0", "serial:///dev/ttyACM0?framing=spi",
     "serial:///dev/ttyACM0?baud=1", "serial:///dev/ttyACM0?speed=1", "udp://", "udp://host:99999",
     "udp://host:x", "udp://host?rate=1", "udp://u@host", "udp://[::1", "replay://", "replay://f?what=1",
     "emulator://x?rate=fast", "emulator://x?rate=nan", "emulator://x?lose=2", "emulator://x?seed=-1",
     "emulator://x?=&"],
)  # fmt: skip
def test_urls_that_cannot_work_say_what_does(url: str) -> None:
    with pytest.raises(UsageError) as caught:
        open_radar(url)
    assert isinstance(caught.value, TagidError)
    assert caught.value.remedy


def test_a_silent_resolver_is_waited_for_only_so_long(monkeypatch: pytest.MonkeyPatch) -> None:
    answered = threading.Event()
    monkeypatch.setattr(links, "_RESOLVE_S", 0.05)
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: answered.wait(30) and [])
    with pytest.raises(DeviceError, match="no answer within 0"):
        open_radar("udp://radar.example")
    answered.set()


@pytest.mark.parametrize(
    "query",
    ["seed=-1", "seed=1.5", "seed=1e300", "seed=9e99999", "rpm=nan", "snr=1e300", "centre=1e400,0",
     "cable_delay=inf", "budget=1&axis_distance=1e-300", "antenna_height=-1e9", "stop=-1", "x=1"],
)  # fmt: skip
def test_numbers_of_a_scene_are_bounded_where_they_come_in(query: str) -> None:
    for take in (emulated_object, open_radar):
        with pytest.raises(UsageError) as caught:
            take(f"emulator://helmet-120?{query}")
        assert caught.value.remedy
