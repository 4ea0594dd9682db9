"""Any file that holds scans, read into a capture; its content says what it is, as names lie.

Every reading command goes through here, so each of them takes each format.
"""

from __future__ import annotations

from pathlib import Path

from tagid.capture import Capture
from tagid.errors import FileFormatError
from tagid.storage import atomic, hdf5, journal, mrm_ret, npz, recordings

_KNOWN = (
    "Expected a capture (.tagid.h5), a journal, a generic NPZ file, a P440 recording (.prd, .out) or an "
    "MRM-RET log (.csv)."
)
_HEAD = 1 << 16


def read_any(path: Path, cable_delay_ps: float = 0.0) -> Capture:
    """Read a capture file, a journal, a generic NPZ file, a P440 recording or an MRM-RET log.

    Args:
        path: the file.
        cable_delay_ps: two-way cable delay to take off the ranges of recordings and logs, ps; the other
            formats hold ranges that it has been taken off already.

    Raises:
        StorageError: missing, a folder, no permission.
        FileFormatError: none of these formats, or damaged.
    """
    head = atomic.read_head(path, _HEAD)
    if not head:
        raise FileFormatError(f"{path}: the file is empty", _KNOWN)
    if head.startswith(hdf5.MAGIC):
        return hdf5.read_capture(path)
    if head.startswith(journal.MAGIC):
        return journal.journal_to_capture(journal.read_journal(path))
    if head.startswith(npz.MAGIC):
        return npz.read_npz(path)
    if recordings.is_recording(head):
        return recordings.read_recording(path, cable_delay_ps)
    if mrm_ret.is_mrm_ret(head):
        return mrm_ret.read_mrm_ret(path, cable_delay_ps)
    raise FileFormatError(f"{path}: the file is of no known format", _KNOWN)
