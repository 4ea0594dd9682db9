"""Expected answers from a manifest, compared with the actual ones: accuracy, confusion, misses.

A manifest that names missing files is rejected before the run starts, because the accuracy would be
meaningless.
"""

from __future__ import annotations

import csv
import io
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tagid import files
from tagid.batch.inputs import Source, is_url
from tagid.errors import UsageError, displayable
from tagid.proportion import wilson
from tagid.report.records import ItemRecord
from tagid.result import NO_NAMES

MAX_BYTES = 64 << 20
NO_LAYOUT = tuple(answer for answer in NO_NAMES if answer != "failed")
"""Answers that can be expected instead of a layout."""
_WANTED = "Write lines of file,expected_layout; of an object without a tag file,no_tag."
_FILE_HEADS = ("file", "path", "filename", "name")
_LAYOUT_HEADS = ("expected_layout", "expected layout", "expected", "layout")


@dataclass(frozen=True)
class Expectations:
    """The manifest: expected answer for the location of each file."""

    path: str
    by_location: Mapping[str, str]


def read_manifest(
    path: Path, sources: Sequence[Source], layouts: Iterable[str], *, may_come: bool = False
) -> Expectations:
    """Read a manifest: CSV with the columns `file` and `expected_layout` (without a header: the first two).

    A file is named as in the report, by a path relative to the manifest's or the current folder, or by its
    file name if that is unique among the inputs.

    Args:
        layouts: enrolled names; `no_tag`, `unknown` and `ambiguous` may be expected, too.
        may_come: whether files may be missing because they can still arrive (a watched folder).

    Raises:
        StorageError: the manifest cannot be read.
        FileFormatError: it is larger than 64 MiB.
        UsageError: it is not a table, or names unknown layouts, a file twice, or one not among the inputs.
    """
    rows = _rows(path)
    known = {*layouts, *NO_LAYOUT}
    finder = _Finder(path, sources)
    by_location: dict[str, str] = {}
    missing, strange, doubled = [], [], []
    for line, name, layout in rows:
        if layout not in known:
            strange.append(f"line {line}: {layout!r}")
        location = finder.find(name)
        if location is None:
            missing.append(f"line {line}: {name}")
            if not may_come:
                continue
            location = finder.later(name)
        if by_location.setdefault(location, layout) != layout:
            doubled.append(f"line {line}: {name}")
    names = ", ".join(sorted(known))
    for offending, what, remedy in (
        (strange, "names layouts that are not enrolled", f"Known are {names}."),
        ([] if may_come else missing, "names files that are not among the inputs",
         "Correct the names, give the folder that contains them, or delete the lines."),
        (doubled, "expects different answers for one file", "Keep one line per file."),
    ):  # fmt: skip
        if offending:
            more = f" and {len(offending) - 5} more" if len(offending) > 5 else ""
            raise UsageError(f"{path} {what}: {'; '.join(offending[:5])}{more}", remedy)
    return Expectations(displayable(str(path)), by_location)


def _rows(path: Path) -> list[tuple[int, str, str]]:
    """(line, file, layout) of a manifest."""
    raw = files.read_bytes(path, MAX_BYTES)
    try:
        # Names that are not UTF-8 keep the operating system's bytes.
        text = raw.decode("utf-8-sig", "surrogateescape")
        first = text.partition("\n")[0]
        separator = ";" if first.count(";") > first.count(",") else ","
        table = [
            (i, row) for i, row in enumerate(csv.reader(io.StringIO(text), delimiter=separator), 1) if row
        ]
    except csv.Error as error:
        raise UsageError(f"{path} is not a CSV table: {error}", _WANTED) from None
    if not table:
        raise UsageError(f"{path} is empty", _WANTED)
    heads = [cell.strip().lower() for cell in table[0][1]]
    file_at = next((heads.index(name) for name in _FILE_HEADS if name in heads), None)
    layout_at = next((heads.index(name) for name in _LAYOUT_HEADS if name in heads), None)
    if file_at is not None and layout_at is not None:
        table = table[1:]
    else:
        file_at, layout_at = 0, 1
    rows = []
    for line, row in table:
        if len(row) <= max(file_at, layout_at) or not row[file_at].strip() or not row[layout_at].strip():
            raise UsageError(f"{path}, line {line}: a file and its expected layout are needed", _WANTED)
        rows.append((line, row[file_at].strip(), row[layout_at].strip()))
    return rows


class _Finder:
    def __init__(self, manifest: Path, sources: Sequence[Source]) -> None:
        self._folders = (manifest.absolute().parent, Path.cwd())
        self._locations = {source.location for source in sources}
        self._by_name: dict[str, list[str]] = {}
        for source in sources:
            self._by_name.setdefault(source.location.rpartition("/")[2], []).append(source.location)

    def find(self, name: str) -> str | None:
        if name in self._locations:
            return name
        if not is_url(name):
            for folder in self._folders:
                place = os.path.normpath(folder / name)
                if place in self._locations:
                    return place
        alike = self._by_name.get(name, [])
        return alike[0] if len(alike) == 1 else None

    def later(self, name: str) -> str:
        """Location of an expected file that does not exist yet."""
        return name if is_url(name) else os.path.normpath(self._folders[0] / name)


@dataclass
class Comparison:
    """Running comparison of answers with expectations.

    Attributes:
        counts: number of items by (expected, answer).
        misses: file, expected and given answer, and its reason, of the items with another answer.
        not_expected: number of items that the manifest does not name.
    """

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    misses: list[dict[str, str]] = field(default_factory=list)
    not_expected: int = 0
    _seen: set[tuple[str, str, str]] = field(default_factory=set)

    def add(self, record: ItemRecord) -> None:
        """Count one judged record; a copy only if another answer is expected of it."""
        if record.expected is None:
            self.not_expected += record.copy_of is None
            return
        if record.content_sha256 is not None:
            content = record.content_sha256, record.expected, record.answer
            if content in self._seen:
                return
            self._seen.add(content)
        self.counts[record.expected, record.answer] += 1
        if not record.correct:
            self.misses.append(
                {
                    "file": record.file,
                    "expected": record.expected,
                    "answer": record.answer,
                    "reason": record.reason,
                }
            )

    def to_dict(self) -> dict[str, Any]:
        """Accuracy with its 95 % interval (Wilson 1927), confusion matrix and misses, plain JSON values."""
        total = self.counts.total()
        hits = sum(count for (expected, answer), count in self.counts.items() if expected == answer)
        interval = wilson(hits / total if total else 0.0, total)
        rows = sorted({expected for expected, _ in self.counts})
        columns = sorted({answer for _, answer in self.counts} | set(rows), key=_names_first)
        return {
            "items": total,
            "correct": hits,
            "accuracy": hits / total if total else None,
            "accuracy_low": interval.low,
            "accuracy_high": interval.high,
            "not_in_manifest": self.not_expected,
            "confusion": {
                "expected": rows,
                "answers": columns,
                "counts": [[self.counts[row, column] for column in columns] for row in rows],
            },
            "misses": self.misses,
        }


def _names_first(answer: str) -> tuple[bool, str]:
    return answer in NO_NAMES, answer
