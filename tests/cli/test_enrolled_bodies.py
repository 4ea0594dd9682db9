"""`tagid enroll --body`, signatures of objects, and `tagid bodies`, from the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tagid.storage.npz import encode_npz
from tests.unit.bodies_synthetic import MUG, PLACES, TAG, Thing, capture


def write(path: Path, thing: Thing, seed: int, centre: complex, rotation: float, views: int = 48) -> None:
    path.write_bytes(encode_npz(capture(thing, seed, centre=centre, rotation=rotation, views=views)))


@pytest.fixture
def files(tmp_path: Path) -> Path:
    for i, (centre, turn) in enumerate(PLACES):
        write(tmp_path / f"mug{i}.npz", MUG, i, centre, turn)
        write(tmp_path / f"tagged{i}.npz", MUG.plus(TAG), 10 + i, centre, turn)
    write(tmp_path / "seen.npz", MUG.plus(TAG), 30, 0.004 - 0.004j, 1.0, views=20)
    return tmp_path


def test_a_body_is_enrolled_listed_drawn_and_read_with(tagid, files: Path) -> None:
    mugs = [f"mug{i}.npz" for i in range(3)]
    looked = tagid("enroll", "--body", "mug", *mugs, "--dry-run", "--output", "json")
    assert looked.code == 0 and not looked.json["data"]["stored"]
    stored = tagid("enroll", "--body", "mug", *mugs, "--output", "json").json["data"]
    assert stored["stored"] and stored["registry_version"] == 5
    assert stored["signature"]["kind"] == "body"
    assert all(capture["residual_over_noise"] < 1.4 for capture in stored["signature"]["captures"])
    again = tagid("enroll", "--body", "mug", *mugs)
    assert again.code == 1 and "already enrolled" in again.err
    changed = tagid("enroll", "--body", "other", "mug0.npz", "tagged1.npz", "mug2.npz")
    assert changed.code == 1 and "tagged1.npz does not show" in changed.err
    few = tagid("enroll", "--body", "other", *mugs[:2])
    assert few.code == 1 and "needs 3" in few.err
    listed = tagid("bodies", "--output", "json").json["data"]["signatures"]
    assert [(item["kind"], item["name"]) for item in listed] == [("body", "mug")]
    shown = tagid("bodies", "show", "mug", "--png", "mug.png")
    assert shown.code == 0 and (files / "mug.png").read_bytes().startswith(b"\x89PNG")
    assert tagid("bodies", "show", "nobody").code == 1
    read = tagid("identify", "seen.npz", "-v")
    assert read.code == 0 and read.out.startswith("CONTAINER-90 ")
    assert "container-90 on the enrolled body mug, centre (4, -4) mm, 0.0 % unexplained\n" in read.out
    # Export, removal, import and undo.
    assert tagid("layouts", "export", "all.toml", "mug").code == 0
    assert tagid("bodies", "--remove", "mug").code == 0
    assert tagid("bodies", "--output", "json").json["data"]["signatures"] == []
    back = tagid("layouts", "import", "all.toml", "--output", "json").json["data"]
    assert back["changes"] == 1 and back["signatures"] == [{"kind": "body", "name": "mug"}]
    assert tagid("layouts", "undo").code == 0
    assert tagid("bodies", "--output", "json").json["data"]["signatures"] == []


def test_three_simulated_captures_of_one_object_are_enrolled(tagid) -> None:
    """As docs/simulation.md says: --seed alone also moves the handle relative to the tag."""
    cup = ("simulate", "container-90", "--body", "cup:40mm,handle", "--snr", 30, "--views", 48)

    def enrolled(*fixed: object) -> Any:
        for i in (1, 2, 3):
            how = f"--seed {i} --rotation {i}20 --centre 0.00{i},-0.003 --out {i}.tagid.h5".split()
            made = tagid(*cup, *fixed, *how, "--force", "--output", "json")
            assert made.code == 0, made.err
        words = ("enroll", "mug-7", *(f"{i}.tagid.h5" for i in (1, 2, 3)), "--dry-run", "--output", "json")
        return tagid(*words)

    same = enrolled("--object-seed", 7)
    assert same.code == 0, same.out
    assert all(capture["residual_over_noise"] < 1.4 for capture in same.json["data"]["signature"]["captures"])
    other = enrolled()
    assert other.code == 1 and "enrollment by signature: " in other.json["errors"][0]["message"]


@pytest.mark.parametrize(
    ("words", "missing"),
    [((), "a name and captures"), (("mug",), "captures"), (("--capture", "mug0.npz"), "a name")],
)
def test_a_body_without_a_name_or_captures(tagid, words: tuple[str, ...], missing: str) -> None:
    refused = tagid("enroll", "--body", *words)
    assert refused.code == 2 and f"--body without {missing}\n" in refused.err, refused.err


def test_an_object_whose_reflectors_are_hidden_is_enrolled_by_its_signature(tagid, files: Path) -> None:
    tagged = [f"tagged{i}.npz" for i in range(3)]
    stored = tagid("enroll", "mug-7", *tagged, "--label", "The blue one", "--output", "json")
    assert stored.code == 0, stored.out
    assert stored.json["data"]["layout"] is None
    assert any("cannot be seen" in message for message in stored.json["messages"])
    item = tagid("identify", "seen.npz", "--output", "json").json["data"]["items"][0]
    assert (item["layout"], item["label"], item["hypothesis"]) == ("mug-7", "The blue one", "object")
    # Listed by `tagid bodies`, it is no body: what shows it and what removes it is said.
    for words in (("show", "mug-7"), ("--remove", "mug-7")):
        (error,) = tagid("bodies", *words, "--output", "json").json["errors"]
        assert error["message"] == "no body is named 'mug-7', but an object is"
        assert "`tagid bodies show mug-7 --object`" in error["remedy"]
        assert "`tagid layouts remove mug-7`" in error["remedy"]
    assert tagid("bodies", "show", "mug-7", "--object").code == 0
    clash = tagid("enroll", "mug-8", *tagged, "--output", "json")
    assert clash.code == 1 and clash.json["errors"][0]["code"] == "layout_conflict"
    checked = tagid("bodies", "check", "--output", "json")
    assert checked.code == 0 and checked.json["data"]["pairs"] == []
    assert tagid("layouts", "--remove", "mug-7").code == 0
    assert tagid("bodies", "--output", "json").json["data"]["signatures"] == []
