"""Pairing rules: bonds, pass-key attempts counted across reboots, and the check for LE Secure Connections.

A fixed pass-key is a weak secret. Pass-key entry compares its 20 bits one after the other (Bluetooth Core
Specification, volume 3, part H, 2.3.5.6.3), so every failed attempt reveals how many bits were right. Failed
attempts are therefore counted over the life of the pass-key and limited (calculation: docs/bridge.md).
"""

import json
import os
from binascii import hexlify, unhexlify

from micropython import const
from tagid_bridge import clock

BONDS = "bonds.json"
TRIES = "tries.json"
_OUR = const(1)
_MOST_PEERS = const(8)
# Wait before each attempt after this many failed ones, ms; after the last the bridge rejects new computers
# until a new pass-key is written over USB.
WAITS_MS = (0, 2000, 10000, 60000, 300000)


class Pairing:
    """Bonds and attempts, kept in two files that are written only from the loop, never from an interrupt."""

    def __init__(self):
        self.failed = _load_tries()
        self._since = clock.ms()
        self._bonds = _load_bonds()
        self._changed = False
        self.secure = False
        self.legacy = False

    # Pass-key attempts, called from the loop.

    def may_try(self):
        """Whether an attempt is allowed; the wait restarts at boot, as the clock stops without power."""
        if self.failed >= len(WAITS_MS):
            return False
        return clock.ms() - self._since >= WAITS_MS[self.failed]

    def begin(self):
        """Count an attempt as failed, in flash, before it is answered, so that a power cut cannot undo it."""
        self._since = clock.ms()
        self.failed += 1
        _write(TRIES, self.failed)

    def passed(self):
        """The attempt in progress was right; only that one is subtracted."""
        self.failed = max(0, self.failed - 1)
        _write(TRIES, self.failed)

    # Secrets of the radio stack, called from its interrupt.

    def forget_link(self):
        """A new link or a new pairing: not authenticated yet."""
        self.secure = self.legacy = False

    def get(self, kind, index, key):
        """The secret of a peer, or the one at an index; None if there is none."""
        for other, name, value in self._bonds:
            if other != kind:
                continue
            if key is None:
                if index == 0:
                    return value
                index -= 1
            elif name == bytes(key):
                # Only bonds made with LE Secure Connections are stored.
                self.secure = self.secure or kind == _OUR
                return value
        return None

    def put(self, kind, key, value):
        """Store, replace or (without a value) remove a secret; return whether that was done."""
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
        """Write the bonds if they changed; called from the loop."""
        if self._changed:
            self._changed = False
            rows = [
                [kind, hexlify(key).decode(), hexlify(value).decode()] for kind, key, value in self._bonds
            ]
            _write(BONDS, rows)


def made_securely(value):
    """Whether a bond comes from LE Secure Connections.

    The value is NimBLE's `ble_store_value_sec`: bytes 16..23 are the random number by which legacy pairing
    identifies its key, bytes 24..39 the long-term key (apache/mynewt-nimble, ble_store.h). With Secure
    Connections the number is zero (Core Specification, volume 3, part H, 2.4.4); the bridge generates it
    itself, so a peer cannot choose it.
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
        # Damaged: the number of attempts is unknown.
        return len(WAITS_MS)


def _load_bonds():
    try:
        with open(BONDS) as file:
            rows = [(kind, unhexlify(key), unhexlify(value)) for kind, key, value in json.load(file)]
    except (OSError, ValueError, TypeError):
        return []
    # Firmware before 1.1 also stored bonds of legacy pairing.
    secure = [key for kind, key, value in rows if kind == _OUR and made_securely(value)]
    return [row for row in rows if row[1] in secure]


def _write(path, content):
    beside = path + ".new"
    with open(beside, "w") as file:
        json.dump(content, file)
    os.rename(beside, path)
