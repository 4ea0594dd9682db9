"""`tagid identify --vote`: several recordings of one object, one item."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def test_recordings_of_one_object_give_one_answer(tagid: Callable[..., Any]) -> None:
    for seed in (1, 2):
        words = ("--views", 24, "--snr", 12, "--seed", seed, "--out", f"{seed}.tagid.h5")
        assert tagid("simulate", "helmet-120", *words).code == 0
    asked = tagid("identify", "--vote", "1.tagid.h5", "2.tagid.h5", "--output", "json")
    (item,) = asked.json["data"]["items"]
    assert asked.code == 0 and (item["status"], item["layout"]) == ("identified", "helmet-120")
    assert [vote["file"] for vote in item["votes"]] == ["1.tagid.h5", "2.tagid.h5"]
    wrong = tagid("identify", "--vote", "1.tagid.h5", "none.tagid.h5", "--output", "json")
    assert wrong.code == 1 and "none.tagid.h5" in wrong.json["errors"][0]["message"]
    assert tagid("scan", "--demo", "--repeat", 0).code == 2
