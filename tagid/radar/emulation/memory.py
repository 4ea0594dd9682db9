"""Connects a client to an emulated radar in the same process.

Replay and demo use the ordinary client on this link, so no driver needs special cases for them.
"""

from __future__ import annotations

import time
from collections import deque

from tagid.radar.emulation.core import EmulatorCore
from tagid.radar.emulation.faults import Faults, FaultyPath


class MemoryLink:
    """A link without a network to an emulated radar, which messages call `name`.

    `rate` is emulated seconds per second; 0 is as fast as the client reads scans, without waiting.
    """

    guarded = True
    skipped_bytes = 0

    def __init__(
        self, core: EmulatorCore, rate: float = 0.0, faults: Faults | None = None, name: str = "memory"
    ) -> None:
        self.foreign = 0
        self.packet_time_s = 0.0
        self._core = core
        self._rate = rate
        self._path = FaultyPath(faults)
        self._queue: deque[bytes] = deque()
        self._name = name
        self._origin = time.monotonic() - core.now_s / rate if rate else 0.0
        if rate:
            core.follow(lambda emulated_s: self._origin + emulated_s / rate)

    def __repr__(self) -> str:
        return self._name

    @property
    def exhausted(self) -> bool:
        """Whether a recording has ended and all of it has been received."""
        return self._core.ended and not self._queue

    def send(self, packet: bytes) -> None:
        if self._rate:
            self._put(self._core.advance_by_one((time.monotonic() - self._origin) * self._rate))
        if self._path.request_arrives():
            self._put(self._core.handle(packet))

    def receive(self, timeout: float) -> bytes | None:
        """The next packet; at rate 0 time jumps to the next scan instead of waiting for it."""
        deadline = time.monotonic() + timeout
        if not self._rate:
            while not self._queue and self._core.next_due_s is not None:
                self._put(self._core.step())
                if time.monotonic() >= deadline:
                    break  # if every packet is lost, return to the caller
            self._queue.extend(self._path.flush() if not self._queue else [])
            return self._queue.popleft() if self._queue else None
        while True:
            now = time.monotonic()
            self._put(self._core.advance_by_one((now - self._origin) * self._rate))
            if self._queue or now >= deadline:
                return self._queue.popleft() if self._queue else None
            due = self._core.next_due_s
            until = deadline if due is None else min(deadline, self._origin + due / self._rate)
            time.sleep(min(max(until - now, 0.0), 0.05))

    def reopen(self) -> None:
        """Discard packets that were not received; this radar never disconnects."""
        self.close()

    def close(self) -> None:
        """Discard packets that were not received."""
        self._queue.clear()

    def _put(self, packets: list[bytes]) -> None:
        self._queue.extend(self._path.pass_on(packets, self._core.now_s))
