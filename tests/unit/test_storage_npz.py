"""NPZ and MATLAB files, telling files apart by content, files of older versions, and long recordings."""

from __future__ import annotations

import io
import pickle
import shutil
import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import loadmat, savemat
from storage_samples import assert_equal, capture

from tagid.errors import FileFormatError, StorageError, UsageError
from tagid.metadata import ObjectInfo, RadarInfo
from tagid.storage.exporters import export
from tagid.storage.importers import read_any
from tagid.storage.journal import JournalWriter
from tagid.storage.journal_capture import write_captures
from tagid.storage.metadata import read_metadata, stored_version

GOOD: dict[str, Any] = {
    "samples": np.linspace(-1, 1, 24).reshape(4, 6),
    "range_start_m": 0.5,
    "range_step_m": 0.01,
    "angles_rad": np.arange(4.0),
    "axis_distance_m": 1.5,
}


def npz(path: Path, remove: tuple[str, ...] = (), **changes: Any) -> Path:
    np.savez(path, **{k: v for k, v in {**GOOD, **changes}.items() if k not in remove})
    return path


def test_generic_file_of_another_radar(tmp_path: Path) -> None:
    c = read_any(npz(tmp_path / "a.npz", object="box 3", antenna_height_m=0.2, center_frequency_hz=6e9))
    assert c.samples.dtype == np.float32 and c.samples.shape == (4, 6)
    np.testing.assert_array_equal(c.angles_rad, np.arange(4.0))
    assert (c.axis_distance_m, c.antenna_height_m, c.center_frequency_hz) == (1.5, 0.2, 6e9)
    assert c.object == ObjectInfo(label="box 3") and c.complete
    single = {"samples": np.ones((1, 1)), "angles_rad": np.zeros(1)}
    assert read_any(npz(tmp_path / "b.npz", **single)).samples.shape == (1, 1)


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [("centre_frequency_hz", "center_frequency_hz"), ("Bandwith_Hz", "bandwidth_hz")],
)
def test_a_misspelt_key_is_an_error_not_a_default(tmp_path: Path, wrong: str, meant: str) -> None:
    with pytest.raises(FileFormatError, match=f"is it {meant}") as raised:
        read_any(npz(tmp_path / "a.npz", **{wrong: 1e9}))
    assert meant in raised.value.remedy
    # A key of its own, or beside the right one, is nobody's mistake.
    read_any(npz(tmp_path / "b.npz", temperature_c=20.0))
    read_any(npz(tmp_path / "c.npz", **{wrong: 1e9, meant: 1e6}))


def turn(views: int = 36, **changes: Any) -> dict[str, Any]:
    scans = np.random.default_rng(views).standard_normal((views, 16))
    return {"samples": scans, "angles_rad": np.arange(views) * 2 * np.pi / views, **changes}


JITTER = np.random.default_rng(3).normal(0, 0.1, 360)
DEGREES = {
    "8 views": np.arange(8) * 45.0,
    "36 views, clockwise": np.arange(36) * -10.0,
    "1440 views": np.arange(1440) / 4,
    "1440 views, clockwise": np.arange(1440) / -4,
    "jitter": np.arange(360) + JITTER,
    "part": np.arange(120.0),
    "wrapped": (np.arange(360) + 180.0) % 360 - 180,
    "again from 0": (np.arange(0, 360, 0.5) + 100) % 360,
    "twice again from 0": (np.arange(0, 720, 0.5) + 100) % 360,
    "turns": np.arange(720.0),
    "fine": np.arange(720) / 2 + 0.3 * np.tile(JITTER, 2),
    "lost": np.delete(np.arange(720) / 2, np.arange(100, 110)),
}


@pytest.mark.parametrize("case", DEGREES)
def test_angles_in_degrees_are_refused_with_the_conversion(tmp_path: Path, case: str) -> None:
    degrees, views = DEGREES[case], len(DEGREES[case])
    with pytest.raises(FileFormatError, match="not radians") as raised:
        read_any(npz(tmp_path / "a.npz", **turn(views, angles_rad=degrees)))
    assert "deg2rad" in raised.value.remedy
    assert read_any(npz(tmp_path / "b.npz", **turn(views, angles_rad=np.deg2rad(degrees)))).views == views


def test_few_views_a_turn_and_golden_angles_of_one_turn_are_radians(tmp_path: Path) -> None:
    for step in (2 * np.pi / 6, 2.39996):
        wrapped = np.arange(30) * step % (2 * np.pi)
        assert read_any(npz(tmp_path / "a.npz", **turn(30, angles_rad=wrapped))).views == 30


def test_ranges_in_millimetres_are_refused_with_the_conversion(tmp_path: Path) -> None:
    changes = {"range_start_m": 300.0, "range_step_m": 9.15, "axis_distance_m": 1000.0}
    with pytest.raises(FileFormatError, match="not metres") as raised:
        read_any(npz(tmp_path / "a.npz", **turn(**changes)))
    assert "by 1000" in raised.value.remedy
    metres = {name: value / 1000 for name, value in changes.items()}
    assert read_any(npz(tmp_path / "b.npz", **turn(**metres))).axis_distance_m == 1.0


def test_many_turns_in_radians_and_long_ranges_of_a_narrow_band_are_no_wrong_units(tmp_path: Path) -> None:
    turns = np.arange(600) * 0.7
    assert read_any(npz(tmp_path / "a.npz", **turn(600, angles_rad=turns))).views == 600
    coarse = turn(range_step_m=9.15, bandwidth_hz=5e6, center_frequency_hz=1e8, axis_distance_m=1000.0)
    assert read_any(npz(tmp_path / "b.npz", **coarse)).range_step_m == 9.15
    # A thousandth of 200 m is no range step of this band either.
    coarse = turn(range_start_m=1e3, range_step_m=200.0, axis_distance_m=1.5e3)
    assert read_any(npz(tmp_path / "c.npz", **coarse)).range_step_m == 200.0
    base = tmp_path / "own.npz"
    export(capture(angles_rad=np.arange(capture().views) * 360.0 / capture().views), base)
    assert read_any(base).angles_rad is not None


@pytest.mark.parametrize(
    ("dtype", "scale", "expected"),
    [("int16", 1, "int32"), ("uint64", 1, "int32"), ("int64", 2**40, "float32"), (">i4", 1, "int32"),
     (">f8", 1, "float32"), ("float16", 1, "float32"), (">c8", 1, "complex64")],
)  # fmt: skip
def test_dtypes_by_row_and_as_matlab_by_column(tmp_path: Path, dtype: str, scale: int, expected: str) -> None:
    values = (np.arange(24).reshape(4, 6) * scale).astype(dtype)
    for order in "CF":
        c = read_any(npz(tmp_path / "a.npz", samples=np.asarray(values, order=order)))
        assert c.samples.dtype == np.dtype(expected) and c.samples.dtype.isnative
        np.testing.assert_allclose(c.samples, np.arange(24.0).reshape(4, 6) * scale)


def test_times_or_positions_instead_of_angles(tmp_path: Path) -> None:
    c = read_any(
        npz(tmp_path / "a.npz", ("angles_rad", "axis_distance_m"), timestamps_s=np.array([0, 0.5, 1, 2]))
    )
    assert c.radar_time_ms.tolist() == [0, 500, 1000, 2000]
    c = read_any(npz(tmp_path / "a.npz", ("angles_rad",), antenna_positions_m=np.ones((4, 3))))
    assert c.antenna_positions_m is not None and c.angles_rad is None
    c = read_any(npz(tmp_path / "a.npz", object='{"kind": "helmet"}', pulse=[0, 1, 0], pulse_step_s=1e-11))
    assert c.object == ObjectInfo(extra={"kind": "helmet"}) and c.pulse is not None and c.pulse.step == 1e-11


BAD: dict[str, tuple[tuple[str, ...], dict[str, Any], str]] = {
    "no samples": (("samples",), {}, "samples"),
    "no range step": (("range_step_m",), {}, "range_step_m"),
    "no place": (("angles_rad",), {}, "antenna positions"),
    "no axis distance": (("axis_distance_m",), {}, "axis_distance_m"),
    "flat": ((), {"samples": np.ones(24)}, "(24,)"),
    "cube": ((), {"samples": np.ones((4, 3, 2))}, "(4, 3, 2)"),
    "no views": ((), {"samples": np.ones((0, 6))}, "(0, 6)"),
    "objects": ((), {"samples": np.array([[{}], [1]], dtype=object)}, "samples"),
    "text": ((), {"samples": np.array([["a", "b"]])}, "dtype"),
    "booleans": ((), {"samples": np.ones((4, 6), bool)}, "dtype"),
    "records": ((), {"samples": np.zeros((4, 6), [("a", "i4")])}, "dtype"),
    "NaN": ((), {"samples": np.full((4, 6), np.nan)}, "non-finite"),
    "too large for float32": ((), {"samples": np.full((4, 6), 1e300)}, "non-finite"),
    "angles of another length": ((), {"angles_rad": np.zeros(5)}, "(5,)"),
    "angles NaN": ((), {"angles_rad": np.full(4, np.nan)}, "angles_rad"),
    "angles complex": ((), {"angles_rad": np.zeros(4, complex)}, "angles_rad"),
    "positions flat": (("angles_rad",), {"antenna_positions_m": np.ones((4, 2))}, "(4, 2)"),
    "receivers alone": (
        ("angles_rad",),
        {"receive_positions_m": np.ones((4, 3)), "timestamps_s": np.arange(4.0)},
        "transmitting",
    ),
    "transmitters alone": (("angles_rad",), {"transmit_positions_m": np.ones((4, 3))}, "receive_positions_m"),
    "antennas a negative distance apart": ((), {"antenna_separation_m": -0.1}, "antenna_separation_m"),
    "angles and positions": ((), {"antenna_positions_m": np.ones((4, 3))}, "not both"),
    "times infinite": ((), {"timestamps_s": np.full(4, 1e308)}, "timestamps_s"),
    "range step of zero": ((), {"range_step_m": 0.0}, "range_step_m"),
    "range step of nothing": ((), {"range_step_m": 5e-324}, "not plausible"),
    "range start beyond all": ((), {"range_start_m": 1e300}, "not plausible"),
    "bandwidth beyond all": ((), {"bandwidth_hz": 1e300}, "not plausible"),
    "range start a vector": ((), {"range_start_m": np.ones(2)}, "range_start_m"),
    "axis distance negative": ((), {"axis_distance_m": -1.0}, "axis_distance_m"),
    "pulse without step": ((), {"pulse": np.ones(5)}, "pulse_step_s"),
    "pulse of zeros": ((), {"pulse": np.zeros(5), "pulse_step_s": 1e-12}, "pulse"),
    "object a number": ((), {"object": 5}, "object"),
    "tagid not JSON": ((), {"tagid": "{"}, "tagid"),
    "scan ids as float": ((), {"scan_id": np.zeros(4)}, "scan_id"),
    "flags too large": ((), {"flags": np.full(4, 300)}, "flags"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_content(tmp_path: Path, name: str) -> None:
    remove, changes, said = BAD[name]
    path = npz(tmp_path / "a.npz", remove, **changes)
    with pytest.raises(FileFormatError) as caught:
        read_any(path)
    assert str(path) in caught.value.message and said in caught.value.message


class Bomb:
    """Would leave a file behind if it were unpickled."""

    def __reduce__(self) -> Any:
        return (Path.touch, (Path("unpickled"),))


def test_nothing_is_unpickled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.npz").write_bytes(member("samples", b"\x80" + pickle.dumps(Bomb())))
    with pytest.raises(FileFormatError):
        read_any(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", **{**GOOD, "samples": np.array([[Bomb()]], dtype=object)})
    with pytest.raises(FileFormatError):
        read_any(tmp_path / "b.npz")
    assert not (tmp_path / "unpickled").exists()


def member(key: str, content: bytes) -> bytes:
    """An NPZ file whose `key` holds these raw bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, **{k: v for k, v in GOOD.items() if k != key})
    with zipfile.ZipFile(buffer, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{key}.npy", content)
    return buffer.getvalue()


def header(text: str, version: bytes = b"\1\0") -> bytes:
    return b"\x93NUMPY" + version + len(text).to_bytes(2, "little") + text.encode()


@pytest.mark.parametrize(
    "content",
    [
        header("{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000, 1000000000), }\n"),
        header("{'descr': '<f4', 'fortran_order': False, 'shape': (-1, -40), }\n"),
        header("{'descr': '<f4', 'fortran_order': False, 'shape': (True, 6), }\n") + bytes(100),
        header("{'descr': '|V0', 'fortran_order': False, 'shape': (4, 6), }\n"),
        header("{'descr': '<U0', 'fortran_order': False, 'shape': (99999999999, 6), }\n"),
        header("[" * 9000),
        header("{'descr': '<f4'}", b"\7\7"),
        b"",
        b"\x93NUM",
    ],
)
def test_hostile_array_headers(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.npz").write_bytes(member("samples", content))
    with pytest.raises(FileFormatError):
        read_any(tmp_path / "a.npz")


def test_zip_bomb(tmp_path: Path) -> None:
    shape = "{'descr': '|i1', 'fortran_order': False, 'shape': (1000, 20000), }\n"
    (tmp_path / "a.npz").write_bytes(member("samples", header(shape) + bytes(20_000_000)))
    assert (tmp_path / "a.npz").stat().st_size < 40_000
    with pytest.raises(FileFormatError, match="not plausible"):
        read_any(tmp_path / "a.npz")


def test_damage_gives_the_same_samples_or_an_error(tmp_path: Path) -> None:
    shown = capture()
    export(shown, tmp_path / "a.tagid.h5")
    data = (tmp_path / "a.tagid.h5").read_bytes()
    rng = np.random.default_rng(3)
    refused = 0
    for turn in range(100):
        bad = bytearray(data)
        if turn % 3:
            bad[rng.integers(len(bad))] ^= 1 << rng.integers(8)
        else:
            bad = bad[: rng.integers(len(bad))]
        (tmp_path / "b").write_bytes(bad)
        try:
            again = read_any(tmp_path / "b")
        except FileFormatError:
            refused += 1
        else:
            assert_equal(shown, again)
    assert refused > 67


def test_unknown_suffix_lists_those_known(tmp_path: Path) -> None:
    for name in ("a", "a.npy"):
        with pytest.raises(UsageError) as caught:
            export(capture(), tmp_path / name)
        assert ".npz" in caught.value.remedy and ".mat" in caught.value.remedy


def test_content_decides_not_the_name(tmp_path: Path) -> None:
    shown = capture()
    export(shown, tmp_path / "a.h5")
    (tmp_path / "a.h5").rename(tmp_path / "a.npz")
    assert_equal(shown, read_any(tmp_path / "a.npz"))
    with JournalWriter(tmp_path / "b.csv", {"range_start_m": 0.0, "range_step_m": 0.01}) as journal:
        journal.append(0, 0, 0.0, np.arange(5, dtype=np.float32))
    assert read_any(tmp_path / "b.csv").samples.tolist() == [[0, 1, 2, 3, 4]]


@pytest.mark.parametrize("suffix", [".npz", ".tagid.journal", ""])
def test_no_such_content(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    noise = np.random.default_rng(0).bytes(5000)
    for content in (b"", b"\0", bytes(5000), noise, b"hello, world\n" * 90, b"PK\3\4", b"\x89HDF\r\n\x1a\n"):
        path.write_bytes(content)
        with pytest.raises(FileFormatError) as caught:
            read_any(path)
        assert str(path) in caught.value.message and caught.value.remedy


def test_no_file_to_read(tmp_path: Path) -> None:
    for path in (tmp_path / "none.npz", tmp_path, Path("/dev/zero"), tmp_path / ("x" * 300)):
        with pytest.raises(StorageError):
            read_any(path)


def test_every_format_names_the_angles_alike_and_takes_the_old_name(tmp_path: Path) -> None:
    shown = capture()
    for name in ("a.npz", "a.mat", "a.tagid.h5"):
        export(shown, tmp_path / name)
    with np.load(tmp_path / "a.npz") as arrays, h5py.File(tmp_path / "a.tagid.h5") as file:
        held = (dict(arrays), loadmat(tmp_path / "a.mat"), file["scans"])
        for arrays_of in held:
            assert np.ravel(arrays_of["angles_rad"]) == pytest.approx(shown.angles_rad)
            np.testing.assert_array_equal(arrays_of["samples"], shown.samples)  # a view is a row
        mat = held[1]
        np.testing.assert_allclose(mat["range_m"][:, 0], shown.ranges_m)
        assert mat["axis_distance_m"].item() == 1.25 and mat["object"].item() == '{"label": "helmet 7"}'
        old = {("angle_rad" if key == "angles_rad" else key): value for key, value in held[0].items()}
        in_matlab = {("angle_rad" if key == "angles_rad" else key): value for key, value in held[1].items()}
    np.savez(tmp_path / "old.npz", **old)
    savemat(tmp_path / "old.mat", {key: value for key, value in in_matlab.items() if key[:2] != "__"})
    shutil.copy(tmp_path / "a.tagid.h5", tmp_path / "old.tagid.h5")
    with h5py.File(tmp_path / "old.tagid.h5", "r+") as file:
        file.move("scans/angles_rad", "scans/angle_rad")
    for name in ("old.npz", "old.mat", "old.tagid.h5"):
        np.testing.assert_array_equal(read_any(tmp_path / name).angles_rad, shown.angles_rad)
    with h5py.File(tmp_path / "old.tagid.h5", "r+") as file:
        file["scans/angles_rad"] = shown.angles_rad + 1
    np.testing.assert_array_equal(read_any(tmp_path / "old.tagid.h5").angles_rad, shown.angles_rad + 1)


@pytest.mark.parametrize(("placed", "wanted"), [(True, (11, 2.0, 30.0)), (False, (7, 3.0, 20.0))])
def test_settings_and_facts_of_the_first_version_do_not_replace_those_in_their_place(
    placed: bool, wanted: tuple[float, ...]
) -> None:
    assert stored_version({}, "a file without a version") == 1
    radar: dict[str, Any] = {"base_integration_index": 7}
    motion: dict[str, Any] = {"rpm": 3.0, "period_s": 20.0}
    if placed:
        radar["config"] = {"base_integration_index": 11}
        motion |= {"nominal_rpm": 2.0, "resolved": {"period_s": 30.0}}
    result = read_metadata({"radar": radar, "motion": motion}, "a file", 1)
    read = result["motion"]
    assert (result["radar"].config.base_integration_index, read.nominal_rpm, read.resolved.period_s) == wanted


@pytest.mark.parametrize(("scans", "parts"), [(10, [4, 4, 2]), (8, [4, 4]), (3, [3])])
def test_the_parts_of_a_long_recording_hold_every_scan_once(
    tmp_path: Path, scans: int, parts: list[int]
) -> None:
    samples = np.arange(scans * 6, dtype=np.int32).reshape(scans, 6)
    with JournalWriter(tmp_path / "j", {"range_start_m": 0.4, "range_step_m": 0.01}) as journal:
        for number, values in enumerate(samples):
            journal.append(number, 10**18 + number, 20.0 * number, values)
        journal.close({})
    made = write_captures(
        tmp_path / "j", lambda part: tmp_path / f"{part}.tagid.h5", RadarInfo(scans_lost=5), part_bytes=4 * 24
    )
    captures = [read_any(path) for path in made.paths]
    assert [capture.views for capture in captures] == parts and made.views == scans
    np.testing.assert_array_equal(np.concatenate([capture.samples for capture in captures]), samples)
    assert len({capture.uuid for capture in captures}) == len(parts), "each is a recording of its own"
    assert all(capture.complete and capture.radar.scans_lost == 5 for capture in captures)
    positions = [capture.radar.recording for capture in captures]
    if len(parts) > 1:
        assert [(place.uuid, place.part, place.parts) for place in positions] == [
            (captures[0].uuid, number + 1, len(parts)) for number in range(len(parts))
        ]
