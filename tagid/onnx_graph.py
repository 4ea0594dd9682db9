"""Runs a small ONNX graph with numpy.

The reflector detector takes some milliseconds of convolutions. Importing onnxruntime for it would cost ten
times as much, and 25 MB of memory. Field numbers are those of onnx.proto3, IR version 10; operators those of
opset 20.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from tagid.errors import ModelError
from tagid.onnx_files import message_fields

Array = NDArray[Any]

_DTYPES = {1: "float32", 6: "int32", 7: "int64"}
"""Element types of tensors that are read."""


@dataclass
class _Node:
    """One operator: its type, names of inputs and outputs, and attributes by name."""

    kind: str = ""
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    attributes: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Port:
    """An input or output of a graph: name, numpy dtype name, and sizes with names for free dimensions."""

    name: str
    dtype: str
    shape: tuple[int | str, ...]


class Graph:
    """A graph of float32 convolutions and what goes with them.

    Args:
        content: serialized ModelProto, verified by the caller (`models_store.model_bytes`).

    Attributes:
        metadata: metadata_props by key.
        inputs, outputs: of the graph, without constants.

    Raises:
        ModelError: the graph has an operator or a tensor that is not supported here.
    """

    def __init__(self, content: bytes) -> None:
        self.metadata: dict[str, str] = {}
        self._nodes: list[_Node] = []
        self._constants: dict[str, Array] = {}
        inputs: list[Port] = []
        outputs: list[Port] = []
        for number, value in message_fields(memoryview(content)):
            if number == 14:
                key, text = _strings(value, 1, 2)
                self.metadata[key] = text
            elif number == 7:
                for part, inner in message_fields(_message(value)):
                    if part == 1:
                        self._nodes.append(_node(_message(inner)))
                    elif part == 5:
                        name, tensor = _tensor(_message(inner))
                        self._constants[name] = tensor
                    elif part == 11:
                        inputs.append(_port(_message(inner)))
                    elif part == 12:
                        outputs.append(_port(_message(inner)))
        self.inputs = tuple(port for port in inputs if port.name not in self._constants)
        self.outputs = tuple(outputs)
        unknown = sorted({node.kind for node in self._nodes} - set(_OPERATORS))
        if unknown:
            raise ModelError(f"operators {', '.join(unknown)} are not supported without onnxruntime")

    def run(self, outputs: Sequence[str], feeds: Mapping[str, Array]) -> list[Array]:
        """The named outputs for these inputs."""
        known = {**self._constants, **feeds}
        for node in self._nodes:
            values = [known[name] for name in node.inputs]
            known[node.outputs[0]] = _OPERATORS[node.kind](values, node.attributes)
        return [known[name] for name in outputs]


def _message(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise ModelError("the model file is damaged: a number in place of a message")
    return value


def _text(value: int | memoryview) -> str:
    return bytes(_message(value)).decode()


def _strings(value: int | memoryview, *numbers: int) -> list[str]:
    """Strings in the given fields of a message, "" for missing ones."""
    found = dict(message_fields(_message(value)))
    return [_text(found[number]) if number in found else "" for number in numbers]


def _signed(value: int | memoryview) -> int:
    if not isinstance(value, int):
        raise ModelError("the model file is damaged: a message in place of a number")
    return value - (1 << 64) if value >= 1 << 63 else value


def _integers(value: int | memoryview) -> list[int]:
    """A repeated integer field, packed or not."""
    if isinstance(value, int):
        return [_signed(value)]
    numbers, at = [], 0
    while at < len(value):
        end = at
        while value[end] & 0x80:
            end += 1
        numbers.append(sum((byte & 0x7F) << 7 * i for i, byte in enumerate(value[at : end + 1])))
        at = end + 1
    return [_signed(number) for number in numbers]


def _node(message: memoryview) -> _Node:
    node = _Node()
    for number, value in message_fields(message):
        if number == 1:
            node.inputs.append(_text(value))
        elif number == 2:
            node.outputs.append(_text(value))
        elif number == 4:
            node.kind = _text(value)
        elif number == 5:
            name, given = _attribute(_message(value))
            node.attributes[name] = given
    return node


def _attribute(message: memoryview) -> tuple[str, Any]:
    name, found = "", cast(Any, None)
    several: list[int] = []
    for number, value in message_fields(message):
        if number == 1:
            name = _text(value)
        elif number == 2:
            found = float(np.frombuffer(_message(value), "<f4")[0])
        elif number == 3:
            found = _signed(value)
        elif number == 4:
            found = _text(value)
        elif number == 8:
            several += _integers(value)
    return name, several or found


def _tensor(message: memoryview) -> tuple[str, Array]:
    name, kind, shape = "", 0, list[int]()
    raw: memoryview | None = None
    integers: list[int] = []
    floats = b""
    for number, value in message_fields(message):
        if number == 1:
            shape += _integers(value)
        elif number == 2:
            kind = _signed(value)
        elif number == 4:
            floats += bytes(_message(value))
        elif number in (5, 7):
            integers += _integers(value)
        elif number == 8:
            name = _text(value)
        elif number == 9:
            raw = _message(value)
    if kind not in _DTYPES:
        raise ModelError(f"tensor {name} has element type {kind}, which is not supported without onnxruntime")
    stored = np.dtype(_DTYPES[kind]).newbyteorder("<")
    if raw is not None or kind == 1:
        flat = np.frombuffer(floats if raw is None else raw, stored).astype(_DTYPES[kind])
    else:
        flat = np.array(integers, dtype=_DTYPES[kind])
    return name, flat.reshape(shape)


def _port(message: memoryview) -> Port:
    name, kind, shape = "", 0, list[int | str]()
    for number, value in message_fields(message):
        if number == 1:
            name = _text(value)
        elif number == 2:
            tensor = dict(message_fields(_message(value)))[1]
            for part, inner in message_fields(_message(tensor)):
                if part == 1:
                    kind = _signed(inner)
                elif part == 2:
                    shape = [_dimension(_message(size)) for _, size in message_fields(_message(inner))]
    return Port(name, _DTYPES.get(kind, str(kind)), tuple(shape))


def _dimension(message: memoryview) -> int | str:
    found = dict(message_fields(message))
    return _signed(found[1]) if 1 in found else _text(found[2])


def _conv(values: list[Array], given: dict[str, Any]) -> Array:
    """(n, m, h', w') of (n, c, h, w) with weights (m, c, kh, kw): columns of patches, and one product."""
    x, weight, bias = values
    down, right = given.get("strides", [1, 1])
    top, left, bottom, end = given.get("pads", [0, 0, 0, 0])
    if given.get("group", 1) != 1 or set(given.get("dilations", [1])) != {1}:
        raise ModelError("grouped or dilated convolutions are not supported without onnxruntime")
    n, c, h, w = x.shape
    padded = np.zeros((n, c, h + top + bottom, w + left + end), dtype=x.dtype)
    padded[:, :, top : top + h, left : left + w] = x
    m, _, kh, kw = weight.shape
    rows = (padded.shape[2] - kh) // down + 1
    columns = (padded.shape[3] - kw) // right + 1
    patches = np.empty((n, c, kh, kw, rows, columns), dtype=x.dtype)
    for i in range(kh):
        for j in range(kw):
            patches[:, :, i, j] = padded[:, :, i : i + down * rows : down, j : j + right * columns : right]
    out: Array = np.matmul(weight.reshape(m, -1), patches.reshape(n, c * kh * kw, rows * columns))
    out += bias[:, None]
    return out.reshape(n, m, rows, columns)


def _conv_transpose(values: list[Array], given: dict[str, Any]) -> Array:
    """(n, m, s h, s w) of (n, c, h, w) with weights (c, m, s, s): patches that do not overlap."""
    x, weight, bias = values
    n, c, h, w = x.shape
    _, m, kh, kw = weight.shape
    if list(given.get("strides", [1, 1])) != [kh, kw] or any(given.get("pads", [])):
        raise ModelError("overlapping transposed convolutions are not supported without onnxruntime")
    out: Array = np.matmul(weight.reshape(c, -1).T, x.reshape(n, c, h * w)).reshape(n, m, kh, kw, h, w)
    out += bias[:, None, None, None, None]
    return out.transpose(0, 1, 4, 2, 5, 3).reshape(n, m, h * kh, w * kw)


def _reshape(values: list[Array], given: dict[str, Any]) -> Array:
    sizes = [int(size) for size in values[1]]
    if not given.get("allowzero", 0):
        sizes = [values[0].shape[i] if size == 0 else size for i, size in enumerate(sizes)]
    return values[0].reshape(sizes)


def _gemm(values: list[Array], given: dict[str, Any]) -> Array:
    a = values[0].T if given.get("transA", 0) else values[0]
    b = values[1].T if given.get("transB", 0) else values[1]
    out = np.float32(given.get("alpha", 1.0)) * (a @ b)
    return out + np.float32(given.get("beta", 1.0)) * values[2]


def _reduce(by: Callable[..., Any]) -> Callable[[list[Array], dict[str, Any]], Array]:
    def reduced(values: list[Array], given: dict[str, Any]) -> Array:
        axes = tuple(int(axis) for axis in values[1])
        return np.asarray(by(values[0], axis=axes, keepdims=bool(given.get("keepdims", 1))))

    return reduced


_OPERATORS: Mapping[str, Callable[[list[Array], dict[str, Any]], Array]] = {
    "Concat": lambda values, given: np.concatenate(values, axis=given["axis"]),
    "Conv": _conv,
    "ConvTranspose": _conv_transpose,
    "Gather": lambda values, given: np.take(values[0], values[1], axis=given.get("axis", 0)),
    "Gemm": _gemm,
    "ReduceMax": _reduce(np.max),
    "ReduceMean": _reduce(np.mean),
    "Relu": lambda values, given: np.maximum(values[0], 0),
    "Reshape": _reshape,
    "Transpose": lambda values, given: values[0].transpose(given["perm"]),
}
"""Operators of the shipped detector."""
