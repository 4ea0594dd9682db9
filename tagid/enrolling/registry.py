"""The enrolled layouts, bodies and objects, and every change made to them, in one sqlite file.

A reading records the registry's version, so the set of entries it was compared with can be established later.
"""

from __future__ import annotations

import json
import sqlite3
from bisect import bisect_left
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from tagid.counting import meant
from tagid.errors import RegistryError, TagidError, UsageError
from tagid.result import NO_NAMES
from tagid.storage.database import Database, Schema
from tagid.storage.spreadsheet import FORMULA_STARTS
from tagid.tags.bodies.signature import Signature, SignatureKind
from tagid.tags.bodies.signature_file import from_bytes, to_bytes
from tagid.tags.layouts.layout import Layout, builtin_layouts, layout_from_dict
from tagid.tags.layouts.test_card import NAME as TEST_CARD

APPLICATION_ID = 0x74616764
"""Application id in the sqlite header (offset 68): "tagd"."""
MAX_DEFINITION = 64 * 1024
_COMMANDS = {
    "body": ("tagid bodies show {}", "tagid bodies remove {}"),
    "object": ("tagid bodies show {} --object", "tagid layouts remove {}"),
    "layout": ("tagid layouts show {}", "tagid layouts remove {}"),
}
"""How an entry of each kind is shown, and removed."""

_MIGRATIONS = (
    # 1: the layouts now, and the log of changes; a change's number is the registry's version.
    (
        "CREATE TABLE layout (name TEXT PRIMARY KEY, definition TEXT NOT NULL, version INTEGER NOT NULL)",
        "CREATE TABLE change (version INTEGER PRIMARY KEY AUTOINCREMENT, time_utc TEXT NOT NULL,"
        " action TEXT NOT NULL, name TEXT NOT NULL, source TEXT NOT NULL, definition TEXT NOT NULL)",
    ),
    # 2: signatures of bodies and objects; a change says what kind of entry it is about.
    (
        "CREATE TABLE signature (kind TEXT NOT NULL, name TEXT NOT NULL, data BLOB NOT NULL,"
        " version INTEGER NOT NULL, PRIMARY KEY (kind, name))",
        "ALTER TABLE change ADD COLUMN kind TEXT NOT NULL DEFAULT 'layout'",
        "ALTER TABLE change ADD COLUMN data BLOB",
    ),
)
_SCHEMA = Schema(
    "registry",
    APPLICATION_ID,
    _MIGRATIONS,
    "Restore a backup, or move the file away to start with the built-in layouts.",
)


_BACK = "back to version "
_FORWARD = "forward to version "
"""Sources of the changes that undo and redo make; the number is the version restored."""

Key = tuple[str, str]
"""Kind of an entry ("layout", "body" or "object") and its name."""
_Command = tuple[str, str]
"""Time (ISO 8601) and source of a command, the same for all of its changes.

Its time has microseconds and differs from that of the command before it. Of commands by tagid up to 0.2.0,
whose times are whole seconds, those of the same second and source are one.
"""
_MOST_DIGITS = 18


@dataclass(frozen=True)
class RegistryChange:
    """One entry of the history.

    Attributes:
        version: registry version after the change.
        time_utc: ISO 8601.
        action: "add", "replace" or "remove".
        name: of the layout, body or object.
        source: origin of the entry ("built-in", a file, "captures", ...).
        kind: "layout", "body" or "object".
        entry: the entry as added or as removed; None if it is damaged.
        command: version after all changes of the command that made it, as `undo --to` takes it.
    """

    version: int
    time_utc: str
    action: str
    name: str
    source: str
    kind: str
    entry: Layout | Signature | None
    command: int

    @property
    def layout(self) -> Layout | None:
        """The entry if it is a layout, else None."""
        return self.entry if isinstance(self.entry, Layout) else None


@dataclass(frozen=True)
class RegistryContents:
    """Everything enrolled at one version.

    Attributes:
        version: registry version.
        layouts: sorted by name.
        signatures: of bodies and objects, sorted by kind and name.
    """

    version: int
    layouts: list[Layout]
    signatures: list[Signature]


@dataclass(frozen=True)
class Restored:
    """What an undo or redo did.

    Attributes:
        version: of the registry from now on.
        undone: source of the change that was undone, or redone, as in the history.
        added, removed, changed: names of the entries that came back, went, or became another version again.
    """

    version: int
    undone: str
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Steps:
    """The versions that undo and redo go to, the next one last, and what made the present state."""

    undo: list[int]
    redo: list[int]
    made_by: str

    @classmethod
    def of(cls, deeds: Sequence[tuple[int, str]]) -> _Steps:
        """From (last version, source) of every command, as an editor keeps its two stacks."""
        state, undo, redo = 0, list[int](), list[int]()
        sources = dict(deeds)
        for version, source in deeds:
            for start, taken, kept in ((_BACK, undo, redo), (_FORWARD, redo, undo)):
                number = source.removeprefix(start)
                if source.startswith(start) and number.isdecimal() and len(number) <= _MOST_DIGITS:
                    kept.append(state)
                    state = int(number)
                    if state in taken:
                        del taken[taken.index(state) :]
                    break
            else:
                undo.append(state)
                redo.clear()
                state = version
        return cls(undo, redo, sources.get(state, f"the changes up to version {state}"))


class Registry:
    """Layouts, bodies and objects in a sqlite file. A new file contains the built-in layouts.

    Several processes may use one file: every change is one immediate transaction.

    Raises:
        RegistryError: the file is not a registry, damaged, from a newer tagid, locked or not writable.
    """

    def __init__(self, path: Path) -> None:
        self._database = Database(path, _SCHEMA, self._fill)
        self.path = self._database.path

    @property
    def version(self) -> int:
        """Number of changes made so far."""
        with self._database.connection() as connection:
            return self._version(connection)

    def layouts(self) -> list[Layout]:
        """All enrolled layouts, sorted by name."""
        return self.snapshot()[1]

    def get(self, name: str) -> Layout:
        """The layout of that name. Raises RegistryError, which lists the names, if there is none."""
        with self._database.connection() as connection:
            row = connection.execute("SELECT definition FROM layout WHERE name = ?", (name,)).fetchone()
        if row is None:
            raise self._missing(name)
        return self._decode(name, row[0])

    def signatures(self, kind: SignatureKind | None = None) -> list[Signature]:
        """The enrolled bodies and objects, or those of one kind, sorted by kind and name."""
        with self._database.connection() as connection:
            rows = connection.execute("SELECT kind, name, data FROM signature ORDER BY kind, name").fetchall()
        return [self._signature((k, name), data) for k, name, data in rows if kind in (None, k)]

    def signature(self, kind: SignatureKind, name: str) -> Signature:
        """One body or object. Raises RegistryError, which lists the names, if there is none."""
        with self._database.connection() as connection:
            row = connection.execute(
                "SELECT data FROM signature WHERE kind = ? AND name = ?", (kind, name)
            ).fetchone()
        if row is None:
            raise self._missing(name, kind)
        return self._signature((kind, name), row[0])

    def contents(self) -> RegistryContents:
        """The version and everything enrolled at that version."""
        with self._database.connection() as connection:
            connection.execute("BEGIN")
            version = self._version(connection)
            layouts = connection.execute("SELECT name, definition FROM layout ORDER BY name").fetchall()
            rows = connection.execute("SELECT kind, name, data FROM signature ORDER BY kind, name").fetchall()
            connection.execute("COMMIT")
        return RegistryContents(
            version,
            [self._decode(name, text) for name, text in layouts],
            [self._signature((kind, name), data) for kind, name, data in rows],
        )

    def snapshot(self) -> tuple[int, list[Layout]]:
        """The version and the layouts enrolled at that version."""
        with self._database.connection() as connection:
            connection.execute("BEGIN")
            version = self._version(connection)
            rows = connection.execute("SELECT name, definition FROM layout ORDER BY name").fetchall()
            connection.execute("COMMIT")
        return version, [self._decode(name, text) for name, text in rows]

    def add(self, layout: Layout, source: str, *, replace: bool = False) -> int:
        """Enroll a layout and return the new version.

        Raises RegistryError if the name is taken and `replace` is not set. Conflicts with similar layouts are
        checked by `tagid.enrolling.enrollment`, not here.
        """
        version = self.add_all([layout], source, replace=replace)
        assert version is not None
        return version

    def add_all(
        self,
        layouts: Sequence[Layout],
        source: str,
        *,
        replace: bool = True,
        since: int | None = None,
        signatures: Sequence[Signature] = (),
    ) -> int | None:
        """Enroll layouts, bodies and objects, all or none, and return the new version.

        An entry identical to the enrolled one does not change the version.

        Args:
            layouts: with unique names.
            source: origin of the entries, for the history.
            replace: whether they may replace entries of the same name.
            since: store only if this is still the version; otherwise do nothing and return None.
            signatures: with unique pairs of kind and name; that of an object has the name of its layout.

        Raises RegistryError if a name is taken and `replace` is not set, and UsageError for a label or notes
        that a spreadsheet would execute as a formula, or a name that is an answer already.
        """
        for layout in layouts:
            _check_label(layout)
        for name in (*(layout.name for layout in layouts), *(signature.name for signature in signatures)):
            _check_answer(name)
        new: dict[Key, str | bytes] = {
            ("layout", layout.name): json.dumps(layout.to_dict(), sort_keys=True) for layout in layouts
        }
        new |= {(signature.kind, signature.name): to_bytes(signature) for signature in signatures}
        with self._database.transaction() as connection:
            if since is not None and self._version(connection) != since:
                return None
            now = self._entries(connection)
            command = self._command(connection, source)
            for key, value in new.items():
                error = taken(key, now)
                if error is not None and not replace:
                    raise error
                if now.get(key) != value:
                    self._put(connection, key, value, command)
            return self._version(connection)

    def undo(self, to: int | None = None) -> Restored:
        """Undo the last command that changed the registry, or go back to a version; again, the one before it.

        Every command is one step, however many entries it changed. The steps back are changes themselves, so
        nothing is lost from the history. Raises RegistryError where there is nothing to undo, or no such
        version.
        """
        with self._database.transaction() as connection:
            last = self._version(connection)
            steps = _Steps.of(self._deeds(connection))
            if to is not None:
                if not 1 <= to < last:
                    raise RegistryError(
                        f"there is no version {to} to go back to, the registry is at version {last}",
                        "`tagid layouts --history` lists the versions.",
                    )
                return self._restore(connection, to, f"{_BACK}{to}", f"every change since version {to}")
            if not steps.undo or steps.undo[-1] < 1:
                raise RegistryError(
                    "there is nothing to undo: the registry holds what it started with",
                    "`tagid layouts --history` lists the changes.",
                )
            target = steps.undo[-1]
            return self._restore(connection, target, f"{_BACK}{target}", steps.made_by)

    def redo(self) -> Restored:
        """Take the last `undo` back. Raises RegistryError where nothing was undone since the last change."""
        with self._database.transaction() as connection:
            deeds = self._deeds(connection)
            steps = _Steps.of(deeds)
            if not steps.redo:
                raise RegistryError(
                    "there is nothing to redo: the last change was not an undo",
                    "`tagid layouts --history` lists the changes; `tagid layouts undo --to VERSION` restores "
                    "any version.",
                )
            target = steps.redo[-1]
            redone = dict(deeds).get(target, f"the changes up to version {target}")
            return self._restore(connection, target, f"{_FORWARD}{target}", redone)

    def _restore(self, connection: sqlite3.Connection, target: int, source: str, undone: str) -> Restored:
        """Make all entries what they were at a version, by new changes."""
        rows = connection.execute(
            "SELECT action, kind, name, definition, data FROM change WHERE version <= ? ORDER BY version",
            (target,),
        )
        then: dict[Key, str | bytes] = {}
        for action, kind, name, definition, data in rows:
            then.pop((kind, name), None)
            if action != "remove":
                value = definition if kind == "layout" else data
                self._entry((kind, name), value)
                then[kind, name] = value
        now = self._entries(connection)
        gone = sorted(now.keys() - then.keys())
        put = [key for key, value in sorted(then.items(), key=lambda item: item[0]) if now.get(key) != value]
        command = self._command(connection, source)
        for key in gone:
            self._take_out(connection, key, now[key], command)
        for key in put:
            self._put(connection, key, then[key], command)
        return Restored(
            self._version(connection),
            undone,
            removed=_names(gone),
            added=_names(key for key in put if key not in now),
            changed=_names(key for key in put if key in now),
        )

    @staticmethod
    def _deeds(connection: sqlite3.Connection) -> list[tuple[int, str]]:
        """(last version, source) of every command that changed something, oldest first."""
        rows = connection.execute("SELECT version, time_utc, source FROM change ORDER BY version")
        changes = [(int(version), (str(time), str(source))) for version, time, source in rows]
        ends = [
            i for i, (_, deed) in enumerate(changes) if i + 1 == len(changes) or changes[i + 1][1] != deed
        ]
        return [(changes[i][0], changes[i][1][1]) for i in ends]

    @staticmethod
    def _command(connection: sqlite3.Connection, source: str) -> _Command:
        """The identity of a new command."""
        last = connection.execute("SELECT time_utc FROM change ORDER BY version DESC LIMIT 1").fetchone()
        now = datetime.now(UTC)
        if last == (now.isoformat(timespec="microseconds"),):
            now += timedelta(microseconds=1)
        return now.isoformat(timespec="microseconds"), source

    def _entries(self, connection: sqlite3.Connection) -> dict[Key, str | bytes]:
        entries: dict[Key, str | bytes] = {
            ("layout", name): text for name, text in connection.execute("SELECT name, definition FROM layout")
        }
        rows = connection.execute("SELECT kind, name, data FROM signature")
        return entries | {(kind, name): data for kind, name, data in rows}

    @staticmethod
    def _version(connection: sqlite3.Connection) -> int:
        return int(connection.execute("SELECT COALESCE(MAX(version), 0) FROM change").fetchone()[0])

    def _put(self, connection: sqlite3.Connection, key: Key, value: str | bytes, command: _Command) -> None:
        kind, name = key
        where = "layout WHERE name = ?2" if kind == "layout" else "signature WHERE kind = ?1 AND name = ?2"
        enrolled = connection.execute(f"SELECT ?1 FROM {where}", (kind, name)).fetchone()
        version = self._log(connection, "replace" if enrolled else "add", key, command, value)
        if kind == "layout":
            connection.execute("INSERT OR REPLACE INTO layout VALUES (?, ?, ?)", (name, value, version))
        else:
            connection.execute(
                "INSERT OR REPLACE INTO signature VALUES (?, ?, ?, ?)", (kind, name, value, version)
            )

    def _take_out(
        self, connection: sqlite3.Connection, key: Key, value: str | bytes, command: _Command
    ) -> int:
        kind, name = key
        if kind == "layout":
            connection.execute("DELETE FROM layout WHERE name = ?", (name,))
        else:
            connection.execute("DELETE FROM signature WHERE kind = ? AND name = ?", key)
        return self._log(connection, "remove", key, command, value)

    def remove(self, name: str, source: str = "") -> int:
        """Remove an identity (layout and object signature) and return the new version; its history stays."""
        return self._remove([("layout", name), ("object", name)], source)

    def remove_signature(self, kind: SignatureKind, name: str, source: str = "") -> int:
        """Remove a body, or the signature of an object; the history stays. Returns the new version."""
        return self._remove([(kind, name)], source)

    def _remove(self, keys: Sequence[Key], source: str) -> int:
        version = None
        with self._database.transaction() as connection:
            now = self._entries(connection)
            command = self._command(connection, source)
            for key in keys:
                if key in now:
                    version = self._take_out(connection, key, now[key], command)
        if version is None:
            raise self._missing(keys[0][1], keys[0][0])
        return version

    def history(self, name: str | None = None) -> list[RegistryChange]:
        """Every change, or only those to entries called `name`, oldest first."""
        query = "SELECT version, time_utc, action, name, source, kind, definition, data FROM change"
        with self._database.connection() as connection:
            if name is None:
                rows = connection.execute(f"{query} ORDER BY version").fetchall()
            else:
                rows = connection.execute(f"{query} WHERE name = ? ORDER BY version", (name,)).fetchall()
            ends = [version for version, _ in self._deeds(connection)]
        changes = []
        for number, time_utc, action, named, source, kind, definition, data in rows:
            if not all(isinstance(text, str) for text in (time_utc, action, named, source, kind)):
                raise RegistryError(f"{self.path} holds a damaged change, version {number}", _SCHEMA.restore)
            command = ends[bisect_left(ends, number)]
            entry: Layout | Signature | None
            try:
                entry = self._entry((kind, named), definition if kind == "layout" else data)
            except RegistryError:
                entry = None
            changes.append(RegistryChange(number, time_utc, action, named, source, kind, entry, command))
        return changes

    def _fill(self, connection: sqlite3.Connection) -> None:
        """Start a new file with the built-in layouts."""
        command = self._command(connection, "built-in")
        for layout in builtin_layouts().values():
            text = json.dumps(layout.to_dict(), sort_keys=True)
            self._put(connection, ("layout", layout.name), text, command)

    @staticmethod
    def _log(
        connection: sqlite3.Connection, action: str, key: Key, command: _Command, value: str | bytes
    ) -> int:
        time, source = command
        kind, name = key
        text, data = (value, None) if kind == "layout" else ("", value)
        cursor = connection.execute(
            "INSERT INTO change (time_utc, action, name, source, definition, kind, data)"
            " VALUES (?, ?, ?, ?, ?, ?, ?)",
            (time, action, name, source, text, kind, data),
        )
        return int(cursor.lastrowid or 0)

    def _entry(self, key: Key, value: object) -> Layout | Signature:
        return self._decode(key[1], value) if key[0] == "layout" else self._signature(key, value)

    def _decode(self, name: str, text: object) -> Layout:
        try:
            if not isinstance(text, str) or len(text) > MAX_DEFINITION:
                raise ValueError("not a definition")
            layout = layout_from_dict(json.loads(text))
            if layout.name != name:
                raise ValueError(f"it belongs to {layout.name}")
            return layout
        except (ValueError, RecursionError, TagidError) as error:
            raise RegistryError(
                f"{self.path} holds a damaged definition of {str(name)[:80]!r}: {str(error)[:200]}",
                "Remove it with `tagid layouts remove NAME` (its history stays), go back with "
                "`tagid layouts undo --to VERSION`, or restore a backup.",
            ) from None

    def _signature(self, key: Key, data: object) -> Signature:
        kind, name = str(key[0])[:20], str(key[1])[:80]
        try:
            if not isinstance(data, bytes):
                raise ValueError("not a signature")
            signature = from_bytes(data, f"{kind} {name}")
            if (signature.kind, signature.name) != key:
                raise ValueError(f"it belongs to the {signature.kind} {signature.name}")
            return signature
        except (ValueError, TagidError) as error:
            group = "bodies" if kind == "body" else "layouts"
            raise RegistryError(
                f"{self.path} holds a damaged signature of the {kind} {name!r}: {str(error)[:200]}",
                f"Remove it with `tagid {group} remove NAME` (its history stays) and enroll it again, "
                "go back with `tagid layouts undo --to VERSION`, or restore a backup.",
            ) from None

    def _missing(self, name: str, kind: str = "layout") -> RegistryError:
        """The error for a name that no entry of this kind has; it says which kind has it, if one does."""
        with self._database.connection() as connection:
            entries = list(self._entries(connection))
        shown = name[:80]
        other = next((k for k in ("body", "object", "layout") if k != kind and (k, name) in entries), None)
        if other is not None:
            show, remove = _COMMANDS[other]
            return RegistryError(
                f"no {kind} is named {shown!r}, but {_article(other)} is",
                f"Show it with `{show.format(shown)}`, or remove it with `{remove.format(shown)}`.",
            )
        names = sorted(str(key[1])[:80] for key in entries if key[0] == kind)
        listed = ", ".join(names) or "none"
        return RegistryError(f"no {kind} is named {shown!r}", f"{meant(name, names)}Enrolled: {listed}.")


def taken(key: Key, entries: Collection[Key]) -> RegistryError | None:
    """The error if the name of a new entry is taken among the enrolled ones.

    A layout and an object of one name are the same identity, so that each takes the other's name.
    """
    kind, name = key
    kinds = ("body",) if kind == "body" else ("layout", "object")
    holder = next((other for other in kinds if (other, name) in entries), None)
    if holder is None:
        return None
    return RegistryError(
        f"{_article(holder)} named {name} is already enrolled",
        f"Choose another name, remove it with `{_COMMANDS[holder][1].format(name)}`, "
        "or replace it with `force`.",
    )


def _names(keys: Iterable[Key]) -> tuple[str, ...]:
    """Names of entries; an object and its layout have one."""
    return tuple(dict.fromkeys(name for _, name in keys))


def _article(kind: str) -> str:
    return "an object" if kind == "object" else f"a {kind}"


def _check_answer(name: str) -> None:
    """Raises UsageError for a reserved name, or an answer that names nothing: reports confuse the two."""
    if name in NO_NAMES:
        raise UsageError(f"{name!r} is what answers say when they name nothing", "Choose another name.")
    if name == TEST_CARD:
        raise UsageError(f"{name!r} is reserved for the test card of a rig", "Choose another name.")


def _check_label(layout: Layout) -> None:
    """Raises UsageError for a label or notes that a spreadsheet would execute."""
    for name in ("label", "notes"):
        if getattr(layout, name).lstrip().startswith(FORMULA_STARTS):
            raise UsageError(
                f"layout {layout.name}: the {name} begins with {getattr(layout, name).lstrip()[0]!r}",
                "Begin it with a letter or digit: spreadsheets execute such text as a formula.",
            )
