"""Access to the scan: one browser at a time, and the motion stops when it disconnects.

Every connection gets a key. A browser that reloads presents its key again within the grace period and remains
the operator. Whether a connection still exists is asked of the system, because the web server may be late.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable

GRACE_S = 5.0
"""Time that an operator may be disconnected, s: a reload takes one or two."""
_MOST_KEYS = 256
Connected = Callable[[], bool]
"""Whether a connection still exists; may be called on any thread."""


def _always() -> bool:
    return True


class Operators:
    """The connections and the key that holds the lock; thread-safe.

    Args:
        clock: monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._connections: dict[str, list[Connected]] = {}
        self._left_at: dict[str, float] = {}
        self._operator: str | None = None

    def join(self, shown: str | None = None, connected: Connected = _always) -> str:
        """Register an opened connection; returns its key, which is the presented one if known."""
        with self._lock:
            known = shown is not None and shown in self._connections
            key = str(shown) if known else secrets.token_urlsafe(18)
            self._connections.setdefault(key, []).append(connected)
            self._left_at.pop(key, None)
            return key

    def leave(self, key: str, connected: Connected = _always) -> None:
        """Register a closed connection."""
        with self._lock:
            connections = self._connections.get(key, [])
            if connected in connections:
                connections.remove(connected)
                self._mark_lost()

    def take(self, key: str, force: bool = False) -> bool:
        """Take the lock; False if another key has it, unless forced.

        A key keeps it during the grace period: its browser may be reloading the page.
        """
        with self._lock:
            if not self._present(key):
                return False
            if self._operator in (None, key) or force:
                self._operator = key
                return True
            return False

    def release(self, key: str) -> None:
        with self._lock:
            if self._operator == key:
                self._operator = None

    def holds(self, key: str | None) -> bool:
        """Whether a connected key has the lock."""
        with self._lock:
            return key is not None and key == self._operator and self._present(key)

    @property
    def taken(self) -> bool:
        """Whether some key has the lock."""
        return self._operator is not None

    @property
    def connected(self) -> int:
        """Number of open connections."""
        with self._lock:
            return sum(map(len, self._connections.values()))

    def expire(self) -> bool:
        """Remove keys disconnected for longer than the grace period; True if the operator was one."""
        with self._lock:
            self._mark_lost()
            now = self._clock()
            gone = [key for key, at in self._left_at.items() if now - at >= GRACE_S]
            oldest = sorted(self._left_at, key=self._left_at.__getitem__)
            gone += [key for key in oldest[: max(0, len(self._connections) - _MOST_KEYS)] if key not in gone]
            for key in gone:
                del self._left_at[key], self._connections[key]
            if self._operator in gone:
                self._operator = None
                return True
            return False

    def _present(self, key: str) -> bool:
        return key in self._connections and key not in self._left_at

    def _mark_lost(self) -> None:
        """Begin the grace period of the keys without a connection; the lock is held."""
        for key, connections in self._connections.items():
            if key not in self._left_at and not any(connected() for connected in connections):
                self._left_at[key] = self._clock()
