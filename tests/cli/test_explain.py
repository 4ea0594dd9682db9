"""`tagid identify`: with --explain the hypotheses that competed, as bars; with --vote one item of several."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image


def simulated(tagid, seed: int) -> str:
    name = f"{seed}.tagid.h5"
    words = ("--views", 24, "--snr", 12, "--seed", seed, "--out", name)
    assert tagid("simulate", "helmet-120", *words).code == 0
    return name


def test_recordings_of_one_object_give_one_answer(tagid) -> None:
    files = [simulated(tagid, seed) for seed in (1, 2)]
    asked = tagid("identify", "--vote", *files, "--output", "json")
    (item,) = asked.json["data"]["items"]
    assert asked.code == 0 and (item["status"], item["layout"]) == ("identified", "helmet-120")
    assert [vote["file"] for vote in item["votes"]] == files
    wrong = tagid("identify", "--vote", files[0], "none.tagid.h5", "--output", "json")
    assert wrong.code == 1 and "none.tagid.h5" in wrong.json["errors"][0]["message"]
    assert tagid("scan", "--demo", "--repeat", 0).code == 2


def test_bars_say_how_far_behind_the_others_are(
    tagid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    words = ("identify", simulated(tagid, 1))
    assert "behind" not in tagid(*words).out
    (item,) = tagid(*words, "--output", "json").json["data"]["items"]
    rows = item["hypotheses"]
    shown = tagid(*words, "--explain").out.partition("the |):\n")[2].splitlines()
    assert len(shown) == len(rows) > 2
    for line, row in zip(shown, rows, strict=True):
        behind, bar, rest = re.fullmatch(r" *([0-9.]+) ([#|+]*) *(.*)", line.rstrip()).groups()  # type: ignore[union-attr]
        assert float(behind) == pytest.approx(-row["log_evidence"], abs=0.051)
        assert rest.startswith(row["words"]) and rest.endswith("% unexplained")
        assert len(bar) == min(round(-row["log_evidence"]), 20) + (-row["log_evidence"] > 20)
        assert ("|" in bar) == (len(bar) > round(item["lead_needed"]))
    # The rows beside the named one are other tags: the best of them says the lead.
    others = [row for row in rows if row["layout"] != "helmet-120"]
    assert min(-row["log_evidence"] for row in others) == pytest.approx(item["lead"], abs=0.01)
    assert tagid(*words, "--explain", "--png", "p.png").code == 0
    with Image.open(tmp_path / "p.left.png") as picture:
        # The recording, and what the first four hypotheses leave of it.
        assert picture.size == (940, 60 + 5 * 220 + 30)
        shades = np.asarray(picture.convert("L"), dtype=float)[:, 110:810]
    recorded, best = (shades[60 + 220 * i : 210 + 220 * i].max() for i in (0, 1))
    assert recorded > best
