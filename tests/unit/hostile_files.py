"""Files made to break the program that reads them: each is one failed item, and costs nothing else."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from storage_samples import capture

from tagid.storage.hdf5 import write_capture
from tagid.storage.npz import encode_npz

ZEROS_BYTES = 400 << 20
"""What the compressed zeros of a file would be in memory."""


def _recompressed(content: bytes, method: int, member: str = "") -> bytes:
    """An NPZ with another compression, and 16 bytes within the data of one member inverted."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(buffer, "w", method) as target:
        for info in source.infolist():
            target.writestr(info.filename, source.read(info))
        where = next((info for info in target.infolist() if info.filename == member), None)
    data = bytearray(buffer.getvalue())
    if where is not None:
        middle = where.header_offset + 30 + len(member) + where.compress_size // 2
        data[middle : middle + 16] = bytes(255 - byte for byte in data[middle : middle + 16])
    return bytes(data)


def lzma_member(path: Path) -> None:
    """An NPZ that numpy does not write, with a damaged LZMA member."""
    path.write_bytes(_recompressed(encode_npz(capture()), zipfile.ZIP_LZMA, "samples.npy"))


def half_a_surrogate(path: Path) -> None:
    """An NPZ whose UUID is no text that can be written."""
    with np.load(io.BytesIO(encode_npz(capture()))) as arrays:
        values = dict(arrays)
    ours = json.loads(str(values["tagid"])) | {"uuid": "\ud800"}
    np.savez(path, **{**values, "tagid": json.dumps(ours)})


def _changed(path: Path, change: Callable[[Any], None]) -> None:
    write_capture(path, capture())
    with h5py.File(path, "r+") as file:
        change(file)


def _zeros(file: Any, name: str) -> None:
    if name in file:
        del file[name]
    rows = ZEROS_BYTES // 4000
    file.create_dataset(name, (rows, 1000), "i4", chunks=(1000, 1000), compression="gzip", fillvalue=0)
    file[name][:1000] = 0  # one chunk is stored, so that the size of the file is not nothing


def unknown_dataset(path: Path) -> None:
    """A good capture with a dataset that tagid does not know: small on disk, large in memory."""
    _changed(path, lambda file: _zeros(file, "scans/other"))


def inflated_samples(path: Path) -> None:
    """A capture whose samples are small on disk and large in memory."""
    _changed(path, lambda file: _zeros(file, "scans/samples"))


def _attribute(name: str, value: float) -> Callable[[Path], None]:
    return lambda path: _changed(path, lambda file: file.attrs.__setitem__(name, value))


REFUSED: dict[str, Callable[[Path], None]] = {
    "lzma.npz": lzma_member,
    "surrogate.npz": half_a_surrogate,
    "inflated.tagid.h5": inflated_samples,
    "step.tagid.h5": _attribute("range_step_m", 5e-324),
    "start.tagid.h5": _attribute("range_start_m", 1e300),
    "distance.tagid.h5": _attribute("axis_distance_m", 1e-300),
}
"""By file name."""
