"""The generic NPZ file: imports scans of any radar and exports captures to numpy.

Keys (docs/formats.md): samples (views, bins) real or complex; range_start_m, range_step_m; one of angles_rad
(views,), timestamps_s (views,), antenna_positions_m (views, 3), or transmit_positions_m with
receive_positions_m if the radar has two antennas; with angles axis_distance_m, optionally
antenna_height_m and antenna_separation_m (between two antennas side by side). Optional: center_frequency_hz,
bandwidth_hz, wave_speed_m_s (m/s, vacuum unless given), pulse with pulse_step_s, object (text or JSON). Files
that `tagid` exports also contain angle_sigma_rad, radar_time_ms, host_time_ns, scan_id, flags and tagid
(JSON: provenance, settings).
"""

from __future__ import annotations

import io
import json
import lzma
import math
import tokenize
import warnings
import zipfile
import zlib
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid import files
from tagid.capture import Capture
from tagid.counting import runs
from tagid.errors import FileFormatError, displayable
from tagid.metadata import METADATA_VERSION, RadarInfo
from tagid.storage.assembly import (
    AS_NPZ,
    MAX_EXPANSION,
    OLD_ANGLES,
    OPTIONAL_NUMBERS,
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
from tagid.storage.metadata import PARTS, VERSION_KEY, metadata_of, read_metadata, stored_version
from tagid.storage.units import check_times, check_units

MAGIC = b"PK"

_TRANSMIT = "transmit_positions_m"
"""Another name of antenna_positions_m, for files that contain receive_positions_m."""
_WHERE = ("angles_rad", "timestamps_s", "antenna_positions_m", _TRANSMIT)
_OTHER = (
    _TRANSMIT,
    "samples",
    "range_start_m",
    "range_step_m",
    "timestamps_s",
    "pulse",
    "pulse_step_s",
    "object",
    "tagid",
)
_KEYS = frozenset((*OPTIONAL_NUMBERS, *VIEW_ARRAYS, *_OTHER))
_ALIKE = 0.85
"""Likeness (0 to 1, difflib) from which on a name is a misspelt key: bandwith_hz, centre_frequency_hz."""


def read_npz(path: Path) -> Capture:
    """Read a generic NPZ file; nothing in it is unpickled.

    float64 samples become float32, integers int32 if they fit and float32 otherwise, complex128 complex64.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: damaged; a key is missing or misspelt; a value has a wrong shape, dtype or size.
    """
    data = files.read_bytes(path)
    arrays = read_arrays(path, data, _KEYS | {OLD_ANGLES})
    _refuse_misspelt(path, data, arrays)
    if OLD_ANGLES in arrays:
        arrays.setdefault("angles_rad", arrays[OLD_ANGLES])
    missing = [key for key in ("samples", "range_start_m", "range_step_m") if key not in arrays]
    if missing and is_image(path):
        name = path.name.removesuffix(".npz").removesuffix(".image")
        raise FileFormatError(
            f"{path} is an image, not a recording",
            f"Give the capture that it was made from, e.g. {path.with_name(name)}.tagid.h5.",
        )
    if missing:
        raise FileFormatError(
            f"{path}: the NPZ file lacks {', '.join(missing)}",
            f"It needs these and one of {', '.join(_WHERE)}: {AS_NPZ}",
        )
    ours = (
        decode_settings(_string(arrays["tagid"], f"{path} (tagid)"), f"{path} (tagid)")
        if "tagid" in arrays
        else {}
    )
    if not ours and not any(key in arrays for key in _WHERE):
        raise FileFormatError(
            f"{path}: the NPZ file does not contain the antenna positions",
            "Add one of angles_rad (views,), timestamps_s (views,) or antenna_positions_m (views, 3).",
        )
    if not ours and "angles_rad" in arrays and "axis_distance_m" not in arrays:
        raise FileFormatError(
            f"{path}: the NPZ file holds angles_rad, but lacks axis_distance_m",
            "Add axis_distance_m, the metres from the radar to the rotation axis.",
        )
    if _TRANSMIT in arrays:
        if "antenna_positions_m" in arrays or "receive_positions_m" not in arrays:
            raise FileFormatError(
                f"{path}: {_TRANSMIT} requires receive_positions_m",
                "Give both, or antenna_positions_m for one antenna.",
            )
        arrays["antenna_positions_m"] = arrays.pop(_TRANSMIT)
    samples = _samples(path, arrays["samples"])
    fields: dict[str, Any] = {
        key: number(arrays[key], f"{path} ({key})")
        for key in ("range_start_m", "range_step_m", *OPTIONAL_NUMBERS)
        if key in arrays
    }
    for key, dtype in VIEW_ARRAYS.items():
        if key in arrays:
            fields[key] = _vector(path, key, arrays[key], dtype, len(samples))
    if "timestamps_s" in arrays and "radar_time_ms" not in arrays:
        seconds = _vector(path, "timestamps_s", arrays["timestamps_s"], "float64", len(samples))
        if not ours:
            check_times(path, seconds[np.isfinite(seconds)])
        with np.errstate(over="ignore"):  # infinite values are rejected by the capture
            fields["radar_time_ms"] = seconds * 1000.0
    if "pulse" in arrays:
        if "pulse_step_s" not in arrays:
            raise FileFormatError(f"{path}: the NPZ file holds pulse, but lacks pulse_step_s")
        step = number(arrays["pulse_step_s"], f"{path} (pulse_step_s)")
        fields["pulse"] = build_pulse(arrays["pulse"], step, path)
    fields |= _provenance(path, arrays, ours)
    if not ours:
        samples, fields = _in_order(path, samples, fields)
    capture = build_capture(path, samples=samples, **fields)
    if not ours:
        check_units(path, capture)
    return capture


def _refuse_misspelt(path: Path, data: bytes, arrays: dict[str, NDArray[Any]]) -> None:
    """Raise FileFormatError where a number that has a default is there under a similar name only."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = [member.filename.removesuffix(".npy") for member in archive.infolist()]
    absent = [key for key in OPTIONAL_NUMBERS if key not in arrays]
    for name in names:
        if name not in _KEYS:
            for meant in get_close_matches(name.lower(), absent, 1, _ALIKE):
                raise FileFormatError(
                    f"{path}: the NPZ file holds {displayable(name)}, which is not a key; is it {meant}?",
                    f"Rename it to {meant}, or leave it out.",
                )


def is_image(path: Path) -> bool:
    """Whether an NPZ file contains an image or a volume of `tagid reconstruct --out`, and no scans."""
    try:
        with zipfile.ZipFile(path) as file:
            names = set(file.namelist())
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return False
    return not names.isdisjoint(("image.npy", "volume.npy")) and "samples.npy" not in names


def encode_npz(capture: Capture) -> bytes:
    """The bytes of a generic NPZ file that `read_npz` restores without loss."""
    arrays: dict[str, Any] = {
        "samples": capture.samples,
        "range_start_m": np.float64(capture.range_start_m),
        "range_step_m": np.float64(capture.range_step_m),
    }
    for key in (*OPTIONAL_NUMBERS, *VIEW_ARRAYS):
        value = getattr(capture, key)
        if value is not None:
            arrays[key] = np.asarray(value)
    if capture.receive_positions_m is not None:
        arrays[_TRANSMIT] = arrays.pop("antenna_positions_m")
    if capture.radar_time_ms is not None:
        arrays["timestamps_s"] = capture.radar_time_ms / 1000.0
    if capture.pulse is not None:
        arrays |= {"pulse": capture.pulse.samples, "pulse_step_s": np.float64(capture.pulse.step)}
    ours = {key: getattr(capture, key) for key in (*TEXTS, "complete")}
    ours |= {**metadata_of(capture), VERSION_KEY: METADATA_VERSION}
    arrays |= {"object": encode_settings(capture.object.to_json()), "tagid": encode_settings(ours)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def read_arrays(path: Path, data: bytes, keys: frozenset[str]) -> dict[str, NDArray[Any]]:
    """The arrays of an NPZ file's content under known keys, each checked before memory is allocated for it.

    Raises FileFormatError: damaged, Python objects, or sizes that are not plausible.
    """
    arrays: dict[str, NDArray[Any]] = {}
    budget = files.MAX_FILE_BYTES
    try:
        with warnings.catch_warnings(), zipfile.ZipFile(io.BytesIO(data)) as archive:
            warnings.simplefilter("ignore")  # numpy warns about headers that are expensive to parse
            for member in archive.infolist():
                key = member.filename.removesuffix(".npy")
                if key not in keys or key in arrays:
                    continue
                budget -= member.file_size
                large = member.file_size > SMALL_BYTES
                if budget < 0 or (large and member.file_size > MAX_EXPANSION * max(member.compress_size, 1)):
                    raise FileFormatError(
                        f"{path}: {key} claims {member.file_size} bytes, which is not plausible"
                    )
                with archive.open(member) as stream:
                    content = stream.read(min(member.file_size, SMALL_BYTES))
                header = _checked(f"{path}: {key}", content, member.file_size)
                if large:  # not twice in memory
                    with archive.open(member) as stream:
                        arrays[key] = np.lib.format.read_array(stream, allow_pickle=False)
                else:
                    arrays[key] = header.array(content)
    # zipfile and numpy raise any of these on damaged files, depending on the location of the damage.
    except (
        zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, RuntimeError, TypeError, SyntaxError,
        LookupError, MemoryError, OverflowError, tokenize.TokenError, lzma.LZMAError,
    ) as error:  # fmt: skip
        raise FileFormatError(
            f"{path}: the NPZ file is damaged or truncated ({str(error)[:120]})",
            "Write it again with numpy.savez.",
        ) from error
    return arrays


@dataclass(frozen=True)
class _Header:
    """Header of an array in a file: `length` bytes, then the values in this order, shape and dtype."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[Any]
    length: int

    def array(self, content: bytes) -> NDArray[Any]:
        """The array of a whole member. Raises ValueError if it is too short."""
        if self.dtype.itemsize == 0:
            return np.ndarray(self.shape, self.dtype)
        values = np.frombuffer(content, self.dtype, math.prod(self.shape), self.length)
        if self.fortran_order:
            return values.reshape(self.shape[::-1]).copy().transpose()
        return values.reshape(self.shape).copy()


@lru_cache(maxsize=64)
def _header(content: bytes) -> _Header | None:
    """What the bytes of a header say; the captures of a batch have the same ones.

    None for an unknown version. Raises as numpy does.
    """
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        return _Header(*np.lib.format.read_array_header_1_0(stream), stream.tell())
    if version == (2, 0):
        return _Header(*np.lib.format.read_array_header_2_0(stream), stream.tell())
    return None


def _checked(where: str, content: bytes, size: int) -> _Header:
    """The header of a member of `size` bytes. Rejects objects, and shapes that it cannot hold."""
    start = 12 if content[6:7] == b"\2" else 10
    header = _header(content[: start + int.from_bytes(content[8:start], "little")])
    if header is None:
        raise FileFormatError(f"{where} has npy version {tuple(content[6:8])}, expected (1, 0) or (2, 0)")
    shape, dtype = header.shape, header.dtype
    if dtype.hasobject or dtype.kind not in "iufcUS":
        raise FileFormatError(
            f"{where} has dtype {dtype}, expected numbers or text", "Python objects are not read."
        )
    claimed = dtype.itemsize
    for length in shape:
        claimed *= int(length)
    if claimed < 0 or claimed > size or any(length < 0 for length in shape):
        raise FileFormatError(f"{where} claims shape {shape}, but only {size} bytes are stored")
    return header


def _samples(path: Path, values: NDArray[Any]) -> NDArray[Any]:
    if values.ndim != 2 or values.size == 0:
        raise FileFormatError(f"{path}: samples have shape {values.shape}, expected (views, bins)")
    if values.dtype.kind not in "iufc":
        raise FileFormatError(f"{path}: samples have dtype {values.dtype}, expected numbers")
    if values.dtype.kind in "iu":
        limits = np.iinfo(np.int32)
        fits = int(values.min()) >= limits.min and int(values.max()) <= limits.max
        return np.ascontiguousarray(values, dtype=np.int32 if fits else np.float32)
    # Values too large for single precision become infinite and are rejected by the capture.
    with np.errstate(over="ignore", invalid="ignore"):
        return np.ascontiguousarray(values, dtype=np.complex64 if values.dtype.kind == "c" else np.float32)


def _vector(path: Path, key: str, values: NDArray[Any], dtype: str, views: int) -> NDArray[Any]:
    shape = (views, 3) if key.endswith("positions_m") else (views,)
    if values.shape != shape:
        raise FileFormatError(
            f"{path}: {key} has shape {values.shape}, but samples has {views} views: expected {shape}"
        )
    kinds = "iuf" if dtype == "float64" else "iu"
    if values.dtype.kind not in kinds:
        raise FileFormatError(f"{path}: {key} has dtype {values.dtype}, expected {dtype}")
    converted = values.astype(dtype)
    if kinds == "iu" and not np.array_equal(converted, values):
        raise FileFormatError(f"{path}: {key} holds values that do not fit {dtype}")
    return converted


def _in_order(
    path: Path, samples: NDArray[Any], fields: dict[str, Any]
) -> tuple[NDArray[Any], dict[str, Any]]:
    """The views with a known place, in the order of their times, and what was left out.

    A tracker that loses sight writes NaN: these views are dropped, as no position can be guessed.

    Raises FileFormatError if that is more than half of the views.
    """
    views = np.arange(len(samples))
    notes = []
    for key in ("antenna_positions_m", "receive_positions_m", "angles_rad", "radar_time_ms"):
        values = fields.get(key)
        if values is None:
            continue
        kept = views[np.isfinite(values[views]).reshape(len(views), -1).all(axis=1)]
        if len(kept) == len(views):
            continue
        name = "timestamps_s" if key == "radar_time_ms" else key
        gone = runs(np.setdiff1d(views, kept))
        lost = (
            f"{len(views) - len(kept)} of {len(samples)} views, whose {name} is not finite ({gone}, from 0)"
        )
        if 2 * len(kept) < len(samples):
            raise FileFormatError(
                f"{path}: {lost} are more than half", "Interpolate the values, or record again."
            )
        notes.append(f"{lost}; to keep them, interpolate {name} before the import")
        views = kept
    times = fields.get("radar_time_ms")
    if times is not None and len(views) > 1 and (np.diff(times[views]) < 0).any():
        views = views[np.argsort(times[views], kind="stable")]
        notes.append("the order of the scans, which are sorted by timestamps_s")
    if not notes:
        return samples, fields
    fields |= {key: fields[key][views] for key in VIEW_ARRAYS if key in fields}
    radar = fields.get("radar", RadarInfo())
    return samples[views], {**fields, "radar": replace(radar, ignored=tuple(notes))}


def _provenance(path: Path, arrays: dict[str, NDArray[Any]], ours: dict[str, Any]) -> dict[str, Any]:
    fields: dict[str, Any] = {key: text(ours[key], f"{path} (tagid, {key})") for key in TEXTS if key in ours}
    parts = {key: ours[key] for key in PARTS if key in ours}
    if "object" in arrays:
        parts["object"] = _object(_string(arrays["object"], f"{path} (object)"))
    fields |= read_metadata(parts, f"{path} (tagid)", stored_version(ours, str(path)))
    if not isinstance(ours.get("complete", True), bool):
        raise FileFormatError(f"{path}: complete in tagid is not true or false")
    fields["complete"] = ours.get("complete", True)
    return fields


def _object(content: str) -> dict[str, Any]:
    """A JSON object unchanged; any other text is the object's label."""
    try:
        value = json.loads(content)
        json.dumps(value, ensure_ascii=False).encode()
    except (ValueError, RecursionError):  # half a surrogate pair is a ValueError, too
        value = content
    return value if isinstance(value, dict) else {"label": displayable(content)}


def _string(value: NDArray[Any], where: str) -> str:
    if value.shape != () or value.dtype.kind not in "US":
        raise FileFormatError(f"{where}: has shape {value.shape} and dtype {value.dtype}, expected one text")
    item = value.item()
    content = item.decode("utf-8", errors="replace") if isinstance(item, bytes) else str(item)
    return displayable(content)
