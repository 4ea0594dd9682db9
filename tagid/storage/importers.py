"""Reads any supported file into a capture; the content, not the name, determines the format.

Every reading command uses this module, so each supports every format.
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Final

from tagid import files
from tagid.capture import Capture
from tagid.counting import counted
from tagid.errors import FileFormatError
from tagid.metadata import RadarSettings
from tagid.storage import hdf5
from tagid.storage.assembly import AS_NPZ

_KNOWN = (
    "Give a capture (.tagid.h5), a journal, an NPZ or MATLAB file, a P440 recording (.prd, .out) or an "
    "MRM-RET log (.csv); docs/formats.md says how other scans become an NPZ file."
)
_HEAD = 1 << 16


def read_any(path: Path | str, cable_delay_ps: float = 0.0, node: int | None = None) -> Capture:
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
    path = Path(path)
    head = files.read_head(path, _HEAD)
    if not head:
        raise FileFormatError(f"{path}: the file is empty", "Record it again, or copy it again.")
    if head.startswith(hdf5.MAGIC):
        return _of_node(path, hdf5.read_capture(path), node)
    # The other formats are imported where one of them is read.
    from tagid.storage import journal, journal_capture, mat, mrm_ret, npz, recordings

    if head.startswith(journal.MAGIC):
        return _of_node(path, journal_capture.read_journal_capture(path), node)
    if head.startswith(mat.MAGIC):
        return _of_node(path, mat.read_mat(path, cable_delay_ps, node), node)
    if head.startswith(npz.MAGIC):
        check_zip(path)
        return _of_node(path, npz.read_npz(path), node)
    if mrm_ret.is_mrm_ret(head):
        return mrm_ret.read_mrm_ret(path, cable_delay_ps, node)
    with files.open_regular(path) as (stream, size):
        messages = size <= files.MAX_FILE_BYTES and recordings.is_recording(stream)
    if messages:
        return recordings.read_recording(path, cable_delay_ps, node)
    check_foreign(path, head)
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
    notes = []
    left_over = radar.bytes_left_over or radar.journal_bytes_dropped
    if left_over:
        notes.append(
            f"{left_over} bytes are left over: the file is truncated or damaged; its complete scans are kept"
        )
    if lost := radar.scans_lost:
        notes.append(f"{lost} scan{' is' if lost == 1 else 's are'} missing or incomplete")
    if radar.ignored:
        notes.append(f"ignored: {', '.join(radar.ignored)}")
    elif radar.packets_ignored:
        notes.append(f"ignored: {counted(radar.packets_ignored, 'message')} or lines that are no scan")
    if radar.source in ("recording", "mrm-ret") and radar.config == RadarSettings():
        notes.append(
            "the file holds no configuration: integration and gain are unknown, clipping is not seen"
        )
    if radar.config_stale:
        asked, actual = (list(window or ()) for window in (radar.window_requested_ps, radar.window_actual_ps))
        notes.append(f"the Config line is stale: it requests {asked} ps, the scans hold {actual} ps")
    return tuple(notes)


_TABLE: Final = "Save the sheet of an MRM-RET log as CSV and import that; store other scans as NPZ: " + AS_NPZ
_PACKED: Final = "Unpack it and import the files in it."
_STORE: Final = "Load it with the program or library it is from, and store its scans as NPZ: " + AS_NPZ
_RESAVE: Final = "Save it again with `save -v7`, or read it with h5py and store it as NPZ: " + AS_NPZ
_MAGIC: Final = (
    (b"MATLAB 7.3 MAT-file", "a MATLAB 7.3 file", _RESAVE),
    (b"\x93NUMPY", "a numpy array (.npy)", "Load it with numpy.load, and store it as NPZ: " + AS_NPZ),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "an Excel workbook (.xls)", _TABLE),
    (b"PAR1", "a Parquet file", _STORE),
    (b"ARROW1", "a Feather or Arrow file", _STORE),
    (b"FEA1", "a Feather file", _STORE),
    (b"SQLite format 3\0", "an SQLite database", _STORE),
    (b"#ROSBAG", "a ROS bag", _STORE),
    (b"\x89MCAP0", "a ROS 2 bag (MCAP)", _STORE),
    (b"TDSm", "a LabVIEW TDMS file", _STORE),
    (b"CDF\1", "a NetCDF file", _STORE),
    (b"CDF\2", "a NetCDF file", _STORE),
    (b"RIFF", "a RIFF file (e.g. WAV)", _STORE),
    *((magic, "a packet capture (pcap) without scans of a P440", _STORE)
      for magic in (b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d",
                    b"\x0a\x0d\x0d\x0a")),
    (b"\x1f\x8b", "a gzip file", _PACKED),
    (b"BZh", "a bzip2 file", _PACKED),
    (b"\xfd7zXZ\0", "an xz file", _PACKED),
    (b"\x28\xb5\x2f\xfd", "a Zstandard file", _PACKED),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive", _PACKED),
    (b"Rar!", "a RAR archive", _PACKED),
)  # fmt: skip
"""Magic number -> (format, what to do)."""
_PICKLE: Final = re.compile(rb"\x80[\x02-\x05][\x95(\]}c\x8c]")
_NUMBERS: Final = re.compile(rb"[-+0-9.eE,;\t \r\n]+")


def check_foreign(path: Path, head: bytes) -> None:
    """Raise FileFormatError where the first bytes of a file are of a known format that is not read."""
    for magic, name, remedy in _MAGIC:
        if head.startswith(magic):
            raise _error(path, name, remedy)
    if head[257:262] == b"ustar":
        raise _error(path, "a tar archive", _PACKED)
    if _PICKLE.match(head):
        raise _error(path, "a Python pickle, which may run any code", _STORE)
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if text[:1] in (b"{", b"["):
        raise _error(path, "a JSON text", _STORE)
    if text and _NUMBERS.fullmatch(text):
        remedy = "Load it with numpy.loadtxt, and store it as NPZ: " + AS_NPZ
        raise _error(path, "a table of numbers without an MRM-RET log's names of the lines", remedy)


def check_zip(path: Path) -> None:
    """Raise FileFormatError for a ZIP archive that is no NPZ file, but e.g. a workbook."""
    try:
        with files.open_regular(path) as (stream, _), zipfile.ZipFile(stream) as archive:
            names = set(archive.namelist())
    except (zipfile.BadZipFile, OSError, ValueError, RuntimeError, LookupError, OverflowError):
        return
    if not names or any(name.endswith(".npy") for name in names):
        return
    if any(name.startswith("xl/") for name in names):
        raise _error(path, "an Excel workbook", _TABLE)
    if "content.xml" in names:
        raise _error(path, "an OpenDocument spreadsheet", _TABLE)
    raise _error(path, "a ZIP archive", _PACKED)


def _error(path: Path, name: str, remedy: str) -> FileFormatError:
    return FileFormatError(f"{path}: is {name}; tagid does not read that", remedy)
