"""Totals over all items of a report, counted one record at a time so that none has to be kept in memory.

The page's header, summary.json and the exit code are all derived from them.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from tagid.batch.expected import Comparison
from tagid.errors import EXIT_BATCH, EXIT_OK, EXIT_UNCERTAIN
from tagid.report.records import CAVEATS, ItemRecord
from tagid.storage.history import STATUSES

SUMMARY_VERSION = 1


@dataclass
class Tally:
    """Counts over the records of a report.

    Attributes:
        repeated: number of those that are copies of another one; `status`, `layout` and `caveats` count
            without them.
        status, layout, caveats: number of captures per status, per layout and per caveat.
        verdicts: number of test cases with a "failure" or an "error".
        items_s: processing time of all items, s.
        comparison: comparison with the manifest; None without one.
        copies: file and sha256 of its content, by the UUID of the capture.
    """

    items: int = 0
    repeated: int = 0
    status: Counter[str] = field(default_factory=Counter)
    caveats: Counter[str] = field(default_factory=Counter)
    layout: Counter[str] = field(default_factory=Counter)
    verdicts: Counter[str] = field(default_factory=Counter)
    items_s: float = 0.0
    comparison: Comparison | None = None
    copies: dict[str, list[tuple[str, str | None]]] = field(default_factory=dict)

    def add(self, record: ItemRecord) -> None:
        self.items += 1
        if record.copy_of is None:
            self.status[record.status] += 1
            self.caveats.update(record.caveats)
            if record.status == "identified":
                self.layout[record.answer] += 1
        else:
            self.repeated += 1
        verdict = record.verdict()
        if verdict:
            self.verdicts[verdict.kind] += 1
        self.items_s += record.total_s
        if self.comparison is not None:
            self.comparison.add(record)
        if record.capture_uuid:
            copy = record.file, record.content_sha256
            self.copies.setdefault(record.capture_uuid, []).append(copy)

    def duplicates(self) -> list[dict[str, Any]]:
        """Captures found in several files: copies, or different scans with the same UUID."""
        return [
            {
                "capture_uuid": uuid,
                "files": [file for file, _ in copies],
                "same_content": len({content for _, content in copies}) == 1,
            }
            for uuid, copies in self.copies.items()
            if len(copies) > 1
        ]

    def exit_code(self) -> int:
        """5 if items failed, 3 if an answer is not a name or not the expected one, else 0."""
        if self.status["failed"]:
            return EXIT_BATCH
        missed = self.comparison is not None and bool(self.comparison.misses)
        return EXIT_OK if self.status["identified"] == self.captures and not missed else EXIT_UNCERTAIN

    @property
    def captures(self) -> int:
        """Number of records without copies."""
        return self.items - self.repeated

    def to_dict(self) -> dict[str, Any]:
        """The totals' part of summary.json."""
        return {
            "items": self.items,
            "captures": self.captures,
            "copies": self.repeated,
            "by_status": {status: self.status[status] for status in STATUSES},
            "by_layout": dict(sorted(self.layout.items())),
            "caveats": {name: self.caveats[name] for name in CAVEATS},
            "expected": None if self.comparison is None else self.comparison.to_dict(),
            "duplicate_uuids": self.duplicates(),
            "junit": {
                "tests": self.items,
                "failures": self.verdicts["failure"],
                "errors": self.verdicts["error"],
            },
        }
