"""One request and its confirm: retries, packets dropped while waiting, and the timeout.

The client works with commands and scans; this module handles packets that are lost, late, damaged or from
an earlier run.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from typing import Final

import numpy as np

from tagid.errors import DeviceRejectedError, DeviceRestartedError, DeviceTimeoutError, UsageError
from tagid.radar.assembler import WINDOW, Statistics
from tagid.radar.links import Link, UdpLink, port_remedy
from tagid.radar.messages import (
    MalformedMessage,
    Message,
    MessageType,
    Status,
    Value,
    decode,
    encode,
    status_text,
)
from tagid.radar.scan_info import SCAN_INFO_HEAD, Fragment, read_fragment

_T = MessageType
_QUIET_S: Final = 0.05
_BACKLOG: Final = 4
"""Fragments that may be queued before an answer on a slow line."""
_FIRST_S: Final = 0.6
"""Longest wait for an answer of a radar that was never heard, s: a P440 answers within milliseconds, and a
wrong address is to be reported soon. One that was heard may be busy, or about to return."""


class Exchange:
    """Requests and their confirms over one link.

    Attributes:
        timeout: wait for one answer, s.
        attempts: number of times a request is sent before the radar is considered silent.
        statistics: counters of the connection.
        next_id: id of the next request, u16.
        scanning: whether our run is in progress, so its fragments are kept during requests.
        started: whether READY_INFO is unexpected, i.e. means a reboot.
        early: fragments of the run that arrived while waiting for a confirm.
    """

    def __init__(self, link: Link, timeout: float, attempts: int) -> None:
        self.link = link
        self.timeout = timeout
        self.attempts = attempts
        self.statistics = Statistics()
        self.next_id = 1
        self.scanning = False
        self.started = False
        self.early: deque[Fragment] = deque(maxlen=1024)

    @property
    def patience_s(self) -> float:
        """Timeout for an answer that queues behind fragments on a slow line, s."""
        return self.timeout + _BACKLOG * self.link.packet_time_s

    def request(self, kind: MessageType, **fields: int | np.void) -> Message:
        """Send a request that does not start a run; return its confirm. Raises as `exchange`."""
        confirm = self.exchange(kind, fields, self.patience_s)
        assert isinstance(confirm, Message)
        return confirm

    def exchange(
        self, kind: MessageType, fields: Mapping[str, Value], patience: float, attempts: int | None = None
    ) -> Message | Fragment:
        """Send a request until its confirm arrives (requests are idempotent; repeats carry the same id).

        If the request starts a run, the run's first fragment is returned and also kept for the assembler.

        It waits `patience` seconds for an answer.

        Raises:
            UsageError: a value does not fit its field.
            DeviceTimeoutError: no answer. DeviceRejectedError: the radar does not know the request.
            DeviceRestartedError: the radar rebooted meanwhile.
        """
        message_id, self.next_id = self.next_id, (self.next_id + 1) & 0xFFFF
        try:
            packet = encode(kind, message_id, **fields)
        except ValueError as error:
            raise UsageError(
                f"the request cannot be encoded: {error}", "Give a value within the limits."
            ) from error
        starts_run = kind is _T.CONTROL_REQUEST and bool(fields.get("scan_count"))
        bytes_before, heard = self._bytes_in_vain(), 0
        attempts = attempts or self.attempts
        if not self.statistics.received:
            patience = min(patience, _FIRST_S + _BACKLOG * self.link.packet_time_s)
        for attempt in range(attempts):
            self.statistics.retries += attempt > 0
            self.link.send(packet)
            deadline = time.monotonic() + patience
            while (remaining_s := deadline - time.monotonic()) > 0:
                message = self.receive(remaining_s)
                if message is None:
                    if self.link.exhausted:
                        break
                    continue
                heard += 1
                if isinstance(message, Fragment):
                    if starts_run and (message.id - message_id) & 0xFFFF < 2 * WINDOW:
                        self.early.append(message)
                        return message
                    if self.scanning and kind is _T.GET_CONFIG_REQUEST:
                        self.early.append(message)
                    else:
                        self._left_over(message)
                elif message.id == message_id and message.type == kind + 0x100:
                    return message
                else:
                    self._refused(message, kind, message_id)
        strange = self._bytes_in_vain() - bytes_before
        if strange and not heard:
            raise DeviceTimeoutError(
                f"something answers at {self.link}, but not as a P440 ({kind.name} sent {attempts} times)",
                "Check the address and port; on a serial line, the framing (usb or uart), the baud rate, and "
                "that the device is a P440.",
            )
        raise DeviceTimeoutError(
            f"the radar at {self.link} did not answer {kind.name} ({attempts} tries)",
            _no_answer(self.link),
        )

    def _bytes_in_vain(self) -> int:
        """Number of malformed packets so far, plus bytes outside frames on a serial line."""
        return self.statistics.malformed + self.link.skipped_bytes

    def drain(self) -> None:
        """Drop packets that still arrive after a stop, until the line is quiet."""
        deadline = time.monotonic() + self.timeout
        while time.monotonic() < deadline:
            message = self.receive(_QUIET_S)
            if message is None:
                return
            self._left_over(message)

    def _left_over(self, message: Message | Fragment) -> None:
        """Move request ids past the scan ids of an old run, so that its late packets precede the next run."""
        if isinstance(message, Fragment) and (message.id - self.next_id) & 0xFFFF < 0x8000:
            self.next_id = (message.id + 1) & 0xFFFF

    def receive(self, timeout: float) -> Message | Fragment | None:
        """The next message, or None if none arrived in time; malformed packets are counted and dropped."""
        deadline = time.monotonic() + timeout
        while (packet := self.link.receive(max(deadline - time.monotonic(), 0.0))) is not None:
            self.statistics.received += 1
            if packet.startswith(SCAN_INFO_HEAD):
                fragment = read_fragment(packet)
                if fragment is not None:
                    return fragment
                self.statistics.malformed += 1
            else:
                try:
                    return decode(packet)
                except MalformedMessage:
                    self.statistics.malformed += 1
            if time.monotonic() >= deadline:
                break
        return None

    def _refused(self, message: Message, request: MessageType, message_id: int) -> None:
        """Raise if a message ends the wait for a confirm; drop late confirms of other requests."""
        if message.type is _T.INVALID_MESSAGE_CONFIRM and message["bad_id"] == message_id:
            raise DeviceRejectedError(
                f"the radar does not accept {request.name}: {status_text(message['status'])}",
                "Its firmware differs, or the device is not a P440 in MRM mode; see `tagid doctor`.",
            )
        if message.type is _T.READY_INFO and self.started:
            raise restarted()
        self.statistics.unexpected += 1


def _no_answer(link: Link) -> str:
    """What to do about a radar that is silent."""
    if not isinstance(link, UdpLink):
        return "Check its power and cable, and that the URL names the radar's serial port."
    return (
        "Check power, cable and the address (kit units: 192.168.1.100 to 103, this computer 192.168.1.1/24), "
        f"{port_remedy(link.address[1])}, and that no firewall drops the answers."
    )


def accept(confirm: Message, action: str) -> None:
    """Raises DeviceRejectedError unless the confirm's status is ok."""
    status = confirm["status"]
    if status != Status.OK:
        raise DeviceRejectedError(
            f"the radar refused to {action}: {status_text(status)}",
            "Check the setting against the P440's limits; rebooting the radar clears a wrong mode.",
        )


def restarted() -> DeviceRestartedError:
    """The error for an unexpected READY_INFO."""
    return DeviceRestartedError(
        "the radar rebooted while in use (READY_INFO arrived)",
        "Check its power supply, then run the command again; the scans received so far are kept.",
    )
