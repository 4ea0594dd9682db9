"""The shipped networks and graphs, opened only by name and verified against the manifest.

A model file that is damaged, from another release or of another shape would silently identify objects
wrongly, so it is compared with the manifest before it runs.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from numpy.typing import NDArray

from tagid.errors import ModelError, StorageError
from tagid.files import read_bytes

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

    A content that is no protocol buffer message counts as such: onnxruntime rejects it as well.
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


FOLDER = Path(__file__).parent / "models"
"""In a checkout, a link to the top-level folder `models/`; in a wheel the files themselves."""

OPSET = 20
"""The version of the ONNX operator set of all graphs."""

MAX_BYTES = 1 << 28
_MAX_MANIFEST_BYTES = 1 << 20
MANIFEST_VERSION = 1
_DTYPES = {"float32": "tensor(float)", "int32": "tensor(int32)", "int64": "tensor(int64)"}
_REINSTALL = "Reinstall tagid; in a checkout, restore the folder models/."

Shape = tuple[int | str, ...]


@dataclass(frozen=True)
class Tensor:
    """An input or output: numpy dtype name and shape; a named dimension has the same size everywhere."""

    dtype: str
    shape: Shape


@dataclass(frozen=True)
class ModelEntry:
    """A model's entry in the manifest.

    Attributes:
        name: argument of `open_model`.
        file: file name in the folder of the manifest.
        sha256, size: of the file.
        opset: ONNX operator set.
        inputs, outputs: by name, in order.
        facts: other facts: training data, measured quality.
    """

    name: str
    file: str
    sha256: str
    size: int
    opset: int
    inputs: Mapping[str, Tensor]
    outputs: Mapping[str, Tensor]
    facts: Mapping[str, Any]

    @classmethod
    def from_json(cls, name: str, item: Mapping[str, Any]) -> ModelEntry:
        """Parse one entry. Raises KeyError, TypeError or ValueError if it is invalid."""
        file = str(item["file"])
        if Path(file).name != file:
            raise ValueError(f"file {file!r} is not a plain name")
        sides = [
            {str(n): Tensor(str(t["dtype"]), _shape(t["shape"])) for n, t in item[side].items()}
            for side in ("inputs", "outputs")
        ]
        size, opset = int(item["size"]), int(item["opset"])
        return cls(name, file, str(item["sha256"]), size, opset, sides[0], sides[1], item.get("facts", {}))


class Model:
    """An opened model.

    Attributes:
        entry: its manifest entry.
    """

    def __init__(self, entry: ModelEntry, session: Any) -> None:
        self.entry = entry
        self._session = session
        self._outputs = list(entry.outputs)

    @property
    def metadata(self) -> Mapping[str, str]:
        """The file's metadata_props, by key."""
        return dict(self._session.get_modelmeta().custom_metadata_map)

    def check(self, feeds: Mapping[str, NDArray[Any]]) -> None:
        """Compare inputs with the manifest.

        Raises:
            ModelError: a name, dtype, rank or size differs; the message gives both values.
        """
        wanted = self.entry.inputs
        if set(feeds) != set(wanted):
            odd = sorted(set(feeds) ^ set(wanted))
            raise ModelError(f"model {self.entry.name} takes {', '.join(wanted)}; {', '.join(odd)} differ")
        sizes: dict[str, int] = {}
        for name, tensor in wanted.items():
            given = feeds[name]
            fits = given.dtype.name == tensor.dtype and given.ndim == len(tensor.shape)
            for dimension, size in zip(tensor.shape, given.shape, strict=False):
                want = sizes.setdefault(dimension, size) if isinstance(dimension, str) else dimension
                fits = fits and size == want
            if not fits:
                known = ", ".join(
                    f"{k} = {sizes[k]}" for k in tensor.shape if isinstance(k, str) and k in sizes
                )
                raise ModelError(
                    f"model {self.entry.name}: input {name} is {given.dtype.name}{list(given.shape)}, "
                    f"expected {tensor.dtype}{list(tensor.shape)}" + (f" with {known}" if known else "")
                )

    def run(self, feeds: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Outputs by name. Inputs are not checked again here: see `check`."""
        return dict(zip(self._outputs, self._session.run(self._outputs, dict(feeds)), strict=True))


@cache
def manifest(folder: Path = FOLDER) -> Mapping[str, ModelEntry]:
    """Every shipped model by name.

    Raises:
        ModelError: the manifest is invalid.
        StorageError: it is missing.
    """
    path = folder / "manifest.json"
    try:
        data = json.loads(read_bytes(path, _MAX_MANIFEST_BYTES))
        if data["manifest_version"] != MANIFEST_VERSION:
            version = data["manifest_version"]
            raise ModelError(f"{path} has version {version}, expected {MANIFEST_VERSION}", _REINSTALL)
        return {str(name): ModelEntry.from_json(str(name), item) for name, item in data["models"].items()}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ModelError(f"{path} is not a model manifest: {error!r}", _REINSTALL) from None


def model_bytes(name: str, folder: Path = FOLDER) -> tuple[bytes, ModelEntry]:
    """Content of a model file whose size, sha256 and opset match the manifest.

    Raises:
        ModelError: unknown model, or a different file; the message gives both values.
        StorageError: the file is missing.
    """
    known = manifest(folder)
    if name not in known:
        raise ModelError(f"unknown model {name!r}; known are: {', '.join(sorted(known))}", _REINSTALL)
    entry, path = known[name], folder / known[name].file
    if entry.opset != OPSET:
        raise ModelError(f"model {name} has opset {entry.opset}, expected {OPSET}", _REINSTALL)
    try:
        content = read_bytes(path, MAX_BYTES)
    except StorageError as error:
        raise StorageError(error.message, _REINSTALL) from error
    if len(content) != entry.size:
        raise ModelError(f"{path} has {len(content)} bytes, the manifest says {entry.size}", _REINSTALL)
    digest = hashlib.sha256(content).hexdigest()
    if digest != entry.sha256:
        raise ModelError(f"{path} has sha256 {digest}, the manifest says {entry.sha256}", _REINSTALL)
    if refers_to_files(content):
        raise ModelError(f"{path} keeps data in other files, which are not followed", _REINSTALL)
    return content, entry


def load_onnxruntime() -> Any:
    """The package onnxruntime with its telemetry off; every session is made with what this returns.

    From its import on, onnxruntime 1.31 otherwise writes a device id and a database into the user's cache
    folder, and sends events over the network. Raises ImportError if it is not installed.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    onnxruntime.disable_telemetry_events()
    return onnxruntime


def open_model(name: str, threads: int = 1, folder: Path = FOLDER) -> Model:
    """A model of the manifest in a folder, ready to run on the processor with some threads.

    Raises:
        ModelError: file or graph differs from the manifest (hash, opset, names, dtypes, shapes).
        StorageError: it is missing.
    """
    onnxruntime = load_onnxruntime()
    content, entry = model_bytes(name, folder)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # The arena never shrinks; plain allocations cost little compared with the computation.
    options.enable_cpu_mem_arena = options.enable_mem_pattern = False
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions have no common base
        raise ModelError(f"onnxruntime cannot run model {name}: {error}", _REINSTALL) from None
    for side, wanted in ((session.get_inputs(), entry.inputs), (session.get_outputs(), entry.outputs)):
        actual = {item.name: (item.type, _shape(item.shape)) for item in side}
        expected = {
            n: (_DTYPES.get(tensor.dtype, tensor.dtype), tensor.shape) for n, tensor in wanted.items()
        }
        odd = [n for n in {**actual, **expected} if actual.get(n) != expected.get(n)]
        if odd:
            raise ModelError(
                f"model {name}: {odd[0]} is {actual.get(odd[0])}, the manifest says {expected.get(odd[0])}",
                _REINSTALL,
            )
    return Model(entry, session)


def check_all() -> None:
    """Raises ModelError or StorageError if any shipped file does not match the manifest."""
    for name in manifest():
        model_bytes(name)


def _shape(dimensions: Any) -> Shape:
    """A shape from JSON or from onnxruntime: integers and names."""
    shape = tuple(dimensions)
    if not all(isinstance(d, (int, str)) and not isinstance(d, bool) for d in shape):
        raise ValueError(f"shape {dimensions!r} does not consist of integers and names")
    return shape
