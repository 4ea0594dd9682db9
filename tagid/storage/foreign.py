"""Names files of other programs that hold scans, but are not read, and how the scans get in.

Only magic numbers and the names in a ZIP archive are looked at; nothing is unpacked or executed.
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Final

from tagid import files
from tagid.errors import FileFormatError
from tagid.storage.assembly import AS_NPZ

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
    """Raise FileFormatError where the first bytes of a file are of a known format that is not read.

    Args:
        path: the file.
        head: its first bytes.
    """
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
