"""Whatever a file holds: one clear message, the right exit code, no traceback, nothing half-written."""

from __future__ import annotations

import io
import socket
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

GOOD = {
    "samples": np.random.default_rng(0).standard_normal((36, 192)).astype(np.float32),
    "range_start_m": 0.3,
    "range_step_m": 0.00915,
    "angles_rad": np.arange(36) * np.pi / 18,
    "axis_distance_m": 1.0,
}


def npz(**changes: object) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **{k: v for k, v in {**GOOD, **changes}.items() if v is not None})
    return buffer.getvalue()


def one_nan() -> bytes:
    samples = np.array(GOOD["samples"])
    samples[3, 5] = np.nan
    return npz(samples=samples)


def huge_header() -> bytes:
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (100000000, 100000), }\n"
    npy = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    buffer = io.BytesIO(npz())
    with zipfile.ZipFile(buffer, "a") as file:
        file.writestr("pulse.npy", npy)
    return buffer.getvalue()


BAD = {
    "empty": b"",
    "random": np.random.default_rng(1).bytes(5000),
    "truncated": npz()[:3000],
    "huge header": huge_header(),
    "NaN": one_nan(),
    "text": npz(samples=np.full((36, 192), "x")),
    "pickled": npz(samples=np.array([{}] * 36, dtype=object)),
    "no angles": npz(angles_rad=None),
    "angles too few": npz(angles_rad=np.zeros(3)),
    "one view": npz(samples=GOOD["samples"][:1], angles_rad=np.zeros(1)),
    "one bin": npz(samples=GOOD["samples"][:, :1]),
    "all zero": npz(samples=np.zeros((36, 192), np.float32)),
    "object outside": npz(axis_distance_m=9.0),
    "negative step": npz(range_step_m=-1.0),
}


@pytest.mark.parametrize("kind", sorted(BAD))
def test_a_bad_file_is_one_clear_error(tagid, tmp_path: Path, kind: str) -> None:
    (tmp_path / "bad.npz").write_bytes(BAD[kind])
    done = tagid("identify", "bad.npz", "--output", "json")
    document = done.json
    assert done.code == document["exit_code"] == 1, document
    (error,) = document["errors"]
    assert "bad.npz" in error["message"] and not error["message"].startswith("unexpected"), error
    if kind == "NaN":
        assert "1 of 36 views hold non-finite samples, the first is view 3" in error["message"]
        assert "Leave these views out" in error["remedy"]
    if kind in ("truncated", "NaN", "all zero"):
        image = tagid("reconstruct", "bad.npz", "--method", "bp", "--out", "i.npz")
        assert (image.code, image.err.count("error:")) == (1, 1)
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == ["bad.npz"]


def test_unwritable_places(tagid, tmp_path: Path) -> None:
    (tmp_path / "good.npz").write_bytes(npz())
    (tmp_path / "file").write_text("")
    for words in (
        ("import", "good.npz", "--out", "file/x.tagid.h5"),
        ("import", "good.npz", "--out", "none/x.tagid.h5"),
        ("export", "good.npz", "--out", "none/x.mat"),
        ("reconstruct", "good.npz", "--method", "bp", "--out", "none/i.npz"),
        ("reconstruct", "good.npz", "--method", "bp", "--png", "none/i.png"),
        ("simulate", "helmet-120", "--out", "none/x.tagid.h5"),
        ("scan", "--radar", "emulator://helmet-120", "--axis-distance", "1", "--save-dir", "file/x"),
    ):
        done = tagid(*words)
        assert (done.code, done.err.count("error:")) == (1, 1), (words, done)


def test_a_port_in_use_is_named(tagid) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        done = tagid("emulate", "p440", "--bind", f"127.0.0.1:{port}", "--output", "json")
    (error,) = done.json["errors"]
    assert (done.code, error["code"]) == (4, "port_in_use") and str(port) in error["message"]


@pytest.mark.parametrize(
    "where",
    [
        {"angles_rad": np.zeros(36)},
        {"angles_rad": None, "axis_distance_m": None, "antenna_positions_m": np.ones((36, 3))},
    ],
    ids=["angles", "antenna positions"],
)
def test_views_from_one_place_are_not_imaged(
    tagid, tmp_path: Path, where: dict[str, object], request: pytest.FixtureRequest
) -> None:
    (tmp_path / "still.npz").write_bytes(npz(**where))
    done = tagid("reconstruct", "still.npz", "--method", "bp", "--out", "image.npz")
    assert done.code == 1
    assert f"the {request.node.callspec.id} of all 36 views are the same" in done.err
    assert not (tmp_path / "image.npz").exists()
