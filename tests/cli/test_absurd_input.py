"""Numbers and files that a user can give by mistake: refused with a sentence, in bounded time and memory."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tagid.imaging import memory

RESPONSE = Path(__file__).parents[1] / "data" / "responses" / "can30_c180.npz"


@pytest.mark.parametrize(
    "words",
    [
        ("enroll", "new", "--point", "0.1,0", "--point", "0,0.1", "--sigma", "1e300"),
        ("enroll", "new", "--point", "0.1,0", "--point", "0,0.1", "--sigma", "inf"),
        ("layouts", "check", "--sigma", "1e300"),
        ("layouts", "design", "--object", "mug", "--count=-1"),
        ("simulate", "points-3", "--views", "12", "--out", "s.h5", "--beam", "1e-300"),
        ("reconstruct", "c.h5", "--wave-speed", "1e-300"),
        ("reconstruct", "c.h5", "--axis-search", "1e-300"),
        ("reconstruct", "c.h5", "--ats", "spreading=1000000"),
        ("reconstruct", "c.h5", "--ats", "robust=1e300"),
        ("radar", "config", "--radar", "udp://127.0.0.1:9", "--start-ps", "9" * 60),
        ("simulate", "points-3", "--views", "9" * 60, "--out", "s.h5"),
        ("config", "set", "storage.folder", "caf\udce9"),
    ],
    ids=lambda words: " ".join(words)[:60].encode("ascii", "replace").decode(),
)
def test_absurd_numbers_are_refused(tagid, tmp_path: Path, words: tuple[str, ...]) -> None:
    if "c.h5" in words:
        assert tagid("simulate", "points-3", "--views", "12", "--out", "c.h5").code == 0
    done = tagid(*words)
    assert done.code in (1, 2) and "what to do:" in done.err, done.err
    assert "bug in tagid" not in done.err and "Warning" not in done.err


@pytest.mark.parametrize(
    "text",
    [
        "[radar]\ngain = " + "9" * 5001,
        "a = " + "[" * 5000,
        "[radar]\ngain = 1" + "0" * 400,
        "[radar]\ngain = inf",
    ],
    ids=["digits", "brackets", "integer", "infinity"],
)
def test_a_configuration_that_no_parser_takes(tagid, home: dict[str, str], text: str) -> None:
    path = Path(home["TAGID_CONFIG"])
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    done = tagid("config")
    assert done.code == 2 and str(path) in done.err and "what to do:" in done.err, done.err


def test_a_configuration_that_is_no_file(tagid, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "large").open("wb") as file:
        file.truncate(1 << 40)
    for name, words in (
        ("pipe", "not a regular file"),
        ("large", "limit"),
        ("/dev/zero", "not a regular file"),
    ):
        done = tagid("config", TAGID_CONFIG=name)
        assert done.code in (1, 2) and words in done.err
    (tmp_path / "home").mkdir(exist_ok=True)
    for name in ("robots.toml", "directions.toml"):
        os.mkfifo(tmp_path / "home" / name)
    assert "not a regular file" in tagid("motion", "info", "comxim+serial:///dev/x").err
    assert "not a regular file" in tagid("motion", "info", "roomba+serial:///dev/x").err


@pytest.mark.parametrize("step_hz", [1e-3, 1e13])
def test_a_response_between_whose_frequencies_no_object_fits(tagid, tmp_path: Path, step_hz: float) -> None:
    content = dict(np.load(RESPONSE))
    content["frequency_hz"] = 4e9 + np.arange(21) * step_hz
    np.savez_compressed(tmp_path / "close.npz", **content)
    done = tagid("simulate", "--response", "close.npz", "--views", "24", "--out", "r.tagid.h5")
    assert done.code == 1 and "frequencies" in done.err and "bug in tagid" not in done.err


def test_limits_of_the_process_and_of_its_group_count_as_memory(tmp_path: Path) -> None:
    code = "from tagid.imaging.memory import free_memory; print(free_memory())"
    for limit in (resource.RLIMIT_AS, resource.RLIMIT_DATA):
        done = subprocess.run(
            [sys.executable, "-c", f"import resource; resource.setrlimit({limit}, (2**30, 2**30)); {code}"],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert 0 < int(done.stdout) < 2**30
    (tmp_path / "memory.max").write_text("1000000\n")
    (tmp_path / "memory.current").write_text("700000\n")
    (tmp_path / "memory.stat").write_text("anon 1\ninactive_file 100000\n")
    assert list(memory._of_cgroup(tmp_path, *memory._VERSION_2)) == [400_000]
    (tmp_path / "memory.max").write_text("max\n")
    assert list(memory._of_cgroup(tmp_path, *memory._VERSION_2)) == []
