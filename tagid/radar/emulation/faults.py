"""A network that loses, duplicates, reorders and delays packets, reproducibly from a seed.

Only packets from the radar are delayed or reordered. Requests may be lost but are never held back: a stop
request that arrives after the next start would reveal a fault of the network, not of the client.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Faults:
    """Probabilities, per packet.

    Attributes:
        lose: a packet from the radar is lost.
        lose_requests: a packet to the radar is lost.
        duplicate: a packet arrives twice.
        reorder: a packet arrives after the next one to three packets.
        delay: a packet arrives `delay_s` late.
        delay_s: the delay, s of the emulated clock.
    """

    lose: float = 0.0
    lose_requests: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    delay: float = 0.0
    delay_s: float = 0.02
    seed: int = 0


class FaultyPath:
    def __init__(self, faults: Faults | None = None) -> None:
        self._faults = faults or Faults()
        self._random = np.random.default_rng(self._faults.seed)
        self._sent = 0
        # (minimum packet count, earliest time, order, packet)
        self._held: list[tuple[int, float, int, bytes]] = []
        self.lost = 0

    def request_arrives(self) -> bool:
        """Whether the next packet to the radar arrives."""
        return not self._random.random() < self._faults.lose_requests

    def pass_on(self, packets: list[bytes], now_s: float) -> list[bytes]:
        """The packets that arrive now, of those sent now and those held back before."""
        out: list[bytes] = []
        f = self._faults
        for packet in packets:
            lose, twice, swap, late = self._random.random(4)
            self._sent += 1
            if lose < f.lose:
                self.lost += 1
                continue
            if swap < f.reorder or late < f.delay:
                behind = int(self._random.integers(1, 4)) if swap < f.reorder else 0
                until = now_s + f.delay_s if late < f.delay else now_s
                self._held.append((self._sent + behind, until, self._sent, packet))
            else:
                out.append(packet)
            if twice < f.duplicate:
                out.append(packet)
            out += self._released(now_s, self._sent)
        return out + self._released(now_s, self._sent)

    @property
    def holding(self) -> bool:
        return bool(self._held)

    def flush(self, now_s: float = math.inf) -> list[bytes]:
        """Release packets that are waiting for others that will not follow; delayed ones only when due."""
        return self._released(now_s, math.inf)

    @property
    def next_due_s(self) -> float | None:
        """When the next delayed packet is due; None if nothing is held back."""
        return min((until for _, until, _, _ in self._held), default=None)

    def _released(self, now_s: float, sent: float) -> list[bytes]:
        ready = [held for held in self._held if held[0] <= sent and held[1] <= now_s]
        if ready:
            self._held = [held for held in self._held if held not in ready]
        return [packet for *_, packet in sorted(ready)]
