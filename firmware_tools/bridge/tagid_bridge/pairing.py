"""Who may pair: bonds, tries of the pass-key over all reboots, and the check for LE Secure Connections.

A fixed pass-key is a weak secret. Pass-key entry compares its 20 bits one after the other (Bluetooth Core
Specification, volume 3, part H, 2.3.5.6.3), so every failed try tells how many bits were right. Failed tries
are therefore counted for the life of the pass-key and are few (docs/bridge.md has the arithmetic).
"""

import json
import os
from binascii import hexlify, unhexlify
from time import ticks_diff, ticks_ms

from micropython import const

BONDS = "bonds.json"
TRIES = "tries.json"
_OUR = const(1)
_MOST_PEERS = const(8)
# Wait before each try after so many failed ones, ms; after the last the bridge takes no new computer until
# a new pass-key is written over USB.
WAITS_MS = (0, 2000, 10000, 60000, 300000)


class Pairing:
    """Bonds and tries, kept in two files that are written from the loop only, never from an interrupt."""

    def __init__(self):
        self.failed = _load_tries()
        self._since = ticks_ms()
        self._bonds = _load_bonds()
        self._changed = False
        self.secure = False
        self.legacy = False

    # Tries of the pass-key, called from the loop.

    def may_try(self):
        """Whether a try is due; the wait restarts at every boot, because the clock stops without power."""
        if self.failed >= len(WAITS_MS):
            return False
        return ticks_diff(ticks_ms(), self._since) >= WAITS_MS[self.failed]

    def begin(self):
        """Counts a try as failed, in flash, before it is answered: a power cut must not save it."""
        self._since = ticks_ms()
        self.failed += 1
        _write(TRIES, self.failed)

    def passed(self):
        """The try that was begun was right; only that one is taken back."""
        self.failed = max(0, self.failed - 1)
        _write(TRIES, self.failed)

    # Secrets of the radio stack, called from its interrupt.

    def forget_link(self):
        """A new link or a new pairing: nothing is proved yet."""
        self.secure = self.legacy = False

    def get(self, kind, index, key):
        """The secret of a peer, or the one at a position; None if there is none."""
        for other, name, value in self._bonds:
            if other != kind:
                continue
            if key is None:
                if index == 0:
                    return value
                index -= 1
            elif name == bytes(key):
                # Only bonds made with LE Secure Connections are ever kept.
                self.secure = self.secure or kind == _OUR
                return value
        return None

    def put(self, kind, key, value):
        """Keeps, replaces or (without a value) removes a secret; whether that was done."""
        key = bytes(key)
        before = len(self._bonds)
        kept = [bond for bond in self._bonds if bond[0] != kind or bond[1] != key]
        if value is None:
            self._bonds = kept
            self._changed = self._changed or len(kept) != before
            return len(kept) != before
        value = bytes(value)
        if kind == _OUR:
            self.secure = made_securely(value)
            self.legacy = not self.secure
        if self.legacy:
            self._bonds = [bond for bond in kept if bond[1] != key]
            self._changed = True
            return False
        peers = []
        for bond in kept:
            if bond[1] not in peers:
                peers.append(bond[1])
        if key not in peers and len(peers) >= _MOST_PEERS:
            kept = [bond for bond in kept if bond[1] != peers[0]]
        kept.append((kind, key, value))
        self._bonds = kept
        self._changed = True
        return True

    def save(self):
        """Writes the bonds, where they changed; from the loop."""
        if self._changed:
            self._changed = False
            rows = [
                [kind, hexlify(key).decode(), hexlify(value).decode()] for kind, key, value in self._bonds
            ]
            _write(BONDS, rows)


def made_securely(value):
    """Whether a bond comes from LE Secure Connections.

    The value is NimBLE's `ble_store_value_sec`: the random number that legacy pairing finds its key by stands
    at 16..23, the long-term key at 24..39 (apache/mynewt-nimble, ble_store.h). With Secure Connections the
    number is zero (Core Specification, volume 3, part H, 2.4.4); our own is drawn by us, so a peer cannot
    choose it.
    """
    return len(value) >= 40 and not any(value[16:24]) and any(value[24:40])


def _load_tries():
    try:
        with open(TRIES) as file:
            count = json.load(file)
        return count if isinstance(count, int) and count >= 0 else len(WAITS_MS)
    except OSError:
        return 0
    except ValueError:
        # Damaged: nobody knows how many there were.
        return len(WAITS_MS)


def _load_bonds():
    try:
        with open(BONDS) as file:
            rows = [(kind, unhexlify(key), unhexlify(value)) for kind, key, value in json.load(file)]
    except (OSError, ValueError, TypeError):
        return []
    # Firmware before 1.1 kept bonds of legacy pairing, too.
    secure = [key for kind, key, value in rows if kind == _OUR and made_securely(value)]
    return [row for row in rows if row[1] in secure]


def _write(path, content):
    beside = path + ".new"
    with open(beside, "w") as file:
        json.dump(content, file)
    os.rename(beside, path)
