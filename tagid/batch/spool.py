"""The working file of a report, which stores every result when it arrives.

It is a sqlite file in the report's folder: a report of any size needs little memory, and a run that was
stopped or killed can be resumed.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Generator, Iterator
from pathlib import Path

from tagid import files, interrupts
from tagid.batch.job import Known, Outcome
from tagid.errors import StorageError
from tagid.report.records import ItemRecord, StoredItem
from tagid.storage.database import Schema, check_objects, clear_errors

FILE_NAME = ".tagid-report.sqlite"
_VERSION = 1
_SCHEMA = Schema(
    what="working file",
    application_id=0x74616773,  # "tags"
    migrations=(),
    restore="Remove the file (`resume` then finds no results), or choose another `out`.",
    error=StorageError,
    move="choose another `out`",
    busy="Another tagid report is writing it: wait for it, or choose another `out`.",
    room="and add `resume`: the results so far are kept",
)
_FINAL = "(status <> 'failed' OR json_extract(record, '$.error.code') IN ('bad_file', 'bad_data'))"
"""Answers that the same content always produces; other failures, such as a lost worker, are retried."""
_FILE = "json_extract(record, '$.file')"


class Spool:
    """Results of one report, by position among its items; only one process may have it open.

    A fresh one discards earlier contents.

    Raises StorageError for a file that is no working file of tagid, is used by another report, or cannot be
    written; DiskFullError.
    """

    def __init__(self, path: Path, fresh: bool) -> None:
        self.path = path
        with interrupts.deferred(), clear_errors(self.path, _SCHEMA):
            self._db = sqlite3.connect(files.in_place(path), timeout=0.2, isolation_level=None)
            try:
                self._open(fresh)
            except BaseException:
                self._db.close()
                raise

    def __enter__(self) -> Spool:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(sqlite3.Error):
            self._db.close()

    def _open(self, fresh: bool) -> None:
        db = self._db
        # Exclusive from the first statement: two reports in one folder would mix their items.
        db.execute("PRAGMA locking_mode = EXCLUSIVE")
        db.execute("PRAGMA synchronous = EXTRA")
        db.execute("BEGIN EXCLUSIVE")
        owner = int(db.execute("PRAGMA application_id").fetchone()[0])
        version = int(db.execute("PRAGMA user_version").fetchone()[0])
        if owner not in (0, _SCHEMA.application_id):
            raise StorageError(f"{self.path} belongs to another program", "Choose another `out`.")
        check_objects(db, self.path, _SCHEMA)
        if fresh or version != _VERSION:
            for table in ("item", "kept"):
                db.execute(f"DROP TABLE IF EXISTS {table}")
            columns = (
                "content TEXT, job TEXT NOT NULL, status TEXT NOT NULL, record TEXT NOT NULL,"
                " drawing TEXT NOT NULL, image BLOB NOT NULL, sinogram BLOB NOT NULL"
            )
            db.execute(f"CREATE TABLE item (position INTEGER PRIMARY KEY, name TEXT NOT NULL, {columns})")
            db.execute(f"CREATE TABLE kept (number INTEGER PRIMARY KEY, {columns})")
            db.execute(f"PRAGMA application_id = {_SCHEMA.application_id}")
            db.execute(f"PRAGMA user_version = {_VERSION}")
        db.execute(f"CREATE INDEX IF NOT EXISTS kept_file ON kept (content, job, {_FILE})")
        db.execute("COMMIT")
        # With the write-ahead log each result costs one sync, and a power cut loses none.
        db.execute("PRAGMA journal_mode = WAL")

    def take_over(self, job: str) -> frozenset[str]:
        """Keep the results of earlier runs with this fingerprint and empty the list of items.

        Returns the sha256 of the contents whose answers can be reused.
        """
        with interrupts.deferred(), clear_errors(self.path, _SCHEMA):
            self._db.execute("BEGIN")
            columns = "content, job, status, record, drawing, image, sinogram"
            self._db.execute(f"INSERT INTO kept ({columns}) SELECT {columns} FROM item ORDER BY position")
            self._db.execute("DELETE FROM kept WHERE job <> ? OR content IS NULL", (job,))
            self._db.execute(
                "DELETE FROM kept WHERE number NOT IN"
                f" (SELECT MAX(number) FROM kept GROUP BY content, {_FILE})"
            )
            self._db.execute("DELETE FROM item")
            self._db.execute("COMMIT")
            rows = self._db.execute(f"SELECT DISTINCT content FROM kept WHERE {_FINAL}").fetchall()
        return frozenset(content for (content,) in rows)

    def answers(self) -> Generator[tuple[str, ItemRecord], None, None]:
        """Fingerprint and record of every answer, also of earlier runs, sorted by fingerprint."""
        with clear_errors(self.path, _SCHEMA):
            query = "SELECT job, record FROM item UNION ALL SELECT job, record FROM kept ORDER BY 1"
            for job, record in self._db.execute(query):
                yield job, ItemRecord.from_json(record)

    def put(self, position: int, name: str, job: str, outcome: Outcome) -> ItemRecord:
        """Store a result; return its record.

        For a known answer that is the earlier one of this file, else that of another file under this name.
        """
        with interrupts.deferred(), clear_errors(self.path, _SCHEMA):
            if isinstance(outcome, Known):
                query = (
                    "SELECT record, drawing, image, sinogram FROM kept"
                    f" WHERE content = ? AND job = ? AND {_FINAL}"
                )
                values = (outcome.content_sha256, job)
                same = self._db.execute(f"{query} AND {_FILE} = ?", (*values, name)).fetchone()
                text, *drawn = same or self._db.execute(query, values).fetchone()
                record = ItemRecord.from_json(text).renamed(name)
            else:
                record, pictures = outcome.record, outcome.pictures
                drawn = [json.dumps(pictures.drawing), pictures.image, pictures.sinogram]
            self._db.execute(
                "INSERT OR REPLACE INTO item VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (position, name, record.content_sha256, job, record.status, record.to_json(), *drawn),
            )
        return record

    def items(self) -> Iterator[StoredItem]:
        """All items in the order of the inputs, read lazily."""
        with clear_errors(self.path, _SCHEMA):
            query = (
                "SELECT position, record, drawing, length(image) + length(sinogram)"
                " FROM item ORDER BY position"
            )
            for position, record, drawing, size in self._db.execute(query):
                yield StoredItem(position, ItemRecord.from_json(record), json.loads(drawing), size)

    def pictures(self, position: int) -> tuple[bytes, bytes]:
        """Image and sinogram of one item, PNG; empty if it has none."""
        with clear_errors(self.path, _SCHEMA):
            query = "SELECT image, sinogram FROM item WHERE position = ?"
            return self._db.execute(query, (position,)).fetchone()  # type: ignore[no-any-return]

    def copies(self) -> dict[int, str]:
        """Position of each item whose content and status an earlier one has -> name of the earliest."""
        with clear_errors(self.path, _SCHEMA):
            query = (
                "SELECT item.position, first.name FROM item JOIN"
                " (SELECT content, status, name, MIN(position) AS position FROM item"
                " WHERE content IS NOT NULL GROUP BY content, status HAVING COUNT(*) > 1) AS first"
                " ON first.content = item.content AND first.status = item.status"
                " WHERE item.position > first.position"
            )
            return dict(self._db.execute(query).fetchall())

    def names(self) -> list[str]:
        """Names of the items in the order of the inputs."""
        with clear_errors(self.path, _SCHEMA):
            return [str(name) for (name,) in self._db.execute("SELECT name FROM item ORDER BY position")]
