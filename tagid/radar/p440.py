"""The P440 client: requests with retries, settings as the radar took them, and scans until told to stop.

It leaves the radar stopped however it ends, because a radar left scanning refuses the next user's connect.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Final, Self

from tagid.errors import ConfigError, DeviceError, DeviceRejectedError, DeviceTimeoutError, UsageError
from tagid.radar.assembler import WINDOW, Scan, ScanAssembler, Statistics
from tagid.radar.links import Link
from tagid.radar.messages import (
    OPMODE_MRM,
    SCAN_FOREVER,
    SLEEP_ACTIVE,
    MalformedMessage,
    Message,
    MessageType,
    Status,
    decode,
    encode,
    status_text,
)
from tagid.radar.settings import RadarConfig
from tagid.radar.status import RadarStatus

_T = MessageType
_QUIET_S: Final = 0.05
_NO_ANSWER: Final = (
    "Check power, cable and the address (kit units: 192.168.1.100 to 103, this computer 192.168.1.1/24), and "
    "that no firewall drops the answers from UDP port 21210; `tagid doctor` tries each."
)


class P440:
    """One P440 behind a link; use it as a context manager.

    Args:
        link: carries the packets; closed with the client.
        timeout: wait for one answer, s.
        attempts: how often a request is sent before the radar counts as silent.

    Every method raises DeviceTimeoutError where the radar stays silent, DeviceRejectedError where it refuses,
    and DeviceError where it reboots in the middle or the network fails.
    """

    def __init__(self, link: Link, timeout: float = 1.0, attempts: int = 3) -> None:
        self._link = link
        self._timeout = timeout
        self._attempts = attempts
        self._next_id = 1
        self._scanning = False
        self._config: RadarConfig | None = None
        self._early: deque[Message] = deque(maxlen=1024)
        self._statistics = Statistics()

    @property
    def statistics(self) -> Statistics:
        """Counters of everything since the client was made."""
        self._statistics.foreign = self._link.foreign
        return self._statistics

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
        """Stops whatever runs, drains it, wakes the radar into MRM mode; returns its settings."""
        confirm = self._stop()
        if confirm["status"] == Status.INVALID_DURING_SLEEP:
            self.set_sleep_mode(SLEEP_ACTIVE)
            confirm = self._stop()
        if confirm["status"] == Status.WRONG_OPMODE:
            self.set_opmode(OPMODE_MRM)
            confirm = self._stop()
        _accept(confirm, "stop")
        # Fragments overtaken by the confirm must not reach the next run.
        self._drain()
        return self.get_config()

    def close(self) -> None:
        """Stops a run that is under way and frees the link; never raises for a radar that is gone."""
        try:
            self._stop_quietly()
        finally:
            self._link.close()

    def status(self) -> RadarStatus:
        """Versions, serial number, temperature, self test."""
        m = self._request(_T.GET_STATUSINFO_REQUEST)
        _accept(m, "status")
        return RadarStatus.from_message(m)

    def uptime_s(self) -> float:
        """The radar's clock: seconds since its boot, modulo 2^32 ms."""
        confirm = self._request(_T.GET_CONFIG_REQUEST)
        _accept(confirm, "get configuration")
        return float(confirm["timestamp_ms"] * 1e-3)

    def get_config(self) -> RadarConfig:
        """The settings in force. Raises DeviceRejectedError where they are none that tagid can read."""
        confirm = self._request(_T.GET_CONFIG_REQUEST)
        _accept(confirm, "get configuration")
        try:
            self._config = RadarConfig.from_record(confirm["config"])
        except ConfigError as error:
            raise DeviceRejectedError(
                f"the radar reports settings that cannot be used: {error.message}", error.remedy
            ) from error
        return self._config

    def set_config(self, config: RadarConfig) -> RadarConfig:
        """Sets the radar; returns what it took, which lies on its own grid."""
        _accept(self._request(_T.SET_CONFIG_REQUEST, config=config.to_record()), "set configuration")
        return self.get_config()

    def get_opmode(self) -> int:
        """Operating mode; 1 is MRM."""
        return int(self._request(_T.GET_OPMODE_REQUEST)["mode"])

    def set_opmode(self, mode: int) -> int:
        """Sets the operating mode; returns the mode in force."""
        confirm = self._request(_T.SET_OPMODE_REQUEST, mode=mode)
        _accept(confirm, f"set operating mode {mode}")
        return int(confirm["mode"])

    def get_sleep_mode(self) -> int:
        """Sleep mode: 0 active, 1 idle, 2 standby (Ethernet), 3 standby (serial), 4 sleep."""
        return int(self._request(_T.GET_SLEEPMODE_REQUEST)["mode"])

    def set_sleep_mode(self, mode: int) -> None:
        """Sets the sleep mode."""
        _accept(self._request(_T.SET_SLEEPMODE_REQUEST, mode=mode), f"set sleep mode {mode}")

    def reboot(self, wait_s: float = 15.0) -> RadarConfig:
        """Reboots the radar and connects again (a P440 takes 7 s on Ethernet, 11 s otherwise)."""
        self._request(_T.REBOOT_REQUEST)
        self._scanning = False
        self._config = None  # the READY_INFO to come is no surprise now
        deadline = time.monotonic() + wait_s
        while not self._link.exhausted:
            left = deadline - time.monotonic()
            if left <= 0:
                break
            message = self._receive(left)
            if message is not None and message.type is _T.READY_INFO:
                return self.connect()
        # READY_INFO is one packet and may be lost: the radar is asked before it is given up.
        return self.connect()

    def scans(self, count: int = SCAN_FOREVER, interval_us: int = 0) -> Iterator[Scan]:
        """Starts a run, yields its complete scans in order, and stops the radar however the caller leaves.

        Args:
            count: 1..65534 scans, or 65535 until the caller stops.
            interval_us: time between scans, us; 0 is as fast as the settings allow.

        Raises DeviceTimeoutError where the radar falls silent; the scans up to then have been yielded.
        """
        if not 1 <= count <= SCAN_FOREVER:
            raise UsageError(f"scan count is {count}", "Give 1 to 65534, or 65535 for no end.")
        if not 0 <= interval_us < 2**32:
            raise UsageError(f"scan interval is {interval_us} us", "Give 0 to 4294967295 us.")
        if self._scanning:
            raise UsageError("the radar is scanning already", "End the running scan series first.")
        patience = self._timeout + 3 * max(self.config.scan_period_s, interval_us * 1e-6)
        self._early.clear()
        first_id = self._next_id
        assembler = ScanAssembler(first_id, self._statistics)
        end_id = None if count == SCAN_FOREVER else first_id + count
        try:
            self._scanning = True
            self._start(count, interval_us, patience)
            yield from self._run(assembler, end_id, patience)
        finally:
            self._next_id = (max(assembler.newest_id or 0, first_id, self._next_id) + 1) & 0xFFFF
            self._stop_quietly()

    def _run(self, assembler: ScanAssembler, end_id: int | None, patience: float) -> Iterator[Scan]:
        first_id = assembler.next_id or 0
        deadline = time.monotonic() + patience
        while end_id is None or (assembler.next_id or 0) < end_id:
            message = self._early.popleft() if self._early else self._receive(deadline - time.monotonic())
            if message is not None and message.type is _T.SCAN_INFO:
                yield from _before(assembler.add(message), end_id)
                # Renewed after the yield: a caller that takes its time must not make the radar look silent.
                deadline = time.monotonic() + patience
            elif message is not None:
                self._not_for_a_run(message)
            elif self._link.exhausted:
                yield from _before(assembler.flush(), end_id)
                return
            elif time.monotonic() >= deadline:
                yield from _before(assembler.flush(), end_id)
                over = self._over(assembler, end_id)
                if self._early:
                    continue
                if end_id is None or not over:
                    raise self._silent((assembler.next_id or 0) - first_id, patience)
                assembler.give_up_until(end_id)

    def _over(self, assembler: ScanAssembler, end_id: int | None) -> bool:
        """Whether a silent radar has done its count, only that its last packets were lost.

        Either a packet of the last scan was seen, or the radar answers and the rest is short.
        """
        if end_id is None:
            return False
        if assembler.newest_id is not None and assembler.newest_id >= end_id - 1:
            return True
        try:
            self._request(_T.GET_CONFIG_REQUEST)
        except DeviceTimeoutError:
            return False
        return (assembler.next_id or 0) >= end_id - WINDOW

    def _silent(self, done: int, patience: float) -> DeviceTimeoutError:
        return DeviceTimeoutError(
            f"the radar at {self._link} sent nothing for {patience:.1f} s, after {done} scans",
            "Check power and cable; the scans that arrived before are kept.",
        )

    def _start(self, count: int, interval_us: int, patience: float) -> None:
        """Starts a run; its first scan counts as confirm, so that a lost confirm does not start it twice."""
        confirm = self._request(_T.CONTROL_REQUEST, patience, scan_count=count, interval_us=interval_us)
        if confirm.type is _T.CONTROL_CONFIRM:
            _accept(confirm, "start scanning")

    def _stop(self) -> Message:
        confirm = self._request(_T.CONTROL_REQUEST, scan_count=0)
        self._scanning = False
        return confirm

    def _stop_quietly(self) -> None:
        """Stops a run where one may be under way; a radar that is gone cannot be stopped."""
        if not self._scanning:
            return
        try:
            self._stop()
            self._drain()
        except DeviceError:
            pass
        finally:
            self._scanning = False

    def _drain(self) -> None:
        """Drops what still arrives after a stop, until it has been quiet for a moment."""
        deadline = time.monotonic() + self._timeout
        while time.monotonic() < deadline:
            message = self._receive(_QUIET_S)
            if message is None:
                return
            self._left_over(message)

    def _left_over(self, message: Message) -> None:
        """Moves our ids past those of an old run's scans: stragglers can only be behind the next run."""
        if message.type is _T.SCAN_INFO and (message.id - self._next_id) & 0xFFFF < 0x8000:
            self._next_id = (message.id + 1) & 0xFFFF

    def _request(self, request: MessageType, patience: float | None = None, **fields: Any) -> Message:
        """Sends a request until its confirm comes (requests are idempotent, so repeats carry the same id).

        For the start of a run, the run's first SCAN_INFO is returned as well as kept for the assembler.
        """
        message_id, self._next_id = self._next_id, (self._next_id + 1) & 0xFFFF
        try:
            packet = encode(request, message_id, **fields)
        except ValueError as error:
            raise UsageError(
                f"the radar cannot be sent this: {error}", "Give a value within the limits."
            ) from error
        starts = request is _T.CONTROL_REQUEST and fields.get("scan_count", 0) > 0
        for attempt in range(self._attempts):
            self._statistics.retries += attempt > 0
            self._link.send(packet)
            deadline = time.monotonic() + (patience or self._timeout)
            while (left := deadline - time.monotonic()) > 0:
                message = self._receive(left)
                if message is None:
                    if self._link.exhausted:
                        break
                    continue
                if message.type is _T.SCAN_INFO:
                    if starts and (message.id - message_id) & 0xFFFF < 2 * WINDOW:
                        self._early.append(message)
                        return message
                    if self._scanning and request is _T.GET_CONFIG_REQUEST:
                        self._early.append(message)
                    else:
                        self._left_over(message)
                elif message.id == message_id and message.type == request + 0x100:
                    return message
                else:
                    self._refused(message, request, message_id)
        raise DeviceTimeoutError(
            f"the radar at {self._link} did not answer {request.name} ({self._attempts} tries)", _NO_ANSWER
        )

    def _refused(self, message: Message, request: MessageType, message_id: int) -> None:
        """Raises where a message ends the wait for a confirm; a late confirm of something else is dropped."""
        if message.type is _T.INVALID_MESSAGE_CONFIRM and message["bad_id"] == message_id:
            raise DeviceRejectedError(
                f"the radar does not accept {request.name}: {status_text(message['status'])}",
                "Its firmware is another one, or the device is no P440 in MRM mode; see `tagid doctor`.",
            )
        if message.type is _T.READY_INFO and self._config is not None:
            raise _rebooted()
        self._statistics.unexpected += 1

    def _not_for_a_run(self, message: Message) -> None:
        if message.type is _T.READY_INFO:
            self._scanning = False
            raise _rebooted()
        if message.type is _T.CONTROL_CONFIRM and message["status"] != Status.OK:
            _accept(message, "start scanning")
        if message.type is not _T.CONTROL_CONFIRM:
            self._statistics.unexpected += 1

    def _receive(self, timeout: float) -> Message | None:
        """The next message, or None where none came in time; what is no message is counted and dropped."""
        deadline = time.monotonic() + timeout
        while (packet := self._link.receive(max(deadline - time.monotonic(), 0.0))) is not None:
            self._statistics.received += 1
            try:
                return decode(packet)
            except MalformedMessage:
                self._statistics.malformed += 1
            if time.monotonic() >= deadline:
                break
        return None


def _before(scans: list[Scan], end_id: int | None) -> list[Scan]:
    return [scan for scan in scans if end_id is None or scan.scan_id < end_id]


def _accept(confirm: Message, action: str) -> None:
    """Raises DeviceRejectedError unless the confirm's status is ok."""
    status = confirm["status"]
    if status != Status.OK:
        raise DeviceRejectedError(
            f"the radar refused to {action}: {status_text(status)}",
            "Check the setting against the P440's limits; a reboot of the radar clears a wrong mode.",
        )


def _rebooted() -> DeviceError:
    return DeviceError(
        "the radar rebooted in the middle (READY_INFO arrived)",
        "Check its power supply, then run the command again; the scans that arrived before are kept.",
    )
