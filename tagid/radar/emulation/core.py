"""A P440 as a state machine: bytes in, bytes out, time as an argument. It has no sockets and no clock.

The UDP emulator, the replay and the tests all drive this core, so they behave as the same radar.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tagid.constants import BANDWIDTH_HZ, CENTER_FREQUENCY_HZ, SAMPLE_STEP_S
from tagid.errors import ConfigError
from tagid.radar.emulation.firmware import SERVER_ONLY, Firmware, Identity
from tagid.radar.emulation.sources import FollowingSource, RecordingSource, ScanSource
from tagid.radar.messages import (
    CONFIG_DTYPE,
    OPMODE_MRM,
    SAMPLES_PER_MESSAGE,
    SCAN_FOREVER,
    SLEEP_ACTIVE,
    MalformedMessage,
    Message,
    MessageType,
    Status,
    decode,
    encode,
)
from tagid.radar.scan_info import RAW_FILTER, scan_packets
from tagid.radar.settings import RadarConfig
from tagid.signal import analytic

FAST_TIME: Final = 2
MOTION: Final = 4
DETECTION_LIST: Final = 8
ALL_FILTERS: Final = RAW_FILTER | FAST_TIME | MOTION | DETECTION_LIST
_USUAL_MULTIPLIER: Final = 6
_LARGEST_U16: Final = 0xFFFF


class ServerFilters:
    """The filters of one run.

    Args:
        mask: outputs to send, a subset of `ALL_FILTERS`.
        multiplier: detection threshold as a multiple of the median magnitude of a scan; 0 means 6.
    """

    def __init__(self, mask: int, multiplier: int) -> None:
        self._mask = mask
        self._multiplier = multiplier or _USUAL_MULTIPLIER
        self._last: NDArray[np.float64] | None = None

    def packets(
        self, samples: NDArray[np.int32], config: RadarConfig, scan_id: int, timestamp_ms: int
    ) -> list[bytes]:
        """The messages that the server sends for one raw scan (config.samples,), one output after another."""
        out: list[bytes] = []
        if self._mask & RAW_FILTER:
            out += scan_packets(samples, config, scan_id, timestamp_ms)
        if not self._mask & ~RAW_FILTER:
            return out
        band = _in_band(samples)
        if self._last is None or self._last.shape != band.shape:
            self._last = band
        motion, self._last = band - self._last, band
        for bit, values in ((FAST_TIME, band), (MOTION, motion)):
            if self._mask & bit:
                counts = np.rint(values).astype(np.int32)
                out += scan_packets(counts, config, scan_id, timestamp_ms, bit)
        if self._mask & DETECTION_LIST:
            out.append(self._detections(motion, scan_id))
        return out

    def _detections(self, motion: NDArray[np.float64], scan_id: int) -> bytes:
        """The strongest maxima of the envelope above the threshold, in order of range."""
        envelope = np.abs(analytic(motion[None])[0]).astype(np.float64)
        padded = np.concatenate([[-1.0], envelope, [-1.0]])
        peaks = (padded[1:-1] > padded[:-2]) & (padded[1:-1] >= padded[2:])
        indices = np.flatnonzero(
            peaks & (envelope > self._multiplier * np.median(envelope)) & (envelope >= 1)
        )
        if len(indices) > SAMPLES_PER_MESSAGE:
            indices = np.sort(indices[np.argsort(envelope[indices])[-SAMPLES_PER_MESSAGE:]])
        detections = np.zeros(SAMPLES_PER_MESSAGE, dtype=[("index", ">u2"), ("magnitude", ">u2")])
        detections["index"][: len(indices)] = indices
        detections["magnitude"][: len(indices)] = np.minimum(np.rint(envelope[indices]), _LARGEST_U16)
        return encode(MessageType.DETECTION_LIST_INFO, scan_id, count=len(indices), detections=detections)


def _in_band(samples: NDArray[np.int32]) -> NDArray[np.float64]:
    """(bins,) samples limited to the band of the pulse."""
    spectrum = np.fft.rfft(samples.astype(np.float64))
    frequency = np.fft.rfftfreq(len(samples), SAMPLE_STEP_S)
    spectrum[np.abs(frequency - CENTER_FREQUENCY_HZ) > BANDWIDTH_HZ] = 0
    return np.asarray(np.fft.irfft(spectrum, len(samples)), dtype=np.float64)


_T = MessageType
_BAUD_RATES: Final = range(9_600, 921_601)
_MRM_REQUESTS: Final = (_T.SET_CONFIG_REQUEST, _T.GET_CONFIG_REQUEST, _T.CONTROL_REQUEST)


_LAG_S: Final = 0.5
"""Lag up to which late scans are still sent one after the other, s of the emulated clock."""
_LONGEST_LAG_S: Final = 2.0
"""Lag above which the emulator skips to the current scan, s of the emulated clock."""


@dataclass
class _Run:
    """A running scan series; times are seconds since boot."""

    first_id: int
    count: int
    period_s: float
    started_s: float
    index: int = 0

    def due_s(self) -> float:
        return self.started_s + (self.index + 1) * self.period_s


@dataclass
class _State:
    config: RadarConfig
    flash: RadarConfig
    opmode: int = OPMODE_MRM
    sleep: int = SLEEP_ACTIVE
    filter_mask: int = RAW_FILTER
    motion_index: int = 0
    multiplier: int = 0
    filters: ServerFilters = field(default_factory=lambda: ServerFilters(RAW_FILTER, 0))
    boots_until_s: float | None = None
    run: _Run | None = None
    ended: bool = False


class EmulatorCore:
    """One emulated radar.

    Times are seconds of the emulated clock. `handle` takes a request, `advance_by_one` lets time pass, `step`
    jumps to the next scan; all return the packets that leave the radar, in order.

    Args:
        source: provides the samples; a `RecordingSource` also fixes the settings and the timestamps.
        config: settings at power-up.
        identity: values reported by GET_STATUSINFO.
        booted_s: emulated time since boot at the start.
        firmware: firmware variant to emulate.
    """

    def __init__(
        self,
        source: ScanSource,
        config: RadarConfig | None = None,
        identity: Identity | None = None,
        booted_s: float = 10.0,
        firmware: Firmware | None = None,
    ) -> None:
        self._source = source
        self._fixed = source if isinstance(source, RecordingSource) else None
        self._firmware = firmware or Firmware()
        start = self._fixed.config if self._fixed else self._firmware.take(config or RadarConfig())
        self._state = _State(start, start)
        self._identity = identity or Identity()
        self._now = booted_s
        self._booted_at = 0.0

    def follow(self, monotonic: Callable[[float], float]) -> None:
        """Tell a source that needs it which time.monotonic() corresponds to an emulated time."""
        if isinstance(self._source, FollowingSource):
            self._source.follow(monotonic)

    @property
    def config(self) -> RadarConfig:
        return self._state.config

    @property
    def now_s(self) -> float:
        return self._now

    @property
    def scanning(self) -> bool:
        return self._state.run is not None

    @property
    def ended(self) -> bool:
        """Whether a recording has ended: the run stopped because no scans were left."""
        return self._state.ended and self._state.run is None

    @property
    def next_due_s(self) -> float | None:
        """Emulated time at which the next packet is sent without a request; None if none is scheduled."""
        if self._state.boots_until_s is not None:
            return self._state.boots_until_s
        return self._state.run.due_s() if self._state.run else None

    def handle(self, packet: bytes) -> list[bytes]:
        """Answers to one packet from a client; a booting radar ignores it."""
        if self._state.boots_until_s is not None or len(packet) < 4:
            return []
        try:
            message = decode(packet)
        except MalformedMessage as error:
            return [_invalid(packet, error.status)]
        handler = _HANDLERS.get(message.type)
        if handler is None or (message.type in SERVER_ONLY and not self._firmware.server):
            return [_invalid(packet, Status.UNRECOGNISED)]
        if message.type in _MRM_REQUESTS and self._state.opmode != OPMODE_MRM:
            return [self._refuse(message, Status.WRONG_OPMODE)]
        if message.type is _T.CONTROL_REQUEST and self._state.sleep != SLEEP_ACTIVE:
            return [self._refuse(message, Status.INVALID_DURING_SLEEP)]
        residual: list[bytes] = []
        if message.type is _T.CONTROL_REQUEST and message["scan_count"] == 0:
            for _ in range(self._firmware.residual_scans):
                residual += self.step() if self.scanning else []
        return [*residual, handler(self, message)]

    def hold_back(self, now_s: float) -> None:
        """Advance the time without a scan: the link is full, and the radar waits for it."""
        run = self._state.run
        if run is not None and run.due_s() < now_s:
            run.started_s += now_s - run.due_s()
        self._now = max(self._now, now_s)

    def advance_by_one(self, now_s: float) -> list[bytes]:
        """Advance the time to `now_s` or the next scan, whichever is first; return the packets sent.

        One scan per call, so that a slow source cannot delay the handling of a request such as a stop. If the
        source or this process is too slow, scans are skipped as if lost in transit: the scene
        moves on with the clock, so a late scan must show the moment of its timestamp.
        """
        due = self.next_due_s
        if due is not None and due <= now_s:
            self._catch_up(now_s - due)
            return self.step()
        self._now = max(self._now, now_s)
        return []

    def _catch_up(self, lag_s: float) -> None:
        """Skip scans of a late run: some of them if the lag is short, otherwise all."""
        run = self._state.run
        if run is None or lag_s <= _LAG_S:
            return
        if self._fixed:
            run.started_s += lag_s  # a recording has its own clock, and none of its scans may be skipped
            return
        late = int(lag_s / run.period_s)
        skipped = late if lag_s > _LONGEST_LAG_S else min(int(lag_s / _LAG_S), late)
        if run.count != SCAN_FOREVER:
            skipped = min(skipped, run.count - 1 - run.index)
        run.index += skipped

    def step(self) -> list[bytes]:
        """Jump to the next scheduled event (a scan, the end of a boot)."""
        due = self.next_due_s
        if due is None:
            return []
        self._now = max(self._now, due)
        if self._state.boots_until_s is not None:
            self._state.boots_until_s = None
            self._booted_at = self._now
            return [encode(_T.READY_INFO, 0)]
        return self._next_scan()

    def _next_scan(self) -> list[bytes]:
        state = self._state
        run = state.run
        assert run is not None
        index = run.index
        if self._fixed and not self._fixed.has(index):
            state.run = None
            state.ended = True
            return []
        run.index += 1
        if run.index == run.count and run.count != SCAN_FOREVER:
            state.run = None
        config = state.config
        # The scan was taken during the period that ends now.
        samples = np.asarray(self._source.scan(index, self._now - run.period_s, config))
        if samples.shape != (config.samples,):
            raise ValueError(f"source gave shape {samples.shape}, expected ({config.samples},)")
        limit = config.clip_counts
        stamp = self._fixed.timestamp_ms(index) & 0xFFFFFFFF if self._fixed else self._timestamp()
        taken = np.clip(samples, -limit, limit).astype(np.int32)
        return state.filters.packets(taken, config, (run.first_id + index) & 0xFFFF, stamp)

    def _set_config(self, message: Message) -> bytes:
        self._state.run = None  # without a message, like the real radar
        try:
            wanted = self._firmware.take(RadarConfig.from_record(message.fields["config"]))
        except ConfigError:
            return _confirm(_T.SET_CONFIG_CONFIRM, message, Status.UNSUPPORTED_VALUE)
        self._state.config = self._fixed.config if self._fixed else wanted
        if wanted.persist:
            self._state.flash = self._state.config
        return _confirm(_T.SET_CONFIG_CONFIRM, message)

    def _get_config(self, message: Message) -> bytes:
        record = self._state.config.to_record()
        return encode(_T.GET_CONFIG_CONFIRM, message.id, config=record, timestamp_ms=self._timestamp())

    def _control(self, message: Message) -> bytes:
        count = message["scan_count"]
        if count == 0:
            self._state.run = None
            return _confirm(_T.CONTROL_CONFIRM, message)
        period = max(self._state.config.scan_period_s, message["interval_us"] * 1e-6)
        self._state.run = _Run(message.id, count, period, self._now)
        self._state.ended = False
        return _confirm(_T.CONTROL_CONFIRM, message)

    def _set_filter(self, message: Message) -> bytes:
        mask = message["mask"]
        if not mask or mask & ~ALL_FILTERS:
            return _confirm(_T.SET_FILTER_CONFIRM, message, Status.UNSUPPORTED_VALUE)
        self._state.filter_mask = mask
        self._state.motion_index = message["motion_index"]
        self._state.multiplier = message["threshold_multiplier"]
        self._state.filters = ServerFilters(mask, self._state.multiplier)
        return _confirm(_T.SET_FILTER_CONFIRM, message)

    def _get_filter(self, message: Message) -> bytes:
        state = self._state
        return encode(
            _T.GET_FILTER_CONFIRM,
            message.id,
            mask=state.filter_mask,
            motion_index=state.motion_index,
            threshold_multiplier=state.multiplier,
        )

    def power_cycle(self) -> None:
        """Reboot: settings from flash, no run, and no answers until READY_INFO."""
        flash = self._state.flash
        self._state = _State(flash, flash, boots_until_s=self._now + self._identity.boot_s)

    def _reboot(self, message: Message) -> bytes:
        self.power_cycle()
        return encode(_T.REBOOT_CONFIRM, message.id)

    def _set_opmode(self, message: Message) -> bytes:
        mode = message["mode"]
        known = mode in (0, OPMODE_MRM)  # 0 is ranging: valid on a P440, but without radar scans
        if known:
            self._state.opmode, self._state.run = mode, None
        status = Status.OK if known else Status.UNSUPPORTED_VALUE
        return encode(_T.SET_OPMODE_CONFIRM, message.id, mode=self._state.opmode, status=int(status))

    def _set_sleep(self, message: Message) -> bytes:
        mode = message["mode"]
        if mode > 4:
            return _confirm(_T.SET_SLEEPMODE_CONFIRM, message, Status.UNSUPPORTED_VALUE)
        self._state.sleep = mode
        if mode != SLEEP_ACTIVE:
            self._state.run = None
        return _confirm(_T.SET_SLEEPMODE_CONFIRM, message)

    def _set_baud(self, message: Message) -> bytes:
        status = Status.OK if message["baud"] in _BAUD_RATES else Status.UNSUPPORTED_VALUE
        return _confirm(_T.SET_BAUD_CONFIRM, message, status)

    def _timestamp(self) -> int:
        clock = 1e3 * (1 + 1e-6 * self._identity.clock_ppm)
        return math.floor((self._now - self._booted_at) * clock) & 0xFFFFFFFF

    def _refuse(self, message: Message, status: Status) -> bytes:
        if message.type is _T.GET_CONFIG_REQUEST:
            return encode(
                _T.GET_CONFIG_CONFIRM, message.id, config=np.zeros((), CONFIG_DTYPE), status=int(status)
            )
        return _confirm(MessageType(message.type + 0x100), message, status)


def _confirm(confirm: MessageType, request: Message, status: Status = Status.OK) -> bytes:
    return encode(confirm, request.id, status=int(status))


def _invalid(packet: bytes, status: Status) -> bytes:
    bad_type, bad_id = int.from_bytes(packet[:2], "big"), int.from_bytes(packet[2:4], "big")
    return encode(_T.INVALID_MESSAGE_CONFIRM, bad_id, bad_type=bad_type, bad_id=bad_id, status=int(status))


_HANDLERS: Final[dict[MessageType, Callable[[EmulatorCore, Message], bytes]]] = {
    _T.SET_CONFIG_REQUEST: EmulatorCore._set_config,
    _T.GET_CONFIG_REQUEST: EmulatorCore._get_config,
    _T.CONTROL_REQUEST: EmulatorCore._control,
    _T.SERVER_CONNECT_REQUEST: lambda core, m: _confirm(_T.SERVER_CONNECT_CONFIRM, m),
    _T.SERVER_DISCONNECT_REQUEST: lambda core, m: _confirm(_T.SERVER_DISCONNECT_CONFIRM, m),
    _T.SET_FILTER_REQUEST: EmulatorCore._set_filter,
    _T.GET_FILTER_REQUEST: EmulatorCore._get_filter,
    _T.GET_STATUSINFO_REQUEST: lambda core, m: core._firmware.status_info(m.id, core._identity),
    _T.REBOOT_REQUEST: EmulatorCore._reboot,
    _T.SET_OPMODE_REQUEST: EmulatorCore._set_opmode,
    _T.GET_OPMODE_REQUEST: lambda core, m: encode(_T.GET_OPMODE_CONFIRM, m.id, mode=core._state.opmode),
    _T.SET_SLEEPMODE_REQUEST: EmulatorCore._set_sleep,
    _T.GET_SLEEPMODE_REQUEST: lambda core, m: core._firmware.sleep_mode(m.id, core._state.sleep),
    _T.SET_BAUD_REQUEST: EmulatorCore._set_baud,
}
"""A table of functions, not of bound methods: a radar that refers to itself is freed late, with its scene."""
