"""Every shared option means the same in each command that takes it: one way in, compared from outside."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tagid.simulate import Acquisition, scene_from_name, simulate_capture
from tagid.storage.npz import encode_npz


def bare_npz(path: Path) -> Path:
    """A scan of 1.4 turns that knows the times of its scans, but neither angles nor where the radar stood."""
    capture, _ = simulate_capture(
        scene_from_name("container-90", 4), Acquisition(views=30, turns=1.4, snr_db=20), seed=4
    )
    path.write_bytes(encode_npz(capture))
    with np.load(path, allow_pickle=False) as file:
        kept = {key: file[key] for key in file if key not in ("angles_rad", "angle_sigma_rad", "tagid")}
    kept.pop("axis_distance_m")
    np.savez(path, **kept)
    return path


def answers(tagid, folder: Path, file: Path, words: tuple[object, ...]) -> dict[str, Any]:
    """The answer of each command for a file, and what the image was made with."""
    results: dict[str, Any] = {}
    identified = tagid("identify", file, *words, "--output", "json")
    results["identify"] = identified.json["data"]["items"][0]
    out = folder / f"report-{abs(hash(words))}"
    tagid("report", file, "--out", out, "--jobs", 1, "--no-pictures", *words, "--output", "json")
    results["report"] = json.loads((out / "items.jsonl").read_text().splitlines()[0])
    results["reconstruct"], results["image"] = image(tagid, folder, file, words)
    return results


def image(tagid, folder: Path, file: Path, words: tuple[object, ...]) -> tuple[Any, Any]:
    """(settings, pixels) of an image; (None, None) if there is none."""
    made = tagid("reconstruct", file, *words, "--method", "bp", "--no-focus", "--pixels", 48,
                 "--out", "i.npz", "--output", "json")  # fmt: skip
    if made.code:
        return None, None
    with np.load(folder / "i.npz") as arrays:
        return made.json["data"]["settings"], arrays["image"]


SAME = ("status", "layout", "score", "rotation_deg", "centre_m", "reflectors", "scores")


def assert_alike(document: dict[str, Any]) -> None:
    for key in SAME:
        assert document["identify"][key] == document["report"][key], key


@pytest.mark.parametrize("motion", ["free?rpm=2&direction=cw", None])
def test_motion_and_geometry(tagid, tmp_path: Path, motion: str | None) -> None:
    file = bare_npz(tmp_path / "bare.npz")
    words = ("--axis-distance", 1.0, "--antenna-height", 0.0, *(("--motion", motion) if motion else ()))
    result = answers(tagid, tmp_path, file, words)
    assert_alike(result)
    assert result["reconstruct"]["axis_distance_m"] == pytest.approx(1.0)


def test_a_missing_axis_distance_is_the_same_error_everywhere(tagid, tmp_path: Path) -> None:
    file = bare_npz(tmp_path / "bare.npz")
    result = answers(tagid, tmp_path, file, ("--motion", "free?rpm=2"))
    assert result["identify"]["status"] == result["report"]["status"] == "failed"
    assert result["identify"]["error"]["code"] == result["report"]["error"]["code"]


def test_the_reference_background_is_subtracted_by_every_command(tagid, tmp_path: Path) -> None:
    """`report` used to accept it and subtract nothing."""
    assert tagid("config", "set", "radar.integration", 15).code == 0
    empty = tagid("radar", "calibrate", "--step", "empty", "--radar", "emulator://empty?rpm=0&seed=2",
                  "--axis-distance", 1, "--distance", 1, "--scans", 40, "--output", "json")  # fmt: skip
    assert empty.code == 0, empty.out
    scan = tagid("scan", "--radar", "emulator://helmet-120?rpm=45&seed=2", "--axis-distance", 1,
                 "--motion", "free?rpm=45", "--method", "bp", "--save-dir", "s",
                 "--output", "json")  # fmt: skip
    file = Path(scan.json["data"]["files"]["capture"])
    reference = answers(tagid, tmp_path, file, ("--background", "reference"))
    assert_alike(reference)
    untouched = tagid("identify", file, "--background", "none", "--output", "json").json["data"]["items"][0]
    assert reference["identify"]["scores"] != untouched["scores"]
    plain = image(tagid, tmp_path, file, ("--background", "none"))[1]
    assert not np.allclose(reference["image"], plain)


def test_show_reads_the_file_as_the_others_do(tagid, tmp_path: Path) -> None:
    """`show` keeps every scan; range and geometry are those of `import`."""
    file = bare_npz(tmp_path / "bare.npz")
    shown = tagid("show", file, "--png", tmp_path / "s.png", "--output", "json").json["data"]
    imported = tagid("import", file, "--out", "x.tagid.h5", "--axis-distance", 1.0, "--output", "json")
    assert imported.json["data"]["views"] == shown["views"] == 42
