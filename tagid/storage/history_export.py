"""The history as one table for other programs: typed Parquet, or CSV.

Rows are written in batches, so that memory stays small for any history.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from io import RawIOBase
from pathlib import Path
from typing import Any

from tagid import files
from tagid.errors import MissingExtraError, StorageError, UsageError
from tagid.storage.history import FIELDS, TYPES, Entry, Filter, History, write_csv

_BATCH = 10_000
_MOST_HEADER = 4096


def export(history: History, wanted: Filter, path: Path) -> int:
    """Write the matching rows, oldest first, as .parquet or .csv by suffix; returns their number.

    Parquet keeps the types of `tagid.storage.history.TYPES`; `time_utc` becomes a UTC timestamp.

    Raises:
        UsageError: another suffix. MissingExtraError: Parquet without pyarrow.
        StorageError, DiskFullError: the file cannot be written; no partial file is left.
    """
    entries = history.find(wanted, oldest_first=True)
    suffix = path.suffix.lower()
    if suffix == ".csv":
        with files.replacing_text(path) as file:
            return write_csv(file, entries)
    if suffix in (".parquet", ".pq"):
        return _parquet(entries, path)
    raise UsageError(f"cannot tell the format from {path.name!r}", "Name it .parquet or .csv.")


def is_export(path: Path) -> bool:
    """Whether a file is an earlier export, also of a version with fewer columns."""
    try:
        if path.suffix.lower() == ".csv":
            head = files.read_head(path, _MOST_HEADER).decode().splitlines()
            names = head[0].split(",") if head else []
        else:
            import pyarrow.parquet as pq

            names = list(pq.read_schema(path).names)
    except ImportError:
        return True  # `export` then refuses to write, with the package that it needs
    except (OSError, ValueError, StorageError):  # pyarrow's errors are among them
        return False
    return names[:2] == list(FIELDS[:2]) and set(names) <= set(FIELDS)


def _parquet(entries: Iterator[Entry], path: Path) -> int:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise MissingExtraError(
            "Parquet needs pyarrow, which is not installed",
            "Install it with `pip install 'tagid[parquet]'`, or export to .csv.",
        ) from None
    kinds = {str: pa.string(), float: pa.float64(), int: pa.int64()}
    schema = pa.schema(
        [
            (name, pa.timestamp("ms", tz="UTC") if name == "time_utc" else kinds[TYPES[name]])
            for name in FIELDS
        ]
    )
    count = 0
    with (
        files.replacing(path) as file,
        pa.PythonFile(_Sink(file), mode="w") as sink,
        pq.ParquetWriter(sink, schema) as writer,
    ):
        while some := list(itertools.islice(entries, _BATCH)):
            writer.write_batch(_batch(pa, schema, some))
            count += len(some)
    return count


class _Sink:
    """The file methods that pyarrow needs for sequential writing."""

    closed = False

    def __init__(self, file: RawIOBase) -> None:
        self._file = file
        self._at = 0

    def write(self, data: Any) -> int:
        self._file.write(data)
        self._at += len(data)
        return len(data)

    def tell(self) -> int:
        return self._at

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        """Does nothing: the caller closes the file."""


def _batch(pa: Any, schema: Any, entries: list[Entry]) -> Any:
    from datetime import datetime

    columns = {name: [getattr(entry, name) for entry in entries] for name in FIELDS}
    columns["time_utc"] = [datetime.fromisoformat(entry.time_utc) for entry in entries]
    return pa.record_batch(
        [pa.array(columns[name], type=schema.field(name).type) for name in FIELDS], schema=schema
    )
