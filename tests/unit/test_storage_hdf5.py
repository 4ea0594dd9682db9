"""The capture file comes back as it was, is whole or absent, and refuses what is not one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from storage_samples import FLOAT, assert_equal, capture, file_size_limit

from tagid.errors import DiskFullError, FileFormatError, StorageError
from tagid.metadata import RadarInfo
from tagid.storage.hdf5 import FORMAT_VERSION, read_capture, write_capture


def test_layout_is_the_documented_one(tmp_path: Path) -> None:
    write_capture(tmp_path / "a", capture())
    with h5py.File(tmp_path / "a") as file:
        assert file.attrs["format"] == b"tagid.capture"
        assert int(file.attrs["format_version"]) == FORMAT_VERSION
        assert file["scans/samples"].fletcher32 and file["scans/samples"].compression == "gzip"
        np.testing.assert_array_equal(file["scans/samples"][()], capture().samples)
        np.testing.assert_array_equal(file["scans/angles_rad"][()], capture().angles_rad)


def test_overwrites_whole_and_leaves_no_temporary_file(tmp_path: Path) -> None:
    for shown in (capture(radar=RadarInfo(extra={"notes": "x" * 300_000})), capture(**FLOAT)):
        write_capture(tmp_path / "a", shown)
        assert_equal(shown, read_capture(tmp_path / "a"))
    with file_size_limit(5000), pytest.raises(DiskFullError, match="the disk is full") as caught:
        write_capture(tmp_path / "a", capture())
    assert "Free some space" in caught.value.remedy
    assert_equal(shown, read_capture(tmp_path / "a"))
    assert len(list(tmp_path.iterdir())) == 1


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
