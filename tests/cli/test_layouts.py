"""`tagid layouts` as a user meets it: design, enrol, draw, exchange, check, undo, and mistakes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any


def test_from_a_design_to_a_checked_registry(tagid: Callable[..., Any], tmp_path: Path) -> None:
    words = ("--object", "helmet", "--reflectors", 3, "--slots", 12, "--count", 10)
    made = tagid("layouts", "design", *words, "--out", "family.toml", "--output", "json")
    data = made.json["data"]
    assert made.code == 0 and len(data["layouts"]) == 10 and data["distance_m"] > 0.02
    assert tagid("layouts", "import", "family.toml").code == 0
    checked = tagid("layouts", "check", "--output", "json").json["data"]
    assert checked["layouts"] == 14 and checked["pairs"][0]["rms_m"] > 0.012
    first = data["layouts"][0]["name"]
    shown = tagid("layouts", "show", first, "--template", "t.pdf", "--svg", "p.svg", "--output", "json")
    assert shown.code == 0 and (tmp_path / "t.pdf").read_bytes().startswith(b"%PDF")
    assert tagid("layouts", "export", "again.toml", first).code == 0
    assert first in (tmp_path / "again.toml").read_text()
    assert tagid("layouts", "undo", "--output", "json").json["data"]["layouts"] == [
        "container-180",
        "container-90",
        "helmet-120",
        "helmet-linear",
    ]


def test_mistakes_change_nothing(tagid: Callable[..., Any], tmp_path: Path) -> None:
    too_many = tagid("layouts", "design", "--count", 30, "--enroll", "--output", "json")
    assert too_many.code == 2 and "room for 18" in too_many.json["errors"][0]["message"]
    (tmp_path / "bad.toml").write_text(
        'format = "tagid.layouts"\nversion = 1\n[[layout]]\nname = "fine"\n'
        "positions_m = [[0.1, 0.0], [0.0, 0.05]]\n[[layout]]\n"
        'name = "twin"\npositions_m = [[0.1, 0.0], [0.1, 0.0]]\n'
    )
    refused = tagid("layouts", "import", "bad.toml", "--output", "json")
    assert refused.code != 0 and "layout 2" in refused.json["errors"][0]["message"]
    assert tagid("layouts", "--output", "json").json["data"]["registry_version"] == 4
    assert tagid("layouts", "show", "helmet-120", "--template", "t.docx").code == 2
    assert not (tmp_path / "t.docx").exists()
