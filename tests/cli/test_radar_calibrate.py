"""`tagid radar calibrate` as a user types it: empty scene, target, and an image that uses both."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from on_a_terminal import answering, run

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
    assert done.code == 2 and "--step empty" in done.json["errors"][0]["remedy"]


def test_nothing_is_kept_where_nothing_was_found(tagid, tmp_path: Path) -> None:
    url = f"emulator://corner?{SCENE}"
    words = ("radar", "calibrate", "--radar", url, "--scans", 20, "--output", "json")
    nowhere = "--distance 9"
    for more in (
        nowhere,
        "--distance 0",
        "--distance nan",
        "--step target",
        "--step x",
        "--distance 2 --scans 3",
    ):
        done = tagid(*words, *more.split())
        assert done.code == (1 if more == nowhere else 2), (more, done.out)
        assert "unexpected" not in done.json["errors"][0]["message"]
    dry = tagid(*words, "--distance", 2, "--dry-run")
    assert dry.code == 0 and dry.json["data"]["config"] is None
    home = tmp_path / "home"
    assert not (home / "config.toml").exists() and not list(home.glob("*.h5"))


def test_on_a_terminal_it_waits_for_the_user(home: dict[str, str]) -> None:
    """The emulated scene cannot change in between, so the difference is zero and that is said."""
    words = [
        "radar",
        "calibrate",
        "--distance",
        "2",
        "--scans",
        "20",
        "--radar",
        f"emulator://corner?{SCENE}",
    ]
    react = answering((b"Remove the target from the beam", b"\n"), (b"Put the target at 2 m", b"\n"))
    done = run(home, words, (24, 200), react)
    assert done.code == 1 and b"no echo of a target stands out" in done.sent, done


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
