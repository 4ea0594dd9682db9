"""Reads the variables of MATLAB 5 files: numbers, texts and structs (MAT-File Format, MathWorks, chapter 1).

Own code, because scipy's reader crashes the process on damaged structs; sizes are checked against the bytes.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

HEADER_BYTES: Final = 128
_MATRIX, _COMPRESSED = 14, 15
_STORED: Final = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"
}  # fmt: skip
_CLASSES: Final = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"
}  # fmt: skip
_TEXTS: Final = {2: "latin-1", 1: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_STRUCT, _CHAR = 2, 4
_COMPLEX: Final = 0x0800
_DEEPEST: Final = 8

Variable = NDArray[Any] | list[dict[str, Any]] | None
"""An array, a text as array of one element, the elements of a struct array; None for other classes."""


def read_variables(data: bytes, limit: int) -> dict[str, Variable]:
    """The variables of a file by name.

    Raises ValueError, zlib.error or LookupError: damaged, or its compressed variables hold more than `limit`
    bytes.
    """
    order = "<" if data[HEADER_BYTES - 2 : HEADER_BYTES] == b"IM" else ">"
    variables: dict[str, Variable] = {}
    for kind, payload in _elements(memoryview(data)[HEADER_BYTES:], order):
        parts = [(kind, payload)]
        if kind == _COMPRESSED:
            content = zlib.decompressobj().decompress(payload, max(limit, 0) + 1)
            limit -= len(content)
            if limit < 0:
                raise ValueError("its variables claim a size that is not plausible")
            parts = list(_elements(memoryview(content), order))
        for number, part in parts:
            if number == _MATRIX:
                name, variable = _matrix(part, order, 0)
                variables[name] = variable
    return variables


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """(type, content) of consecutive elements, each padded to 8 bytes except compressed ones."""
    at = 0
    while at + 8 <= len(data):
        kind, size = (int(value) for value in np.frombuffer(data[at : at + 8], f"{order}u4"))
        start = at + 8
        if kind >> 16:
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
        content = data[start : start + size]
        if len(content) != size:
            raise ValueError("a variable is truncated")
        yield kind, content
        end = start + size
        at = end if kind == _COMPRESSED else end + -end % 8


def _matrix(data: memoryview, order: str, depth: int) -> tuple[str, Variable]:
    if not len(data):
        return "", np.zeros((0, 0))
    (_, flags), (_, sizes), (_, name), *parts = _elements(data, order)
    word = int(np.frombuffer(flags[:4], f"{order}u4")[0])
    shape = np.frombuffer(sizes, f"{order}i4").tolist()
    if depth > _DEEPEST or min(shape, default=0) < 0:
        raise ValueError("a variable is damaged")
    text, of_class = bytes(name).decode("ascii", "replace"), word & 0xFF
    if of_class == _STRUCT:
        return text, _structs(parts, math.prod(shape), order, depth)
    if of_class == _CHAR:
        kind, content = parts[0] if parts else (1, memoryview(b""))
        encoding = _TEXTS[kind]
        if encoding.startswith("utf-1") or encoding.startswith("utf-3"):
            encoding += "-le" if order == "<" else "-be"
        return text, np.array([bytes(content).decode(encoding, "replace")])
    if of_class not in _CLASSES:
        return text, None
    dtype = np.dtype(_CLASSES[of_class])
    numbers = [np.frombuffer(part, f"{order}{_STORED[kind]}").astype(dtype) for kind, part in parts]
    if not numbers or any(len(values) != math.prod(shape) for values in numbers):
        raise ValueError(f"a variable claims {shape} numbers, and holds others")
    values = numbers[0]
    if word & _COMPLEX:
        if len(numbers) < 2 or dtype.kind != "f":
            raise ValueError("a complex variable is damaged")
        values = np.empty(len(values), np.result_type(dtype, np.complex64))
        values.real, values.imag = numbers[:2]
    return text, values.reshape(shape, order="F")


def _structs(parts: list[tuple[int, memoryview]], count: int, order: str, depth: int) -> list[dict[str, Any]]:
    (_, width), (_, names), *fields = parts
    length = int(np.frombuffer(width[:4], f"{order}i4")[0])
    if length < 1 or len(names) % length:
        raise ValueError("the names of a struct are damaged")
    keys = [
        bytes(names[at : at + length]).split(b"\0")[0].decode("ascii", "replace")
        for at in range(0, len(names), length)
    ]
    if count * len(keys) != len(fields) or any(kind != _MATRIX for kind, _ in fields):
        raise ValueError(f"a struct claims {count} elements, and holds others")
    values = [_matrix(content, order, depth + 1)[1] for _, content in fields]
    return [
        dict(zip(keys, values[at : at + len(keys)], strict=True))
        for at in range(0, len(values), len(keys) or 1)
    ]
