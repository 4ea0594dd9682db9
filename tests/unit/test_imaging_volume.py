"""Volumes: heights are told apart, blocks do not show, files are read back by other programs."""

from __future__ import annotations

import struct
import tracemalloc
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from tagid.capture import Capture
from tagid.errors import DataError, UsageError
from tagid.geometry import ImageGrid, VolumeGrid
from tagid.imaging import kernel, memory, volume
from tagid.imaging.ats import volume as volume_fit
from tagid.imaging.ats.volume import Field, Interpolation, fit_volume
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.volume import backproject_volume
from tagid.pipeline.join import heights_of, join
from tagid.pipeline.volume import VolumeSettings, reconstruct_volume
from tagid.report.arrays import isosurface, write_surface, write_volume
from tagid.report.volume_picture import draw_projections, write_turning
from tests.unit.imaging_scenes import record, turn

HEIGHTS = (-0.2, -0.1, 0.0, 0.1, 0.2)
POINTS = np.array([[0.06, 0.02, 0.06], [0.06, 0.02, -0.07], [-0.05, -0.04, 0.01]])
GRID = VolumeGrid(ImageGrid(0.24, 24), -0.12, 0.12, 12)


def captures(noise: float = 0.02, apart: float = 0.0) -> list[Capture]:
    """A turn of 24 views from each height, each with a room of its own that does not turn."""
    results = []
    for number, height in enumerate(HEIGHTS):
        aperture = turn(24, 1.0, height, apart)
        recorded = record(POINTS, [1, 0.8, 1], aperture, start_m=0.6, noise=noise, seed=number)
        room = 3 * np.sin(np.arange(recorded.bins) * (0.3 + 0.05 * number))
        results.append(replace(recorded, samples=(recorded.samples + room).astype(np.float32)))
    return results


def without_room(points: object, amplitudes: list[float]) -> Capture:
    """All heights joined, without noise or room."""
    return join([record(points, amplitudes, turn(24, 1.0, height), start_m=0.6) for height in HEIGHTS])


LOW = VolumeSettings("bp", 0.24, 16, (-0.12, 0.12), 4, held_out=False)


def brightest(values: np.ndarray, grid: VolumeGrid, count: int, apart_m: float) -> np.ndarray:
    """(count, 3) places of the brightest voxels that are so far apart."""
    remaining, result = np.abs(values).ravel().copy(), []
    positions = grid.points()
    for _ in range(count):
        result.append(positions[int(np.argmax(remaining))])
        remaining[np.linalg.norm(positions - result[-1], axis=1) < apart_m] = 0
    return np.array(result)


@pytest.mark.parametrize(("method", "apart"), [("bp", 0.0), ("sparse", 0.2), ("ats", 0.2)])
def test_two_reflectors_of_one_radius_are_told_apart_by_height(method: str, apart: float) -> None:
    settings = VolumeSettings(method, 0.24, 24, (-0.12, 0.12), 12)
    made = reconstruct_volume(join(captures(apart=apart)), settings)
    # Backprojection resolves 95 mm in height with these antennas.
    result = brightest(made.volume.values, made.volume.grid, 3, 0.09 if method == "bp" else 0.04)
    errors = np.linalg.norm(result[:, None] - POINTS[None], axis=2).min(axis=0)
    assert errors.max() < (0.03 if method == "bp" else 0.02)
    assert (made.views, made.heights) == (120, 5)
    held_out = made.volume.settings["held_out"]
    if method != "bp":
        assert held_out["residual"] < 0.3 * held_out["backprojection"]


def test_a_volume_beyond_the_ranges_is_refused_and_one_of_coarse_voxels_warned_of() -> None:
    joined = join(captures())
    with pytest.raises(UsageError, match="beyond the recorded ranges"):
        reconstruct_volume(joined, VolumeSettings("bp", 40.0, 32))
    coarse = replace(LOW, extent_m=0.8, heights_m=(-0.05, 0.05), levels=2)
    assert "coarser" in reconstruct_volume(joined, coarse).volume.settings["warnings"][0]
    fine = replace(coarse, extent_m=0.24)
    assert "warnings" not in reconstruct_volume(joined, fine).volume.settings


def test_a_volume_is_the_matched_filter_of_every_voxel(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same in one block and in many, compiled or not, and for a point 1 at its voxel."""
    place = GRID.points()[1000]
    settings = PreprocessSettings("none", True, extent_m=0.24, heights_m=(-0.12, 0.12))
    scans = preprocess(without_room([place], [1.0]), settings=settings)
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


def test_a_fit_begins_as_the_backprojection_and_ends_below_it(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = PreprocessSettings("none", False, extent_m=0.24, heights_m=(-0.12, 0.12))
    joined = without_room(POINTS, [1, 0.8, 1])
    scans = preprocess(joined, settings=settings)
    matched = preprocess(joined, settings=replace(settings, matched_filter=True))
    calls: list[float] = []
    remaining = []
    for steps in (1, 60):
        made = fit_volume(matched, scans, GRID, lambda d, t, _: calls.append(d / t), steps)
        seen = ForwardOperator(scans, GRID.points()).forward(made.values.ravel())
        remaining.append(np.linalg.norm(seen - scans.samples) ** 2 / np.linalg.norm(scans.samples) ** 2)
        assert calls == sorted(calls)
        assert calls[-1] == pytest.approx(1)
        calls.clear()
    first = backproject_volume(matched, GRID)
    fitted = np.abs(first.values) >= 0.1 * np.abs(first.values).max()
    assert (made.values[~fitted] == 0).all()
    assert made.settings["active_voxels"] == fitted.sum()
    assert remaining[1] < 0.06
    assert remaining[1] < 0.2 * remaining[0]
    monkeypatch.setattr(volume_fit, "MOST_ACTIVE", 50)
    few = fit_volume(matched, scans, GRID, steps=1)
    assert np.count_nonzero(few.values) == 50
    assert np.abs(first.values)[few.values != 0].min() >= np.sort(np.abs(first.values).ravel())[-50]
    dark = replace(scans, samples=np.zeros_like(scans.samples))
    assert not fit_volume(replace(matched, samples=np.zeros_like(matched.samples)), dark, GRID).values.any()


def test_the_gradient_of_the_field_is_that_of_its_loss() -> None:
    """A small step against the gradient of sum |sigma - t|^2 lowers it by rate times |gradient|^2."""
    rng = np.random.default_rng(0)
    axes = [tuple(np.linspace(0, 1, n) for _ in range(3)) for n in (2, 3)]
    at = [Interpolation.of(rng.random((40, 3)), ax) for ax in axes]
    table, values = rng.random((2, 27)).astype(np.float32), rng.random((2, 40)).astype(np.float32)
    assert np.vdot(at[1].read(table), values) == pytest.approx(np.vdot(table, at[1].spread(values)), rel=1e-5)
    first = rng.standard_normal(27) + 1j * rng.standard_normal(27)
    field = Field.carrying(first, at, 2.0)
    values = field.evaluate(field.layers()[-1])
    expected = 2 * (at[1].read(first.real[None]) + 1j * at[1].read(first.imag[None]))[0]
    np.testing.assert_allclose(values, expected, atol=0.2 * np.abs(values).max())
    target = (rng.standard_normal(40) + 1j * rng.standard_normal(40)).astype(np.complex64)

    def loss(single: Field) -> float:
        return float((np.abs(single.evaluate(single.layers()[-1]) - target) ** 2).sum())

    before, start = loss(field), [parameter.copy() for parameter in field.parameters]
    layers = field.layers()
    field.descend(layers, 2 * (values - target), 1e-5, 1)
    moved = [a - b for a, b in zip(field.parameters, start, strict=True)]
    # Numerically along every tensor's own step.
    predicted = 0.0
    for number, step in enumerate(moved):
        single = Field([item.copy() for item in start], at, field.scale)
        single.parameters[number] = start[number] + 30 * step
        predicted += (loss(single) - before) / 30
    assert loss(field) < before
    assert loss(field) - before == pytest.approx(predicted, rel=0.05)
    assert all((np.abs(step) > 0).any() for step in moved)


def test_interpolation_is_linear_along_every_axis() -> None:
    """A linear function of the places is read back exactly: no axis is mistaken for another."""
    axes = np.linspace(-1, 1, 4), np.linspace(0, 2, 5), np.linspace(3, 4, 3)
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    points = np.column_stack([np.random.default_rng(k).uniform(a[0], a[-1], 30) for k, a in enumerate(axes)])
    read = Interpolation.of(points, axes).read((x + 10 * y + 100 * z).ravel()[None].astype(np.float32))
    np.testing.assert_allclose(read[0], points @ [1, 10, 100], rtol=1e-5)


def test_joined_captures_keep_their_positions_and_heights() -> None:
    parts = captures(apart=0.2)
    joined = join(parts)
    for number, views in enumerate(heights_of(joined)):
        assert (joined.aperture().positions[views, 2] == HEIGHTS[number]).all()
    expected = np.concatenate([part.aperture().distances(POINTS) for part in parts])
    np.testing.assert_allclose(joined.aperture().distances(POINTS), expected)
    with pytest.raises(UsageError, match="one capture"):
        join(parts[:1])
    with pytest.raises(DataError, match="the step between bins, the band"):
        join([parts[0], replace(parts[1], range_step_m=0.01, center_frequency_hz=4e9)])
    with pytest.raises(DataError, match="same height"):
        reconstruct_volume(joined.select(heights_of(joined)[0]))
    with pytest.raises(DataError, match="at the same antenna height"):
        join([parts[0], replace(parts[0], uuid="another of the same height")])
    with pytest.raises(UsageError, match="captures 1 and 2 are the same recording"):
        join([parts[0], parts[0]])
    with pytest.raises(DataError, match="in the wave speed"):
        join([parts[0], replace(parts[1], wave_speed_m_s=2.0e8)])
    assert joined.complete and not join([*parts[:2], replace(parts[2], complete=False)]).complete


@pytest.fixture(scope="module")
def made() -> volume.Volume:
    """A bright voxel among others that all differ, so that a wrong order of the axes shows."""
    rng = np.random.default_rng(0)
    values = (rng.standard_normal((12, 24, 24)) + 1j * rng.standard_normal((12, 24, 24))).astype(np.complex64)
    values[3, 10, 20] = 100
    return volume.Volume(values, GRID, {"method": "bp"})


def test_files_are_read_back(tmp_path: Path, made: volume.Volume) -> None:
    for name in ("v.npz", "v.ply"):
        write_volume(tmp_path / name, made)
    with np.load(tmp_path / "v.npz") as file:
        np.testing.assert_array_equal(file["volume"], made.values)
        np.testing.assert_allclose(file["z_m"], GRID.heights)
    head, _, body = (tmp_path / "v.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 1\n" in head
    x, y, z, magnitude = struct.unpack("<4f", body)
    axis = GRID.square.axis
    assert (x, y, z) == pytest.approx((axis[20], axis[10], GRID.heights[3]), rel=1e-6)
    assert magnitude == 100
    axes = GRID.square.axis, GRID.heights
    draw_projections(made.values, *axes, tmp_path / "v.png", "three views")
    write_turning(made.values, *axes, tmp_path / "v.webp")
    with Image.open(tmp_path / "v.png") as picture, Image.open(tmp_path / "v.webp") as film:
        assert picture.size[0] > picture.size[1]
        assert film.n_frames == 48
    with pytest.raises(UsageError, match="no suffix of a volume"):
        write_volume(tmp_path / "v.stl", made)


def test_the_vti_file_is_what_its_format_says(tmp_path: Path, made: volume.Volume) -> None:
    """Read by the format's document: raw appended data after an underscore, each array after its 64-bit
    length."""
    write_volume(tmp_path / "v.vti", made)
    head, _, rest = (tmp_path / "v.vti").read_bytes().partition(b'<AppendedData encoding="raw">\n_')
    root = ElementTree.fromstring(head + b'<AppendedData encoding="raw">_</AppendedData></VTKFile>')
    image = root.find("ImageData")
    assert root.attrib["header_type"] == "UInt64"
    assert image.attrib["WholeExtent"] == "0 23 0 23 0 11"
    assert [float(n) for n in image.attrib["Spacing"].split()] == pytest.approx([0.01, 0.01, 0.02])
    arrays = {}
    for array in image.iter("DataArray"):
        at = int(array.attrib["offset"])
        (length,) = struct.unpack_from("<Q", rest, at)
        arrays[array.attrib["Name"]] = np.frombuffer(rest, "<f4", length // 4, at + 8).reshape(12, 24, 24)
    np.testing.assert_allclose(arrays["magnitude"] * np.exp(1j * arrays["phase"]), made.values, rtol=1e-5)


def test_pyvista_reads_the_volume(tmp_path: Path, made: volume.Volume) -> None:
    pyvista = pytest.importorskip("pyvista", reason="pip install '.[vtk]' checks the file with VTK")
    write_volume(tmp_path / "v.vti", made)
    image = pyvista.read(tmp_path / "v.vti")
    assert (image.dimensions, image.spacing) == ((24, 24, 12), pytest.approx((0.01, 0.01, 0.02)))
    assert image.origin == pytest.approx((GRID.square.axis[0], GRID.square.axis[0], GRID.heights[0]))
    magnitude, phase = (np.asarray(image[name]).reshape(12, 24, 24) for name in ("magnitude", "phase"))
    np.testing.assert_allclose(magnitude * np.exp(1j * phase), made.values, rtol=1e-5)
    blob = np.exp(-(np.linalg.norm(GRID.points(), axis=1) ** 2) / 0.05**2).reshape(12, 24, 24)
    write_surface(tmp_path / "s.ply", volume.Volume(blob.astype(np.complex64), GRID, {}))
    mesh = pyvista.read(tmp_path / "s.ply")
    assert mesh.is_manifold
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * (0.05 * np.sqrt(np.log(10) / 2)) ** 3, rel=0.1)


def test_a_surface_is_closed_and_faces_outwards() -> None:
    z, y, x = np.linspace(-1, 1, 15), np.linspace(-1, 1, 17), np.linspace(-1, 1, 19)
    grid = np.meshgrid(z, y, x, indexing="ij")
    values = np.exp(-((grid[2] / 0.7) ** 2 + (grid[1] / 0.6) ** 2 + (grid[0] / 0.5) ** 2))
    result = isosurface(values, float(np.exp(-1)), (z, y, x))
    corners = result.points[result.triangles]
    inside = np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert inside == pytest.approx(4 / 3 * np.pi * 0.7 * 0.6 * 0.5, rel=0.03)
    ways = result.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges, uses = np.unique(np.sort(ways, axis=1), axis=0, return_counts=True)
    assert (uses == 2).all()
    assert len(np.unique(ways, axis=0)) == len(ways)
    assert len(result.points) - len(edges) + len(result.triangles) == 2
    radii = np.linalg.norm(result.points / [0.7, 0.6, 0.5], axis=1)
    assert radii.min() > 0.93
    assert radii.max() < 1.03
    assert len(isosurface(values, 2.0, (z, y, x)).triangles) == 0


def test_from_the_command_line(tagid, tmp_path: Path) -> None:
    common = ("--views", 24, "--elevation", "0.05m", "--seed", 3)
    for name, height in (("low.npz", 0.0), ("high.npz", 0.2)):
        assert tagid("simulate", "points-3", *common, "--antenna-height", height, "--out", name).code == 0
    joined = tagid("join", "low.npz", "high.npz", "--out", "all.npz", "--output", "json")
    assert joined.code == 0, joined.err
    assert joined.json["data"]["heights_m"] == pytest.approx([0.0, 0.2])
    words = ("--method", "sparse", "--extent", 0.3, "--pixels", 32, "--heights", "-0.1,0.15", "--levels", 5)
    made = tagid("reconstruct", "all.npz", "--volume", *words, "--ply", "a.ply", "--output", "json")
    assert made.code == 0, made.err
    settings = made.json["data"]["settings"]
    assert settings["held_out"]["residual"] < 0.3 * settings["held_out"]["backprojection"]
    files = ("--surface", tmp_path / "s.ply", "--vti", tmp_path / "v.vti", "--no-held-out")
    fitted = tagid("reconstruct", "all.npz", "--volume", *words[2:], "--method", "ats", *files)
    assert fitted.code == 0, fitted.err
    assert (tmp_path / "s.ply").read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")
    for bad in (("--ats", "steps=5"), ("--surface", "s.stl"), ("--method", "omp")):
        assert tagid("reconstruct", "all.npz", "--volume", *words[2:], *bad).code == 2
    idle = tagid("reconstruct", "all.npz", "--volume", "--axis-search", 0.1, "--subtract-body")
    assert idle.code == 2 and "--axis-search and --subtract-body" in " ".join(idle.err.split())
    wrong = tagid("reconstruct", "all.npz", "--levels", 5)
    assert wrong.code == 2
    assert "--volume" in wrong.err


def test_levels_sample_the_vertical_resolution_three_times_and_are_no_thinner_than_a_pixel() -> None:
    joined = join(captures())
    fine = reconstruct_volume(joined, replace(LOW, pixels=48, levels=None)).volume
    # lambda R / (2 H) at 1 m of antennas that reach over 0.4 m.
    resolution_m = 299_792_458 / 3.95e9 / (2 * 0.4)
    assert resolution_m / 4 < fine.grid.rise < resolution_m / 2.5
    coarse = reconstruct_volume(joined, replace(LOW, pixels=4, levels=None)).volume
    assert coarse.grid.rise >= coarse.grid.square.step


def test_a_sparse_volume_is_refused_where_less_memory_is_free_than_it_takes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    joined = join(captures())
    settings = VolumeSettings("sparse", 0.24, 64, (-0.12, 0.12), 32, held_out=False, outside=False)
    tracemalloc.start()
    reconstruct_volume(joined, settings)
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    monkeypatch.setattr(memory, "free_memory", lambda: taken)
    with pytest.raises(UsageError, match="131,072 voxels of a fit need"):
        reconstruct_volume(joined, settings)
    monkeypatch.setattr(memory, "free_memory", lambda: 2 * taken)
    assert reconstruct_volume(joined, settings).volume.grid.voxels == 131_072


@pytest.mark.parametrize(("method", "place"), [("sparse", [0.02, 0.03, 0.26]), ("ats", [0.30, 0.05, 0.0])])
def test_a_strong_reflector_outside_a_volume_leaves_its_faces_dark(method: str, place: list[float]) -> None:
    points = [*POINTS.tolist(), place]
    heights = np.linspace(-0.2, 0.2, 9)
    some = [record(points, [1, 0.8, 1, 3], turn(16, 1.0, h), start_m=0.4, bins=160) for h in heights]
    made = reconstruct_volume(join(some), VolumeSettings(method, 0.24, 24, (-0.12, 0.12), 12)).volume
    power = np.abs(made.values) ** 2
    assert power[1:-1, 2:-2, 2:-2].sum() > 0.9 * power.sum()
    assert made.settings["outside"]["share"] > 0.3 and made.settings["outside"]["subtracted"]
    assert made.settings["held_out"]["residual"] < 0.3
    result = brightest(made.values, made.grid, 3, 0.04)
    assert np.linalg.norm(result[:, None] - POINTS[None], axis=2).min(axis=0).max() < 0.03


def test_a_volume_about_another_centre_shows_the_same_places(tmp_path: Path) -> None:
    joined = join(captures())
    assert joined.antenna_positions_m is not None
    about = reconstruct_volume(joined, LOW).volume
    moved = joined.shifted(np.array([-3.0, 2.0, 0.0]))
    there = reconstruct_volume(moved, replace(LOW, centre_m=(3.0, -2.0))).volume
    np.testing.assert_allclose(there.values, about.values, atol=1e-4)
    write_volume(tmp_path / "v.npz", there)
    stored = np.load(tmp_path / "v.npz")
    np.testing.assert_allclose([stored["x_m"].mean(), stored["y_m"].mean()], [3.0, -2.0])
    np.testing.assert_allclose(np.diff(stored["x_m"]), 0.24 / 16)


def test_copies_of_the_scene_in_height_are_warned_of() -> None:
    """Antennas 0.1 m apart at 1 m: the copies are about half a wavelength over 0.1 apart."""
    high = replace(LOW, heights_m=(-0.3, 0.3), levels=8)
    joined = join(captures())
    assert "warnings" not in reconstruct_volume(joined, LOW).volume.settings
    (words,) = reconstruct_volume(joined, high).volume.settings["warnings"]
    assert "the scene shows again 0.42 m above and below itself" in words and "5 antenna heights" in words
