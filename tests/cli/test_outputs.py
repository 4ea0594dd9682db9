"""Files that a command writes: never a recording, refused before the work, one clear error."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from on_a_terminal import answering, run

from tagid.cli.emulate import is_truth
from tagid.cli.outputs import check_own
from tagid.recording.radars import emulated_object
from tagid.storage.history import is_export
from tagid.storage.journal import JournalWriter
from tests.cli.test_bad_input import GOOD, npz


def stored(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.parametrize(
    "words",
    [
        ("reconstruct", "mine.npz", "--method", "bp", "--out", "mine.npz"),
        ("reconstruct", "mine.npz", "--method", "bp", "--out", "scan.tagid.h5"),
        ("reconstruct", "mine.npz", "--method", "bp", "--png", "link.png"),
        ("show", "mine.npz", "--png", "scan.tagid.h5"),
        ("identify", "mine.npz", "--png", "mine.npz"),
        ("identify", "mine.npz", "other.npz", "--png", "both.png"),
        ("recover", "cut.tagid.journal", "--out", "cut.tagid.journal", "--force"),
        ("recover", "scan.tagid.h5"),
        ("import", "mine.npz", "--out", "mine.npz", "--force"),
        ("export", "scan.tagid.h5", "--out", "link.h5", "--force"),
        ("join", "mine.npz", "other.npz", "--out", "other.npz", "--force"),
        ("join", "mine.npz", "next.npz", "--out", "all.npz"),
        ("reconstruct", "mine.npz", "--volume", "--out", "mine.npz"),
        ("report", ".", "--out", "."),
        ("enroll", "no_tag", "--point", "0.1,0", "--point", "0,0.1"),
        ("layouts", "show", "helmet-120", "--png", "mine.npz"),
        ("layouts", "design", "--object", "mug", "--count", "2", "--out", "tags.toml"),
        ("history", "export", "other.parquet"),
        ("emulate", "p440", "--truth", "notes.json"),
    ],
)
def test_no_recording_and_no_layouts_are_overwritten(tagid, tmp_path: Path, words: tuple[str, ...]) -> None:
    for name in ("mine.npz", "other.npz", "scan.tagid.h5", "tags.toml"):
        (tmp_path / name).write_bytes(npz())
    (tmp_path / "table.csv").write_text("name,price\nhelmet,12\n")
    (tmp_path / "other.parquet").write_bytes(b"PAR1 something else PAR1")
    (tmp_path / "notes.json").write_text('{"note": "mine"}')
    (tmp_path / "link.png").symlink_to("mine.npz")
    (tmp_path / "link.h5").symlink_to("scan.tagid.h5")
    (tmp_path / "next.npz").write_bytes(npz(samples=GOOD["samples"][::-1]))
    with JournalWriter(tmp_path / "cut.tagid.journal", {}, sync_every=0) as journal:
        journal.append(0, 0, 0, np.zeros(8, dtype=np.int32))
    before = stored(tmp_path)
    done = tagid(*words, "--output", "json")
    assert done.code in (1, 2) and done.json["errors"][0]["remedy"]
    assert stored(tmp_path) == before


def test_an_export_an_image_and_a_truth_file_may_be_made_again(tagid, tmp_path: Path) -> None:
    for name in ("answers.csv", "answers.parquet"):
        for _ in range(2):
            done = tagid("history", "export", name, "--output", "json")
            assert done.code == 0, done.err
    (tmp_path / "mine.npz").write_bytes(npz())
    words = ("reconstruct", "mine.npz", "--method", "bp", "--out", "image.npz", "--png", "image.png")
    for _ in range(2):
        assert tagid(*words).code == 0
    assert "image" in np.load(tmp_path / "image.npz")
    truth = tmp_path / "truth.json"
    assert not is_truth(truth)
    about = emulated_object("emulator://helmet-120?rotation=30")
    assert about is not None
    truth.write_text(json.dumps(about.to_json()))
    check_own(truth, is_truth, "a truth file")
    (tmp_path / "answers.csv").write_text("")
    assert not is_export(tmp_path / "answers.csv") and not is_truth(tmp_path / "answers.csv")


@pytest.mark.parametrize(
    ("name", "said"),
    [("none/x.png", "does not exist"), ("x.bmp", "does not end in .png"), ("a" * 300 + ".png", "too long")],
)
def test_a_picture_that_cannot_be_written_is_refused_before_the_work(
    tagid, tmp_path: Path, name: str, said: str
) -> None:
    (tmp_path / "mine.npz").write_bytes(npz())
    done = tagid("identify", "mine.npz", "--png", name, "--output", "json")
    assert done.code in (1, 2) and not done.json["data"]
    assert said in done.json["errors"][0]["message"]


def test_an_invalid_prefix_is_not_blamed_on_other_options(tagid) -> None:
    words = ("layouts", "design", "--object", "mug", "--count", "2", "--prefix", "Mine/x")
    done = tagid(*words, "--output", "json")
    (error,) = done.json["errors"]
    assert done.code == 2 and "--prefix" in error["message"] and "a-z" in error["remedy"]


@pytest.mark.parametrize(("key", "code", "files"), [(b"n", 130, ["a.npz"]), (b"y", 5, ["b.npz"])])
def test_an_earlier_report_is_replaced_if_the_terminal_agrees(
    tagid, home: dict[str, str], tmp_path: Path, key: bytes, code: int, files: list[str]
) -> None:
    for name in ("a.npz", "b.npz"):
        (tmp_path / name).write_bytes(b"nothing")
    words = ["report", "--out", str(tmp_path / "r"), "-j", "1"]
    assert tagid(*words, tmp_path / "a.npz").code == 5
    done = run(home, [*words, str(tmp_path / "b.npz")], (24, 200), answering((b"[y/N]", key + b"\n")))
    assert done.code == code and b"r holds a report of 1 capture. Replace it?" in done.sent
    lines = (tmp_path / "r" / "items.jsonl").read_text().splitlines()
    assert [Path(json.loads(line)["file"]).name for line in lines] == files
