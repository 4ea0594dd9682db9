"""What holds for every method alike: symmetry, determinism, refusals, foresight, a point and a cylinder."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imaging_scenes import helix, record, turn

from tagid.capture import Capture
from tagid.errors import DataError, UsageError
from tagid.geometry import Aperture, ImageGrid
from tagid.imaging import memory
from tagid.imaging.ats.problem import view_subsets
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.restore import restore
from tagid.imaging.types import BasebandScans
from tagid.pipeline.reconstruct import METHODS, make_image, reconstruct
from tagid.pipeline.settings import ImagingSettings
from tagid.simulate import Acquisition, Scene, simulate_capture
from tests.benchmarks.electromagnetic import ConductingCylinder

GRID = ImageGrid(0.4, 56)
POINTS = np.array([[0.11, 0.04], [-0.06, -0.12]])
QUICK = AtsSettings(steps=60)


def image_of(scans: BasebandScans, method: str, grid: ImageGrid = GRID) -> np.ndarray:
    image = make_image(scans, grid, method, ats=QUICK)
    if METHODS[method].sparse:
        image = restore(image, scans.wavenumber)
    return image.values


def scans_of(capture: Capture, method: str, extent_m: float = GRID.extent) -> BasebandScans:
    settings = PreprocessSettings("none", METHODS[method].matched_filter, extent_m=extent_m)
    return preprocess(capture, settings=settings)


@pytest.fixture(params=list(METHODS))
def method(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_the_object_turned_is_the_aperture_turned_back(method: str) -> None:
    """One recording under two frames a quarter turn apart: the images differ by that quarter turn."""
    scans = scans_of(record(POINTS, [1.0, 0.7], helix(40), noise=0.02), method)
    quarter = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # rows times it turn by +90
    moved = scans.with_aperture(Aperture(scans.aperture.positions @ quarter))
    first, second = np.abs(image_of(scans, method)), np.abs(image_of(moved, method))
    turned = np.rot90(first, k=-1)  # index [y, x] to [x, N - 1 - y]
    # The field's weights are drawn in one frame, and do not turn.
    allowed = 0.25 if method == "ats" else 0.02
    assert np.linalg.norm(turned - second) < allowed * np.linalg.norm(second)
    wrong = np.rot90(first, k=1)
    assert np.linalg.norm(wrong - second) > 0.5 * np.linalg.norm(second)


def test_the_same_twice_is_the_same_image(method: str) -> None:
    scans = scans_of(record(POINTS, [1.0, 0.7], turn(24), noise=0.2), method)
    np.testing.assert_array_equal(image_of(scans, method), image_of(scans, method))


def test_a_point_is_where_it_is(method: str) -> None:
    """Not mirrored, not transposed; far away, so that the plane-wave methods have their chance."""
    capture = record([[0.11, 0.04]], [1.0], turn(72, 4.0), noise=0.02)
    magnitude = np.abs(image_of(scans_of(capture, method), method))
    row, column = np.unravel_index(magnitude.argmax(), magnitude.shape)
    result = np.array([GRID.axis[column], GRID.axis[row]])
    assert np.hypot(*(result - [0.11, 0.04])) < (0.025 if method == "range-doppler" else 0.009)


@pytest.mark.parametrize("method", ["bp", "sparse"])
def test_a_conducting_cylinder_is_a_circle_of_its_radius(method: str) -> None:
    """The exact series of a can: every view sees its nearest line, so the image is its circumference."""
    body, grid = ConductingCylinder(0.12, 0.2, (0.02, -0.01)), ImageGrid(0.5, 70)
    capture, _ = simulate_capture(Scene("can", (body,)), Acquisition(views=120, snr_db=30), seed=1)
    power = np.abs(image_of(scans_of(capture, method, grid.extent), method, grid)) ** 2
    x, y = np.meshgrid(grid.axis, grid.axis)
    radius = np.hypot(x - 0.02, y + 0.01)
    assert (power * radius).sum() / power.sum() == pytest.approx(0.12, abs=0.008)


@pytest.mark.parametrize(("method", "preset"), [*((name, "field") for name in METHODS), ("ats", "paper")])
def test_silence_is_refused_and_too_little_memory_foreseen(method: str, preset: str, monkeypatch) -> None:
    if preset == "paper":
        pytest.importorskip("torch", reason="the published model needs the extra 'ats'")
    capture = record(POINTS, [1.0, 0.7], turn(24))
    settings = ImagingSettings(method=method, preset=preset, background="none", focus_m=0.0, pixels=256)
    with pytest.raises(DataError, match="zero"):
        reconstruct(replace(capture, samples=np.zeros_like(capture.samples)), settings)
    monkeypatch.setattr(memory, "free_memory", lambda: 500_000)
    with pytest.raises(UsageError, match="are free") as caught:
        reconstruct(capture, settings)
    assert caught.value.remedy


def test_subsets_of_a_path_have_no_common_spacing() -> None:
    """Even subsets of a rail would put one grating lobe of every reflector into each of them."""
    path = Aperture(np.stack([np.linspace(-1.7, 1.7, 600), np.zeros(600), np.zeros(600)], axis=1))
    for aperture, views in ((path, 12), (turn(360), 12)):
        subsets = view_subsets(aperture, views)
        assert sorted(np.concatenate(subsets)) == list(range(aperture.views))
    spacing = np.diff(np.sort(view_subsets(path, 12)[0]))
    assert spacing.std() > 3
    assert np.ptp(np.diff(view_subsets(turn(360), 12)[0])) == 0
