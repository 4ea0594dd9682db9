"""The capture file comes back as it was, is whole or absent, and refuses what is not one."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from storage_samples import BARE, COMPLEX, FLOAT, FREE, LONG, PAIRS, TINY, assert_equal, capture

from tagid import files
from tagid.errors import DiskFullError, FileFormatError, StorageError, TagidError
from tagid.storage.hdf5 import FORMAT_VERSION, read_capture, write_capture


@pytest.mark.parametrize("changes", [{}, FREE, PAIRS, BARE, COMPLEX, FLOAT, TINY, LONG, {"complete": True}])
def test_round_trip(tmp_path: Path, changes: dict[str, Any]) -> None:
    shown = capture(**changes)
    write_capture(tmp_path / "a.tagid.h5", shown)
    assert_equal(shown, read_capture(tmp_path / "a.tagid.h5"))
    assert [p.name for p in tmp_path.iterdir()] == ["a.tagid.h5"]


def test_layout_is_the_documented_one(tmp_path: Path) -> None:
    write_capture(tmp_path / "a", capture())
    with h5py.File(tmp_path / "a") as file:
        assert (
            file.attrs["format"] == b"tagid.capture" and int(file.attrs["format_version"]) == FORMAT_VERSION
        )
        assert file["scans/samples"].fletcher32 and file["scans/samples"].compression == "gzip"
        np.testing.assert_array_equal(file["scans/samples"][()], capture().samples)
        np.testing.assert_array_equal(file["scans/angles_rad"][()], capture().angles_rad)


def test_overwrites_whole_and_leaves_no_temporary_file(tmp_path: Path) -> None:
    write_capture(tmp_path / "a", capture())
    write_capture(tmp_path / "a", capture(**FLOAT))
    assert read_capture(tmp_path / "a").samples.dtype == np.float32
    assert len(list(tmp_path.iterdir())) == 1


def test_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_capture(tmp_path / "a", capture())
    before = (tmp_path / "a").read_bytes()

    def full(descriptor: int, data: Any) -> int:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(files.os, "write", full)
    with pytest.raises(DiskFullError) as caught:
        write_capture(tmp_path / "a", capture(**FLOAT))
    monkeypatch.undo()
    assert "Free some space" in caught.value.remedy
    assert (tmp_path / "a").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_real_limit_of_the_file_size(tmp_path: Path) -> None:
    code = (
        "import resource, sys\nfrom pathlib import Path\nimport numpy as np\n"
        "from tagid.capture import Capture\nfrom tagid.errors import DiskFullError\n"
        "from tagid.storage.hdf5 import write_capture\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))\n"
        "noise = np.random.default_rng(0).standard_normal((50, 100)).astype(np.float32)\n"
        "try:\n    write_capture(Path(sys.argv[1]), Capture(noise, 0.0, 0.01))\n"
        "except DiskFullError as error:\n    print('full')\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.tagid.h5")],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])},
    )
    assert result.stdout == "full\n", result.stderr
    assert list(tmp_path.iterdir()) == []


def test_where_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"x")
    for path in (tmp_path / "no" / "a.h5", tmp_path, tmp_path / "file" / "a.h5", Path("/dev/null")):
        with pytest.raises(StorageError):
            write_capture(path, capture())
    assert not Path("/dev/null").is_file()
    with pytest.raises(StorageError):
        read_capture(tmp_path / "missing.h5")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_folder_without_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(StorageError, match="permission"):
            write_capture(tmp_path / "a.h5", capture())
    finally:
        tmp_path.chmod(0o700)


def tampered(tmp_path: Path, change: Any) -> Path:
    path = tmp_path / "t.tagid.h5"
    write_capture(path, capture())
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def replace(name: str, **dataset: Any) -> Any:
    def change(file: Any) -> None:
        if name in file:
            del file[name]
        file.create_dataset(name, **dataset)

    return change


def link(file: Any) -> None:
    del file["scans/samples"]
    file["scans/samples"] = h5py.ExternalLink("/etc/passwd", "/x")


def attribute(name: str, value: Any) -> Any:
    return lambda file: file.attrs.__setitem__(name, value)


BAD = {
    "newer version": attribute("format_version", 99),
    "version zero": attribute("format_version", 0),
    "version of text": attribute("format_version", np.bytes_(b"one")),
    "other format": attribute("format", np.bytes_(b"other")),
    "text of variable length": attribute("format", "tagid.capture"),
    "settings are no JSON": attribute("radar", np.bytes_(b"{")),
    "settings are a list": attribute("radar", np.bytes_(b"[1]")),
    "settings nested without end": attribute("radar", np.bytes_(b"[" * 30_000)),
    "range step not a number": attribute("range_step_m", np.nan),
    "range step negative": attribute("range_step_m", -1.0),
    "range step missing": lambda file: file.attrs.__delitem__("range_step_m"),
    "complete is a number": attribute("complete", 3.5),
    "samples missing": lambda file: file.__delitem__("scans/samples"),
    "scans missing": lambda file: file.__delitem__("scans"),
    "samples float64": replace("scans/samples", data=np.ones((9, 40))),
    "samples text": replace("scans/samples", data=np.full((9, 40), b"x")),
    "samples objects": replace("scans/samples", data=["a"] * 9, dtype=h5py.string_dtype()),
    "samples not finite": replace("scans/samples", data=np.full((9, 40), np.nan, np.float32)),
    "samples flat": replace("scans/samples", data=np.ones(360, np.int32)),
    "samples huge": replace("scans/samples", shape=(2**31, 2**12), dtype="i4", chunks=(1, 4096)),
    "samples huge, compressed": replace(
        "scans/samples", shape=(100_000, 4000), dtype="i4", chunks=(1000, 4000), compression="gzip"
    ),
    "samples empty": replace("scans/samples", shape=(0, 40), dtype="i4"),
    "angles too short": replace("scans/angles_rad", data=np.zeros(8)),
    "times as float": replace("scans/host_time_ns", data=np.zeros(9)),
    "imaginary part of another shape": replace("scans/samples_imag", data=np.ones((9, 39), np.float32)),
    "link to another file": link,
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused(tmp_path: Path, name: str) -> None:
    path = tampered(tmp_path, BAD[name])
    with pytest.raises(FileFormatError) as caught:
        read_capture(path)
    assert str(path) in caught.value.message
    if name == "newer version":
        assert "upgrade" in caught.value.remedy


def test_damage_never_gives_other_samples(tmp_path: Path) -> None:
    shown = capture()
    write_capture(tmp_path / "a", shown)
    data = (tmp_path / "a").read_bytes()
    rng = np.random.default_rng(3)
    refused = 0
    for turn in range(300):
        bad = bytearray(data)
        if turn % 3:
            bad[rng.integers(len(bad))] ^= 1 << rng.integers(8)
        else:
            bad = bad[: rng.integers(len(bad))]
        (tmp_path / "b").write_bytes(bad)
        try:
            assert_equal(shown, read_capture(tmp_path / "b"))
        except TagidError:
            refused += 1
    assert refused > 200
