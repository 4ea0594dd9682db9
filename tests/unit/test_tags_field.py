"""Templates, folded views, the finder of reflectors, and layouts measured: on scans by definition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tags_synthetic import synthetic_scans

from tagid.enrolling.averaging import Sighting, average, position_covariances
from tagid.enrolling.field import MatchedField
from tagid.enrolling.reflectors import SearchDisc, find_reflectors, refine_positions
from tagid.errors import DataError
from tagid.geometry import Aperture
from tagid.imaging.types import BasebandScans
from tagid.reading.views import fold_views
from tagid.tags.layouts.codebook import best_pairing, rotational_distance
from tagid.tags.layouts.layout import Layout, builtin_layouts, rotation_matrix

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
    half = uneven.turned(uneven.angles[: views // 2], 0.5)
    part = replace(many, samples=many.samples[seen[: views // 2]], aperture=half)
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
        assert gap.min(axis=1).max() < 2e-3 and np.unique(gap.argmin(axis=1)).size == layout.size
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
    apart = np.tile([0.0, 0.0, 0.05], (len(positions), 1))
    return replace(scans, aperture=Aperture(positions, half_baseline=apart))


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


def sighting(
    rng: np.random.Generator,
    sigma_m: float,
    *,
    told_m: float | None = None,
    name: str = "c",
    points: np.ndarray = SCALENE,
) -> Sighting:
    """Points turned, shifted by up to 5 mm and off by sigma a coordinate, told to be off by told_m."""
    placed = Layout("x", points).placed(rng.uniform(0, 6), rng.uniform(-0.005, 0.005, 2))
    noise = sigma_m * rng.standard_normal(placed.shape)
    order = rng.permutation(len(points))
    variance = (sigma_m if told_m is None else told_m) ** 2 * np.eye(2)
    return Sighting(name, (placed + noise)[order], np.tile(variance, (len(points), 1, 1)))


def test_the_covariance_told_is_that_of_the_errors_made() -> None:
    points = Layout("x", SCALENE).placed(0.3, np.array([0.004, -0.003]))
    noise, off, reported = 0.5, [], []
    for seed in range(60):
        field = MatchedField(synthetic_scans(points, noise=noise, seed=seed, views=24), 0.16)
        refined_spots, _ = refine_positions(field, points)
        off.append(refined_spots - points)
        reported.append(position_covariances(field, refined_spots))
    made = np.einsum("nki,nkj->kij", off, off) / len(off)
    for base, stated in zip(made, np.mean(reported, axis=0), strict=True):
        # 60 draws: a variance is known to 18 %.
        assert np.sqrt(np.diag(base) / np.diag(stated)) == pytest.approx(1.0, abs=0.35)


def test_errors_of_the_mean_are_as_large_as_its_covariance_says() -> None:
    rng = np.random.default_rng(0)
    square, unweighted = [], []
    for _ in range(24):
        captures = [sighting(rng, sigma) for sigma in (2e-4, 2e-4, 2e-4, 1.2e-3)]
        estimate = average(captures, "mean")
        layout = estimate.layout
        pair = best_pairing(layout.positions, SCALENE)
        turn = rotation_matrix(pair.rotation_rad)
        remaining = layout.positions @ turn.T + pair.shift_m - SCALENE[pair.partner]
        weight = np.linalg.inv(turn @ layout.covariance @ turn.T)
        square.append(np.einsum("ki,kij,kj->", remaining, weight, remaining))
        alike = average([replace(c, covariances=captures[0].covariances) for c in captures], "mean")
        unweighted.append(rotational_distance(alike.layout, Layout("t", SCALENE)).rms_m)
        unweighted[-1] -= rotational_distance(layout, Layout("t", SCALENE)).rms_m
    # The fit to the truth takes three of the six coordinates.
    assert np.mean(square) == pytest.approx(3.0, abs=1.3)
    assert np.mean(unweighted) > 0


def test_scatter_beyond_the_noise_told_is_found() -> None:
    rng = np.random.default_rng(1)
    results = [average([sighting(rng, 1e-3, told_m=1e-4) for _ in range(6)], "x").scatter_m for _ in range(8)]
    assert np.sqrt(np.mean(np.square(results))) == pytest.approx(1e-3, rel=0.2)
    exact = [average([sighting(rng, 1e-3) for _ in range(6)], "x").scatter_m for _ in range(8)]
    assert np.median(exact) < 4e-4


def test_turns_are_told_and_the_outermost_reflector_lies_on_x() -> None:
    turns, exact = (0.4, 2.0, 5.0), np.tile(1e-8 * np.eye(2), (3, 1, 1))
    placed = (Layout("x", SCALENE).placed(t, np.zeros(2)) for t in turns)
    estimate = average([Sighting(f"c{i}", points, exact) for i, points in enumerate(placed)], "x")
    outermost = np.argmax(np.linalg.norm(estimate.layout.positions, axis=1))
    assert estimate.layout.positions[outermost][1] == pytest.approx(0, abs=1e-6)
    assert np.allclose(estimate.rotations_deg, np.rad2deg(turns), atol=1e-3)
    again = Layout("y", estimate.layout.positions)
    assert rotational_distance(again, Layout("x", SCALENE), 0.0).worst_m < 1e-6


def test_captures_that_do_not_belong_are_named_with_what_is_wrong() -> None:
    rng = np.random.default_rng(2)
    good = [sighting(rng, 3e-4, name=f"good{i}.h5") for i in range(3)]
    moved = SCALENE + np.array([[0, 0], [0, 0.009], [0, 0]])
    cases = {
        "shows 2 reflectors, the others 3$": sighting(rng, 3e-4, name="odd.h5", points=SCALENE[:2]),
        r"has a reflector \d\.\d mm from its position": sighting(rng, 3e-4, name="odd.h5", points=moved),
        "is the mirror image": sighting(rng, 3e-4, name="odd.h5").mirrored(),
        "locates a reflector only to within 7": sighting(rng, 3e-4, told_m=7e-3, name="odd.h5"),
    }
    for words, odd in cases.items():
        for at in range(4):
            with pytest.raises(DataError, match=rf"^odd\.h5 {words}"):
                average([*good[:at], odd, *good[at:]], "x")
    with pytest.raises(DataError, match="no majority"):
        average([good[0], sighting(rng, 3e-4, points=moved)], "x")
    with pytest.raises(DataError, match="no capture"):
        average([], "x")
    with pytest.raises(DataError, match="needs two"):
        average([Sighting(f"c{i}", SCALENE[:1], 1e-8 * np.eye(2)[None]) for i in range(3)], "x")
    with pytest.raises(DataError, match="needs two"):
        average([Sighting.of(synthetic_scans(np.array([[0.05, 0.0]])), "one")], "x")


def test_where_the_direction_is_unknown_captures_are_mirrored() -> None:
    rng = np.random.default_rng(3)
    captures = [sighting(rng, 2e-4, name=f"c{i}") for i in range(4)]
    captures[2] = captures[2].mirrored()
    estimate = average(captures, "x", direction_known=False)
    assert estimate.mirrored == ("c2",)
    assert estimate.spread_m.max() < 1e-3
    assert rotational_distance(estimate.layout, Layout("t", SCALENE)).worst_m < 1.5e-3


def test_a_reflector_far_out_is_seen_and_makes_no_others() -> None:
    far = np.array([[0.21, 0.0], [-0.02, 0.06], [-0.05, -0.04]])
    seen = Sighting.of(synthetic_scans(far, noise=0.1), "far")
    assert len(seen.positions) == 3
    assert rotational_distance(Layout("seen", seen.positions), Layout("far", far), 0.0).worst_m < 2e-3


def test_a_layout_measured_from_scans() -> None:
    rng = np.random.default_rng(1)
    truth = Layout("truth", SCALENE)
    stands = [truth.placed(rng.uniform(0, 6), rng.uniform(-0.005, 0.005, 2)) for _ in range(5)]
    captures = [Sighting.of(synthetic_scans(p, noise=0.3, seed=i), f"c{i}") for i, p in enumerate(stands)]
    estimate = average(captures, "measured")
    assert estimate.spread_m.max() < 2e-3 and 0 < estimate.layout.sigma_m < 1e-3
    assert rotational_distance(estimate.layout, truth).worst_m < 2e-3
    # The axis averages out: 5 mm uniform in x and y over five captures leaves about 1.3 mm.
    assert np.linalg.norm(estimate.layout.positions, axis=1).max() == pytest.approx(0.1, abs=4e-3)
