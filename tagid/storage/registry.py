"""The enrolled layouts and every change that was ever made to them, in one sqlite file.

A reading names the registry's version, so that it can be told later which layouts it was chosen from.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from tagid.errors import RegistryError, TagidError, UsageError
from tagid.storage.database import Database, Schema
from tagid.storage.spreadsheet import FORMULA_STARTS
from tagid.tags.layout import Layout, builtin_layouts, layout_from_dict

APPLICATION_ID = 0x74616764
"""Marks the file as ours ("tagd"), sqlite header, offset 68."""
MAX_DEFINITION = 64 * 1024

_MIGRATIONS = (
    # 1: the layouts now, and the log of changes; a change's number is the registry's version.
    (
        "CREATE TABLE layout (name TEXT PRIMARY KEY, definition TEXT NOT NULL, version INTEGER NOT NULL)",
        "CREATE TABLE change (version INTEGER PRIMARY KEY AUTOINCREMENT, time_utc TEXT NOT NULL,"
        " action TEXT NOT NULL, name TEXT NOT NULL, source TEXT NOT NULL, definition TEXT NOT NULL)",
    ),
)
_SCHEMA = Schema(
    "registry",
    APPLICATION_ID,
    _MIGRATIONS,
    "Restore a backup, remove the file to begin with the built-in layouts, or give another path.",
)


@dataclass(frozen=True)
class Change:
    """One entry of the history.

    Attributes:
        version: the registry's version from then on.
        time_utc: ISO 8601.
        action: "add", "replace" or "remove".
        name: layout.
        source: where it came from ("built-in", a file, "captures", ...).
        layout: as it was added, or as it was when removed; None where that cannot be read any more.
    """

    version: int
    time_utc: str
    action: str
    name: str
    source: str
    layout: Layout | None


class Registry:
    """Enrolled layouts in a sqlite file, made with the built-in ones where it does not exist.

    Safe to use from several processes: every change is one immediate transaction.

    Raises:
        RegistryError: the file is not a registry, damaged, from a newer tagid, locked or not writable.
    """

    def __init__(self, path: Path) -> None:
        self._database = Database(path, _SCHEMA, self._fill)
        self.path = self._database.path

    @property
    def version(self) -> int:
        """Number of changes made so far; grows by one with each."""
        with self._database.connection() as connection:
            return self._version(connection)

    def layouts(self) -> list[Layout]:
        """All enrolled layouts, by name."""
        with self._database.connection() as connection:
            rows = connection.execute("SELECT name, definition FROM layout ORDER BY name").fetchall()
        return [self._decode(name, text) for name, text in rows]

    def get(self, name: str) -> Layout:
        """The layout of that name; RegistryError lists the names where there is none."""
        with self._database.connection() as connection:
            row = connection.execute("SELECT definition FROM layout WHERE name = ?", (name,)).fetchone()
        if row is None:
            raise self._missing(name)
        return self._decode(name, row[0])

    def snapshot(self) -> tuple[int, list[Layout]]:
        """The version, and all layouts enrolled at it."""
        with self._database.connection() as connection:
            connection.execute("BEGIN")
            version = self._version(connection)
            rows = connection.execute("SELECT name, definition FROM layout ORDER BY name").fetchall()
            connection.execute("COMMIT")
        return version, [self._decode(name, text) for name, text in rows]

    def add(self, layout: Layout, source: str, *, replace: bool = False) -> int:
        """Enrol a layout and return the new version.

        Raises RegistryError where the name is taken and `replace` is not set. Whether it could be confused
        with another is for `tagid.tags.enrolment` to say.
        """
        version = self.add_all([layout], source, replace=replace)
        assert version is not None
        return version

    def add_all(
        self, layouts: Sequence[Layout], source: str, *, replace: bool = True, since: int | None = None
    ) -> int | None:
        """Enrol layouts, all or none; returns the new version.

        A layout that is enrolled just so makes no new version.

        Args:
            layouts: of different names.
            source: where they come from, for the history.
            replace: whether they may stand for others of their names.
            since: store only where this is still the version; else nothing is done and None returned.

        Raises RegistryError where a name is taken and `replace` is not set, UsageError for a label or notes
        that a spreadsheet would run as a formula.
        """
        with self._database.transaction() as connection:
            if since is not None and self._version(connection) != since:
                return None
            now = self._definitions(connection)
            for layout in layouts:
                _check_label(layout)
                text = json.dumps(layout.to_dict(), sort_keys=True)
                if layout.name in now and not replace:
                    raise RegistryError(
                        f"a layout named {layout.name} is enrolled already",
                        "Choose another name, remove the old one first, or replace it with --force.",
                    )
                if now.get(layout.name) != text:
                    self._put(connection, layout.name, text, source)
            return self._version(connection)

    def go_back(self, version: int | None = None) -> int:
        """Restore the layouts as they were at a version, by new changes; returns the new version.

        Args:
            version: None takes the one before what was done last (an import is one deed of many changes), so
                that going back twice changes nothing.

        Raises RegistryError where there is no such version.
        """
        with self._database.transaction() as connection:
            last = self._version(connection)
            target = self._before_last_deed(connection) if version is None else version
            if not 1 <= target < last:
                raise RegistryError(
                    f"there is no version {target} to go back to, the registry is at version {last}",
                    "`tagid layouts --history` lists the versions.",
                )
            rows = connection.execute(
                "SELECT action, name, definition FROM change WHERE version <= ? ORDER BY version", (target,)
            )
            then: dict[str, str] = {}
            for action, name, definition in rows:
                then.pop(name, None)
                if action != "remove":
                    self._decode(name, definition)
                    then[name] = definition
            now = self._definitions(connection)
            source = f"back to version {target}"
            for name in sorted(now.keys() - then.keys()):
                connection.execute("DELETE FROM layout WHERE name = ?", (name,))
                self._log(connection, "remove", name, source, now[name])
            for name, text in sorted(then.items()):
                if now.get(name) != text:
                    self._put(connection, name, text, source)
            return self._version(connection)

    @staticmethod
    def _before_last_deed(connection: sqlite3.Connection) -> int:
        rows = connection.execute("SELECT version, time_utc, source FROM change ORDER BY version DESC")
        version, *deed = rows.fetchone()
        for earlier, *other in rows:
            if other != deed:
                break
            version = earlier
        return int(version) - 1

    def _definitions(self, connection: sqlite3.Connection) -> dict[str, str]:
        return dict(connection.execute("SELECT name, definition FROM layout").fetchall())

    @staticmethod
    def _version(connection: sqlite3.Connection) -> int:
        return int(connection.execute("SELECT COALESCE(MAX(version), 0) FROM change").fetchone()[0])

    def _put(self, connection: sqlite3.Connection, name: str, text: str, source: str) -> int:
        taken = connection.execute("SELECT 1 FROM layout WHERE name = ?", (name,)).fetchone()
        version = self._log(connection, "replace" if taken else "add", name, source, text)
        connection.execute(
            "INSERT OR REPLACE INTO layout (name, definition, version) VALUES (?, ?, ?)",
            (name, text, version),
        )
        return version

    def remove(self, name: str, source: str = "") -> int:
        """Take a layout out (its history stays) and return the new version."""
        with self._database.transaction() as connection:
            row = connection.execute("SELECT definition FROM layout WHERE name = ?", (name,)).fetchone()
            if row is not None:
                connection.execute("DELETE FROM layout WHERE name = ?", (name,))
                return self._log(connection, "remove", name, source, row[0])
        raise self._missing(name)

    def history(self, name: str | None = None) -> list[Change]:
        """Every change, oldest first; of one layout where a name is given."""
        query = "SELECT version, time_utc, action, name, source, definition FROM change"
        with self._database.connection() as connection:
            if name is None:
                rows = connection.execute(f"{query} ORDER BY version").fetchall()
            else:
                rows = connection.execute(f"{query} WHERE name = ? ORDER BY version", (name,)).fetchall()
        changes = []
        for number, time_utc, action, named, source, definition in rows:
            try:
                layout = self._decode(named, definition)
            except RegistryError:
                layout = None
            changes.append(Change(number, time_utc, action, named, source, layout))
        return changes

    def _fill(self, connection: sqlite3.Connection) -> None:
        """Begin a new file with the built-in layouts."""
        for layout in builtin_layouts().values():
            text = json.dumps(layout.to_dict(), sort_keys=True)
            version = self._log(connection, "add", layout.name, "built-in", text)
            connection.execute("INSERT INTO layout VALUES (?, ?, ?)", (layout.name, text, version))

    @staticmethod
    def _log(connection: sqlite3.Connection, action: str, name: str, source: str, text: str) -> int:
        now = datetime.now(UTC).isoformat(timespec="seconds")
        cursor = connection.execute(
            "INSERT INTO change (time_utc, action, name, source, definition) VALUES (?, ?, ?, ?, ?)",
            (now, action, name, source, text),
        )
        return int(cursor.lastrowid or 0)

    def _decode(self, name: str, text: object) -> Layout:
        try:
            if not isinstance(text, str) or len(text) > MAX_DEFINITION:
                raise ValueError("not a definition")
            layout = layout_from_dict(json.loads(text))
            if layout.name != name:
                raise ValueError(f"it is that of {layout.name}")
            return layout
        except (ValueError, RecursionError, TagidError) as error:
            raise RegistryError(
                f"{self.path} holds a damaged definition of {str(name)[:80]!r}: {str(error)[:200]}",
                "Take it out with `tagid layouts --remove NAME` (its history stays), go back with "
                "`tagid layouts undo --to VERSION`, or restore a backup.",
            ) from None

    def _missing(self, name: str) -> RegistryError:
        names = ", ".join(layout.name for layout in self.layouts())
        return RegistryError(f"no layout is named {name[:80]!r}", f"Enrolled are: {names or 'none'}.")


def _check_label(layout: Layout) -> None:
    """Raises UsageError for texts of a layout to enrol that a spreadsheet would run."""
    for name in ("label", "notes"):
        if getattr(layout, name).lstrip().startswith(FORMULA_STARTS):
            raise UsageError(
                f"layout {layout.name}: the {name} begins with {getattr(layout, name).lstrip()[0]!r}",
                "Begin it with a letter or digit: spreadsheets run such texts as formulas.",
            )
