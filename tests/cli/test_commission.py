"""`tagid commission` as a person types it: step by step, resumed, refused, and archived."""

from __future__ import annotations

import zipfile
from pathlib import Path

RIG = "rig=realistic%3Fseed%3D8&seed=1"
TAPE = ("--axis-distance", 1, "--antenna-height", 0.05, "--distance", 1, "--scans", 40)


def test_steps_alone_are_remembered_and_the_page_and_the_archive_show_them(tagid, tmp_path: Path) -> None:
    link = tagid("commission", "--step", "link", "--seconds", 1, "--radar", f"emulator://empty?{RIG}", *TAPE,
                 "--output", "json")  # fmt: skip
    assert link.code == 0, link.out
    assert (link.json["data"]["next"], link.json["data"]["profile"]) == ("room", None)
    room = tagid("commission", "--step", "room", "--radar", f"emulator://empty?{RIG}", "--scans", 40,
                 "--page", "rig.html", "--output", "json")  # fmt: skip
    assert room.code == 0, room.out
    (report,) = room.json["data"]["steps"]
    assert report["passed"] and report["values"]["noise_counts"]["sigma"] > 0
    page = (tmp_path / "rig.html").read_text()
    assert "Empty room" in page and "not commissioned yet" in page
    assert tagid("commission", "--bundle", "rig.zip").code == 0
    with zipfile.ZipFile(tmp_path / "rig.zip") as archive:
        assert "room.tagid.h5" in archive.namelist()
    # The target of this rig is not on the table.
    words = ("commission", "--step", "target", "--radar", f"emulator://empty?{RIG}", "--scans", 40)
    nothing = tagid(*words, "--output", "json")
    (*_, row) = nothing.json["data"]["steps"][0]["rows"]
    assert (nothing.code, row["code"]) == (1, "no-echo")
    assert f"-> {row['advice']}" in tagid(*words, COLUMNS="60").out, "no advice is wrapped"


def test_a_damaged_profile_is_written_again_and_a_stop_shows_what_was_done(tagid, tmp_path: Path) -> None:
    folder = tmp_path / "home"
    folder.mkdir(exist_ok=True)
    (folder / "rig.toml").write_text("format = 'tagid.rig'\nformat_version = 2\n")
    refused = tagid("doctor", "--output", "json").json["errors"][0]
    assert refused["code"] == "config" and "tagid commission" in refused["remedy"]
    # Nobody is there to clear the table for the second step.
    words = ("--seconds", 1, "--radar", f"emulator://empty?{RIG}", *TAPE, "--page", "rig.html")
    done = tagid("commission", *words)
    assert done.code == 2 and "Clear the table" in done.err
    assert "rig.damaged.toml" in done.err and (folder / "rig.damaged.toml").exists()
    assert "temperature" in done.out and "scan rate" in (tmp_path / "rig.html").read_text()


def test_what_cannot_be_done_is_one_error(tagid) -> None:
    common = ("--radar", f"emulator://empty?{RIG}", "--output", "json")
    for words, code, says in (
        (("--step", "x", *common), 2, "Give one of link, room"),
        (("--step", "link", *common), 2, "--axis-distance"),
        (("--step", "room", "--target", "cube:3cm", *TAPE, *common), 2, "Use octahedron"),
        (("--step", "result", *TAPE, *common), 2, "step link"),
        (("--bundle", "a.zip", *common), 2, "first steps"),
        (("--step", "room", "--radar", "emulator://empty?rig=realistic%3Ffault%3Dx", *TAPE, *common[2:]), 2,
         "Use cable"),
    ):  # fmt: skip
        done = tagid("commission", *words)
        assert done.code == code, (words, done.out)
        assert says in done.json["errors"][0]["remedy"], done.json["errors"]


def test_a_data_folder_that_cannot_be_made_is_one_error(tagid, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = tagid("commission", "--step", "link", "--seconds", 1, "--radar", f"emulator://empty?{RIG}", *TAPE,
                 "--output", "json", TAGID_DATA=str(tmp_path / "file" / "data"))  # fmt: skip
    assert done.code == 1 and "file" in done.json["errors"][0]["message"], done.json["errors"]
    assert done.json["errors"][0]["code"] == "storage" and "bug" not in done.json["errors"][0]["remedy"]


def test_the_card_is_drawn_and_doctor_tells_of_the_rig(tagid, tmp_path: Path) -> None:
    assert tagid("layouts", "show", "test-card", "--template", "card.svg").code == 0
    assert "test-card" in (tmp_path / "card.svg").read_text()
    findings = tagid("doctor", "--output", "json").json["data"]["findings"]
    (rig,) = [finding for finding in findings if finding["topic"] == "rig"]
    assert rig["text"] == "not commissioned" and "tagid commission" in rig["remedy"]
    listed = tagid("layouts", "--output", "json").json["data"]["layouts"]
    assert "test-card" not in {layout["name"] for layout in listed}
