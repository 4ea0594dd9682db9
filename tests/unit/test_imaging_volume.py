"""Volumes: heights are told apart, blocks do not show, files are read back by other programs."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.errors import DataError, UsageError
from tagid.geometry import ImageGrid, VolumeGrid
from tagid.imaging import kernel, volume
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.volume import backproject_volume, sparse_volume
from tagid.pipeline.join import heights_of, join
from tagid.pipeline.volume import VolumeSettings, reconstruct_volume
from tagid.report.volume_picture import draw_projections, write_turning
from tagid.storage.volume import write_volume
from tests.unit.imaging_scenes import record, turn

HEIGHTS = (-0.2, -0.1, 0.0, 0.1, 0.2)
POINTS = np.array([[0.06, 0.02, 0.06], [0.06, 0.02, -0.07], [-0.05, -0.04, 0.01]])
GRID = VolumeGrid(ImageGrid(0.24, 24), -0.12, 0.12, 12)


def captures(noise: float = 0.02, apart: float = 0.0) -> list[Capture]:
    """A turn of 24 views from each height, each with a room of its own that does not turn."""
    found = []
    for number, height in enumerate(HEIGHTS):
        one = record(POINTS, [1, 0.8, 1], turn(24, 1.0, height, apart), start_m=0.6, noise=noise, seed=number)
        room = 3 * np.sin(np.arange(one.bins) * (0.3 + 0.05 * number))
        found.append(replace(one, samples=(one.samples + room).astype(np.float32)))
    return found


def brightest(values: np.ndarray, grid: VolumeGrid, count: int, apart_m: float) -> np.ndarray:
    """(count, 3) places of the brightest voxels that are so far apart."""
    left, found = np.abs(values).ravel().copy(), []
    places = grid.points()
    for _ in range(count):
        found.append(places[int(np.argmax(left))])
        left[np.linalg.norm(places - found[-1], axis=1) < apart_m] = 0
    return np.array(found)


@pytest.mark.parametrize("apart", [0.0, 0.2])
@pytest.mark.parametrize("method", ["bp", "sparse"])
def test_two_reflectors_of_one_radius_are_told_apart_by_height(method: str, apart: float) -> None:
    settings = VolumeSettings(method, 0.24, 24, (-0.12, 0.12), 12)
    made = reconstruct_volume(join(captures(apart=apart)), settings)
    # Backprojection resolves 95 mm in height with these antennas.
    found = brightest(made.volume.values, made.volume.grid, 3, 0.09 if method == "bp" else 0.04)
    errors = np.linalg.norm(found[:, None] - POINTS[None], axis=2).min(axis=0)
    assert errors.max() < (0.03 if method == "bp" else 0.02)
    assert (made.views, made.heights) == (120, 5)
    held_out = made.volume.settings["held_out"]
    if method == "sparse":
        assert held_out["residual"] < 0.3 * held_out["backprojection"]


def test_a_volume_is_the_matched_filter_of_every_voxel(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same in one block and in many, compiled or not, and for a point 1 at its voxel."""
    place = GRID.points()[1000]
    one = join([record([place], [1.0], turn(24, 1.0, height), start_m=0.6) for height in HEIGHTS])
    settings = PreprocessSettings("none", True, extent_m=0.24, heights_m=(-0.12, 0.12))
    scans = preprocess(one, settings=settings)
    whole = backproject_volume(scans, GRID)
    assert np.argmax(np.abs(whole.values)) == 1000
    assert abs(whole.values.ravel()[1000]) == pytest.approx(1, abs=0.02)
    calls: list[float] = []
    monkeypatch.setattr(volume, "_SLAB_VOXELS", 1200)
    monkeypatch.setattr(volume, "_VIEW_VALUES", 8000)
    monkeypatch.setattr(kernel, "_compiled", None)
    pieces = backproject_volume(scans, GRID, lambda done, total, _: calls.append(done / total))
    np.testing.assert_allclose(pieces.values, whole.values, atol=2e-3)
    assert calls == sorted(calls)
    assert len(calls) > 10
    assert calls[-1] == 1


def test_sparse_voxels_are_points_of_their_amplitude() -> None:
    settings = PreprocessSettings("none", False, extent_m=0.24, heights_m=(-0.12, 0.12))
    place = GRID.points()[1000]
    one = join([record([place], [2.0], turn(24, 1.0, height), start_m=0.6) for height in HEIGHTS])
    scans = preprocess(one, settings=settings)
    made = sparse_volume(scans, GRID)
    assert np.argmax(np.abs(made.values)) == 1000
    left = scans.samples - ForwardOperator(scans, GRID.points()).forward(made.values.ravel())
    assert np.vdot(left, left).real < 0.05 * np.vdot(scans.samples, scans.samples).real


def test_joined_captures_keep_their_positions_and_heights() -> None:
    parts = captures(apart=0.2)
    one = join(parts)
    for number, views in enumerate(heights_of(one)):
        assert (one.aperture().positions[views, 2] == HEIGHTS[number]).all()
    expected = np.concatenate([part.aperture().distances(POINTS) for part in parts])
    np.testing.assert_allclose(one.aperture().distances(POINTS), expected)
    with pytest.raises(UsageError, match="one capture"):
        join(parts[:1])
    with pytest.raises(DataError, match="the step between bins, the band"):
        join([parts[0], replace(parts[1], range_step_m=0.01, center_frequency_hz=4e9)])
    with pytest.raises(DataError, match="same height"):
        reconstruct_volume(join([parts[0], parts[0]]))


def test_files_are_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    values = (rng.standard_normal((12, 24, 24)) + 1j * rng.standard_normal((12, 24, 24))).astype(np.complex64)
    values[3, 10, 20] = 100
    made = volume.Volume(values, GRID, {"method": "bp"})
    for name in ("v.npz", "v.vti", "v.ply"):
        write_volume(tmp_path / name, made)
    with np.load(tmp_path / "v.npz") as file:
        np.testing.assert_array_equal(file["volume"], values)
        np.testing.assert_allclose(file["z_m"], GRID.heights)
    head, _, body = (tmp_path / "v.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 1\n" in head
    x, y, z, magnitude = struct.unpack("<4f", body)
    axis = GRID.square.axis
    assert (x, y, z) == pytest.approx((axis[20], axis[10], GRID.heights[3]), rel=1e-6)
    assert magnitude == 100
    axes = GRID.square.axis, GRID.heights
    draw_projections(values, *axes, tmp_path / "v.png", "three views")
    write_turning(values, *axes, tmp_path / "v.webp")
    from PIL import Image

    with Image.open(tmp_path / "v.png") as picture, Image.open(tmp_path / "v.webp") as film:
        assert picture.size[0] > picture.size[1]
        assert film.n_frames == 48
    with pytest.raises(UsageError, match="no name of a volume"):
        write_volume(tmp_path / "v.stl", made)


def test_vtk_reads_the_volume(tmp_path: Path) -> None:
    vtk = pytest.importorskip("vtkmodules.vtkIOXML", reason="VTK checks the file where it is installed")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    values = (np.arange(12 * 24 * 24).reshape(12, 24, 24) * np.exp(0.7j)).astype(np.complex64)
    write_volume(tmp_path / "v.vti", volume.Volume(values, GRID, {}))
    reader = vtk.vtkXMLImageDataReader()
    reader.SetFileName(str(tmp_path / "v.vti"))
    reader.Update()
    image = reader.GetOutput()
    assert image.GetDimensions() == (24, 24, 12)
    assert image.GetSpacing() == pytest.approx((0.01, 0.01, 0.02))
    assert image.GetOrigin() == pytest.approx((GRID.square.axis[0], GRID.square.axis[0], GRID.heights[0]))
    data = image.GetPointData()
    magnitude = vtk_to_numpy(data.GetArray("magnitude")).reshape(12, 24, 24)
    phase = vtk_to_numpy(data.GetArray("phase")).reshape(12, 24, 24)
    np.testing.assert_allclose(magnitude * np.exp(1j * phase), values, rtol=1e-5)


def test_from_the_command_line(tagid) -> None:
    names = []
    for number, height in enumerate((0.0, 0.2)):
        names.append(f"{number}.tagid.h5")
        words = ("--views", 24, "--antenna-height", height, "--elevation", "0.05m", "--seed", 3)
        assert tagid("simulate", "points-3", *words, "--out", names[-1]).code == 0
    joined = tagid("join", *names, "--out", "all.npz", "--output", "json")
    assert joined.code == 0, joined.err
    assert joined.json["data"]["heights_m"] == pytest.approx([0.0, 0.2])
    words = ("--method", "sparse", "--extent", 0.3, "--pixels", 32, "--heights", "-0.1,0.15", "--levels", 5)
    made = tagid("reconstruct", "all.npz", "--volume", *words, "--ply", "a.ply", "--output", "json")
    assert made.code == 0, made.err
    settings = made.json["data"]["settings"]
    assert settings["held_out"]["residual"] < 0.3 * settings["held_out"]["backprojection"]
    wrong = tagid("reconstruct", "all.npz", "--levels", 5)
    assert wrong.code == 2
    assert "--volume" in wrong.err
