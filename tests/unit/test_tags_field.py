"""Templates, folded views and the finder of reflectors: on scans made from their definition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tags_synthetic import synthetic_scans

from tagid.enrolling.field import MatchedField
from tagid.enrolling.reflectors import SearchDisc, find_reflectors
from tagid.geometry import Aperture
from tagid.imaging.types import BasebandScans
from tagid.reading.views import fold_views
from tagid.tags.layouts.layout import builtin_layouts

LAYOUTS = builtin_layouts()
SCALENE = np.array([[0.1, 0.0], [-0.02, 0.06], [-0.05, -0.04]])


def test_the_fit_of_known_points_gives_their_amplitudes() -> None:
    points = np.array([[0.05, 0.02], [-0.03, 0.06]])
    sigma = np.array([1.0, 0.5j])
    field = MatchedField(synthetic_scans(points, amplitudes=sigma), 0.15)
    d = field.templates(points)
    result = np.linalg.solve(field.gram(d), field.correlate(d))
    assert np.allclose(result, sigma, atol=0.01)
    explained = np.vdot(field.correlate(d), result).real
    assert explained == pytest.approx(field.energy, rel=0.01)


def test_static_clutter_changes_nothing() -> None:
    points = LAYOUTS["helmet-linear"].placed(0.3, np.array([0.004, 0.0]))
    scans = synthetic_scans(points)
    wall = 5 * np.exp(1j * np.arange(scans.samples.shape[1]))
    before = MatchedField(scans, 0.15)
    expected = before.correlate(before.templates(points))
    scans.samples[:] += wall.astype(np.complex64)
    cluttered = MatchedField(scans, 0.15)
    assert np.allclose(cluttered.correlate(cluttered.templates(points)), expected, atol=1e-3)


def test_many_views_fold_into_few_without_loss() -> None:
    points = LAYOUTS["helmet-120"].placed(0.2, np.array([0.005, 0.0]))
    many = synthetic_scans(points, views=720)
    few = fold_views(many, 0.15)
    assert few.aperture.views < 120
    truth = synthetic_scans(points, views=few.aperture.views)
    error = np.linalg.norm(few.samples - truth.samples) / np.linalg.norm(truth.samples)
    assert error < 0.01
    noise = synthetic_scans(np.zeros((0, 2)), views=720, noise=1.0)
    folded = fold_views(noise, 0.15)
    assert np.sqrt(np.mean(np.abs(folded.samples) ** 2)) == pytest.approx(folded.noise_std, rel=0.05)
    assert fold_views(synthetic_scans(points, views=36), 0.15).aperture.views == 36


@pytest.mark.parametrize("views", [76, 89, 160])
def test_views_that_do_not_divide_a_turn_become_even_ones(views: int) -> None:
    """A table turns on by 0.4 of a step more than the whole number of views."""
    points = LAYOUTS["helmet-120"].placed(0.2, np.array([0.005, 0.0]))
    many = synthetic_scans(points, views=7200)
    seen = np.rint(7200 / (views + 0.4) * np.arange(views)).astype(int)
    uneven = Aperture.turntable(seen * 2 * np.pi / 7200, 0.5)
    even = fold_views(replace(many, samples=many.samples[seen], aperture=uneven), 0.13)
    truth = synthetic_scans(points, views=even.aperture.views)
    assert even.aperture.views == 75
    assert np.linalg.norm(even.samples - truth.samples) < 1e-3 * np.linalg.norm(truth.samples)
    noise = synthetic_scans(np.zeros((0, 2)), views=views, noise=1.0)
    folded = fold_views(replace(noise, aperture=uneven), 0.13)
    assert np.sqrt(np.mean(np.abs(folded.samples) ** 2)) == pytest.approx(folded.noise_std, rel=0.05)
    part = replace(
        many,
        samples=many.samples[seen[: views // 2]],
        aperture=uneven.turned(uneven.angles[: views // 2], 0.5),
    )
    assert fold_views(part, 0.13).aperture.angles[-1] < 3.2, "half a turn stays one"


def test_neighbouring_views_of_a_part_of_a_turn_are_averaged() -> None:
    """Its echo is that of the mean angles, and its noise less; where they are few, nothing is."""
    points = LAYOUTS["helmet-120"].placed(0.2, np.array([0.005, 0.0]))
    angles = np.linspace(0, np.pi, 720)
    whole = synthetic_scans(points, views=1440)
    half = replace(whole, samples=whole.samples[:720], aperture=Aperture.turntable(angles, 0.5))
    few = fold_views(half, 0.15)
    assert few.aperture.views < 120 and few.aperture.angles is not None
    assert np.ptp(few.aperture.angles) == pytest.approx(np.pi, abs=0.1)
    at = np.interp(few.aperture.angles, angles, np.arange(720))
    truth = whole.samples[np.rint(at).astype(int)]
    assert np.linalg.norm(few.samples - truth) < 0.05 * np.linalg.norm(truth)
    noise = synthetic_scans(np.zeros((0, 2)), views=1440, noise=1.0)
    folded = fold_views(replace(noise, samples=noise.samples[:720], aperture=half.aperture), 0.15)
    assert np.sqrt(np.mean(np.abs(folded.samples) ** 2)) == pytest.approx(folded.noise_std, rel=0.05)
    part = replace(half, samples=half.samples[:90], aperture=Aperture.turntable(angles[:720:8], 0.5))
    assert fold_views(part, 0.15) is part


def test_the_finder_reports_reflectors_and_no_sidelobes() -> None:
    rng = np.random.default_rng(0)
    for name, layout in LAYOUTS.items():
        points = layout.placed(rng.uniform(0, 6), np.array([0.008, 0.004]))
        result = find_reflectors(synthetic_scans(points, noise=0.2, seed=1))
        assert len(result) == layout.size, name
        positions = np.array([(r.x_m, r.y_m) for r in result])
        gap = np.linalg.norm(positions[:, None] - points[None], axis=2)
        assert gap.min(axis=1).max() < 2e-3
        assert np.unique(gap.argmin(axis=1)).size == layout.size
        assert all(abs(abs(r.amplitude) - 1) < 0.15 for r in result)
    assert find_reflectors(synthetic_scans(np.zeros((0, 2)), noise=1.0)) == ()


def at_two_heights(scans: BasebandScans) -> BasebandScans:
    """The same samples, half of them seen from 0.1 m above."""
    positions = scans.aperture.positions.copy()
    positions[::2, 2] = 0.1
    return replace(scans, aperture=Aperture(positions))


def with_two_antennas(scans: BasebandScans) -> BasebandScans:
    """The same samples, transmitter and receiver 0.1 m apart."""
    positions = scans.aperture.positions
    return replace(
        scans, aperture=Aperture(positions, half_baseline=np.tile([0.0, 0.0, 0.05], (len(positions), 1)))
    )


@pytest.mark.parametrize("seen", [lambda scans: scans, at_two_heights, with_two_antennas])
def test_the_disc_holds_what_points_leave(seen: Callable[[BasebandScans], BasebandScans]) -> None:
    """The pixels are correlated from tables, and with their templates here."""
    places = LAYOUTS["helmet-120"].placed(0.3, np.array([0.004, -0.003]))
    field = MatchedField(seen(synthetic_scans(places, views=13, noise=0.1, seed=5)), 0.08)
    disc = SearchDisc(field, 0.06)
    amplitudes = np.array([0.3 + 0.2j, -0.5j])
    positions = np.array([[0.04, -0.03], [-0.05, 0.02]])
    for count in (0, 2):
        data = field.data - amplitudes[:count] @ field.templates(positions[:count])
        wanted = np.abs(field.templates(disc.points).conj() @ data) ** 2
        residual = disc.residual(positions[:count], amplitudes[:count])
        assert np.abs(residual - wanted).max() <= 1e-4 * wanted.max()
