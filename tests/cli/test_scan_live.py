"""`tagid scan --live` on a terminal: the image forms in characters; and what --until-sure refuses."""

from __future__ import annotations

import json
import re
from pathlib import Path

from on_a_terminal import run


def test_the_image_forms_on_a_terminal_without_colours(home: dict[str, str], tmp_path: Path) -> None:
    words = [
        "scan", "--live", "--radar", "emulator://helmet-120?rpm=60&rate=1&seed=2", "--motion", "free?rpm=60",
        "--axis-distance", "1", "--method", "bp", "--save-dir", str(tmp_path / "out"), "--output", "json",
    ]  # fmt: skip
    drawn = run(home, words, (30, 90), TAGID_RADAR_INTEGRATION="15", NO_COLOR="1")
    text = drawn.sent.decode(errors="replace")
    assert drawn.code == 0, text[-2000:]
    document = json.loads(drawn.out)
    assert document["data"]["items"][0]["layout"] == "helmet-120"
    live = document["data"]["live"]
    assert live["frames"] >= 2 and live["answer_after_last_scan_s"] is not None
    assert (document["data"]["scans_lost"], document["data"]["scans_dropped"]) == (0, 0)
    assert "▀" not in text and not re.search(r"\x1b\[[\d;]*[34]8;", text), "no colours"
    screen = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", text)
    turned = [int(degrees) for degrees in re.findall(r"(\d+) of 360 deg", screen)]
    assert turned and max(turned) <= 360
    assert re.search(r"helmet-120 +#{24} ahead by \d+", screen), screen[-3000:]
    assert "x, mm" in screen and "range, m" in screen and "nats" not in screen
    kept = text[text.rindex("\x1b[?1049l") :]
    assert "HELMET-120" in kept and "x, mm" in kept, "the last frame stays"
    assert re.search(r"[-=+*#%@]{3}", screen), "the image is not drawn"


def test_what_cannot_end_early_is_refused_before_anything_moves(tagid, tmp_path: Path) -> None:
    for words, message in (
        (("--motion", "free"), "--until-sure needs the angle during the scan"),
        (("--motion", "free?rpm=12", "--repeat", "2"), "--until-sure cannot be combined with --repeat"),
    ):
        scan = ("scan", "--until-sure", "--radar", "emulator://helmet-120?rpm=12", "--axis-distance", 1)
        done = tagid(*scan, "--save-dir", "out", *words, "--output", "json")
        (error,) = done.json["errors"]
        assert done.code == 2 and message in error["message"] and error["remedy"]
    assert not list(tmp_path.glob("out/*"))
