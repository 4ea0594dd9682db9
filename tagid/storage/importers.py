"""Reads any supported file into a capture; the content, not the name, determines the format.

Every reading command uses this module, so each supports every format.
"""

from __future__ import annotations

from pathlib import Path

from tagid import files
from tagid.capture import Capture
from tagid.counting import counted
from tagid.errors import FileFormatError
from tagid.metadata import RadarSettings
from tagid.storage import hdf5
from tagid.storage.assembly import AS_NPZ

_KNOWN = (
    "Expected a capture (.tagid.h5), a journal, a generic NPZ file, a MATLAB file of tagid or of the "
    "vendor's log reader, a P440 recording (.prd, .out) or an MRM-RET log (.csv). Store other scans as NPZ: "
    + AS_NPZ
)
_HEAD = 1 << 16


def read_any(path: Path, cable_delay_ps: float = 0.0, node: int | None = None) -> Capture:
    """Read a capture, a journal, a generic NPZ or a MATLAB file, a P440 recording or an MRM-RET log.

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
    if head.startswith(hdf5.MAGIC):
        return _of_node(path, hdf5.read_capture(path), node)
    # The other formats are imported where one of them is read.
    from tagid.storage import foreign, journal, journal_capture, mat, mrm_ret, npz, recordings

    if head.startswith(journal.MAGIC):
        return _of_node(path, journal_capture.read_journal_capture(path), node)
    if head.startswith(mat.MAGIC):
        return _of_node(path, mat.read_mat(path, cable_delay_ps, node), node)
    if head.startswith(npz.MAGIC):
        foreign.check_zip(path)
        return _of_node(path, npz.read_npz(path), node)
    if mrm_ret.is_mrm_ret(head):
        return mrm_ret.read_mrm_ret(path, cable_delay_ps, node)
    with files.open_regular(path) as (stream, size):
        messages = size <= files.MAX_FILE_BYTES and recordings.is_recording(stream)
    if messages:
        return recordings.read_recording(path, cable_delay_ps, node)
    foreign.check_foreign(path, head)
    raise FileFormatError(f"{path}: unknown file format", _KNOWN)


def _of_node(path: Path, capture: Capture, node: int | None) -> Capture:
    """The capture; raises UsageError if it is known to be of another radar than `node`."""
    known = capture.radar.node_id
    if node is not None and known is not None and known != node:
        from tagid.storage.p440 import choose_node

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
    if radar.ignored:
        found.append(f"ignored: {', '.join(radar.ignored)}")
    elif radar.packets_ignored:
        found.append(f"ignored: {counted(radar.packets_ignored, 'message')} or lines that are no scan")
    if radar.source in ("recording", "mrm-ret") and radar.config == RadarSettings():
        found.append(
            "the file holds no configuration: integration and gain are unknown, clipping is not seen"
        )
    if radar.config_stale:
        asked, actual = (list(window or ()) for window in (radar.window_requested_ps, radar.window_actual_ps))
        found.append(f"the Config line is stale: it requests {asked} ps, the scans hold {actual} ps")
    return tuple(found)
