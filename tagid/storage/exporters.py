"""Export of captures to other programs; the suffix selects the format.

For writing, the name is the only statement of what the user wants; readers go by content.
"""

from __future__ import annotations

import io
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from tagid import files
from tagid.capture import Capture
from tagid.errors import UsageError
from tagid.storage import hdf5
from tagid.storage.assembly import encode_settings
from tagid.storage.metadata import metadata_of
from tagid.storage.mrm_ret_export import mrm_ret_lines
from tagid.storage.npz import encode_npz
from tagid.storage.recordings import encode_recording

_MAT_NAMES = MappingProxyType(
    {
        "angles_rad": "angle_rad",
        "angle_sigma_rad": "angle_sigma_rad",
        "antenna_positions_m": "antenna_positions_m",
        "host_time_ns": "host_time_ns",
        "radar_time_ms": "radar_time_ms",
        "scan_id": "scan_id",
        "flags": "flags",
        "axis_distance_m": "axis_distance_m",
        "antenna_height_m": "antenna_height_m",
        "center_frequency_hz": "center_frequency_hz",
        "bandwidth_hz": "bandwidth_hz",
        "range_start_m": "range_start_m",
        "range_step_m": "range_step_m",
        "uuid": "uuid",
        "created_utc": "created_utc",
        "tool_version": "tool_version",
    }
)

SUFFIXES = (".npz", ".mat", ".out", ".prd", ".csv", ".h5")
"""Formats that `export` writes, by suffix."""


def export(capture: Capture, path: Path) -> None:
    """Write a capture atomically, in the format given by the suffix of `path`.

    `.npz` the generic NPZ file (see `tagid.storage.npz`), `.mat` MATLAB 5 (see `encode_mat`), `.out` and
    `.prd` P440 recordings (int32 counts only), `.csv` MRM-RET logs (the same), `.h5` the capture file.

    Raises:
        UsageError: another suffix, or samples that the format cannot hold.
        DataError: settings or times that the format needs are missing or do not fit.
        DiskFullError, StorageError: the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix == ".h5":
        hdf5.write_capture(path, capture)
    elif suffix == ".npz":
        files.write_bytes(path, encode_npz(capture))
    elif suffix == ".mat":
        files.write_bytes(path, encode_mat(capture))
    elif suffix in (".out", ".prd"):
        files.write_bytes(path, encode_recording(capture))
    elif suffix == ".csv":
        with files.replacing(path) as stream:
            for line in mrm_ret_lines(capture):
                stream.write(line)
    else:
        raise UsageError(f"{path}: unknown suffix {suffix!r}", f"Use one of {', '.join(SUFFIXES)}.")


def encode_mat(capture: Capture) -> bytes:
    """The bytes of a MATLAB 5 file.

    Variables: samples (views, bins) int32, single or complex single; range_m (bins, 1), m; range_start_m,
    range_step_m; as columns, if known, angle_rad, angle_sigma_rad, host_time_ns (int64), radar_time_ms,
    scan_id (int64), flags (uint8); antenna_positions_m (views, 3); axis_distance_m, antenna_height_m,
    center_frequency_hz, bandwidth_hz; pulse with pulse_step_s; radar, motion, object as JSON text; uuid,
    created_utc, tool_version, complete, format.
    """
    from scipy.io import savemat  # imported late: it takes 100 ms

    variables: dict[str, NDArray[Any] | str | float] = {
        "format": hdf5.FORMAT,
        "complete": np.asarray(capture.complete),
        "samples": capture.samples,
        "range_m": capture.ranges_m,
    }
    for field, name in _MAT_NAMES.items():
        value = getattr(capture, field)
        if value is not None:
            variables[name] = value
    for name, part in metadata_of(capture).items():
        variables[name] = encode_settings(part)
    if capture.pulse is not None:
        variables |= {"pulse": capture.pulse.samples, "pulse_step_s": capture.pulse.step}
    buffer = io.BytesIO()
    savemat(cast(Any, buffer), variables, oned_as="column", do_compression=True)
    return buffer.getvalue()
