"""Reads any supported file into a capture; the content, not the name, determines the format.

Every reading command uses this module, so each supports every format.
"""

from __future__ import annotations

from pathlib import Path

from tagid import files
from tagid.capture import Capture
from tagid.errors import FileFormatError
from tagid.storage import hdf5, journal, journal_capture, mat, mrm_ret, npz, recordings
from tagid.storage.p440 import choose_node

_KNOWN = (
    "Expected a capture (.tagid.h5), a journal, a generic NPZ file, a MATLAB file that tagid wrote, a P440 "
    "recording (.prd, .out) or an MRM-RET log (.csv)."
)
_HEAD = 1 << 16


def read_any(path: Path, cable_delay_ps: float = 0.0, node: int | None = None) -> Capture:
    """Read a capture, a journal, a generic NPZ or our MATLAB file, a P440 recording or an MRM-RET log.

    Args:
        path: the file.
        cable_delay_ps: two-way cable delay to subtract from the ranges of recordings and logs, ps; the other
            formats hold ranges from which it has already been subtracted.
        node: number of the radar to read, if a recording or log holds scans of several.

    Raises:
        StorageError: missing, a folder, no permission.
        FileFormatError: none of these formats, or damaged.
        UsageError: scans of several radars and no `node`, or none of that radar.
    """
    head = files.read_head(path, _HEAD)
    if not head:
        raise FileFormatError(f"{path}: the file is empty", _KNOWN)
    if not head.startswith((hdf5.MAGIC, journal.MAGIC, npz.MAGIC, mat.MAGIC)):
        if recordings.is_recording(head):
            return recordings.read_recording(path, cable_delay_ps, node)
        if mrm_ret.is_mrm_ret(head):
            return mrm_ret.read_mrm_ret(path, cable_delay_ps, node)
        raise FileFormatError(f"{path}: unknown file format", _KNOWN)
    if head.startswith(hdf5.MAGIC):
        capture = hdf5.read_capture(path)
    elif head.startswith(journal.MAGIC):
        capture = journal_capture.read_journal_capture(path)
    elif head.startswith(mat.MAGIC):
        capture = mat.read_mat(path)
    else:
        capture = npz.read_npz(path)
    known = capture.radar.node_id
    if node is not None and known is not None and known != node:
        choose_node(path, {known: capture.views}, node)
    return capture


def remarks(capture: Capture) -> tuple[str, ...]:
    """Notes on how a file was read, one sentence each; empty for a file without anomalies."""
    radar = capture.radar
    found = []
    left_over = radar.bytes_left_over or radar.journal_bytes_dropped
    if left_over:
        found.append(
            f"{left_over} bytes are left over: the file is truncated or damaged; its complete scans are kept"
        )
    if lost := radar.scans_lost:
        found.append(f"{lost} scan{' is' if lost == 1 else 's are'} missing or incomplete")
    if radar.packets_ignored:
        found.append(f"{radar.packets_ignored} messages or lines are not scans of this radar; ignored")
    if radar.config_stale:
        asked, actual = (list(window or ()) for window in (radar.window_requested_ps, radar.window_actual_ps))
        found.append(f"the Config line is stale: it requests {asked} ps, the scans hold {actual} ps")
    return tuple(found)
