"""Machine-readable report files: one row, line or test case per object.

Each is written in pieces from a stream of records, in constant memory.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TextIO
from xml.sax.saxutils import quoteattr

from tagid.files import replacing_text
from tagid.storage.spreadsheet import cell

Record = Mapping[str, Any]

STAGES = ("load", "prepare", "preprocess", "read", "pictures")
CSV_COLUMNS = (
    "file", "status", "layout", "label", "score", "margin", "rotation_deg", "centre_x_m", "centre_y_m",
    "reflectors", "missing", "extra", "expected", "correct", "reason", "error_code", "error_remedy",
    "capture_uuid", "content_sha256", "size_bytes", "tool_version", "model_sha256", "registry_version",
    *(f"{stage}_s" for stage in STAGES), "total_s", "time_utc",
)  # fmt: skip
"""Columns of items.csv; names include units."""
# Characters not allowed in XML 1.0, even escaped (section 2.2).
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def total_s(record: Record) -> float:
    """Seconds of all stages of an item."""
    return round(float(sum(record["seconds"].values())), 4)


def row_of(record: Record) -> dict[str, Any]:
    """A record as one flat row with `CSV_COLUMNS`; unknown values are None."""
    centre = record["centre_m"] or (None, None)
    error = record["error"] or {}
    own = {
        "centre_x_m": centre[0],
        "centre_y_m": centre[1],
        "reflectors": len(record["reflectors"]),
        "error_code": error.get("code"),
        "error_remedy": error.get("remedy"),
        "total_s": total_s(record),
        **{f"{stage}_s": record["seconds"].get(stage) for stage in STAGES},
    }
    return {name: own[name] if name in own else record.get(name) for name in CSV_COLUMNS}


def write_csv(path: Path, records: Iterable[Record]) -> None:
    """items.csv: UTF-8, RFC 4180, cells as `spreadsheet.cell` makes them.

    Raises StorageError, DiskFullError.
    """
    with replacing_text(path) as file:
        table = csv.writer(file)
        table.writerow(CSV_COLUMNS)
        for record in records:
            table.writerow([cell(value) for value in row_of(record).values()])


def line_of(record: Record) -> str:
    """A record as a line of items.jsonl."""
    return json.dumps(record, allow_nan=False) + "\n"


def write_jsonl(path: Path, records: Iterable[Record]) -> None:
    """items.jsonl: one JSON document per line. Raises StorageError, DiskFullError."""
    with replacing_text(path) as file:
        for record in records:
            file.write(line_of(record))


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """One indented JSON document. Raises StorageError, DiskFullError."""
    with replacing_text(path) as file:
        file.write(json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_junit(path: Path, records: Iterable[Record], summary: Mapping[str, Any]) -> None:
    """junit.xml: one test case per object, after the JUnit and Jenkins schema.

    An object passes if the answer matches the manifest or, without one, if it is identified. An
    item that failed is an error.

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


def verdict(record: Record) -> tuple[str, str] | None:
    """("error" or "failure", reason) of an item; None if it passes."""
    if record["status"] == "failed":
        return "error", record["reason"]
    expected = record.get("expected")
    if expected is None:
        return (
            None
            if record["status"] == "identified"
            else ("failure", f"{record['status']}: {record['reason']}")
        )
    if record["correct"]:
        return None
    answer = record["layout"] if record["status"] == "identified" else record["status"]
    reason = f" ({record['reason']})" if record["reason"] else ""
    return "failure", f"expected {expected}, found {answer}{reason}"


def _case(file: TextIO, record: Record) -> None:
    file.write(f'<testcase classname="tagid" name={_quoted(record["file"])} time="{total_s(record):.4f}"')
    found = verdict(record)
    if found is None:
        file.write("/>\n")
        return
    kind, why = found
    code = str((record["error"] or {}).get("code", record["status"]))
    file.write(f"><{kind} type={_quoted(code)} message={_quoted(why)}/></testcase>\n")


def _quoted(text: str) -> str:
    return quoteattr(_NOT_XML.sub("\ufffd", text), {"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"})
