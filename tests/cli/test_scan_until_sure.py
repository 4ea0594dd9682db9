"""`tagid scan --until-sure`: what it refuses, what it prints, and what `show` says of its capture."""

from __future__ import annotations

from pathlib import Path

RADAR = "emulator://helmet-120?rpm=12&rate=1&seed=2"


def test_what_cannot_end_early_is_refused_before_anything_moves(tagid, tmp_path: Path) -> None:
    for words, message in (
        (("--motion", "free"), "--until-sure needs the angle during the scan"),
        (("--motion", "free?rpm=12", "--repeat", "2"), "--until-sure cannot be combined with --repeat"),
    ):
        done = tagid(
            "scan", "--until-sure", "--radar", RADAR, "--axis-distance", "1", "--save-dir", "out", *words,
            "--output", "json",
        )  # fmt: skip
        (error,) = done.json["errors"]
        assert done.code == 2 and message in error["message"] and error["remedy"]
    assert not list(tmp_path.glob("out/*"))
