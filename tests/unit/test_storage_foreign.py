"""Files of other programs: the vendor's MATLAB structs are read, other containers are named with a way on."""

from __future__ import annotations

import io
import json
import pickle
import struct
import tarfile
import zipfile
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from tagid.constants import RANGE_STEP_M
from tagid.errors import FileFormatError, UsageError
from tagid.storage.importers import read_any, remarks

VIEWS, BINS = 5, 96
SAMPLES = np.random.default_rng(4).integers(-90_000, 90_000, (VIEWS, BINS)).astype(np.int32)
CONFIG = {
    "T": 0, "nodeID": 7, "Tstrt": 10_000, "Tstp": 15_858, "Nbin": 32, "BII": 11, "Iant": 2, "Gtmt": 63,
    "Ichan": 0,
}  # fmt: skip


def scan(view: int, node: int = 7, filtering: int = 1) -> dict[str, Any]:
    return {
        "T": 4.1e8 + view, "msgID": view, "srcID": node, "Tstmp": 1000 + 20 * view, "Tstrt": 10_000,
        "Tstp": 15_858, "Nbin": 32, "Nfilt": filtering, "antID": 2, "Imode": 3, "Nscn": BINS,
        "scn": SAMPLES[view][:, None],
    }  # fmt: skip


def array_of(scans: list[dict[str, Any]]) -> np.ndarray:
    """A MATLAB struct array."""
    array = np.empty((1, len(scans)), [(name, object) for name in scans[0]])
    for at, values in enumerate(scans):
        for name, value in values.items():
            array[name][0, at] = value
    return array


ALL = [scan(view) for view in range(VIEWS)]
COLUMNS = {name: np.array([item[name] for item in ALL]) for name in ALL[0] if name != "scn"} | {
    "scn": SAMPLES
}
VARIABLES: dict[str, dict[str, Any]] = {
    "structs": {"cfg": CONFIG, "req": [], "scn": array_of(ALL), "det": []},
    "columns": {"cfg": CONFIG, "scn": COLUMNS},
    "columns transposed": {"cfg": CONFIG, "scn": {**COLUMNS, "scn": SAMPLES.T.astype(float)}},
    "only scans": {"scn": array_of(ALL)},
    "nested": {"run1": {"config": CONFIG, "scans": array_of(ALL)}},
    "filtered": {"cfg": CONFIG, "scn": array_of([s for v in range(VIEWS) for s in (scan(v), scan(v, 7, 4))])},
}


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", VARIABLES)
def test_the_structs_of_the_vendors_reader(tmp_path: Path, kind: str, compressed: bool) -> None:
    savemat(tmp_path / "a.mat", VARIABLES[kind], do_compression=compressed)
    capture = read_any(tmp_path / "a.mat")
    np.testing.assert_array_equal(capture.samples, SAMPLES)
    assert capture.range_step_m == pytest.approx(RANGE_STEP_M)
    assert capture.radar_time_ms.tolist() == [1000 + 20 * i for i in range(5)]
    assert capture.radar.config.base_integration_index == (None if kind == "only scans" else 11)
    if kind == "filtered":
        assert remarks(capture) == ("ignored: 5 filtered scans of the same radar",)


def test_structs_of_several_radars_ask_for_the_node(tmp_path: Path) -> None:
    savemat(
        tmp_path / "a.mat", {"scn": array_of([s for v in range(VIEWS) for s in (scan(v), scan(v, node=9))])}
    )
    with pytest.raises(UsageError, match="2 radars"):
        read_any(tmp_path / "a.mat")
    assert read_any(tmp_path / "a.mat", node=9).radar.node_id == 9


@pytest.mark.parametrize(
    "change",
    [{"scn": "text"}, {"Tstmp": np.nan}, {"Tstrt": 1e12}, {"Nbin": 0}, {"scn": np.full((96, 1), 0.5)}],
)
def test_structs_that_no_p440_makes(tmp_path: Path, change: dict[str, Any]) -> None:
    savemat(tmp_path / "a.mat", {"scn": array_of([{**scan(0), **change}, scan(1)])})
    with pytest.raises(FileFormatError):
        read_any(tmp_path / "a.mat")


def test_structs_that_claim_more_than_they_hold(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"scn": array_of(ALL)})
    data = path.read_bytes()
    assert data.count(struct.pack("<ii", 1, VIEWS)) >= 1
    path.write_bytes(data.replace(struct.pack("<ii", 1, VIEWS), struct.pack("<ii", 30_000, 60_000)))
    with pytest.raises(FileFormatError, match="claims"):
        read_any(path)
    bomb = zlib.compress(bytes(64 << 20))
    path.write_bytes(data[:128] + struct.pack("<II", 15, len(bomb)) + bomb)
    with pytest.raises(FileFormatError):
        read_any(path)


def _zip(*names: str) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in names:
            archive.writestr(name, "x")
    return buffer.getvalue()


def _written(write: Any) -> bytes:
    buffer = io.BytesIO()
    write(buffer)
    return buffer.getvalue()


def _tar(buffer: io.BytesIO) -> None:
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("a"))


def _hdf5(buffer: io.BytesIO) -> None:
    with h5py.File(buffer, "w") as file:
        file["scans"] = SAMPLES


def _matlab_7_3(buffer: io.BytesIO) -> None:
    with h5py.File(buffer, "w", userblock_size=512) as file:
        file["scans"] = SAMPLES
    buffer.seek(0)
    buffer.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64")


CONTAINERS = {
    "Excel workbook": _zip("[Content_Types].xml", "xl/workbook.xml"),
    "OpenDocument": _zip("mimetype", "content.xml"),
    "ZIP archive": _zip("scan1.csv"),
    "xls": b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600),
    "pickle": pickle.dumps({"scans": [1, 2]}),
    "npy": _written(lambda buffer: np.save(buffer, SAMPLES)),
    "JSON": json.dumps({"scans": SAMPLES.tolist()}).encode(),
    "WAV": b"RIFF\x64\0\0\0WAVEfmt " + bytes(99),
    "SQLite": b"SQLite format 3\0" + bytes(99),
    "tar": _written(_tar),
    "gzip": zlib.compress(b"x" * 99, wbits=31),
    "Parquet": b"PAR1" + bytes(99) + b"PAR1",
    "Feather": b"ARROW1\0\0" + bytes(99),
    "pcap": b"\xd4\xc3\xb2\xa1\2\0\4\0" + bytes(99),
    "ROS bag": b"#ROSBAG V2.0\n" + bytes(99),
    "table of numbers": "\n".join(",".join(map(str, row)) for row in SAMPLES.tolist()).encode(),
    "HDF5": _written(_hdf5),
    "MATLAB 7.3": _written(_matlab_7_3),
    "MATLAB file with Y, fs": _written(lambda buffer: savemat(buffer, {"Y": SAMPLES, "fs": 1.0})),
}


@pytest.mark.parametrize("name", CONTAINERS)
def test_other_containers_are_named_with_a_way_on(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.bin").write_bytes(CONTAINERS[name])
    with pytest.raises(FileFormatError, match=name) as raised:
        read_any(tmp_path / "a.bin")
    packed = name in ("ZIP archive", "tar", "gzip")
    assert ("Unpack" if packed else "numpy.savez(") in raised.value.remedy
