"""`tagid identify --explain`: the hypotheses that competed, as bars."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image


def test_bars_say_how_far_behind_the_others_are(
    tagid: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    words = ("--views", 24, "--snr", 12, "--seed", 1, "--out", "1.tagid.h5")
    assert tagid("simulate", "helmet-120", *words).code == 0
    plain, item = (tagid("identify", "1.tagid.h5", *more) for more in ((), ("--output", "json")))
    assert "behind" not in plain.out
    rows = item.json["data"]["items"][0]["hypotheses"]
    shown = tagid("identify", "1.tagid.h5", "--explain").out.partition("the |):\n")[2].splitlines()
    assert len(shown) == len(rows) > 2
    needed = item.json["data"]["items"][0]["lead_needed"]
    for line, row in zip(shown, rows, strict=True):
        behind, bar, rest = re.fullmatch(r" *([0-9.]+) ([#|+]*) *(.*)", line.rstrip()).groups()  # type: ignore[union-attr]
        assert float(behind) == pytest.approx(-row["log_evidence"], abs=0.051)
        assert rest.startswith(row["words"]) and rest.endswith("% unexplained")
        assert len(bar) == min(round(-row["log_evidence"]), 20) + (-row["log_evidence"] > 20)
        assert ("|" in bar) == (len(bar) > round(needed))
    # The rows beside the named one are other tags: the best of them says the lead.
    others = [row for row in rows if row["layout"] != "helmet-120"]
    lead = item.json["data"]["items"][0]["lead"]
    assert min(-row["log_evidence"] for row in others) == pytest.approx(lead, abs=0.01)
    drawn = tagid("identify", "1.tagid.h5", "--explain", "--png", "p.png")
    assert drawn.code == 0
    with Image.open(tmp_path / "p.left.png") as picture:
        # The recording, and what the first four hypotheses leave of it.
        assert picture.size == (940, 60 + 5 * 220 + 30)
        shades = np.asarray(picture.convert("L"), dtype=float)[:, 110:810]
    recorded, best = (shades[60 + 220 * i : 210 + 220 * i].max() for i in (0, 1))
    assert recorded > best
