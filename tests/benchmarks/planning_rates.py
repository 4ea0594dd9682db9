"""Write `tagid/planning/rates.json`, the measured rates of the reader that `tagid plan` interpolates.

It reads the published tables of docs/results, so that plan and pages never differ:

    python tests/benchmarks/planning_rates.py

Run it again whenever one of the tables is measured anew.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"
OUT = ROOT / "tagid" / "planning" / "rates.json"
BARE = (RESULTS / "identification.md", "The paper's four layouts")
BODIES = RESULTS / "reader-bodies-after.md"
MODES = {"bodies": "Our simulator, blind", "enrolled": "Our simulator, enrolled"}
BODY_VIEWS = 36


def section(page: str, heading: str) -> str:
    match = re.search(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", page, re.M | re.S)
    if match is None:
        raise SystemExit(f"there is no section {heading!r}")
    return match[1]


def tables(text: str) -> list[list[dict[str, str]]]:
    """Every Markdown table of a text, a dict per row."""
    found = []
    for block in re.findall(r"(?:^\|.*\|\n)+", text + "\n", re.M):
        rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in block.strip().split("\n")]
        found.append([dict(zip(rows[0], row, strict=True)) for row in rows[2:]])
    return found


def count(cell: str, scenes: int) -> int:
    """Scenes behind a rate such as '97.5 (87.1..99.6)'."""
    return round(float(cell.split()[0]) / 100 * scenes)


def row(entry: dict[str, str], body: str, views: int, enrolled: bool = False) -> dict[str, Any]:
    scenes = int(entry["scenes"])
    named, wrong = count(entry["correct"], scenes), count(entry["wrong"], scenes)
    return {
        "body": body,
        "views": views,
        "snr_db": float(entry["SNR dB"]),
        "scenes": scenes,
        "named": named,
        "wrong": wrong,
        "enrolled": enrolled,
    }


def main() -> None:
    rows: list[dict[str, Any]] = []
    path, heading = BARE
    page = path.read_text()
    sources = {"none": source(path, heading, page)}
    for table in tables(section(page, heading)):
        if {"views", "SNR dB", "correct"} <= set(table[0]):
            rows += [row(entry, "none", int(entry["views"])) for entry in table]
    page = BODIES.read_text()
    for mode, heading in MODES.items():
        sources[mode] = source(BODIES, heading, page)
        for table in tables(section(page, heading)):
            if {"body", "SNR dB", "correct"} <= set(table[0]) and "enrolled" not in table[0]:
                kept = [entry for entry in table if entry["body"] != "none"]
                rows += [row(entry, entry["body"], BODY_VIEWS, mode == "enrolled") for entry in kept]
    OUT.write_text(json.dumps({"format": 1, "sources": sources, "rows": rows}, indent=1) + "\n")
    print(f"{len(rows)} rows in {OUT.relative_to(ROOT)}")


def source(path: Path, heading: str, page: str) -> str:
    commit = re.search(r"Commit: (\w{7,40})", page)
    return f"docs/results/{path.name}, {heading}" + (f", commit {commit[1]}" if commit else "")


if __name__ == "__main__":
    main()
