"""Exports captures for other programs: the suffix selects the format; files are written atomically."""

from __future__ import annotations

from pathlib import Path

from tagid import files
from tagid.capture import Capture
from tagid.errors import UsageError
from tagid.storage import hdf5
from tagid.storage.mat import encode_mat
from tagid.storage.mrm_ret_export import mrm_ret_lines
from tagid.storage.npz import encode_npz
from tagid.storage.recordings import encode_recording

SUFFIXES = (".npz", ".mat", ".out", ".prd", ".csv", ".h5")
"""Export formats, by suffix."""


def export(capture: Capture, path: Path | str) -> None:
    """Write a capture atomically, in the format given by the suffix of `path`.

    `.npz` the generic NPZ file (see `tagid.storage.npz`), `.mat` MATLAB 5 (see `tagid.storage.mat`), `.out`
    and `.prd` P440 recordings (int32 counts only), `.csv` MRM-RET logs (the same), `.h5` the capture file.

    Raises:
        UsageError: another suffix, or samples that the format cannot hold.
        DataError: settings or times that the format needs are missing or do not fit.
        DiskFullError, StorageError: the file cannot be written.
    """
    path = Path(path)
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
        raise UsageError(f"{path}: no format has the suffix {suffix!r}", f"Use one of {', '.join(SUFFIXES)}.")
