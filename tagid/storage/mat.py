"""MATLAB 5 files: exports captures to MATLAB and Octave, and reads them back.

Of other files, the structs of the vendor's log reader are read; import others as NPZ, in which the variables
can be named.
"""

from __future__ import annotations

import io
import zlib
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from tagid import files
from tagid.capture import Capture
from tagid.errors import FileFormatError, MissingExtraError, displayable
from tagid.metadata import METADATA_VERSION
from tagid.storage import hdf5, mat_scans
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
from tagid.storage.mat_reader import Variable, read_variables
from tagid.storage.metadata import PARTS, VERSION_KEY, metadata_of, read_metadata

MAGIC: Final = b"MATLAB 5.0 MAT-file"

_SCALARS: Final = (*OPTIONAL_NUMBERS, "range_start_m", "range_step_m")
_SAMPLE_TYPES: Final = ("int32", "float32", "complex64")


def encode_mat(capture: Capture) -> bytes:
    """The bytes of a MATLAB 5 file.

    Variables: samples (views, bins) int32, single or complex single; range_m (bins, 1), m; range_start_m,
    range_step_m; as columns, if known, angles_rad, angle_sigma_rad, host_time_ns (int64), radar_time_ms,
    scan_id (int64), flags (uint8); antenna_positions_m and receive_positions_m (views, 3); axis_distance_m,
    antenna_height_m, antenna_separation_m, center_frequency_hz, bandwidth_hz, wave_speed_m_s; pulse with
    pulse_step_s; radar, motion, object as JSON text with metadata_version; uuid, created_utc, tool_version,
    complete, format.
    """
    savemat = _scipy_io().savemat
    variables: dict[str, NDArray[Any] | str | float] = {
        "format": hdf5.FORMAT,
        "complete": np.asarray(capture.complete),
        "samples": capture.samples,
        "range_m": capture.ranges_m,
    }
    for name in (*_SCALARS, *TEXTS, *VIEW_ARRAYS):
        value = getattr(capture, name)
        if value is not None:
            variables[name] = value
    variables[VERSION_KEY] = float(METADATA_VERSION)
    for name, part in metadata_of(capture).items():
        variables[name] = encode_settings(part)
    if capture.pulse is not None:
        variables |= {"pulse": capture.pulse.samples, "pulse_step_s": capture.pulse.step}
    buffer = io.BytesIO()
    savemat(cast(Any, buffer), variables, oned_as="column", do_compression=True)
    return buffer.getvalue()


def _scipy_io() -> Any:
    """The package that reads and writes MATLAB files. Raises MissingExtraError if it is not installed."""
    try:
        import scipy.io
    except ImportError:
        raise MissingExtraError(
            "MATLAB files need scipy, which is not installed",
            "Install it with `pip install 'tagid[science]'`, or use NPZ or HDF5.",
        ) from None
    return scipy.io


def read_mat(path: Path, cable_delay_ps: float = 0.0, node: int | None = None) -> Capture:
    """Read a MATLAB 5 file that `encode_mat` wrote, or that holds the structs of the vendor's log reader.

    Arguments as `tagid.storage.importers.read_any`; the delay and the node are of the vendor's scans.

    Raises:
        StorageError: the file cannot be read.
        FileFormatError: damaged, written by another program, or not plausible.
        UsageError: several radars and no `node`, or no scan of that one.
    """
    variables = _load(path)
    arrays = {name: value for name, value in variables.items() if isinstance(value, np.ndarray)}
    if "format" not in arrays or _text(arrays, "format", path) != hdf5.FORMAT or "samples" not in arrays:
        return _of_the_vendor(path, variables, cable_delay_ps, node)
    samples = arrays["samples"]
    if samples.dtype.name not in _SAMPLE_TYPES:
        raise FileFormatError(f"{path}: samples have dtype {samples.dtype}, expected {_SAMPLE_TYPES}")
    if OLD_ANGLES in arrays:
        arrays.setdefault("angles_rad", arrays[OLD_ANGLES])
    fields: dict[str, Any] = {"samples": np.ascontiguousarray(samples)}
    for name in _SCALARS:
        if name in arrays:
            fields[name] = number(
                arrays[name].reshape(-1)[0] if arrays[name].size == 1 else arrays[name], name
            )
    missing = [name for name in ("range_start_m", "range_step_m") if name not in fields]
    if missing:
        raise FileFormatError(f"{path}: the MATLAB file lacks {', '.join(missing)}")
    for name, dtype in VIEW_ARRAYS.items():
        if name in arrays:
            fields[name] = _vector(path, name, arrays[name], dtype)
    for name in TEXTS:
        if name in arrays:
            fields[name] = text(_text(arrays, name, path), f"{path} ({name})")
    parts = {
        name: decode_settings(_text(arrays, name, path), f"{path} ({name})")
        for name in PARTS
        if name in arrays
    }
    version = arrays.get(VERSION_KEY)
    fields |= read_metadata(
        parts, str(path), int(number(version.reshape(-1)[0], VERSION_KEY)) if version is not None else 1
    )
    if "pulse" in arrays and "pulse_step_s" in arrays:
        values = arrays["pulse"]
        if values.dtype.kind not in "iuf" or arrays["pulse_step_s"].size != 1:
            raise FileFormatError(f"{path}: pulse is not an array of real numbers with one step")
        fields["pulse"] = build_pulse(values.reshape(-1), float(arrays["pulse_step_s"].item()), path)
    fields["complete"] = bool(arrays["complete"].any()) if "complete" in arrays else True
    return build_capture(path, **fields)


def _of_the_vendor(
    path: Path, variables: dict[str, Variable], cable_delay_ps: float, node: int | None
) -> Capture:
    """The scans of the vendor's structs. Raises FileFormatError with a way on if there are none."""
    capture = mat_scans.read_scans(path, variables, cable_delay_ps, node)
    if capture is None:
        shown = ", ".join(displayable(name) for name in list(variables)[:8]) or "no variable"
        raise FileFormatError(
            f"{path}: is a MATLAB file with {shown}, but without tagid's variables or the structs cfg and "
            "scn of the vendor's log reader",
            "Load it with scipy.io.loadmat, and store its scans as NPZ: " + AS_NPZ,
        )
    return capture


def _load(path: Path) -> dict[str, Variable]:
    data = files.read_bytes(path)
    try:
        return read_variables(data, max(SMALL_BYTES, MAX_EXPANSION * len(data)))
    except (ValueError, LookupError, OverflowError, MemoryError, zlib.error) as error:
        raise FileFormatError(
            f"{path}: the MATLAB file is damaged ({str(error)[:120]})", "Save it again with `save -v7`."
        ) from error


def _vector(path: Path, name: str, values: NDArray[Any], dtype: str) -> NDArray[Any]:
    if values.dtype.kind not in "iuf":
        raise FileFormatError(f"{path}: {name} has dtype {values.dtype}, expected numbers")
    converted = values.astype(dtype)
    if not np.array_equal(converted, values):
        raise FileFormatError(f"{path}: {name} holds values that do not fit {dtype}")
    return np.ascontiguousarray(converted if name.endswith("positions_m") else converted.reshape(-1))


def _text(arrays: dict[str, NDArray[Any]], name: str, path: Path) -> str:
    value = arrays[name]
    if value.dtype.kind != "U" or value.size > 1:
        raise FileFormatError(f"{path}: {name} is not one text")
    return str(value.reshape(-1)[0]) if value.size else ""
