"""A P440 as a state machine: bytes in, bytes out, time handed in; no sockets, no clock of its own.

The UDP emulator, the replay and the tests all drive this one core, so that they show the same radar.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from tagid.constants import BINS_PER_SAMPLE
from tagid.errors import ConfigError
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
from tagid.radar.settings import RadarConfig
from tagid.radar.sources import FixedSource, ScanSource

_T = MessageType
_RAW_FILTER: Final = 1
_BAUD_RATES: Final = range(9_600, 921_601)
_MRM_REQUESTS: Final = (_T.SET_CONFIG_REQUEST, _T.GET_CONFIG_REQUEST, _T.CONTROL_REQUEST)


@dataclass(frozen=True)
class Identity:
    """What the emulated radar says of itself in GET_STATUSINFO.

    Attributes:
        serial: serial number.
        package: name of the hardware package, up to 32 characters.
        temperature_c: board temperature, degrees Celsius.
        boot_s: time from a reboot to READY_INFO (7 s on Ethernet, measured).
    """

    serial: int = 0x440
    package: str = "P440 emulator"
    temperature_c: float = 41.25
    boot_s: float = 7.0


@dataclass
class _Run:
    """A scan series under way; times are seconds since boot."""

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
    filter_mask: int = _RAW_FILTER
    boots_until_s: float | None = None
    run: _Run | None = None
    clipped: int = 0
    ended: bool = False


class EmulatorCore:
    """One emulated radar.

    Times are seconds of the emulated clock. `handle` takes a request, `advance_by_one` lets time pass, `step`
    jumps to the next scan; all return the packets that leave the radar, in order.

    Args:
        source: what the radar sees; a `FixedSource` (recording) also fixes the settings and the timestamps.
        config: settings at power-up.
        identity: what GET_STATUSINFO says.
        booted_s: emulated time since boot at the start.
    """

    def __init__(
        self,
        source: ScanSource,
        config: RadarConfig | None = None,
        identity: Identity | None = None,
        booted_s: float = 10.0,
    ) -> None:
        self._source = source
        self._fixed = source if isinstance(source, FixedSource) else None
        start = self._fixed.config if self._fixed else (config or RadarConfig()).quantised()
        self._state = _State(start, start)
        self._identity = identity or Identity()
        self._now = booted_s
        self._booted_at = 0.0
        self._handlers: dict[MessageType, Callable[[Message], bytes]] = {
            _T.SET_CONFIG_REQUEST: self._set_config,
            _T.GET_CONFIG_REQUEST: self._get_config,
            _T.CONTROL_REQUEST: self._control,
            _T.SERVER_CONNECT_REQUEST: lambda m: _confirm(_T.SERVER_CONNECT_CONFIRM, m),
            _T.SERVER_DISCONNECT_REQUEST: lambda m: _confirm(_T.SERVER_DISCONNECT_CONFIRM, m),
            _T.SET_FILTER_REQUEST: self._set_filter,
            _T.GET_FILTER_REQUEST: lambda m: encode(
                _T.GET_FILTER_CONFIRM, m.id, mask=self._state.filter_mask
            ),
            _T.GET_STATUSINFO_REQUEST: self._status_info,
            _T.REBOOT_REQUEST: self._reboot,
            _T.SET_OPMODE_REQUEST: self._set_opmode,
            _T.GET_OPMODE_REQUEST: lambda m: encode(_T.GET_OPMODE_CONFIRM, m.id, mode=self._state.opmode),
            _T.SET_SLEEPMODE_REQUEST: self._set_sleep,
            _T.GET_SLEEPMODE_REQUEST: lambda m: encode(
                _T.GET_SLEEPMODE_CONFIRM, m.id, mode=self._state.sleep
            ),
            _T.SET_BAUD_REQUEST: self._set_baud,
        }

    @property
    def config(self) -> RadarConfig:
        """The settings in force."""
        return self._state.config

    @property
    def now_s(self) -> float:
        """The emulated clock."""
        return self._now

    @property
    def scanning(self) -> bool:
        """Whether a run is under way."""
        return self._state.run is not None

    @property
    def ended(self) -> bool:
        """Whether a recording has come to its end: the run stopped for want of scans."""
        return self._state.ended and self._state.run is None

    @property
    def clipped_samples(self) -> int:
        """Samples that were clipped at the radar's full scale."""
        return self._state.clipped

    @property
    def next_due_s(self) -> float | None:
        """Emulated time at which the next packet leaves by itself; None where nothing is planned."""
        if self._state.boots_until_s is not None:
            return self._state.boots_until_s
        return self._state.run.due_s() if self._state.run else None

    def handle(self, packet: bytes) -> list[bytes]:
        """Answers to one packet of a client; a booting radar is deaf."""
        if self._state.boots_until_s is not None or len(packet) < 4:
            return []
        try:
            message = decode(packet)
        except MalformedMessage as error:
            return [_invalid(packet, error.status)]
        handler = self._handlers.get(message.type)
        if handler is None:
            return [_invalid(packet, Status.UNRECOGNISED)]
        if message.type in _MRM_REQUESTS and self._state.opmode != OPMODE_MRM:
            return [self._refuse(message, Status.WRONG_OPMODE)]
        if message.type is _T.CONTROL_REQUEST and self._state.sleep != SLEEP_ACTIVE:
            return [self._refuse(message, Status.INVALID_DURING_SLEEP)]
        return [handler(message)]

    def advance_by_one(self, now_s: float) -> list[bytes]:
        """Lets time pass until `now_s` or the next scan, whichever is first; returns what left the radar.

        One scan a call, so that a slow source cannot keep a request (a stop!) from being heard.
        """
        due = self.next_due_s
        if due is not None and due <= now_s:
            return self.step()
        self._now = max(self._now, now_s)
        return []

    def step(self) -> list[bytes]:
        """Jumps to the next thing that happens by itself (a scan, the end of a boot)."""
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
        state.clipped += int(np.count_nonzero(np.abs(samples) > limit))
        stamp = self._fixed.timestamp_ms(index) & 0xFFFFFFFF if self._fixed else self._timestamp()
        return scan_packets(
            np.clip(samples, -limit, limit).astype(np.int32),
            config,
            (run.first_id + index) & 0xFFFF,
            stamp,
        )

    def _set_config(self, message: Message) -> bytes:
        self._state.run = None  # silently, as the real radar does
        try:
            wanted = RadarConfig.from_record(message.fields["config"]).quantised()
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
        status = Status.OK if message["mask"] == _RAW_FILTER else Status.UNSUPPORTED_VALUE
        return _confirm(_T.SET_FILTER_CONFIRM, message, status)

    def _status_info(self, message: Message) -> bytes:
        return encode(
            _T.GET_STATUSINFO_CONFIRM,
            message.id,
            mrm_major=2,
            mrm_minor=1,
            mrm_build=440,
            kernel_major=1,
            fpga_version=1,
            fpga_year=0x16,
            fpga_month=0x12,
            fpga_day=0x31,
            serial=self._identity.serial,
            board_revision=ord("C"),
            temperature_quarter_c=round(self._identity.temperature_c * 4),
            package=self._identity.package.encode("ascii", "replace")[:32],
        )

    def _reboot(self, message: Message) -> bytes:
        flash = self._state.flash
        self._state = _State(flash, flash, boots_until_s=self._now + self._identity.boot_s)
        return encode(_T.REBOOT_CONFIRM, message.id)

    def _set_opmode(self, message: Message) -> bytes:
        mode = message["mode"]
        known = mode in (0, OPMODE_MRM)  # 0 is ranging: possible on a P440, but no radar then
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
        return math.floor((self._now - self._booted_at) * 1e3) & 0xFFFFFFFF

    def _refuse(self, message: Message, status: Status) -> bytes:
        if message.type is _T.GET_CONFIG_REQUEST:
            return encode(
                _T.GET_CONFIG_CONFIRM, message.id, config=np.zeros((), CONFIG_DTYPE), status=int(status)
            )
        return _confirm(MessageType(message.type + 0x100), message, status)


def scan_packets(samples: Any, config: RadarConfig, scan_id: int, timestamp_ms: int) -> list[bytes]:
    """The SCAN_INFO packets of one scan: 1452 bytes each, the last one zero-padded.

    Args:
        samples: (N,) int32, counts.
        config: settings it was taken with.
        scan_id: message id, u16, that all fragments share.
        timestamp_ms: radar clock, u32, that all fragments share.
    """
    count = -(-len(samples) // SAMPLES_PER_MESSAGE)
    packets = []
    for index in range(count):
        part = samples[index * SAMPLES_PER_MESSAGE : (index + 1) * SAMPLES_PER_MESSAGE]
        padded = np.zeros(SAMPLES_PER_MESSAGE, np.int32)
        padded[: len(part)] = part
        packets.append(
            encode(
                _T.SCAN_INFO,
                scan_id,
                node_id=config.node_id,
                timestamp_ms=timestamp_ms,
                scan_start_ps=config.scan_start_ps,
                scan_stop_ps=config.scan_stop_ps,
                step_bins=BINS_PER_SAMPLE,
                filter=_RAW_FILTER,
                reserved2=3,  # 3 on every recording
                antenna_id=config.antenna_mode,
                operation_mode=OPMODE_MRM,
                message_samples=len(part),
                total_samples=len(samples),
                message_index=index,
                message_count=count,
                samples=padded,
            )
        )
    return packets


def _confirm(confirm: MessageType, request: Message, status: Status = Status.OK) -> bytes:
    return encode(confirm, request.id, status=int(status))


def _invalid(packet: bytes, status: Status) -> bytes:
    bad_type, bad_id = int.from_bytes(packet[:2], "big"), int.from_bytes(packet[2:4], "big")
    return encode(_T.INVALID_MESSAGE_CONFIRM, bad_id, bad_type=bad_type, bad_id=bad_id, status=int(status))
