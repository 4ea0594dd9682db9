"""The base of every sqlite file of tagid: application id, migrations, transactions, clear errors.

The registry of layouts and the history of identifications add only their own tables.
"""

from __future__ import annotations

import contextlib
import sqlite3
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tagid import files, interrupts
from tagid.errors import DiskFullError, RegistryError, TagidError

BUSY_SECONDS = 10.0
"""Longest wait for another process's transaction, s."""

_REMEDIES = {
    sqlite3.SQLITE_READONLY: "Get write permission for the file and its folder, or give another path.",
    sqlite3.SQLITE_PERM: "Get write permission for the file and its folder, or give another path.",
    sqlite3.SQLITE_CANTOPEN: "Get read permission for the file and its folder, or give another path.",
    sqlite3.SQLITE_BUSY: "Another process is changing it; try again later.",
    sqlite3.SQLITE_LOCKED: "Another process is changing it; try again later.",
}
"""Remedies for errors of an intact file, by sqlite error code."""

Migration = tuple[str, ...]
"""The statements that migrate one schema version to the next."""


@dataclass(frozen=True)
class Schema:
    """The kind of a file and its schema.

    Attributes:
        what: readable name of the file, e.g. "registry".
        application_id: application id in the sqlite header, offset 68.
        migrations: one step per version, oldest first; their number is the current version.
        restore: remedy if the file is damaged, one sentence.
        error: class of the errors.
        write_ahead: keep a write-ahead log, so that readers and one writer do not wait for each other.
    """

    what: str
    application_id: int
    migrations: tuple[Migration, ...]
    restore: str
    error: type[TagidError] = RegistryError
    write_ahead: bool = False

    @property
    def version(self) -> int:
        """The current version."""
        return len(self.migrations)


class Database:
    """A sqlite file migrated to the current version of its schema.

    Every change is one immediate transaction, so several processes may use it at once.

    Args:
        path: the file; it and its folder are created if they do not exist.
        schema: its expected schema.
        fill: called with the connection in the transaction that creates a new file.

    Raises:
        the schema's error: another program's file, damaged, from a newer tagid, locked or not writable.
        DiskFullError: no space left.
    """

    def __init__(
        self, path: Path, schema: Schema, fill: Callable[[sqlite3.Connection], None] | None = None
    ) -> None:
        self.path = Path(path)
        self.schema = schema
        try:
            files.make_folder(self.path.parent)
        except OSError as error:
            raise schema.error(
                f"cannot create the folder of the {schema.what} {self.path}: {error.strerror}",
                f"Give a {schema.what} path in a folder that you can write to.",
            ) from error
        if not self._ready():
            with self.transaction() as connection:
                self._prepare(connection, fill)
        if schema.write_ahead:
            with self.connection() as connection:
                _write_ahead(connection)

    @contextlib.contextmanager
    def connection(self) -> Iterator[sqlite3.Connection]:
        """A connection that raises clear errors; sqlite opens lazily, so they occur at the first use."""
        try:
            with contextlib.closing(
                sqlite3.connect(self.path, timeout=BUSY_SECONDS, isolation_level=None)
            ) as connection:
                connection.execute("PRAGMA foreign_keys = ON")
                # FULL, the default, leaves the removal of the rollback journal unsynced: a power cut could
                # undo a committed transaction.
                connection.execute("PRAGMA synchronous = EXTRA")
                yield connection
        except sqlite3.Error as error:
            raise self._told(error) from error

    @contextlib.contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """One immediate transaction, undone on any exception; stop signals are delayed until its end."""
        with self.connection() as connection:
            connection.execute("BEGIN IMMEDIATE")
            with interrupts.deferred():
                try:
                    yield connection
                except BaseException:
                    # sqlite has already rolled back if the disk was full.
                    if connection.in_transaction:
                        connection.execute("ROLLBACK")
                    raise
                connection.execute("COMMIT")

    def _ready(self) -> bool:
        """Whether the file exists with the current schema: opening it then writes nothing, so that it may be
        read-only."""
        try:
            if self.schema.write_ahead or not self.path.is_file() or not self.path.stat().st_size:
                return False
        except OSError:
            return False
        with self.connection() as connection:
            version = int(connection.execute("PRAGMA user_version").fetchone()[0])
            owner = int(connection.execute("PRAGMA application_id").fetchone()[0])
            self._check_objects(connection)
        return version == self.schema.version and owner == self.schema.application_id

    def _check_objects(self, connection: sqlite3.Connection) -> None:
        """Refuses views and triggers, which tagid never makes: reading a view may never end."""
        query = "SELECT name FROM sqlite_master WHERE type IN ('view', 'trigger') LIMIT 1"
        found = connection.execute(query).fetchone()
        if found is not None:
            raise self.schema.error(
                f"the {self.schema.what} {self.path} holds a view or trigger, {str(found[0])[:80]!r}",
                self.schema.restore,
            )

    def _prepare(
        self, connection: sqlite3.Connection, fill: Callable[[sqlite3.Connection], None] | None
    ) -> None:
        schema = self.schema
        version = int(connection.execute("PRAGMA user_version").fetchone()[0])
        tables = connection.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()[0]
        owner = int(connection.execute("PRAGMA application_id").fetchone()[0])
        if tables and owner != schema.application_id:
            raise schema.error(
                f"{self.path} is a database of another program", f"Give another path for the {schema.what}."
            )
        self._check_objects(connection)
        if version > schema.version:
            raise schema.error(
                f"{self.path} has schema {version}, this tagid supports up to {schema.version}",
                f"Use the newer tagid that wrote it, or another {schema.what}.",
            )
        for step in schema.migrations[version:]:
            for statement in step:
                connection.execute(statement)
        if version < schema.version:
            connection.execute(f"PRAGMA application_id = {schema.application_id}")
            connection.execute(f"PRAGMA user_version = {schema.version}")
        if version == 0 and fill is not None:
            fill(connection)

    def _told(self, error: sqlite3.Error) -> TagidError:
        if getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_FULL:
            return DiskFullError(f"no space left to change {self.path}", "Free some space.")
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        remedy = _REMEDIES.get(code, self.schema.restore)
        return self.schema.error(f"cannot use the {self.schema.what} {self.path}: {error}", remedy)


def _write_ahead(connection: sqlite3.Connection) -> None:
    """Turn the write-ahead log on; the setting is stored in the file.

    sqlite ignores its timeout here, so this function waits for other processes.
    """
    end = time.monotonic() + BUSY_SECONDS
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            return
        except sqlite3.OperationalError as error:
            busy = getattr(error, "sqlite_errorcode", 0) & 0xFF in (
                sqlite3.SQLITE_BUSY,
                sqlite3.SQLITE_LOCKED,
            )
            if not busy or time.monotonic() > end:
                raise
            time.sleep(0.01)
