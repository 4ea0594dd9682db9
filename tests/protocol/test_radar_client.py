"""The client against a scripted peer: what it sends, to the byte, and how it takes bad answers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
import pytest

from tagid.errors import DeviceRejectedError, DeviceTimeoutError, UsageError
from tagid.radar.emulation.core import EmulatorCore, Identity
from tagid.radar.emulation.faults import Faults
from tagid.radar.emulation.memory import MemoryLink
from tagid.radar.messages import MessageType, Status, decode, encode
from tagid.radar.p440 import P440
from tagid.radar.settings import RadarConfig

T = MessageType


class Ramp:
    """Scan i holds i, i + 1, ..."""

    def scan(self, index: int, time_s: float, config: RadarConfig) -> np.ndarray:
        return np.arange(config.samples, dtype=np.int32) + index


class TapLink(MemoryLink):
    """Records what is sent, and may replace or drop what arrives."""

    def __init__(self, core: EmulatorCore, faults: Faults | None = None) -> None:
        super().__init__(core, faults=faults)
        self.sent: list[bytes] = []
        self.change: Callable[[bytes], list[bytes]] = lambda packet: [packet]
        self._changed: deque[bytes] = deque()

    def send(self, packet: bytes) -> None:
        self.sent.append(packet)
        super().send(packet)

    def receive(self, timeout: float) -> bytes | None:
        if not self._changed:
            packet = super().receive(timeout)
            if packet is None:
                return None
            self._changed.extend(self.change(packet))
        return self._changed.popleft() if self._changed else None


def client(core: EmulatorCore | None = None) -> tuple[P440, TapLink]:
    link = TapLink(core or EmulatorCore(Ramp()))
    return P440(link, timeout=0.05), link


def test_a_whole_session_sends_exactly_these_bytes() -> None:
    radar, link = client()
    with radar:
        took = radar.set_config(RadarConfig(scan_start_ps=15000, scan_stop_ps=20000, transmit_gain=5))
        assert [s.samples[0] for s in radar.scans(2, interval_us=16)] == [0, 1]
    assert (took.scan_start_ps, took.samples) == (14999, 96)
    assert [p.hex() for p in link.sent] == [
        "100300010000000000000000",  # stop whatever runs
        "10020002",
        "10010003" + "0000000100003a9800004e200020000b" + "0000" * 4 + "00" * 4 + "02050000",
        "10020004",
        "100300050002000000000010",  # the run: its scans carry ids 5 and 6
        "100300070000000000000000",  # stop
    ]


@pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt])
def test_the_radar_is_stopped_however_the_caller_leaves(kind: type[BaseException]) -> None:
    core = EmulatorCore(Ramp())
    radar, link = client(core)
    with pytest.raises(kind), radar:
        run = radar.scans()
        next(run)
        run.close()
        assert not core.scanning
        run = radar.scans()
        next(run)
        assert core.scanning
        raise kind
    assert not core.scanning
    assert decode(link.sent[-1])["scan_count"] == 0


def test_silence_in_the_middle_ends_in_a_timeout_after_the_scans_so_far() -> None:
    radar, link = client()
    got = []
    with radar:
        run = radar.scans()
        with pytest.raises(DeviceTimeoutError) as caught:
            for scan in run:
                got.append(scan.samples[0])
                if len(got) == 10:
                    link.change = lambda packet: []
    assert got == list(range(10))
    assert "after 10 scans" in caught.value.message
    assert caught.value.remedy


def test_the_last_scans_of_a_count_may_be_lost() -> None:
    """A radar that answers has done its count: the tail is lost, not the run."""
    radar, link = client()
    with radar:
        took = radar.config
        last = (radar._talk.next_id + 19) & 0xFFFF
        link.change = lambda p: [] if decode(p).type is T.SCAN_INFO and decode(p).id >= last - 2 else [p]
        assert len(list(radar.scans(20))) == 17
        assert radar.statistics.lost_scans == 3
        link.change = lambda p: [p]
        assert radar.get_config() == took


def test_a_refusal_is_explained() -> None:
    radar, link = client()
    with radar:
        link.change = lambda p: [
            encode(T.INVALID_MESSAGE_CONFIRM, decode(p).id, bad_type=0xF001, bad_id=decode(p).id, status=8)
        ]
        with pytest.raises(DeviceRejectedError, match="not recognised"):
            radar.status()
        link.change = lambda p: [encode(T.SET_CONFIG_CONFIRM, decode(p).id, status=Status.NOT_ENABLED)]
        with pytest.raises(DeviceRejectedError, match="not enabled"):
            radar.set_config(RadarConfig())
        link.change = lambda p: [p]


def test_garbage_between_messages_is_counted_and_dropped() -> None:
    radar, link = client()
    link.change = lambda p: [b"", b"\x10", p[:-1], b"\xff" * 40, p]
    with radar:
        assert [s.samples[0] for s in radar.scans(5)] == [0, 1, 2, 3, 4]
        assert radar.statistics.malformed > 20
        assert radar.statistics.lost_scans == 0


def test_sleep_and_wrong_mode_are_mended_at_connect() -> None:
    core = EmulatorCore(Ramp())
    core.handle(encode(T.SET_SLEEPMODE_REQUEST, 1, mode=4))
    radar, _ = client(core)
    with radar:
        assert radar.get_sleep_mode() == 0
        radar.set_opmode(0)
    radar, _ = client(core)
    with radar:
        assert radar.get_opmode() == 1
        assert radar.status().serial == 0x440
        with pytest.raises(DeviceRejectedError, match="unsupported"):
            radar.set_sleep_mode(9)


def test_reboot_keeps_what_was_persisted() -> None:
    core = EmulatorCore(Ramp(), identity=Identity(boot_s=7))
    radar, _ = client(core)
    with radar:
        kept = radar.set_config(RadarConfig(transmit_gain=7, persist=1))
        radar.set_config(RadarConfig(transmit_gain=9))
        assert radar.reboot(wait_s=1.0) == kept


@pytest.mark.parametrize("seed", range(5))
def test_lost_answers_are_asked_for_again(seed: int) -> None:
    core = EmulatorCore(Ramp())
    link = MemoryLink(core, faults=Faults(lose=0.1, lose_requests=0.3, duplicate=0.1, reorder=0.1, seed=seed))
    with P440(link, timeout=0.02, attempts=12) as radar:
        wanted = RadarConfig(transmit_gain=seed).quantised()
        assert radar.set_config(wanted) == wanted
        got = list(radar.scans(50))
        s = radar.statistics
        assert s.retries > 0
        assert len(got) + s.lost_scans >= 50
        first = got[0].scan_id - got[0].samples[0]
        for scan in got:
            np.testing.assert_array_equal(
                scan.samples, np.arange(radar.config.samples) + scan.scan_id - first
            )


def test_nonsense_is_refused_before_it_is_sent() -> None:
    radar, link = client()
    with radar:
        before = len(link.sent)
        for count, interval in ((0, 0), (65_536, 0), (1, -1), (1, 2**32)):
            with pytest.raises(UsageError):
                next(radar.scans(count, interval))
        with pytest.raises(UsageError):
            radar.set_opmode(-1)
        assert len(link.sent) == before
        run = radar.scans()
        next(run)
        with pytest.raises(UsageError, match="already"):
            next(radar.scans())
