"""`tagid layouts` as a user meets it: design, enroll, draw, exchange, check, undo, rows, and mistakes."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from on_a_terminal import answering, run

POINTS = ("--point", "0.1,0", "--point", "-0.05,0.03", "--point", "0.02,-0.09")
ROWS = ("--radius", 0.1, "--radius", 0.1, "--height", 0.0, "--height", 0.06, "--slots", 8)
SEVERAL = "0,0.3,0.6"


def test_from_a_design_to_a_checked_registry(tagid, tmp_path: Path) -> None:
    words = ("--object", "helmet", "--reflectors", 3, "--slots", 12, "--count", 4)
    made = tagid("layouts", "design", *words, "--out", "family.toml", "--output", "json")
    data = made.json["data"]
    assert made.code == 0 and len(data["layouts"]) == 4 and data["distance_m"] > 0.02
    assert tagid("layouts", "import", "family.toml").code == 0
    checked = tagid("layouts", "check", "--output", "json").json["data"]
    assert checked["layouts"] == 8 and checked["pairs"][0]["rms_m"] > 0.012
    first = data["layouts"][0]["name"]
    shown = tagid("layouts", "show", first, "--template", "t.pdf", "--svg", "p.svg", "--output", "json")
    assert shown.code == 0 and (tmp_path / "t.pdf").read_bytes().startswith(b"%PDF")
    assert tagid("layouts", "export", "again.toml", first).code == 0
    assert first in (tmp_path / "again.toml").read_text()
    left = tagid("layouts", "undo", "--output", "json").json["data"]["layouts"]
    assert left == ["container-180", "container-90", "helmet-120", "helmet-linear"]


def test_mistakes_change_nothing(tagid, tmp_path: Path) -> None:
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


def test_neighbours_and_confusion_are_told_before_anything_is_stored(tagid, tmp_path: Path) -> None:
    looked = tagid("enroll", "mine", *POINTS, "--dry-run", "--output", "json").json["data"]
    assert not looked["stored"] and looked["registry_version"] == 4
    nearest = looked["nearest"][0]
    assert nearest["name"] == "helmet-120" and 0 <= nearest["confusion_rate"] < 1e-6
    assert looked["confusion_rate"] < 1e-6 and looked["reference"] == {"views": 36, "snr_db": 10.0}
    unsure = tagid("enroll", "mine", *POINTS, "--sigma", 0.02, "--output", "json")
    assert unsure.code == 1 and "readings" in unsure.json["errors"][0]["message"]
    assert unsure.json["data"]["nearest"][0]["confusion_rate"] > 0.001 and not unsure.json["data"]["stored"]
    stored = tagid("enroll", "mine", *POINTS, "--sigma", 0.001, "--output", "json").json["data"]
    assert stored["stored"] and stored["sigma_m"] == pytest.approx(0.001)
    again = tagid("enroll", "mine", *POINTS)
    assert again.code == 1 and "already enrolled" in again.err
    design = ("layouts", "design", "--rows", 2, "--count", 3, "--enroll", "--output", "json")
    enrolled = tagid(*design).json["data"]
    assert [item["layout"] for item in enrolled["confusion"]] == [
        layout["name"] for layout in enrolled["layouts"]
    ]
    assert enrolled["confusion"][0]["nearest"] and enrolled["registry_version"] == 8
    refused = tagid(*design, "--alone").json
    assert refused["exit_code"] == 1 and "could be confused with" in refused["errors"][0]["message"]


def test_a_person_is_asked_and_may_refuse(tagid, home: dict[str, str]) -> None:
    def at_a_terminal(answer: bytes, *words: str) -> tuple[int, str]:
        react = answering((b"[y/N]", answer)) if answer else None
        done = run(home, ["enroll", "mine", *POINTS, *words], (40, 200), react, NO_COLOR="1")
        return done.code, (done.sent + done.out).decode()

    code, seen = at_a_terminal(b"n\n")
    assert code == 130 and "nothing was stored" in seen
    assert seen.index("helmet-120") < seen.index("no other layout is like it") < seen.index("[y/N]")
    assert tagid("layouts", "--output", "json").json["data"]["registry_version"] == 4
    code, seen = at_a_terminal(b"y\n")
    assert code == 0 and "mine enrolled" in seen
    code, seen = at_a_terminal(b"", "--yes", "--force")
    assert code == 0 and "[y/N]" not in seen


def test_a_capture_of_another_object_is_named_and_nothing_stored(tagid, tmp_path: Path) -> None:
    for seed, scene in enumerate(("container-180", "container-180", "container-90", "container-180")):
        words = ("--views", 24, "--seed", seed, "--rotation", 70 * seed, "--out", f"{seed}.h5")
        tagid("simulate", scene, *words)
    files = [word for i in range(4) for word in ("--capture", f"{i}.h5")]
    refused = tagid("enroll", "can", *files, "--output", "json")
    assert refused.code == 1 and refused.json["errors"][0]["message"].startswith("2.h5 has a reflector")
    words = ("enroll", "can", "--capture", "0.h5", "1.h5", "3.h5", "--force", "--output", "json")
    data = tagid(*words).json["data"]
    assert data["stored"] and 0 < data["sigma_m"] < 1e-3 and len(data["layout"]["covariance_m2"]) == 2
    assert data["confusable"] == ["container-180"]
    assert math.dist(*data["layout"]["positions_m"]) == pytest.approx(0.09, abs=0.004)
    turns = [(b - a) % 180 for a, b in zip(data["rotations_deg"], data["rotations_deg"][1:], strict=False)]
    assert turns == pytest.approx([70, 140], abs=2)
    nameless = tagid("enroll", "0.h5", "1.h5", "3.h5", "--force")
    assert nameless.code == 2 and "but a name is expected" in nameless.err
    twin = tagid("enroll", "two", "--capture", "0.h5", "--capture", "0.h5", "--force")
    assert twin.code == 2 and "twice" in twin.err


def test_capacity_counts_by_views_and_noise(tagid) -> None:
    words = ("layouts", "capacity", "--object", "mug", "--slots", 8, "--output", "json")
    rows = tagid(*words).json["data"]["rows"]
    results = {(r["views"], r["snr_db"], r["reflectors"]): r["identities"] for r in rows}
    assert len(results) == 12
    assert results[36, 20, 3] >= results[36, 10, 3] > results[36, 0, 3] >= 1
    assert all(r["error_rate"] <= 0.001 for r in rows)
    assert tagid("layouts", "capacity", "--error-rate", 2).code == 2


def test_registries_are_merged(tagid, tmp_path: Path) -> None:
    there = str(tmp_path / "there")
    assert tagid("enroll", "mine", *POINTS, "--sigma", 0.002, TAGID_DATA=there).code == 0
    before = (tmp_path / "there" / "registry.sqlite").read_bytes()
    merged = tagid("layouts", "import", "there/registry.sqlite", "--output", "json").json["data"]
    assert merged["changes"] == 1 and merged["stored"]
    assert (tmp_path / "there" / "registry.sqlite").read_bytes() == before
    listed = tagid("layouts", "--output", "json").json["data"]["layouts"]
    (mine,) = (layout for layout in listed if layout["name"] == "mine")
    assert mine["covariance_m2"][0] == pytest.approx([4e-6, 0, 4e-6])
    (tmp_path / "noise.sqlite").write_bytes(b"no registry" * 200)
    refused = tagid("layouts", "import", "noise.sqlite")
    assert refused.code == 1 and "noise.sqlite" in refused.err


def written(path: Path, name: str, heights: str) -> None:
    positions = "[[0.1, 0.0], [-0.02, 0.08], [-0.05, -0.09]]"
    path.write_text(f'name = "{name}"\nkind = "other"\npositions_m = {positions}\nheights_m = {heights}\n')


def test_several_antenna_heights_make_room_for_more_layouts(tagid) -> None:
    plain = tagid("layouts", "design", *ROWS, "--count", 4, "--alone", "--output", "json").json["data"]
    words = ("--count", 4, "--alone", "--heights", SEVERAL, "--output", "json")
    tall = tagid("layouts", "design", *ROWS, *words).json["data"]
    assert tall["candidates"] > 2 * plain["candidates"]
    assert tall["distance_m"] > plain["distance_m"]
    for wrong in ("0,x", "0,nan"):
        assert tagid("layouts", "design", *ROWS, "--heights", wrong).code == 2


def test_a_twin_at_other_heights_is_enrolled_only_for_several_antenna_heights(tagid, tmp_path: Path) -> None:
    written(tmp_path / "flat.toml", "flat", "[0.0, 0.0, 0.0]")
    written(tmp_path / "tall.toml", "tall", "[0.0, 0.06, 0.0]")
    assert tagid("enroll", "--file", "flat.toml", "--yes").code == 0
    refused = tagid("enroll", "--file", "tall.toml", "--yes", "--output", "json")
    assert (refused.code, refused.json["errors"][0]["code"]) == (1, "layout_conflict")
    assert tagid("config", "set", "motion.antenna_heights", SEVERAL).code == 0
    assert tagid("enroll", "--file", "tall.toml", "--yes").code == 0
    assert tagid("layouts", "check").code == 0
    assert tagid("layouts", "show", "tall", "--template", "t.svg").code == 0
    sheet = (tmp_path / "t.svg").read_text()
    assert "height 60.0" in sheet and "A dashed outline is a reflector above the lowest row." in sheet
