"""Tags in rows on the command line: designed, drawn, and enrolled if the antennas resolve their heights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

ROWS = ("--radius", 0.1, "--radius", 0.1, "--height", 0.0, "--height", 0.06, "--slots", 8)
SEVERAL = "0,0.3,0.6"


def _write(path: Path, name: str, heights: str) -> None:
    positions = "[[0.1, 0.0], [-0.02, 0.08], [-0.05, -0.09]]"
    path.write_text(f'name = "{name}"\nkind = "other"\npositions_m = {positions}\nheights_m = {heights}\n')


def test_several_antenna_heights_make_room_for_more_layouts(tagid: Callable[..., Any]) -> None:
    plain = tagid("layouts", "design", *ROWS, "--count", 4, "--alone", "--output", "json").json["data"]
    words = ("--count", 4, "--alone", "--heights", SEVERAL, "--output", "json")
    tall = tagid("layouts", "design", *ROWS, *words).json["data"]
    assert tall["candidates"] > 2 * plain["candidates"]
    assert tall["distance_m"] > plain["distance_m"]
    for wrong in ("0,x", "0,nan"):
        assert tagid("layouts", "design", *ROWS, "--heights", wrong).code == 2


def test_a_twin_at_other_heights_is_enrolled_only_for_several_antenna_heights(
    tagid: Callable[..., Any], tmp_path: Path
) -> None:
    _write(tmp_path / "flat.toml", "flat", "[0.0, 0.0, 0.0]")
    _write(tmp_path / "tall.toml", "tall", "[0.0, 0.06, 0.0]")
    assert tagid("enroll", "--file", "flat.toml", "--yes").code == 0
    refused = tagid("enroll", "--file", "tall.toml", "--yes", "--output", "json")
    assert refused.code == 1
    assert refused.json["errors"][0]["code"] == "layout_conflict"
    assert tagid("config", "set", "motion.antenna_heights", SEVERAL).code == 0
    assert tagid("enroll", "--file", "tall.toml", "--yes").code == 0
    assert tagid("layouts", "check").code == 0
    drawn = tagid("layouts", "show", "tall", "--template", "t.svg")
    assert drawn.code == 0
    sheet = (tmp_path / "t.svg").read_text()
    assert "height 60.0" in sheet
    assert "A dashed outline is a reflector above the lowest row." in sheet
