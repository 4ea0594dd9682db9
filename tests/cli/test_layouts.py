"""`tagid layouts` as a user meets it: design, enroll, draw, exchange, check, undo, and mistakes."""

from __future__ import annotations

import math
import os
import pty
import select
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

POINTS = ("--point", "0.1,0", "--point", "-0.05,0.03", "--point", "0.02,-0.09")


def test_from_a_design_to_a_checked_registry(tagid: Callable[..., Any], tmp_path: Path) -> None:
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
    assert tagid("layouts", "undo", "--output", "json").json["data"]["layouts"] == [
        "container-180",
        "container-90",
        "helmet-120",
        "helmet-linear",
    ]


def test_mistakes_change_nothing(tagid: Callable[..., Any], tmp_path: Path) -> None:
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


def test_neighbours_and_confusion_are_told_before_anything_is_stored(
    tagid: Callable[..., Any], tmp_path: Path
) -> None:
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


def test_a_person_is_asked_and_may_refuse(tagid: Callable[..., Any], home: dict[str, str]) -> None:
    def at_a_terminal(answer: str, *words: str) -> tuple[int, str]:
        ours, theirs = pty.openpty()
        process = subprocess.Popen(
            [sys.executable, "-m", "tagid", "enroll", "mine", *POINTS, *words],
            stdin=theirs, stdout=theirs, stderr=theirs, env=home,
        )  # fmt: skip
        os.close(theirs)
        seen = b""
        try:
            while select.select([ours], [], [], 60)[0]:
                piece = os.read(ours, 4096)
                seen += piece
                if b"[y/N]" in seen and answer:
                    os.write(ours, answer.encode())
                    answer = ""
        except OSError:  # the other end is closed
            pass
        os.close(ours)
        return process.wait(timeout=60), seen.decode()

    code, seen = at_a_terminal("n\n")
    assert code == 130 and "nothing was stored" in seen
    assert seen.index("helmet-120") < seen.index("no other layout is like it") < seen.index("[y/N]")
    assert tagid("layouts", "--output", "json").json["data"]["registry_version"] == 4
    code, seen = at_a_terminal("y\n")
    assert code == 0 and "mine enrolled" in seen
    code, seen = at_a_terminal("", "--yes", "--force")
    assert code == 0 and "[y/N]" not in seen


def test_a_capture_of_another_object_is_named_and_nothing_stored(
    tagid: Callable[..., Any], tmp_path: Path
) -> None:
    for seed, scene in enumerate(("container-180", "container-180", "container-90", "container-180")):
        tagid(
            "simulate", scene, "--views", 24, "--seed", seed, "--rotation", 70 * seed, "--out", f"{seed}.h5"
        )
    files = [word for i in range(4) for word in ("--capture", f"{i}.h5")]
    refused = tagid("enroll", "can", *files, "--output", "json")
    assert refused.code == 1 and refused.json["errors"][0]["message"].startswith("2.h5 has a reflector")
    data = tagid("enroll", "can", "--capture", "0.h5", "1.h5", "3.h5", "--force", "--output", "json").json[
        "data"
    ]
    assert data["stored"] and 0 < data["sigma_m"] < 1e-3 and len(data["layout"]["covariance_m2"]) == 2
    assert data["confusable"] == ["container-180"]
    assert math.dist(*data["layout"]["positions_m"]) == pytest.approx(0.09, abs=0.004)
    turns = [(b - a) % 180 for a, b in zip(data["rotations_deg"], data["rotations_deg"][1:], strict=False)]
    assert turns == pytest.approx([70, 140], abs=2)
    nameless = tagid("enroll", "0.h5", "1.h5", "3.h5", "--force")
    assert nameless.code == 2 and "but a name is expected" in nameless.err
    twin = tagid("enroll", "two", "--capture", "0.h5", "--capture", "0.h5", "--force")
    assert twin.code == 2 and "twice" in twin.err


def test_capacity_counts_by_views_and_noise(tagid: Callable[..., Any]) -> None:
    words = ("layouts", "capacity", "--object", "mug", "--slots", 8, "--output", "json")
    rows = tagid(*words).json["data"]["rows"]
    results = {(r["views"], r["snr_db"], r["reflectors"]): r["identities"] for r in rows}
    assert len(results) == 12
    assert results[36, 20, 3] >= results[36, 10, 3] > results[36, 0, 3] >= 1
    assert all(r["error_rate"] <= 0.001 for r in rows)
    assert tagid("layouts", "capacity", "--error-rate", 2).code == 2


def test_registries_are_merged(tagid: Callable[..., Any], tmp_path: Path) -> None:
    there = str(tmp_path / "there")
    assert tagid("enroll", "mine", *POINTS, "--sigma", 0.002, TAGID_DATA=there).code == 0
    before = (tmp_path / "there" / "registry.sqlite").read_bytes()
    merged = tagid("layouts", "import", "there/registry.sqlite", "--output", "json").json["data"]
    assert merged["changes"] == 1 and merged["stored"]
    assert (tmp_path / "there" / "registry.sqlite").read_bytes() == before
    layouts = {
        layout["name"]: layout for layout in tagid("layouts", "--output", "json").json["data"]["layouts"]
    }
    assert layouts["mine"]["covariance_m2"][0] == pytest.approx([4e-6, 0, 4e-6])
    (tmp_path / "noise.sqlite").write_bytes(b"no registry" * 200)
    refused = tagid("layouts", "import", "noise.sqlite")
    assert refused.code == 1 and "noise.sqlite" in refused.err
