"""The capture file: one recording with all its metadata, in HDF5.

All commands write this format; other programs can open it without `tagid`.

Layout, version 3 (docs/formats.md). Root attributes: format ("tagid.capture"), format_version, uuid,
created_utc, tool_version, complete, radar, motion, object (JSON), range_start_m, range_step_m,
axis_distance_m (absent: unknown), antenna_height_m, antenna_separation_m (absent: one antenna),
center_frequency_hz, bandwidth_hz, wave_speed_m_s (absent: vacuum), pulse_step_s (with /pulse). Datasets
under /scans, one row per view: samples (views, bins) int32 or float32, samples_imag (for complex samples,
whose real part is in samples), host_time_ns and scan_id int64, radar_time_ms, angles_rad, angle_sigma_rad
float64, flags uint8, antenna_positions_m (views, 3) float64 and, if the receiving antenna is separate,
receive_positions_m; unknown values are absent. /pulse (n,) float64, its middle sample is time zero. Texts
have a fixed length, so that all metadata is checksummed, too. Every dataset is checksummed (Fletcher-32),
shuffled and deflated.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from tagid import files
from tagid.capture import Capture
from tagid.constants import CAPTURE_SUFFIX, SPEED_OF_LIGHT
from tagid.errors import DataError, FileFormatError, StorageError, UsageError
from tagid.metadata import METADATA_VERSION
from tagid.storage.assembly import (
    AS_NPZ,
    MAX_EXPANSION,
    MAX_JSON_BYTES,
    OLD_ANGLES,
    SMALL_BYTES,
    TEXTS,
    VIEW_ARRAYS,
    build_capture,
    build_pulse,
    decode_settings,
    encode_settings,
    number,
    text,
)
from tagid.storage.metadata import PARTS, metadata_of, read_metadata

FORMAT = "tagid.capture"
FORMAT_VERSION = 3
"""Version of the capture file that this tagid writes. 2: typed metadata (`tagid.storage.metadata`). 3: the
angles are called `angles_rad`, as in NPZ and MATLAB files; a second antenna (antenna_separation_m,
/scans/receive_positions_m), which version 2 would ignore."""
MAGIC = b"\x89HDF\r\n\x1a\n"

_NUMBERS = ("range_start_m", "range_step_m", "antenna_height_m", "center_frequency_hz", "bandwidth_hz")
_OPTIONAL = {"axis_distance_m": None, "antenna_separation_m": 0.0, "wave_speed_m_s": SPEED_OF_LIGHT}
"""Numbers that are stored only where they are not these."""
_BLOCK_BYTES = 1 << 20
_KNOWN = frozenset(
    {"pulse", *(f"scans/{name}" for name in ("samples", "samples_imag", OLD_ANGLES, *VIEW_ARRAYS))}
)


def write_capture(path: Path, capture: Capture) -> None:
    """Write a capture file atomically.

    The file is read back and compared with `capture` before it gets its final name.

    Raises:
        DiskFullError, StorageError: see `tagid.files.replacing`; it reads back differently.
        UsageError: more than 2 GiB of samples.
    """
    if capture.samples.nbytes > files.MAX_FILE_BYTES:
        raise UsageError(f"{path}: the capture has {capture.samples.nbytes} bytes", "Write it in parts.")
    with growing_capture(path) as append:
        append(capture)


@contextmanager
def growing_capture(path: Path) -> Iterator[Callable[[Capture], None]]:
    """Write a capture file in parts: call the yielded function with each following part.

    Everything but the scan arrays comes from the first part. The file is read back in bounded memory and
    compared with the data before it gets its final name. Raises the errors of `write_capture`, and DataError
    if a part differs from the first in bins, dtype or the arrays present.
    """
    written = _Written()

    def verify(temporary: Path) -> None:
        _read_back(temporary, path, written)

    with (
        files.replacing(path, verify) as stream,
        h5py.File(stream, "w", libver=("v110", "v110")) as file,
    ):

        def append(capture: Capture) -> None:
            if "scans" in file:
                _extend(file["scans"], capture, written)
            else:
                _fill(file, capture, written)
            stream.check()

        yield append


@dataclass
class _Sum:
    """Rows of a dataset and a digest of their bytes, little-endian."""

    dtype: np.dtype[Any]
    rows: int = 0
    digest: Any = dataclasses.field(default_factory=hashlib.blake2b)

    def add(self, values: NDArray[Any]) -> None:
        self.rows += len(values)
        self.digest.update(np.ascontiguousarray(values, dtype=self.dtype).data)


@dataclass
class _Written:
    """The data passed to HDF5: root attributes by name, and checksums of the datasets by path."""

    attributes: dict[str, Any] = dataclasses.field(default_factory=dict)
    datasets: dict[str, _Sum] = dataclasses.field(default_factory=dict)


def _read_back(temporary: Path, path: Path, written: _Written) -> None:
    """Compare the file on disk with the data. Raises StorageError, which names `path`."""
    try:
        files.forget_cached(temporary)
        # HDF5's own driver: no Python code runs in its callbacks. The file is locked by `files.replacing`.
        with h5py.File(temporary, "r", locking=False) as file:
            different = _differences(file, path, written)
    except (OSError, RuntimeError, KeyError, ValueError, FileFormatError) as error:
        different = [str(error)[:120]]
    if different:
        raise StorageError(
            f"{path}: the file read back differs from the data written: {', '.join(different)}",
            "The disk or the memory may be faulty: write to another disk.",
        )


def _differences(file: Any, path: Path, written: _Written) -> list[str]:
    """Names of attributes and datasets that are missing, additional or different."""
    _version(file, path)
    stored = {name: _attribute(file, name) for name in file.attrs}
    names = sorted(stored.keys() | written.attributes.keys())
    different = [name for name in names if stored.get(name) != written.attributes.get(name)]
    groups = {"": file, "scans/": file["scans"]} if "scans" in file else {"": file}
    datasets = {
        prefix + name: group[name]
        for prefix, group in groups.items()
        for name in group
        if prefix + name != "scans"
    }
    if datasets.keys() != written.datasets.keys():
        different += sorted(datasets.keys() ^ written.datasets.keys())
    for name in datasets.keys() & written.datasets.keys():
        dataset, expected = datasets[name], written.datasets[name]
        _check_dataset(dataset, path)
        same = dataset.dtype == expected.dtype and len(dataset) == expected.rows
        if not same or _sum_of(dataset).digest.digest() != expected.digest.digest():
            different.append(name)
    return different


def _sum_of(dataset: Any) -> _Sum:
    """The checksum of a dataset, read in blocks of whole chunks."""
    total = _Sum(dataset.dtype)
    row_bytes = max(1, dataset.nbytes // len(dataset))
    rows = dataset.chunks[0] * max(1, _BLOCK_BYTES // (row_bytes * dataset.chunks[0]))
    for first in range(0, len(dataset), rows):
        total.add(dataset[first : first + rows])
    return total


def _extend(scans: Any, capture: Capture, written: _Written) -> None:
    arrays = _scan_arrays(capture)
    if set(arrays) != set(scans):
        raise DataError("the parts of a long capture hold different arrays")
    for name, values in arrays.items():
        dataset = scans[name]
        if dataset.shape[1:] != values.shape[1:] or dataset.dtype != values.dtype.newbyteorder("<"):
            raise DataError(f"the parts of a long capture differ in the shape or dtype of {name}")
        written.datasets[f"scans/{name}"].add(values)
        rows = len(dataset)
        dataset.resize(rows + len(values), axis=0)
        dataset[rows:] = values


def read_capture(path: Path) -> Capture:
    """Read a capture file of this or an older version.

    Declared sizes are checked against the file size before memory is allocated.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: not a capture file, damaged, or made by a newer version.
    """
    data = files.read_bytes(path)
    if data[: len(MAGIC)] != MAGIC:
        raise FileFormatError(f"{path}: is not an HDF5 file", f"A capture file ends in {CAPTURE_SUFFIX}.")
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            version = _version(file, path)
            attributes = {name: _attribute(file, name) for name in file.attrs}
            arrays = _read_arrays(file, path)
    # h5py raises any of these on damaged files, depending on where the damage is.
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, MemoryError) as error:
        raise FileFormatError(
            f"{path}: the HDF5 file is damaged or truncated ({str(error)[:120]})",
            "If a journal of the recording exists, use `tagid recover`.",
        ) from error
    return _to_capture(path, version, attributes, arrays)


def _fill(file: Any, capture: Capture, written: _Written) -> None:
    plain: dict[str, Any] = {"format_version": FORMAT_VERSION, "complete": bool(capture.complete)}
    plain |= {name: float(getattr(capture, name)) for name in _NUMBERS}
    for name, default in _OPTIONAL.items():
        if getattr(capture, name) != default:
            plain[name] = float(getattr(capture, name))
    if capture.pulse is not None:
        plain["pulse_step_s"] = float(capture.pulse.step)
    texts = {"format": FORMAT} | {name: getattr(capture, name) for name in TEXTS}
    texts |= {name: encode_settings(part) for name, part in metadata_of(capture).items()}
    written.attributes |= plain
    for name, value in plain.items():
        file.attrs[name] = value
    for name, content in texts.items():
        written.attributes[name] = content.encode().rstrip(b"\0")
        _put_text(file, name, content)
    scans = file.create_group("scans")
    for name, values in _scan_arrays(capture).items():
        written.datasets[f"scans/{name}"] = _put(scans, name, values)
    if capture.pulse is not None:
        samples = np.asarray(capture.pulse.samples, dtype=np.float64)
        written.datasets["pulse"] = _put(file, "pulse", samples)


def _scan_arrays(capture: Capture) -> dict[str, NDArray[Any]]:
    arrays = {"samples": capture.samples}
    if np.iscomplexobj(capture.samples):
        arrays = {"samples": capture.samples.real, "samples_imag": capture.samples.imag}
    for name, dtype in VIEW_ARRAYS.items():
        value = getattr(capture, name)
        if value is not None:
            arrays[name] = np.asarray(value, dtype=dtype)
    return arrays


def _put_text(file: Any, name: str, content: str) -> None:
    """A text of fixed length: HDF5 stores texts of variable length separately and without a checksum."""
    data = content.encode()
    file.attrs.create(name, data, dtype=h5py.string_dtype("utf-8", max(1, len(data))))


def _put(group: Any, name: str, values: NDArray[Any]) -> _Sum:
    little = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    total = _Sum(little.dtype)
    total.add(little)
    group.create_dataset(
        name,
        data=little,
        maxshape=(None, *little.shape[1:]),
        chunks=True,
        compression="gzip",
        compression_opts=4,
        shuffle=True,
        fletcher32=True,
    )
    return total


def _version(file: Any, path: Path) -> int:
    name = _attribute(file, "format")
    if name is None or text(name, f"{path} (format)") != FORMAT:
        raise FileFormatError(
            f"{path}: is an HDF5 file, but not a tagid capture (format is not {FORMAT!r})",
            "Read its arrays with h5py, and store them as NPZ: " + AS_NPZ,
        )
    version = number(_attribute(file, "format_version"), f"{path} (format_version)")
    if version != int(version):
        raise FileFormatError(f"{path}: format_version is {version}, expected a whole number")
    if version > FORMAT_VERSION:
        raise FileFormatError(
            f"{path}: format version {version:g}, this tagid reads up to version {FORMAT_VERSION}",
            "It was made by a newer tagid; upgrade.",
        )
    if version < 1:
        raise FileFormatError(f"{path}: format version {version:g} does not exist", "The file is damaged.")
    return int(version)


def _attribute(file: Any, name: str) -> Any:
    """A root attribute; None if it is missing or is not one number or text of fixed length.

    Texts of variable length are never read: HDF5 2.0 loops forever on a damaged heap.
    """
    if name not in file.attrs:
        return None
    identifier = file.attrs.get_id(name)
    if identifier.shape != () or identifier.get_storage_size() > MAX_JSON_BYTES:
        return None
    return file.attrs[name] if identifier.dtype.kind in "iufbS" else None


def _read_arrays(file: Any, path: Path) -> dict[str, NDArray[Any]]:
    """All numeric datasets of the root and of /scans, by path; links to other files are rejected."""
    arrays: dict[str, NDArray[Any]] = {}
    budget = files.MAX_FILE_BYTES * 2
    for prefix in ("", "scans/"):
        group = file[prefix] if prefix else file
        if not isinstance(group, h5py.Group):
            raise FileFormatError(f"{path}: {prefix!r} is not a group")
        if len(group) > 100:
            raise FileFormatError(f"{path}: /{prefix} holds {len(group)} members, more than 100")
        for name in group:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise FileFormatError(f"{path}: /{prefix}{name} is a link, which is not followed")
            if prefix + name not in _KNOWN:
                continue
            dataset = group[name]
            if not isinstance(dataset, h5py.Dataset):
                continue
            _check_dataset(dataset, path)
            budget -= dataset.nbytes
            if budget < 0:
                raise FileFormatError(f"{path}: the datasets together claim more than the memory allowed")
            arrays[prefix + name] = dataset[()]
    return arrays


def _check_dataset(dataset: Any, path: Path) -> None:
    where = f"{path}: {dataset.name}"
    if dataset.dtype.kind not in "iuf":
        raise FileFormatError(f"{where} has dtype {dataset.dtype}, expected numbers")
    if dataset.is_virtual or dataset.external:
        raise FileFormatError(f"{where} points to other files, which are not followed")
    if dataset.shape is None or not 1 <= dataset.ndim <= 2:
        raise FileFormatError(f"{where} has shape {dataset.shape}, expected one or two axes")
    stored = dataset.id.get_storage_size()
    believed = max(MAX_EXPANSION * stored, SMALL_BYTES if stored else 0)
    if dataset.nbytes > min(files.MAX_FILE_BYTES, believed):
        raise FileFormatError(
            f"{where} claims shape {dataset.shape} ({dataset.nbytes} bytes), but {stored} bytes are stored",
            "The file is damaged or was crafted to exhaust memory.",
        )


def _to_capture(
    path: Path, version: int, attributes: dict[str, Any], arrays: dict[str, NDArray[Any]]
) -> Capture:
    """The capture of a file's root attributes, and of its datasets by path."""
    if f"scans/{OLD_ANGLES}" in arrays:
        arrays.setdefault("scans/angles_rad", arrays[f"scans/{OLD_ANGLES}"])
    needed = {"complete", *TEXTS, *PARTS, *_NUMBERS}
    missing = sorted(name for name in needed if attributes.get(name) is None)
    if "scans/samples" not in arrays:
        missing.append("/scans/samples")
    if missing:
        raise FileFormatError(f"{path}: lacks {', '.join(missing)}", "The file is damaged or truncated.")
    fields: dict[str, Any] = {name: number(attributes[name], f"{path} ({name})") for name in _NUMBERS}
    fields |= {name: text(attributes[name], f"{path} ({name})") for name in TEXTS}
    parts = {}
    for name in PARTS:
        if not isinstance(attributes[name], str | bytes):
            raise FileFormatError(f"{path}: {name} is not a JSON text")
        parts[name] = decode_settings(attributes[name], f"{path} ({name})")
    fields |= read_metadata(parts, str(path), min(version, METADATA_VERSION))
    for name in _OPTIONAL:
        if attributes.get(name) is not None:
            fields[name] = number(attributes[name], f"{path} ({name})")
    if not isinstance(attributes["complete"], bool | np.bool_):
        raise FileFormatError(f"{path}: complete is not true or false")
    for name, dtype in VIEW_ARRAYS.items():
        if f"scans/{name}" in arrays:
            fields[name] = _native(arrays[f"scans/{name}"], f"{path}: /scans/{name}", (dtype,))
    if "pulse" in arrays:
        step = number(attributes.get("pulse_step_s"), f"{path} (pulse_step_s)")
        fields["pulse"] = build_pulse(_native(arrays["pulse"], f"{path}: /pulse", ("float64",)), step, path)
    fields["samples"] = _samples(path, arrays)
    return build_capture(path, complete=bool(attributes["complete"]), **fields)


def _samples(path: Path, arrays: Any) -> NDArray[Any]:
    real = _native(arrays["scans/samples"], f"{path}: /scans/samples", ("int32", "float32"))
    if "scans/samples_imag" not in arrays:
        return real
    imaginary = _native(arrays["scans/samples_imag"], f"{path}: /scans/samples_imag", ("float32",))
    if real.dtype != np.float32 or real.shape != imaginary.shape:
        raise FileFormatError(f"{path}: /scans/samples and samples_imag differ in shape or dtype")
    samples = np.empty(real.shape, dtype=np.complex64)
    samples.real, samples.imag = real, imaginary
    return samples


def _native(values: NDArray[Any], where: str, dtypes: tuple[str, ...]) -> NDArray[Any]:
    if values.dtype.newbyteorder("=").name not in dtypes:
        raise FileFormatError(f"{where} has dtype {values.dtype}, expected {' or '.join(dtypes)}")
    return values.astype(values.dtype.newbyteorder("="), copy=False)
