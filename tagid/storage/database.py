"""The base of every sqlite file of tagid: application id, migrations, transactions, clear errors.

The registry of layouts and the history of identifications add only their own tables.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import sqlite3
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tagid import files, interrupts
from tagid.errors import DiskFullError, RegistryError, StorageError, TagidError, UsageError

BUSY_SECONDS = 10.0
"""Longest wait for another process's transaction, s."""

_MOVE = "set the environment variable TAGID_DATA to another folder"
_HELD = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
"""Errors of a lock that another connection holds."""
_UNLOCKED = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_PERM, sqlite3.SQLITE_IOERR)
"""Errors of a file system without locks."""
_NO_SHARED_MEMORY = (
    sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_FULL
)  # fmt: skip
"""Errors where the shared memory of a write-ahead log cannot be created: full disk, read-only folder."""
_CLOSED = (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM, sqlite3.SQLITE_CANTOPEN)
"""Errors of missing permission."""

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
        move: how to put the file at another location, a clause.
        busy: remedy if another process holds the file.
        room: what else helps on a full disk, a clause.
    """

    what: str
    application_id: int
    migrations: tuple[Migration, ...]
    restore: str
    error: type[TagidError] = RegistryError
    write_ahead: bool = False
    move: str = _MOVE
    busy: str = "Another process is changing it; try again later."
    room: str = f"or {_MOVE}"

    @property
    def version(self) -> int:
        return len(self.migrations)


class Database:
    """A sqlite file migrated to the current version of its schema.

    Every change is one immediate transaction, so several processes may use it at once.

    Args:
        path: the file; it and its folder are created if they do not exist.
        fill: called with the connection in the transaction that creates a new file.
        wait_s: longest wait for another process's transaction, s.

    Raises:
        the schema's error: another program's file, damaged, from a newer tagid, locked, not writable or not
            a regular file.
        DiskFullError: no space left.
    """

    def __init__(
        self,
        path: Path,
        schema: Schema,
        fill: Callable[[sqlite3.Connection], None] | None = None,
        wait_s: float = BUSY_SECONDS,
    ) -> None:
        self.path = Path(path)
        self.schema = schema
        self._wait_s = wait_s
        try:
            files.make_folder(self.path.parent)
        except StorageError as error:
            raise schema.error(
                f"cannot create the folder of the {schema.what}: {error.message}",
                f"Make it writable, or {schema.move}.",
            ) from error
        files.check_regular(self.path, schema.error)
        if not self._ready():
            with self.transaction() as connection:
                self._prepare(connection, fill)
            if schema.write_ahead:
                with clear_errors(self.path, self.schema), contextlib.closing(self._open()) as connection:
                    self._wait(connection, "PRAGMA journal_mode = WAL")

    @contextlib.contextmanager
    def connection(self) -> Iterator[sqlite3.Connection]:
        """A connection to read with; its errors are clear ones.

        Where the file system has no locks, or a write-ahead log cannot be used (full disk, read-only folder),
        the file is read without locks. Raises the schema's error if another process changes it meanwhile.
        """
        before = None
        with clear_errors(self.path, self.schema):
            try:
                opened = self._open()
            except sqlite3.Error as error:
                if not self._readable_unlocked(error):
                    raise
                before = self._state()
                opened = self._open_unlocked()
            try:
                with contextlib.closing(opened) as connection:
                    yield connection
            finally:
                if before is not None and before != self._state():
                    what = f"the {self.schema.what} {self.path}"
                    raise self.schema.error(f"{what} is being changed", self.schema.busy)

    def _open(self) -> sqlite3.Connection:
        """A connection that has held a lock, and from now on waits for other processes."""
        connection = sqlite3.connect(self.path, timeout=0, isolation_level=None)
        try:
            try:
                connection.execute(_FIRST)
            except sqlite3.OperationalError as error:
                # A file system without locks looks as if the file were locked for ever.
                if _code(error) not in _HELD or not _lockable(self.path):
                    raise
                self._wait(connection, _FIRST)
            connection.execute(f"PRAGMA busy_timeout = {round(self._wait_s * 1000)}")
            connection.execute("PRAGMA foreign_keys = ON")
            # FULL, the default, leaves the removal of the rollback journal unsynced: a power cut could
            # undo a committed transaction.
            connection.execute("PRAGMA synchronous = EXTRA")
        except BaseException:
            connection.close()
            raise
        return connection

    def _wait(self, connection: sqlite3.Connection, statement: str) -> None:
        """Execute a statement that may have to wait for other processes; stop signals end the wait.

        sqlite's own wait is deaf to signals, and it does not wait for a change of the journal mode.
        """
        end = time.monotonic() + self._wait_s
        connection.execute("PRAGMA busy_timeout = 0")
        while True:
            try:
                connection.execute(statement)
                break
            except sqlite3.OperationalError as error:
                if _code(error) not in _HELD or time.monotonic() >= end:
                    raise
                time.sleep(0.01)
        connection.execute(f"PRAGMA busy_timeout = {round(self._wait_s * 1000)}")

    def _open_unlocked(self) -> sqlite3.Connection:
        """A connection that only reads and takes no lock."""
        # Without a log and a journal, everything is in the file itself, and a log need not be created.
        whole = "&immutable=1" if self._state()[1:] == [None, None] else ""
        name = f"{self.path.absolute().as_uri()}?mode=ro&vfs=unix-none{whole}"
        connection = sqlite3.connect(name, uri=True, isolation_level=None)
        try:
            connection.execute("PRAGMA query_only = ON")
            connection.execute("PRAGMA locking_mode = EXCLUSIVE")  # the log needs no shared memory then
            connection.execute(_FIRST)
        except BaseException:
            connection.close()
            raise
        return connection

    def _readable_unlocked(self, error: sqlite3.Error) -> bool:
        """Whether the file may be read without locks after this error."""
        if not self._state()[0]:
            return False
        if self.schema.write_ahead and _code(error) in _NO_SHARED_MEMORY:
            return True
        return _code(error) in _UNLOCKED and not _lockable(self.path)

    def _state(self) -> list[tuple[int, int] | None]:
        """Size and time of the file, its log and its journal; None for what is missing or empty."""
        state = []
        for suffix in ("", "-wal", "-journal"):
            try:
                status = Path(f"{self.path}{suffix}").stat()
                state.append((status.st_size, status.st_mtime_ns) if status.st_size else None)
            except OSError:
                state.append(None)
        return state

    @contextlib.contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """One immediate transaction, undone on any exception; stop signals are delayed until its end."""
        with clear_errors(self.path, self.schema), contextlib.closing(self._open()) as connection:
            self._wait(connection, "BEGIN IMMEDIATE")
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
            if not self.path.is_file() or not self.path.stat().st_size:
                return False
        except OSError:
            return False
        with self.connection() as connection:
            version = int(connection.execute("PRAGMA user_version").fetchone()[0])
            owner = int(connection.execute("PRAGMA application_id").fetchone()[0])
            mode = connection.execute("PRAGMA journal_mode").fetchone()[0]
            unlocked = bool(connection.execute("PRAGMA query_only").fetchone()[0])
            check_objects(connection, self.path, self.schema)
        current = (version, owner) == (self.schema.version, self.schema.application_id)
        return current and (unlocked or mode == "wal" or not self.schema.write_ahead)

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
        check_objects(connection, self.path, self.schema)
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


def check_objects(connection: sqlite3.Connection, path: Path, schema: Schema) -> None:
    """Rejects views and triggers, which tagid never creates: reading a view may never end."""
    query = "SELECT name FROM sqlite_master WHERE type IN ('view', 'trigger') LIMIT 1"
    row = connection.execute(query).fetchone()
    if row is not None:
        raise schema.error(
            f"the {schema.what} {path} holds a view or trigger, {str(row[0])[:80]!r}", schema.restore
        )


@contextlib.contextmanager
def clear_errors(path: Path, schema: Schema) -> Iterator[None]:
    """Raise errors of sqlite about this file as clear ones: the schema's, DiskFullError or UsageError."""
    try:
        yield
    except sqlite3.Error as error:
        raise _clear(error, path, schema) from error
    except (UnicodeEncodeError, OverflowError) as error:  # of a value that was to be sent to sqlite
        raise UsageError(
            f"the {schema.what} {path} cannot hold this value: {error}",
            "Give text in UTF-8, or a smaller number.",
        ) from error


def _clear(error: sqlite3.Error, path: Path, schema: Schema) -> TagidError:
    code, what, move = _code(error), schema.what, schema.move
    if code in _UNLOCKED and not _lockable(path):
        return schema.error(
            f"the file system of {path.parent} has no locks, the {what} there can only be read",
            f"To change it, {move}, on a local disk; copy the files of the old folder there.",
        )
    if code == sqlite3.SQLITE_FULL or (code in _NO_SHARED_MEMORY and _is_full(path.parent)):
        return DiskFullError(f"no space left to change {path}", f"Free some space, {schema.room}.")
    remedy = schema.restore
    if code in (*_HELD, sqlite3.SQLITE_PROTOCOL):
        remedy = schema.busy
    elif code in _CLOSED and files.is_read_only(path.parent):
        remedy = f"The file system is read-only: {move}."
    elif code in _CLOSED:
        kind = "read" if code == sqlite3.SQLITE_CANTOPEN else "write"
        remedy = f"Get {kind} permission for the file and its folder, or {move}."
    elif code == sqlite3.SQLITE_IOERR:
        remedy = f"The file itself may be intact: check its disk and try again, or {move}."
    elif code == sqlite3.SQLITE_NOMEM:
        remedy = "Close other programs and try again."
    return schema.error(f"cannot use the {what} {path}: {error}", remedy)


_FIRST = "SELECT 1 FROM sqlite_master LIMIT 1"
"""Takes a lock for the first time: sqlite opens lazily."""


def _code(error: sqlite3.Error) -> int:
    """Primary sqlite error code; 0 for errors of Python's module."""
    return int(getattr(error, "sqlite_errorcode", 0)) & 0xFF


@functools.cache
def _kept_open(path: Path) -> int:
    """A descriptor of a file that is never closed: closing any of them ends the locks of this process."""
    return os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)


def _lockable(path: Path) -> bool:
    """Whether the file system of a file has locks; True if that cannot be found out."""
    try:
        descriptor = _kept_open(path)
    except OSError:
        return True
    try:
        # Asking for a lock takes none and waits for nobody, so that it fails only without locks.
        fcntl.fcntl(descriptor, fcntl.F_GETLK, struct.pack("hhqqi", fcntl.F_RDLCK, os.SEEK_SET, 0, 1, 0))
    except OSError:
        return False
    return True


def _is_full(folder: Path) -> bool:
    """Whether a folder has no room for a small file: space, names or quota are used up."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(1 << 16))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return isinstance(files.storage_error(error, folder, "writing"), DiskFullError)
    return False
