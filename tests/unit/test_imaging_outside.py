"""What turns with the object but lies outside the image is fitted there, not along the image's edge."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tagid.geometry import Aperture, ImageGrid
from tagid.imaging import outside
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.outside import find_outside
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans, PointResponse
from tagid.operate.words import outside_words
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tests.unit.imaging_scenes import record, turn

INSIDE = [[0.05, 0.02], [-0.08, 0.06]]
GRID = ImageGrid(0.4, 64)


def share_at_the_edge(values: np.ndarray) -> float:
    """Energy of the image within four pixels of its edge, over all of it."""
    power = np.abs(values) ** 2
    return float(1 - power[4:-4, 4:-4].sum() / power.sum())


@pytest.mark.parametrize(("method", "place"), [("sparse", [0.27, 0.25]), ("ats", [0.33, 0.05])])
def test_a_strong_reflector_outside_leaves_the_edge_dark(method: str, place: list[float]) -> None:
    capture = record([*INSIDE, place], [1, 0.8, 3], turn(48), noise=0.05, bins=180)
    settings = ImagingSettings(method=method, extent_m=0.4, pixels=64, focus_m=0.0, restore=False)
    image = reconstruct(capture, settings).image
    assert share_at_the_edge(image.values) < 0.01
    assert image.settings["outside"]["share"] > 0.5
    assert image.settings["held_out"]["residual"] < 0.3
    brightest = GRID.points[np.argsort(-np.abs(image.values).ravel())[:4]]
    assert np.hypot(*(brightest[:, None] - np.array(INSIDE)).T).min(axis=0).max() < 0.02


def test_the_place_and_strength_outside_are_found() -> None:
    capture = record([*INSIDE, [0.33, 0.05]], [1, 0.8, 3], turn(48), noise=0.05, bins=180)
    result = find_outside(preprocess(capture, settings=PreprocessSettings("none", False, extent_m=0.4)), GRID)
    assert result is not None
    assert np.hypot(*(result.points - [0.33, 0.05]).T).max() < 0.015
    assert abs(result.amplitudes.sum()) == pytest.approx(3, rel=0.15)


@pytest.mark.parametrize("views", [12, 120])
def test_sidelobes_of_the_inside_are_no_reflector_outside(views: int) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        points, amplitudes = rng.uniform(-0.15, 0.15, (8, 2)), rng.uniform(0.3, 1, 8)
        capture = record(points, amplitudes, turn(views), noise=0.1, seed=seed)
        scans = preprocess(capture, settings=PreprocessSettings("mean", False, extent_m=0.4))
        assert find_outside(scans, GRID) is None


@pytest.mark.parametrize("method", ["bp", "range-doppler"])
def test_methods_without_a_fit_say_that_echoes_lie_outside(method: str) -> None:
    capture = record([*INSIDE, [0.33, 0.05]], [1, 0.8, 3], turn(48), noise=0.05, bins=180)
    settings = ImagingSettings(method=method, extent_m=0.4, pixels=64, focus_m=0.0)
    result = reconstruct(capture, settings).image.settings
    assert result["outside"]["share"] > 0.5 and not result["outside"]["subtracted"]
    (words,) = outside_words(result)
    assert "outside the image; use a larger `imaging.extent_m`" in words
    capture = record(INSIDE, [1, 0.8], turn(48), noise=0.05, bins=180)
    assert "outside" not in reconstruct(capture, settings).image.settings


def short_wave_scans(views: int) -> BasebandScans:
    """Two reflectors inside and a strong one outside an image of 0.4 m, wavelength 4 mm, noise-free."""
    points = np.array([*INSIDE, [0.33, 0.05]])
    ranges = np.arange(0.6, 1.4, 0.02)
    steps = np.arange(-64, 65) * 0.002
    response = PointResponse(np.exp(-((steps / 0.03) ** 2)) + 0j, 0.002)
    empty = np.zeros((views, len(ranges)), dtype=np.complex64)
    scans = BasebandScans(
        empty, 0.6, 0.02, 75e9, response, turn(views), independent_samples=0.5 * empty.size, noise_std=1e-3
    )
    amplitudes = np.array([1, 0.8, 3], dtype=np.complex64)
    return replace(scans, samples=ForwardOperator(scans, points).forward(amplitudes))


def test_the_search_is_bounded_at_short_wavelengths(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = 0
    gather = RangeGeometry.gather

    def counted(self: RangeGeometry, *args: Any) -> Any:
        nonlocal pairs
        pairs += self.views * self.points
        return gather(self, *args)

    monkeypatch.setattr(RangeGeometry, "gather", counted)
    reports: list[tuple[int, int]] = []
    result = find_outside(
        short_wave_scans(60), ImageGrid(0.4, 128), lambda done, of: reports.append((done, of))
    )
    assert result is not None
    assert np.hypot(*(result.points - [0.33, 0.05]).T).max() < 0.01
    assert result.share > 0.5
    # A single look at every pixel of the square of 1.2 m that the wavelength asks for takes more.
    assert pairs < 60 * (1.2 / 0.00047) ** 2 / 2
    assert reports and all(0 < done <= of for done, of in reports)


@pytest.mark.parametrize(("extent", "views"), [(30.0, 400), (100.0, 400)])
def test_a_large_image_is_not_searched_for_longer_and_never_refused(extent: float, views: int) -> None:
    """A flight: its cells outside the image are more than a grid may have, or than every view can visit."""
    u = np.linspace(-1, 1, views)
    flight = Aperture(np.stack([extent * u, np.full(views, -extent), np.full(views, extent)], axis=1))
    start = 1.4 * extent
    capture = record([[0.0, 0.0]], [1.0], flight, start_m=start, bins=300, noise=0.05)
    scans = preprocess(capture, settings=PreprocessSettings("none", False, extent_m=extent))
    visited: list[int] = []
    geometry = RangeGeometry.gather

    def gather(self: RangeGeometry, rows: Any) -> Any:
        visited.append(len(self.antenna) * len(self.x))
        return geometry(self, rows)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RangeGeometry, "gather", gather)
        find_outside(scans, ImageGrid(extent, 64))
    assert sum(visited) < 3e8


def test_the_search_has_a_switch() -> None:
    capture = record([*INSIDE, [0.33, 0.05]], [1, 0.8, 3], turn(48), noise=0.05, bins=180)
    settings = ImagingSettings(method="sparse", extent_m=0.4, pixels=64, focus_m=0.0, held_out=False)
    assert "outside" in reconstruct(capture, settings).image.settings
    image = reconstruct(capture, replace(settings, outside=False))
    assert "outside" not in image.image.settings and "outside" not in image.seconds


def test_a_fit_whose_search_would_take_longer_than_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outside, "_LEAST_WORK", dict.fromkeys((True, False), 0.0))
    monkeypatch.setattr(outside, "_IMAGE_PASSES", dict.fromkeys((True, False), 1))
    capture = record(INSIDE, [1, 0.8], turn(48), noise=0.05, bins=180)
    for method, warned in (("sparse", True), ("bp", False)):
        settings = ImagingSettings(method, extent_m=0.4, pixels=64, focus_m=0.0, held_out=False)
        warnings = reconstruct(capture, settings).image.settings.get("warnings", ())
        assert (outside.NOT_SEARCHED in warnings) is warned
