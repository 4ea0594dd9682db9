"""A signature as bytes: what the registry stores and what layout files carry.

Layout: MAGIC, format version (uint16), length of the header (uint32), JSON header, then little-endian arrays
(float64 wavenumbers and noise, complex64 harmonics), then the SHA-256 of all before it. Nothing is believed
until the checksum, every length and every value have been checked.
"""

from __future__ import annotations

import hashlib
import json
import struct
from typing import Any

import numpy as np

from tagid.errors import FileFormatError, TagidError
from tagid.tags.bodies.signature import KINDS, MAX_FREQUENCIES, MAX_ORDER, Signature

MAGIC = b"TAGIDSIG"
VERSION = 1
MAX_HEADER = 16 * 1024
MAX_BYTES = len(MAGIC) + 6 + MAX_HEADER + MAX_FREQUENCIES * (16 + 8 * (2 * MAX_ORDER + 1)) + 32
"""Bound of a whole signature, 62 kB; a helmet's has 4 kB."""
_HEAD = struct.Struct("<HI")
_NUMBERS = ("radius_m", "distance_m", "height_m", "model_error")
_TEXTS = ("name", "kind", "label")
_COUNTS = ("captures", "frequencies", "order")


def to_bytes(signature: Signature) -> bytes:
    """The bytes of a signature; `from_bytes` takes them back."""
    if np.abs(signature.harmonics).max() > 1e30:
        raise FileFormatError(f"the signature of {signature.name} is too large to be stored")
    header: dict[str, Any] = {name: getattr(signature, name) for name in (*_NUMBERS, *_TEXTS)}
    header |= {"captures": signature.captures, "order": signature.order}
    header["frequencies"] = len(signature.wavenumbers)
    text = json.dumps(header, sort_keys=True).encode()
    body = b"".join(
        [
            MAGIC,
            _HEAD.pack(VERSION, len(text)),
            text,
            signature.wavenumbers.astype("<f8").tobytes(),
            signature.noise.astype("<f8").tobytes(),
            signature.harmonics.astype("<c8").tobytes(),
        ]
    )
    return body + hashlib.sha256(body).digest()


def from_bytes(data: bytes, where: str) -> Signature:
    """A signature from bytes of any origin; `where` is for messages, e.g. "registry.sqlite, body cup".

    Raises FileFormatError where they are damaged, from a newer tagid, or hold impossible values.
    """
    try:
        return _parsed(data)
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError, TagidError) as error:
        raise FileFormatError(
            f"{where}: the signature cannot be read: {str(error)[:200]}",
            "Enroll it again from its captures, go back with `tagid layouts undo`, or restore a backup.",
        ) from None


def _parsed(data: bytes) -> Signature:
    start = len(MAGIC) + _HEAD.size
    if not isinstance(data, bytes) or not start + 32 < len(data) <= MAX_BYTES:
        raise ValueError("wrong length")
    if data[: len(MAGIC)] != MAGIC:
        raise ValueError("not a signature")
    version, length = _HEAD.unpack_from(data, len(MAGIC))
    if version != VERSION:
        raise ValueError(f"format {version}, this tagid reads {VERSION}")
    if hashlib.sha256(data[:-32]).digest() != data[-32:]:
        raise ValueError("its checksum is wrong, it is damaged")
    if length > MAX_HEADER or start + length + 32 > len(data):
        raise ValueError("wrong length of the header")
    header = json.loads(data[start : start + length].decode())
    if not isinstance(header, dict) or set(header) != {*_NUMBERS, *_TEXTS, *_COUNTS}:
        raise ValueError("wrong fields")
    if any(isinstance(header[n], bool) or not isinstance(header[n], (int, float)) for n in _NUMBERS):
        raise ValueError("a field is not a number")
    if any(isinstance(header[n], bool) or not isinstance(header[n], int) for n in _COUNTS):
        raise ValueError("a field is not a whole number")
    if any(not isinstance(header[n], str) for n in _TEXTS) or header["kind"] not in KINDS:
        raise ValueError("a field is not a text")
    count, order = header["frequencies"], header["order"]
    if not (2 <= count <= MAX_FREQUENCIES and 1 <= order <= MAX_ORDER):
        raise ValueError("impossible numbers of frequencies or harmonics")
    columns = 2 * order + 1
    if start + length + count * (16 + 8 * columns) + 32 != len(data):
        raise ValueError("wrong length")
    numbers = np.frombuffer(data, "<f8", 2 * count, start + length)
    harmonics = np.frombuffer(data, "<c8", count * columns, start + length + 16 * count)
    return Signature(
        header["name"],
        header["kind"],
        numbers[:count].copy(),
        harmonics.reshape(count, columns).astype(np.complex128),
        numbers[count:].copy(),
        radius_m=float(header["radius_m"]),
        distance_m=float(header["distance_m"]),
        height_m=float(header["height_m"]),
        model_error=float(header["model_error"]),
        captures=header["captures"],
        label=header["label"],
    )
