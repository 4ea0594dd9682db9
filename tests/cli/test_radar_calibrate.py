"""`tagid radar calibrate` as a user types it: empty scene, target, and an image that uses both."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

SCENE = "axis_distance=2&rpm=0&seed=3&cable_delay=11234"


def test_both_steps_then_a_scan_uses_delay_and_reference(tagid, tmp_path: Path) -> None:
    common = ("--distance", 2, "--axis-distance", 1, "--scans", 40, "--output", "json")
    first = tagid("radar", "calibrate", "--step", "empty", "--radar", f"emulator://empty?{SCENE}", *common)
    assert first.code == 0, first.out
    assert first.json["data"]["reference"]["noise_std"] == pytest.approx(120, rel=0.1)
    second = tagid("radar", "calibrate", "--step", "target", "--radar", f"emulator://corner?{SCENE}", *common)
    data = second.json["data"]
    assert data["estimate"]["delay_ps"] == pytest.approx(11_234, abs=5)
    assert data["estimate"]["sigma_ps"] == pytest.approx(33.4, abs=3)  # 5 mm of tape
    assert second.json["messages"] == []
    kept = tomllib.loads((tmp_path / "home" / "config.toml").read_text())["radar"]
    assert kept["cable_delay_ps"] == pytest.approx(11_234, abs=5)
    assert kept["cable_delay_sigma_ps"] == pytest.approx(33.4, abs=3)
    assert Path(kept["background"]).is_file()

    helmet = "emulator://helmet-120?rpm=60&seed=3&cable_delay=11234"
    scan = tagid("scan", "--radar", helmet, "--axis-distance", 1, "--motion", "free?rpm=60", "--method", "bp",
                 "--save-dir", "s", "--output", "json")  # fmt: skip
    assert scan.code == 0, scan.out
    capture = scan.json["data"]["files"]["capture"]
    for background in ("mean", "reference"):
        done = tagid("reconstruct", capture, "--method", "bp", "--background", background, "--no-focus",
                     "--output", "json")  # fmt: skip
        assert done.code == 0, done.out
    named = tagid("identify", capture, "--background", "reference", "--output", "json")
    assert named.json["data"]["items"][0]["layout"] == "helmet-120"


def test_without_a_reference_it_says_what_is_missing(tagid) -> None:
    tagid("simulate", "helmet-120", "--views", 18, "--out", "h.tagid.h5")
    done = tagid("reconstruct", "h.tagid.h5", "--background", "reference", "--output", "json")
    assert done.code == 2
    assert "--step empty" in done.json["errors"][0]["remedy"]


def test_nothing_is_kept_where_nothing_was_found(tagid, tmp_path: Path) -> None:
    url = f"emulator://corner?{SCENE}"
    words = ("radar", "calibrate", "--radar", url, "--scans", 20, "--output", "json")
    for more, code in (
        (("--distance", 9), 1),  # no echo there
        (("--distance", 0), 2),
        (("--distance", "nan"), 2),
        (("--step", "target"), 2),
        (("--step", "x"), 2),
        (("--distance", 2, "--scans", 3), 2),
    ):
        done = tagid(*words, *more)
        assert done.code == code, (more, done.out)
        assert "unexpected" not in done.json["errors"][0]["message"]
    dry = tagid(*words, "--distance", 2, "--dry-run")
    assert dry.code == 0
    assert dry.json["data"]["config"] is None
    assert not (tmp_path / "home" / "config.toml").exists()
    assert not list((tmp_path / "home").glob("*.h5"))


def test_on_a_terminal_it_waits_for_the_user(home: dict[str, str], tmp_path: Path) -> None:
    """The emulated scene cannot change in between, so the difference is zero and that is said."""
    master, slave = pty.openpty()
    child = subprocess.Popen(
        [sys.executable, "-m", "tagid", "radar", "calibrate", "--distance", "2", "--scans", "20", "--radar",
         f"emulator://corner?{SCENE}"],
        stdin=slave, stdout=slave, stderr=slave, env=home, cwd=tmp_path,
    )  # fmt: skip
    os.close(slave)
    seen = b""
    for prompt in (b"Remove the target from the beam", b"Put the target at 2 m"):
        while prompt not in seen:
            seen += os.read(master, 4096)
        os.write(master, b"\n")
    try:
        while data := os.read(master, 4096):
            seen += data
    except OSError:  # the other end of a pty is closed
        pass
    assert child.wait(timeout=60) == 1, seen
    assert b"no echo of a target stands out" in seen
    os.close(master)


def test_a_delay_that_differs_by_a_metre_is_not_replaced_unasked(tagid, tmp_path: Path) -> None:
    words = ("radar", "calibrate", "--step", "target", "--scans", 20, "--axis-distance", 1,
             "--output", "json", "--radar", f"emulator://corner?{SCENE}")  # fmt: skip
    assert tagid(*words, "--distance", 2).json["data"]["previous_delay_ps"] is None
    wrong = tagid(*words, "--distance", 3)
    assert wrong.code == 1 and "as if the target were at 2.00 m" in wrong.json["errors"][0]["message"]
    settings = tmp_path / "home" / "config.toml"
    assert tomllib.loads(settings.read_text())["radar"]["cable_delay_ps"] == pytest.approx(11_234, abs=5)
    again = tagid(*words, "--distance", 3, "--yes").json["data"]
    assert again["previous_delay_ps"] == pytest.approx(11_234, abs=5)
    assert again["estimate"]["delay_ps"] == pytest.approx(11_234 - 6671, abs=5)
