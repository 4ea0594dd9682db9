"""All identifications made on this computer, in a sqlite file next to the registry.

Each one is stored with its settings, the registry version and the tool version.
"""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json
import math
import platform
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

from tagid import files
from tagid._version import __version__
from tagid.errors import MissingExtraError, StorageError, UsageError
from tagid.storage.database import BUSY_SECONDS, Database, Schema
from tagid.storage.spreadsheet import cell

FILE_NAME = "history.sqlite"
_MOST = 10**9
"""Largest limit of a query."""
STATUSES = ("identified", "unknown", "ambiguous", "no_tag", "failed")


@dataclass(frozen=True)
class HistoryEntry:
    """One identification of the history; None where a value is unknown or does not apply.

    Attributes:
        command: that made it.
        time_utc: ISO 8601, ms.
        file, content_sha256, capture_uuid: what was identified.
        status: of `STATUSES`.
        layout, label: the answer; `label` is its readable name.
        score, margin, rotation_deg, centre_x_m, centre_y_m, missing, extra: as in the contract's
            Identification.
        registry_version, model_sha256, tool_version: what it was made with.
        total_s: processing time, s.
        reason: why the object was not named.
        error_code, error_message: of a failed identification.
        advice: what to do about the reason.
        cause: the likeliest cause with its remedy.
        recording_note: the user's note on the object.
    """

    id: int
    command: str
    time_utc: str
    file: str
    content_sha256: str | None
    capture_uuid: str | None
    status: str
    layout: str | None
    label: str
    score: float
    margin: float
    rotation_deg: float | None
    centre_x_m: float | None
    centre_y_m: float | None
    missing: int
    extra: int
    registry_version: int | None
    model_sha256: str | None
    tool_version: str
    total_s: float
    reason: str
    error_code: str | None
    error_message: str | None
    advice: str = ""
    cause: str = ""
    recording_note: str = ""

    def to_json(self) -> dict[str, Any]:
        """Its fields as plain JSON values, in the order of `FIELDS`."""
        return dict(vars(self))


FIELDS = tuple(field.name for field in fields(HistoryEntry))
"""Names of an entry's fields, which are the columns of an export."""
TYPES = {
    field.name: {"str": str, "float": float, "int": int}[str(field.type).removesuffix(" | None")]
    for field in fields(HistoryEntry)
}
"""Type of each column, where it has a value."""
_OPTIONAL = frozenset(field.name for field in fields(HistoryEntry) if str(field.type).endswith(" | None"))
_COLUMNS = FIELDS[2:]
"""Columns of the table of identifications, besides its keys."""


def _hide_key(table: str, column: str) -> str:
    """SQL that replaces the pass-key in a URL."""
    at = f"instr({column}, 'passkey=')"
    return (
        f"UPDATE {table} SET {column} = substr({column}, 1, {at} + 7) || '***' || substr({column}, {at} + 14)"
        f" WHERE {column} GLOB '*passkey={'[0-9]' * 6}*'"
    )


_SCHEMA = Schema(
    what="history",
    application_id=0x74616768,  # "tagh"
    migrations=(
        # 1: runs of a command, their identifications, and the reflectors of each.
        (
            "CREATE TABLE run (id INTEGER PRIMARY KEY AUTOINCREMENT, started_utc TEXT NOT NULL,"
            " command TEXT NOT NULL, tool_version TEXT NOT NULL, host TEXT NOT NULL, settings TEXT NOT NULL)",
            "CREATE TABLE identification (id INTEGER PRIMARY KEY AUTOINCREMENT,"
            " run_id INTEGER NOT NULL REFERENCES run (id) ON DELETE CASCADE, time_utc TEXT NOT NULL,"
            " file TEXT NOT NULL, content_sha256 TEXT, capture_uuid TEXT,"
            f" status TEXT NOT NULL CHECK (status IN {STATUSES}), layout TEXT, label TEXT NOT NULL,"
            " score REAL NOT NULL, margin REAL NOT NULL, rotation_deg REAL, centre_x_m REAL,"
            " centre_y_m REAL, missing INTEGER NOT NULL, extra INTEGER NOT NULL, registry_version INTEGER,"
            " model_sha256 TEXT, tool_version TEXT NOT NULL, total_s REAL NOT NULL, reason TEXT NOT NULL,"
            " error_code TEXT, error_message TEXT)",
            "CREATE TABLE reflector (identification_id INTEGER NOT NULL"
            " REFERENCES identification (id) ON DELETE CASCADE, number INTEGER NOT NULL,"
            " x_m REAL NOT NULL, y_m REAL NOT NULL, amplitude_db REAL, matched INTEGER NOT NULL,"
            " PRIMARY KEY (identification_id, number)) WITHOUT ROWID",
            "CREATE INDEX identification_run ON identification (run_id)",
            "CREATE INDEX identification_time ON identification (time_utc)",
            "CREATE INDEX identification_capture ON identification (capture_uuid)",
            "CREATE INDEX identification_layout ON identification (layout, status)",
        ),
        # 2: no pass-keys, which runs before stored with the URL of the motion device.
        (
            "PRAGMA secure_delete = ON",
            _hide_key("run", "settings"),
            _hide_key("identification", "error_message"),
        ),
        # 3: what to do, the likeliest cause, and the user's note.
        tuple(
            f"ALTER TABLE identification ADD COLUMN {name} TEXT NOT NULL DEFAULT ''"
            for name in ("advice", "cause", "recording_note")
        ),
    ),
    restore="Restore a backup, or move the file away to begin a new history.",
    error=StorageError,
    write_ahead=True,
)


@dataclass(frozen=True)
class Filter:
    """A filter for identifications; a field that is None or empty matches everything.

    Attributes:
        status, layout, capture_uuid, command: exact match.
        file: part of the file name.
        since, until: ISO 8601 date or time, UTC if no zone is given; from `since` on, before `until`.
        limit: maximum number.
        numbers: of identifications.
    """

    status: str | None = None
    layout: str | None = None
    capture_uuid: str | None = None
    command: str | None = None
    file: str | None = None
    since: str | None = None
    until: str | None = None
    limit: int | None = None
    numbers: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.status and self.status not in STATUSES:
            raise UsageError(f"unknown status {self.status!r}", f"Use one of {', '.join(STATUSES)}.")
        if self.limit is not None and not 1 <= self.limit <= _MOST:
            raise UsageError(f"the limit is {self.limit}", f"Give 1 to {_MOST}.")


def utc_text(moment: datetime | None = None) -> str:
    """A time (None: now) as stored in the history, in a form that sorts as text."""
    return (moment or datetime.now(UTC)).astimezone(UTC).isoformat(timespec="milliseconds")


class History:
    """The identifications in a sqlite file, created if it does not exist; safe with several processes.

    `wait_s` is the longest wait for another process's transaction, s.

    Raises:
        StorageError: another program's file, damaged, from a newer tagid, locked or not writable.
        DiskFullError: no space left.
    """

    def __init__(self, path: Path, wait_s: float = BUSY_SECONDS) -> None:
        self._database = Database(path, _SCHEMA, wait_s=wait_s)
        self.path = self._database.path

    def begin(self, command: str, settings: Mapping[str, Any]) -> int:
        """Record a run of a command with its settings (plain JSON values); returns its number."""
        row = (utc_text(), command, __version__, platform.node(), json.dumps(settings, sort_keys=True))
        with self._database.transaction() as connection:
            return int(
                connection.execute(
                    "INSERT INTO run (started_utc, command, tool_version, host, settings)"
                    " VALUES (?, ?, ?, ?, ?)",
                    row,
                ).lastrowid
                or 0
            )

    def run_with(self, command: str, settings_sha256: str) -> int | None:
        """The newest run of a command with these settings, by the sha256 of their JSON text; None if none."""
        query = "SELECT id, settings FROM run WHERE command = ? ORDER BY id DESC"
        with self._database.connection() as connection:
            for number, settings in connection.execute(query, (command,)):
                if hashlib.sha256(str(settings).encode()).hexdigest() == settings_sha256:
                    return int(number)
        return None

    def add(self, run: int, records: Iterable[Mapping[str, Any]], *, once: bool = False) -> list[int]:
        """Store identifications of a run, all or none; returns their numbers.

        Args:
            run: number of the run.
            records: have the fields of the contract's Identification, with `file` and, if known, `time_utc`,
                `content_sha256` and `recording_note`.
            once: leave out those that are stored, with the same time, file and duration.
        """
        names = ("run_id", *_COLUMNS)
        insert = f"INSERT INTO identification ({', '.join(names)}) VALUES (:{', :'.join(names)})"
        numbers = []
        with self._database.transaction() as connection:
            for record in records:
                row = _row(record) | {"run_id": run}
                if once and connection.execute(_STORED, row).fetchone():
                    continue
                number = int(connection.execute(insert, row).lastrowid or 0)
                connection.executemany(
                    "INSERT INTO reflector VALUES (?, ?, ?, ?, ?, ?)", _reflectors(number, record)
                )
                numbers.append(number)
        return numbers

    def find(self, wanted: Filter | None = None, *, oldest_first: bool = False) -> Iterator[HistoryEntry]:
        """The newest matching entries, read lazily, by default newest first."""
        where, values = _conditions(wanted or Filter())
        limit = f" LIMIT {int(wanted.limit)}" if wanted and wanted.limit else ""
        columns = ", ".join(f"run.{name}" if name == "command" else f"i.{name}" for name in FIELDS)
        query = (
            f"SELECT {columns} FROM identification i JOIN run ON run.id = i.run_id{where}"
            f" ORDER BY i.id DESC{limit}"
        )
        if oldest_first:
            query = f"SELECT * FROM ({query}) ORDER BY id"
        with self._database.connection() as connection:
            for row in connection.execute(query, values):
                self._check(row)
                yield HistoryEntry(*row)

    def _check(self, row: tuple[Any, ...]) -> None:
        """Raises StorageError for a value that tagid cannot have written; sqlite stores any in any column."""
        for name, value in zip(FIELDS, row, strict=True):
            right = (name in _OPTIONAL and value is None) or isinstance(value, TYPES[name])
            if isinstance(value, float):
                right &= math.isfinite(value)
            if name == "time_utc" and right:
                try:
                    datetime.fromisoformat(value)
                except ValueError:
                    right = False
            if not right:
                raise StorageError(
                    f"the history {self.path} holds a damaged entry, number {row[0]}: {name} is "
                    f"{str(value)[:80]!r}",
                    "Restore a backup, or leave the entry out with other filters (`since`, `file`, `limit`).",
                )

    def count(self, wanted: Filter | None = None) -> int:
        """Number of matching rows, without the limit."""
        where, values = _conditions(wanted or Filter())
        query = f"SELECT COUNT(*) FROM identification i JOIN run ON run.id = i.run_id{where}"
        with self._database.connection() as connection:
            return int(connection.execute(query, values).fetchone()[0])

    def reflectors(self, number: int) -> list[dict[str, Any]]:
        """The reflectors of one identification, in the reader's order: strongest first."""
        query = (
            "SELECT x_m, y_m, amplitude_db, matched FROM reflector"
            " WHERE identification_id = ? ORDER BY number"
        )
        with self._database.connection() as connection:
            rows: list[sqlite3.Row] = connection.execute(query, (number,)).fetchall()
        if not all(isinstance(value, int | float) for row in rows for value in row if value is not None):
            raise StorageError(
                f"the history {self.path} holds damaged reflectors of entry {number}", _SCHEMA.restore
            )
        return [{"x_m": x, "y_m": y, "amplitude_db": db, "matched": bool(m)} for x, y, db, m in rows]


def write_csv(file: TextIO, entries: Iterable[HistoryEntry]) -> int:
    """Write entries as CSV, safe to open in a spreadsheet; returns their number."""
    table = csv.writer(file)
    table.writerow(FIELDS)
    count = 0
    for entry in entries:
        table.writerow([cell(value) for value in vars(entry).values()])
        count += 1
    return count


def csv_text(entries: Iterable[HistoryEntry]) -> str:
    """Entries as CSV, safe to open in a spreadsheet."""
    text = io.StringIO()
    write_csv(text, entries)
    return text.getvalue()


def _row(record: Mapping[str, Any]) -> dict[str, Any]:
    centre = record.get("centre_m") or (None, None)
    error = record.get("error") or {}
    causes = [f"{cause['text']}. {cause['remedy']}" for cause in record.get("causes") or ()]
    derived = {
        "time_utc": record.get("time_utc") or utc_text(),
        "centre_x_m": centre[0],
        "centre_y_m": centre[1],
        "total_s": sum((record.get("seconds") or {}).values()),
        "error_code": error.get("code"),
        "error_message": error.get("message"),
        "advice": record.get("advice") or "",
        "cause": causes[0] if causes else "",
        "recording_note": record.get("recording_note") or "",
    }
    return {name: record.get(name) for name in _COLUMNS} | derived


_STORED = "SELECT 1 FROM identification WHERE time_utc = :time_utc AND file = :file AND total_s = :total_s"
"""What tells an identification from any other; copies of a file may share an answer."""


def _reflectors(number: int, record: Mapping[str, Any]) -> Iterator[tuple[Any, ...]]:
    for index, r in enumerate(record.get("reflectors") or ()):
        yield number, index, r["x_m"], r["y_m"], r["amplitude_db"], int(r["matched"])


def _conditions(wanted: Filter) -> tuple[str, list[Any]]:
    tests: list[str] = []
    values: list[Any] = []
    for column, value in (
        ("i.status", wanted.status),
        ("i.layout", wanted.layout),
        ("i.capture_uuid", wanted.capture_uuid),
        ("run.command", wanted.command),
    ):
        if value:
            tests.append(f"{column} = ?")
            values.append(value)
    if wanted.numbers:
        tests.append(f"i.id IN ({', '.join('?' for _ in wanted.numbers)})")
        values += wanted.numbers
    if wanted.file:
        tests.append("instr(i.file, ?) > 0")
        values.append(wanted.file)
    for name, sign, text in (("since", ">=", wanted.since), ("until", "<", wanted.until)):
        if text:
            tests.append(f"i.time_utc {sign} ?")
            values.append(_moment(name, text))
    return (" WHERE " + " AND ".join(tests) if tests else ""), values


def _moment(name: str, text: str) -> str:
    try:
        moment = datetime.fromisoformat(text)
        return utc_text(moment if moment.tzinfo else moment.replace(tzinfo=UTC))
    except (ValueError, OverflowError):  # in UTC, the first and the last day lie outside the calendar
        raise UsageError(
            f"--{name} {text!r} is not a date or a time", f"Give e.g. --{name} 2026-11-21T08:00 (UTC)."
        ) from None


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


def _parquet(entries: Iterator[HistoryEntry], path: Path) -> int:
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
    with files.replacing(path) as file, pq.ParquetWriter(file, schema) as writer:
        while some := list(itertools.islice(entries, _BATCH)):
            rows = [entry.to_json() | {"time_utc": datetime.fromisoformat(entry.time_utc)} for entry in some]
            writer.write_batch(pa.RecordBatch.from_pylist(rows, schema))
            count += len(some)
    return count
