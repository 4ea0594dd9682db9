"""Backprojection: place, side, calibration, agreement with the operator's adjoint."""

from __future__ import annotations

import numpy as np
import pytest
from imaging_scenes import helix, record, turn

from tagid.geometry import ImageGrid
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import PreprocessSettings, preprocess

GRID = ImageGrid(0.5, 100)


def image_of(points, amplitudes, aperture, grid=GRID, matched=True, **kind):
    settings = PreprocessSettings(background="none", matched_filter=matched)
    return backproject(preprocess(record(points, amplitudes, aperture, **kind), settings=settings), grid)


@pytest.mark.parametrize(
    "aperture", [turn(72), turn(72, 1.2, 0.5), helix(72)], ids=["turntable", "raised", "free"]
)
@pytest.mark.parametrize("matched", [True, False])
def test_a_point_peaks_at_its_place_with_its_amplitude(aperture, matched):
    # An asymmetric place on a pixel centre: a mirrored or transposed image would put it elsewhere.
    row, column = 27, 65
    point = (GRID.axis[column], GRID.axis[row])
    image = image_of([point], [2.5], aperture, matched=matched)
    assert image.values.dtype == np.complex64
    assert np.unravel_index(np.abs(image.values).argmax(), image.values.shape) == (row, column)
    assert image.values[row, column] == pytest.approx(2.5, rel=0.01)


def test_complex_reflectivity_keeps_its_phase():
    row, column = 40, 70
    sigma = 1.5 * np.exp(1.1j)
    image = image_of([(GRID.axis[column], GRID.axis[row])], [sigma], turn(72), analytic=True)
    assert image.values[row, column] == pytest.approx(sigma, rel=0.01)


def test_the_rest_of_the_point_response_is_that_of_a_ring_of_views():
    """J0(2 k r): first null at 2.405 / 2k = 14.5 mm, first sidelobe at most -7.9 dB."""
    grid = ImageGrid(0.08, 81)
    image = np.abs(image_of([(0.0, 0.0)], [1.0], turn(180), grid).values)
    cut = image[40, 40:]
    null = grid.step * int(np.argmin(cut[:22]))
    assert null == pytest.approx(2.405 / (2 * 2 * np.pi * 3.95e9 / 299_792_458.0), rel=0.1)
    assert cut[16:].max() < 10 ** (-7.9 / 20) + 0.01


def test_turning_the_object_turns_the_image():
    point = np.array([0.11, 0.04])
    quarter = np.array([-point[1], point[0]])
    first, second = (image_of([p], [1.0], turn(72)).values for p in (point, quarter))
    # A quarter turn counter-clockwise maps (x, y) to (-y, x): index [y, x] to [x, N-1-y].
    assert np.abs(np.rot90(first, k=-1) - second).max() < 0.02


def test_exact_sum_of_the_definition():
    """f(p) = 1/V sum_v z_v(d) exp(2jkd), z the response itself: upsampling and rounding add < 1 %."""
    aperture, point = turn(90), np.array([0.06, -0.13])
    settings = PreprocessSettings(background="none")
    scans = preprocess(record([point], [1.0], aperture), settings=settings)
    grid = ImageGrid(0.4, 40)
    d = np.linalg.norm(aperture.positions[None, :, :2] - grid.points[:, None], axis=2)
    base = np.linalg.norm(aperture.positions[:, :2] - point, axis=1)
    truth = (scans.response(d - base) * np.exp(2j * scans.wavenumber * (d - base))).mean(axis=1)
    assert np.abs(backproject(scans, grid).values.ravel() - truth).max() < 0.01


def test_pixels_outside_the_data_are_zero():
    scans = preprocess(record([(0.0, 0.1)], [1.0], turn(8)), settings=PreprocessSettings(extent_m=0.3))
    image = backproject(scans, ImageGrid(40.0, 16))
    assert image.values[0, 0] == 0
