"""The compiled loops and their stand-in: the same sums, exact transposes, nothing out of bounds."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.errors import UsageError
from tagid.geometry import Aperture
from tagid.imaging import kernel, memory
from tagid.imaging.kernel import RangeGeometry

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-0.2, 0.2, (70, 2))
ANTENNA = RNG.uniform(-0.3, 0.3, (23, 3)) + np.array([1.0, 0.2, 0.3])
FIRST_M, STEP_M = 0.7, 0.002


def complex_noise(*shape):
    return (RNG.standard_normal(shape) + 1j * RNG.standard_normal(shape)).astype(np.complex64)


compiled = pytest.mark.skipif(not kernel.is_compiled(), reason="no compiler was present at installation")


@pytest.fixture(params=[pytest.param("compiled", marks=compiled), "numpy"])
def engine(request, monkeypatch):
    if request.param == "numpy":
        monkeypatch.setattr(kernel, "_compiled", None)
    return request.param


def geometry(bins=500):
    return RangeGeometry.of(Aperture(ANTENNA), POINTS, (FIRST_M, STEP_M), bins)


def by_definition(rows):
    """Linear interpolation by numpy in double precision, one view after the other."""
    bins = np.arange(rows.shape[1])
    total = np.zeros(len(POINTS), dtype=complex)
    for antenna, row in zip(ANTENNA, rows, strict=True):
        distance = np.linalg.norm(np.column_stack([POINTS, np.zeros(len(POINTS))]) - antenna, axis=1)
        at = (distance - FIRST_M) / STEP_M
        total += np.interp(at, bins, row.real) + 1j * np.interp(at, bins, row.imag)
    return total


@pytest.mark.parametrize("bins", [2, 100, 500])
def test_gather_is_linear_interpolation_held_at_the_ends(engine, bins):
    rows = complex_noise(len(ANTENNA), bins)
    truth = by_definition(rows)
    # A few hundred bins away single precision knows the place to 5e-5 of a bin.
    assert np.abs(geometry(bins).gather(rows) - truth).max() < 1e-3 * np.abs(truth).max()


def test_threads_do_not_change_the_sums(monkeypatch):
    rows, values = complex_noise(len(ANTENNA), 500), complex_noise(len(POINTS))
    monkeypatch.setattr(kernel, "_PAIRS_PER_THREAD", 10**9)
    single = geometry().gather(rows), geometry().scatter(values)
    monkeypatch.setattr(kernel, "_PAIRS_PER_THREAD", 1)
    monkeypatch.setattr(kernel, "cores", lambda: 5)
    many = geometry().gather(rows), geometry().scatter(values)
    np.testing.assert_array_equal(single[0], many[0])
    np.testing.assert_array_equal(single[1], many[1])


@compiled
def test_buffers_that_do_not_fit_are_refused():
    where = geometry()
    buffers = complex_noise(23, 500), complex_noise(70)
    for bins in (0, 1, 499, 501, -5, 1 << 40):
        with pytest.raises(ValueError, match="fit"):
            kernel._compiled.gather(
                where.antenna, where.second, where.x, where.y, where.z, *buffers, bins, 0.0, 1
            )


def test_rows_without_end_are_refused():
    with pytest.raises(UsageError, match="fine range bins"):
        geometry(1 << 30)


def test_the_stand_in_tells_what_it_would_store(monkeypatch):
    monkeypatch.setattr(kernel, "_compiled", None)
    monkeypatch.setattr(memory, "free_memory", lambda: 10_000)
    with pytest.raises(UsageError, match="23 views of 70 points") as caught:
        geometry().scatter(complex_noise(70))
    assert "compiler" in caught.value.remedy


@pytest.mark.parametrize("far_m", [1.0, 10.0, 10_000.0, 1e6])
@pytest.mark.parametrize("points", [POINTS, np.column_stack([POINTS, RNG.uniform(-0.2, 0.2, len(POINTS))])])
def test_ranges_are_exact_at_any_distance(engine, far_m, points):
    """Bins half a millimetre apart, 10 km away: a place in single precision is a bin or more off."""
    step, bins = 5e-4, 4000
    antenna = ANTENNA / np.linalg.norm(ANTENNA, axis=1)[:, None] * far_m
    for half_baseline in (None, 0.2 * RNG.normal(size=antenna.shape)):
        far = Aperture(antenna, half_baseline=half_baseline)
        where = RangeGeometry.of(far, points, (far_m - 1.0, step), bins)
        rows = np.tile(np.arange(bins), (len(antenna), 1)).astype(np.complex64)
        expected = ((far.distances(points) - far_m + 1.0) / step).sum(axis=0)
        assert np.abs(where.gather(rows).real - expected).max() < 0.01 * len(antenna)
        rows, x = complex_noise(len(antenna), bins), complex_noise(len(points))
        assert (where.scatter(x) * rows).sum() == pytest.approx(where.gather(rows) @ x, rel=1e-3)
