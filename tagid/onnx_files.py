"""Whether an ONNX file keeps tensors in other files, found without the onnx package.

onnxruntime reads such files relative to the working folder. What they hold is not covered by the hash of the
model.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Final

_INSIDE: Final[Mapping[str, Mapping[int, str]]] = MappingProxyType(
    {
        "model": {7: "graph", 20: "training", 25: "function"},
        "training": {1: "graph", 2: "graph"},
        "function": {7: "node"},
        "graph": {1: "node", 5: "tensor", 15: "sparse"},
        "node": {5: "attribute"},
        "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
        "sparse": {1: "tensor", 2: "tensor"},
    }
)
"""Field numbers that lead to tensors, by message (onnx.proto3, IR version 10)."""
_EXTERNAL_DATA: Final = 13
_DATA_LOCATION: Final = 14


def refers_to_files(content: bytes) -> bool:
    """Whether a tensor of a model (its serialized ModelProto) lies in another file.

    A content that is no protocol buffer message counts as such: onnxruntime refuses it as well.
    """
    waiting = [("model", memoryview(content))]
    try:
        while waiting:
            kind, message = waiting.pop()
            for number, value in _fields(message):
                if kind == "tensor":
                    if number == _EXTERNAL_DATA or (number == _DATA_LOCATION and value != 0):
                        return True
                elif number in _INSIDE[kind] and isinstance(value, memoryview):
                    waiting.append((_INSIDE[kind][number], value))
    except (IndexError, ValueError):
        return True
    return False


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """(field number, value) of a message: a varint as a number, anything else as its bytes.

    Raises IndexError or ValueError where the message is cut off or damaged.
    """
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        wire = key & 7
        if wire == 0:
            number, at = _varint(message, at)
            yield key >> 3, number
            continue
        if wire == 2:
            size, at = _varint(message, at)
        elif wire in (1, 5):
            size = 8 if wire == 1 else 4
        else:
            raise ValueError("no wire type of a protocol buffer")
        if at + size > len(message):
            raise ValueError("cut off")
        yield key >> 3, message[at : at + size]
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """The number at a position, and the position after it."""
    value = shift = 0
    while shift < 70:
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise ValueError("no varint")
