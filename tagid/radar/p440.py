"""The P440 client: requests with retries, the settings that the radar accepted, and scans until stopped.

It always stops the radar on exit, because a scanning radar refuses the connection of the next user.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Final, Self

from tagid.errors import (
    ConfigError,
    DeviceError,
    DeviceGoneError,
    DeviceRejectedError,
    DeviceTimeoutError,
    UsageError,
)
from tagid.radar.assembler import WINDOW, Scan, ScanAssembler, Statistics
from tagid.radar.exchange import Exchange, accept, restarted
from tagid.radar.links import Link
from tagid.radar.messages import (
    OPMODE_MRM,
    SAMPLES_PER_MESSAGE,
    SCAN_FOREVER,
    SLEEP_ACTIVE,
    Message,
    MessageType,
    Status,
    encode,
)
from tagid.radar.scan_info import Fragment
from tagid.radar.settings import RadarConfig
from tagid.radar.status import RadarStatus, status_from

STOP_POLL_S: Final = 0.1
"""Longest interval between two calls that check whether to stop, s."""
AWAY_S: Final = 0.5
"""A pass of the receive loop that takes longer means that this process was suspended or got no CPU, s."""


class Patience:
    """How long a run waits for any fragment and, while fragments arrive, for a complete scan.

    Time in which this process did not run does not count: packets that arrived wait in the receive buffer.

    Attributes:
        quiet_s: time without a fragment after which the radar is considered silent, s.
        whole_s: time without a complete scan after which the run is aborted although fragments arrive, s.
        fragments: packets since the last complete scan.
        whole_scans: number of complete scans when the timeout was last restarted.
    """

    def __init__(self, quiet_s: float, whole_s: float) -> None:
        self.quiet_s, self.whole_s = quiet_s, whole_s
        self.fragments = self.whole_scans = 0
        self._now = self._asked = time.monotonic()
        self._quiet_at = self._now + quiet_s
        self._whole_at = self._now + whole_s

    def tick(self) -> bool:
        """Record the time for the checks below; return whether to check for a stop now."""
        before, self._now = self._now, time.monotonic()
        away = self._now - before
        if away > AWAY_S:
            self._quiet_at += away
            self._whole_at += away
        due = self._now >= self._asked + STOP_POLL_S
        if due:
            self._asked = self._now
        return due

    def wait_s(self) -> float:
        """How long to wait for the next packet, s."""
        return max(min(self._quiet_at, self._whole_at, self._asked + STOP_POLL_S) - self._now, 0.0)

    def heard(self) -> None:
        self._quiet_at = time.monotonic() + self.quiet_s

    def renew(self, whole_scans: int) -> None:
        """Note that a complete scan arrived and the caller has processed it."""
        self.whole_scans, self.fragments = whole_scans, 0
        self._now = time.monotonic()
        self._quiet_at = self._now + self.quiet_s
        self._whole_at = self._now + self.whole_s

    def silent(self) -> bool:
        return self._now >= self._quiet_at

    def fruitless(self) -> bool:
        """Whether fragments arrived for too long without forming a complete scan."""
        return self._now >= self._whole_at


_T = MessageType
BOOT_QUIET_S: Final = 3.0
"""Time after a reboot request in which only READY_INFO counts: before it boots the radar may still answer."""
_POLL_S: Final = 0.25
_WHOLE_S: Final = 4.0
_WHOLE_PERIODS: Final = 20
"""Time within which one complete scan must arrive while fragments arrive, in seconds or scan periods. At 30 %
packet loss, a third of the scans of three fragments are complete; 20 in a row fail once in 4000 times."""


class P440:
    """One P440 behind a link; use it as a context manager.

    Args:
        link: carries the packets; closed with the client.
        timeout: wait for one answer, s.
        attempts: number of times a request is sent before the radar is considered silent.

    Every method raises DeviceTimeoutError if the radar does not answer, DeviceRejectedError if it refuses,
    DeviceRestartedError if it reboots during the call, DeviceGoneError if its port disappears, and
    DeviceError if the network fails.
    """

    def __init__(self, link: Link, timeout: float = 1.0, attempts: int = 3) -> None:
        self._link = link
        self._talk = Exchange(link, timeout, attempts)
        self._config: RadarConfig | None = None
        self._asked: RadarConfig | None = None
        self.latest_status: RadarStatus | None = None

    @property
    def statistics(self) -> Statistics:
        """Counters of the connection since the client was created."""
        self._talk.statistics.foreign = self._link.foreign
        self._talk.statistics.skipped_bytes = self._link.skipped_bytes
        return self._talk.statistics

    @property
    def config(self) -> RadarConfig:
        """The settings as last read back. Raises UsageError before `connect`."""
        if self._config is None:
            raise UsageError("the radar is not connected", "Call connect() first.")
        return self._config

    def __enter__(self) -> Self:
        try:
            self.connect()
        except BaseException:
            self._link.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def connect(self) -> RadarConfig:
        """Stop any run, drain its packets, wake the radar into MRM mode; return its settings."""
        confirm = self._stop()
        # Both may be wrong, and radars differ in which one they report first.
        for _ in range(2):
            if confirm["status"] == Status.INVALID_DURING_SLEEP:
                self.set_sleep_mode(SLEEP_ACTIVE)
                confirm = self._stop()
            elif confirm["status"] == Status.WRONG_OPMODE:
                self.set_opmode(OPMODE_MRM)
                confirm = self._stop()
        accept(confirm, "stop")
        # Fragments overtaken by the confirm must not reach the next run.
        self._talk.drain()
        return self.get_config()

    def close(self) -> None:
        """Stop a run in progress and release the link; never raises for a disconnected radar."""
        try:
            self._stop_quietly()
        finally:
            self._link.close()

    def reconnect(self) -> RadarConfig:
        """Reconnect after the radar or its port disappeared; return its settings, which may differ."""
        self._link.reopen()
        self._talk.scanning = False
        self._config = None
        self._talk.started = False
        return self.connect()

    def status(self) -> RadarStatus:
        """Versions, serial number, temperature, self test."""
        m = self._talk.request(_T.GET_STATUSINFO_REQUEST)
        accept(m, "status")
        return status_from(m)

    def ask_status(self) -> None:
        """Request the status during a run without waiting: a lost answer must not cost a scan.

        The answer becomes `latest_status` while scans are received.
        """
        message_id, self._talk.next_id = self._talk.next_id, (self._talk.next_id + 1) & 0xFFFF
        self._link.send(encode(_T.GET_STATUSINFO_REQUEST, message_id))

    def uptime_s(self) -> float:
        """The radar's clock: seconds since its boot, modulo 2^32 ms."""
        confirm = self._talk.request(_T.GET_CONFIG_REQUEST)
        accept(confirm, "get configuration")
        return confirm["timestamp_ms"] * 1e-3

    def get_config(self) -> RadarConfig:
        """The settings in force. Raises DeviceRejectedError if tagid cannot use them."""
        confirm = self._talk.request(_T.GET_CONFIG_REQUEST)
        accept(confirm, "get configuration")
        try:
            self._config = RadarConfig.from_record(confirm.fields["config"])
        except ConfigError as error:
            raise DeviceRejectedError(
                f"the radar reports settings that cannot be used: {error.message}", error.remedy
            ) from error
        self._talk.started = True
        return self._config

    @property
    def asked(self) -> RadarConfig:
        """The settings last requested; if none were, those in force."""
        return self._asked or self.config

    def set_config(self, config: RadarConfig) -> RadarConfig:
        """Configure the radar; return the settings it accepted, which lie on its own grid."""
        self._asked = config
        accept(self._talk.request(_T.SET_CONFIG_REQUEST, config=config.to_record()), "set configuration")
        return self.get_config()

    def get_opmode(self) -> int:
        """Operating mode; 1 is MRM."""
        return int(self._talk.request(_T.GET_OPMODE_REQUEST)["mode"])

    def set_opmode(self, mode: int) -> int:
        """Set the operating mode; return the mode in force."""
        confirm = self._talk.request(_T.SET_OPMODE_REQUEST, mode=mode)
        accept(confirm, f"set operating mode {mode}")
        return confirm["mode"]

    def get_sleep_mode(self) -> int:
        """Sleep mode: 0 active, 1 idle, 2 standby (Ethernet), 3 standby (serial), 4 sleep."""
        return int(self._talk.request(_T.GET_SLEEPMODE_REQUEST)["mode"])

    def set_sleep_mode(self, mode: int) -> None:
        """Set the sleep mode."""
        accept(self._talk.request(_T.SET_SLEEPMODE_REQUEST, mode=mode), f"set sleep mode {mode}")

    def reboot(self, wait_s: float = 15.0) -> RadarConfig:
        """Reboot the radar and reconnect (a P440 takes 7 s on Ethernet, 11 s otherwise)."""
        self._talk.request(_T.REBOOT_REQUEST)
        self._talk.scanning = False
        self._config = None
        self._talk.started = False  # the next READY_INFO is expected
        now = time.monotonic()
        deadline, ask_from = now + wait_s, now + BOOT_QUIET_S
        while time.monotonic() < deadline and not self._link.exhausted:
            try:
                if self._booted(ask_from):
                    return self.connect()
            except DeviceGoneError:
                # A USB port disappears while its radar boots.
                time.sleep(_POLL_S)
                with contextlib.suppress(DeviceError):
                    self._link.reopen()
        return self.connect()

    def _booted(self, ask_from: float) -> bool:
        """Whether READY_INFO arrived, or, since that single packet may be lost, whether the radar answers."""
        message = self._talk.receive(_POLL_S)
        if isinstance(message, Message) and message.type is _T.READY_INFO:
            return True
        if time.monotonic() < ask_from:
            return False
        try:
            self._talk.exchange(_T.GET_OPMODE_REQUEST, {}, _POLL_S, attempts=1)
        except DeviceTimeoutError:
            return False
        return True

    def scans(
        self,
        count: int = SCAN_FOREVER,
        interval_us: int = 0,
        until: Callable[[], bool] = lambda: False,
    ) -> Iterator[Scan]:
        """Start a run, yield its complete scans in order, and stop the radar however the caller exits.

        Args:
            count: 1..65534 scans, or 65535 until the caller stops.
            interval_us: time between scans, us; 0 is as fast as the settings allow.
            until: called about ten times per second, also while no scan is complete; True ends the run.

        Raises DeviceTimeoutError if the radar stops sending, or if its packets form no complete scan for
        4 s or 20 scan periods; the scans before that have been yielded.
        """
        if not 1 <= count <= SCAN_FOREVER:
            raise UsageError(f"scan count is {count}", "Give 1 to 65534, or 65535 for no end.")
        if not 0 <= interval_us < 2**32:
            raise UsageError(f"scan interval is {interval_us} us", "Give 0 to 4294967295 us.")
        if self._talk.scanning:
            raise UsageError("the radar is scanning already", "End the running scan series first.")
        messages = -(-self.config.samples // SAMPLES_PER_MESSAGE)
        period = max(self.config.scan_period_s, interval_us * 1e-6, messages * self._link.packet_time_s)
        patience = self._talk.timeout + 3 * period
        self._talk.early.clear()
        first_id = self._talk.next_id
        # If damaged packets can get through, an id must agree with the clock to be accepted.
        believed = None if self._link.guarded else self.config.scan_period_s
        assembler = ScanAssembler(first_id, self._talk.statistics, period_s=believed)
        end_id = None if count == SCAN_FOREVER else first_id + count
        whole = self._talk.timeout + max(_WHOLE_S, _WHOLE_PERIODS * period)
        try:
            self._talk.scanning = True
            self._start(count, interval_us, patience)
            yield from self._run(assembler, end_id, Patience(patience, whole), until)
        except DeviceTimeoutError:
            self._stop_quietly(silent=True)
            raise
        finally:
            self._talk.next_id = (max(assembler.newest_id or 0, first_id, self._talk.next_id) + 1) & 0xFFFF
            self._stop_quietly()

    def _run(
        self, assembler: ScanAssembler, end_id: int | None, patience: Patience, until: Callable[[], bool]
    ) -> Iterator[Scan]:
        first_id = assembler.next_id or 0
        early = self._talk.early
        while end_id is None or (assembler.next_id or 0) < end_id:
            if patience.tick() and until():
                yield from _before(assembler.flush(), end_id)
                return
            message = early.popleft() if early else self._talk.receive(patience.wait_s())
            if isinstance(message, Fragment):
                patience.fragments += 1
                scans = assembler.add(message)
                if scans or assembler.whole_scans != patience.whole_scans:
                    yield from _before(scans, end_id)
                    # Renewed after the yield: a slow caller must not make the radar look silent.
                    patience.renew(assembler.whole_scans)
                else:
                    patience.heard()
            elif message is not None:
                self._not_for_a_run(message)
            elif self._link.exhausted:
                yield from _before(assembler.flush(), end_id)
                return
            if message is None and patience.silent():
                yield from _before(assembler.flush(), end_id)
                over = self._over(assembler, end_id)
                if early:
                    patience.heard()
                    continue
                if end_id is None or not over:
                    done = (assembler.next_id or 0) - first_id
                    raise DeviceTimeoutError(
                        f"the radar at {self._link} sent nothing for {patience.quiet_s:.1f} s, "
                        f"after {done} scans",
                        "Check power and cable; the scans that arrived before are kept.",
                    )
                assembler.give_up_until(end_id)
            elif patience.fruitless():
                yield from _before(assembler.flush(), end_id)
                raise DeviceTimeoutError(
                    f"{patience.fragments} packets arrived from the radar at {self._link} in "
                    f"{patience.whole_s:.1f} s, but no complete scan: fragments are missing",
                    "Use a direct cable or a switch with larger buffers, or fewer fragments per scan (a "
                    "shorter range window); the scans that arrived before are kept.",
                )

    def _over(self, assembler: ScanAssembler, end_id: int | None) -> bool:
        """Whether a silent radar has completed its count, and only its last packets were lost.

        Either a packet of the last scan arrived, or the radar answers and only a few scans are missing.
        """
        if end_id is None:
            return False
        if assembler.newest_id is not None and assembler.newest_id >= end_id - 1:
            return True
        try:
            self._talk.request(_T.GET_CONFIG_REQUEST)
        except DeviceTimeoutError:
            return False
        return (assembler.next_id or 0) >= end_id - WINDOW

    def _start(self, count: int, interval_us: int, patience: float) -> None:
        """Start a run; its first scan also counts as confirm, so a lost confirm does not start it twice."""
        fields = {"scan_count": count, "interval_us": interval_us}
        confirm = self._talk.exchange(_T.CONTROL_REQUEST, fields, patience)
        if isinstance(confirm, Message):
            accept(confirm, "start scanning")

    def _stop(self, attempts: int | None = None) -> Message:
        fields = {"scan_count": 0}
        confirm = self._talk.exchange(_T.CONTROL_REQUEST, fields, self._talk.patience_s, attempts)
        assert isinstance(confirm, Message)
        self._talk.scanning = False
        return confirm

    def _stop_quietly(self, silent: bool = False) -> None:
        """Stop a run that may be in progress; a disconnected radar cannot be stopped."""
        if not self._talk.scanning:
            return
        try:
            # Ask a radar that has been silent for long only once, not three times.
            self._stop(1 if silent else None)
            self._talk.drain()
        except DeviceError:
            pass
        finally:
            self._talk.scanning = False

    def _not_for_a_run(self, message: Message) -> None:
        if message.type is _T.READY_INFO:
            self._talk.scanning = False
            raise restarted()
        if message.type is _T.CONTROL_CONFIRM:
            accept(message, "start scanning")
        elif message.type is _T.GET_STATUSINFO_CONFIRM and message["status"] == Status.OK:
            self.latest_status = status_from(message)
        else:
            self._talk.statistics.unexpected += 1


def _before(scans: list[Scan], end_id: int | None) -> list[Scan]:
    return [scan for scan in scans if end_id is None or scan.scan_id < end_id]
