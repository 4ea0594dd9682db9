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


def test_a_scan_says_why_it_ended_and_so_does_show(tagid, tmp_path: Path) -> None:
    """On a slow computer the turn may be over before a look is; both ends are right, and are told apart."""
    done = tagid(
        "scan", "--until-sure", "--radar", RADAR, "--motion", "free?rpm=12", "--axis-distance", "1",
        "--method", "bp", "--save-dir", "out", "--output", "json",
    )  # fmt: skip
    assert done.code == 0, done.err
    data = done.json["data"]
    assert data["items"][0]["layout"] == "helmet-120"
    ended, bound = data["ended"], data["items"][0]["bound"]
    if ended["reason"] == "sure":
        assert ended["layout"] == "helmet-120" and ended["share"] < 1
        assert bound["p_value"] == ended["p_value"] <= 5e-4 and bound["calibration_objects"] == ended["turns"]
        assert not any("degrees" in message for message in done.json["messages"])
    else:
        assert ended == {"reason": "turn", "spent": 0.3} and data["motion"]["turns"] > 1
    shown = tagid("show", data["files"]["capture"], "--output", "json").json["data"]
    assert shown["ended"] == ended
    text = tagid("show", data["files"]["capture"]).out
    assert "ended" in text and ("was certain" in text or "the turn was complete" in text)
