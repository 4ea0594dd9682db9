"""Machine-readable report files: one row, line or test case per capture.

Each is written in pieces from a stream of records, in constant memory.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TextIO
from xml.sax.saxutils import escape, quoteattr

from tagid.files import replacing_text
from tagid.report.records import CAVEATS, ItemRecord
from tagid.storage.spreadsheet import cell

STAGES = ("load", "prepare", "preprocess", "read", "pictures")
CSV_COLUMNS = (
    "file", "status", "layout", "label", "score", "margin", "rotation_deg", "centre_x_m", "centre_y_m",
    "reflectors", "missing", "extra", "expected", "correct", "reason", "error_code", "error_remedy",
    "capture_uuid", "content_sha256", "size_bytes", "tool_version", "registry_version",
    *(f"{stage}_s" for stage in STAGES), "total_s", "time_utc",
    "coverage", "bound_p_value", "caveats", "note", "cause", "what_to_do", "recorded_utc", "recording_note",
    "copy_of",
)  # fmt: skip
"""Columns of items.csv; names include units, and new ones come last."""
# Characters not allowed in XML 1.0, even escaped (section 2.2).
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def _cells(record: ItemRecord) -> list[object]:
    """A record's values of `CSV_COLUMNS`; unknown ones are None."""
    x, y = record.document["centre_m"] or (None, None)
    seconds = record.document["seconds"]
    derived = {
        "centre_x_m": x,
        "centre_y_m": y,
        "reflectors": len(record.document["reflectors"]),
        "error_code": record.error.get("code"),
        "error_remedy": record.error.get("remedy"),
        "total_s": record.total_s,
        **{f"{stage}_s": seconds.get(stage) for stage in STAGES},
        "bound_p_value": record.p_value,
        "caveats": "; ".join(CAVEATS[name] for name in record.caveats),
        "note": record.note,
        "cause": "; ".join(cause["text"] for cause in record.causes),
        "what_to_do": " ".join(record.what_to_do),
    }
    return [derived[name] if name in derived else record.document.get(name) for name in CSV_COLUMNS]


def write_csv(path: Path, records: Iterable[ItemRecord]) -> None:
    """items.csv: UTF-8, RFC 4180, cells as `spreadsheet.cell` makes them.

    Raises StorageError, DiskFullError.
    """
    with replacing_text(path) as file:
        table = csv.writer(file)
        table.writerow(CSV_COLUMNS)
        for record in records:
            table.writerow([cell(value) for value in _cells(record)])


def write_jsonl(path: Path, records: Iterable[ItemRecord]) -> None:
    """items.jsonl: one JSON document per line. Raises StorageError, DiskFullError."""
    with replacing_text(path) as file:
        for record in records:
            file.write(record.to_json() + "\n")


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """One indented JSON document. Raises StorageError, DiskFullError."""
    with replacing_text(path) as file:
        file.write(json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_junit(path: Path, records: Iterable[ItemRecord], summary: Mapping[str, Any]) -> None:
    """junit.xml: one test case per capture, after the JUnit and Jenkins schema.

    A capture passes if the answer matches the manifest or, without one, if it is identified. An
    item that failed is an error. What qualifies the answer is the output of its test case.

    Raises StorageError, DiskFullError.
    """
    counts = summary["junit"]
    attributes = (
        f'name="tagid report" tests="{counts["tests"]}" failures="{counts["failures"]}" '
        f'errors="{counts["errors"]}" skipped="0" time="{summary["seconds"]["items_s"]:.3f}"'
    )
    with replacing_text(path) as file:
        file.write('<?xml version="1.0" encoding="UTF-8"?>\n')
        file.write(f"<testsuites {attributes}>\n")
        file.write(f"<testsuite {attributes} timestamp={_quoted(summary['started_utc'][:19])}>\n")
        for record in records:
            _case(file, record)
        file.write("</testsuite>\n</testsuites>\n")


def _case(file: TextIO, record: ItemRecord) -> None:
    file.write(f'<testcase classname="tagid" name={_quoted(record.file)} time="{record.total_s:.4f}"')
    lines = [f"{name}: {text}" for name, text in record.explained()]
    verdict = record.verdict()
    if verdict is None and not lines:
        file.write("/>\n")
        return
    file.write(">")
    if verdict is not None:
        code = record.error.get("code", record.status)
        file.write(f"<{verdict.kind} type={_quoted(code)} message={_quoted(verdict.reason)}/>")
    if lines:
        file.write(f"<system-out>{escape(_allowed(chr(10).join(lines)))}</system-out>")
    file.write("</testcase>\n")


def _quoted(text: str) -> str:
    return quoteattr(_allowed(text), {"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"})


def _allowed(text: str) -> str:
    return _NOT_XML.sub("\ufffd", text)
