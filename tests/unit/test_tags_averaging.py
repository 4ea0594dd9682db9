"""Layouts measured on captures: weights by precision, real scatter, and captures that do not belong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tags_synthetic import synthetic_scans

from tagid.enrolling.averaging import Sighting, average, position_covariances
from tagid.enrolling.field import MatchedField
from tagid.enrolling.reflectors import refine_positions
from tagid.errors import DataError
from tagid.tags.layouts.codebook import best_pairing, rotational_distance
from tagid.tags.layouts.layout import Layout, rotation_matrix

SCALENE = np.array([[0.1, 0.0], [-0.02, 0.06], [-0.05, -0.04]])


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
        remaining = (
            layout.positions @ rotation_matrix(pair.rotation_rad).T + pair.shift_m - SCALENE[pair.partner]
        )
        turn = rotation_matrix(pair.rotation_rad)
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
    turns = (0.4, 2.0, 5.0)
    captures = [
        Sighting(f"c{i}", Layout("x", SCALENE).placed(t, np.zeros(2)), np.tile(1e-8 * np.eye(2), (3, 1, 1)))
        for i, t in enumerate(turns)
    ]
    estimate = average(captures, "x")
    assert estimate.layout.positions[np.argmax(np.linalg.norm(estimate.layout.positions, axis=1))][
        1
    ] == pytest.approx(0, abs=1e-6)
    assert np.allclose(estimate.rotations_deg, np.rad2deg(turns), atol=1e-3)
    again = Layout("y", estimate.layout.positions)
    assert rotational_distance(again, Layout("x", SCALENE), 0.0).worst_m < 1e-6


def test_captures_that_do_not_belong_are_named_with_what_is_wrong() -> None:
    rng = np.random.default_rng(2)
    good = [sighting(rng, 3e-4, name=f"good{i}.h5") for i in range(3)]
    moved = SCALENE.copy()
    moved[1] += [0.0, 0.009]
    cases = {
        r"^odd\.h5 shows 2 reflectors, the others 3$": sighting(rng, 3e-4, name="odd.h5", points=SCALENE[:2]),
        r"^odd\.h5 has a reflector \d\.\d mm from its position": sighting(
            rng, 3e-4, name="odd.h5", points=moved
        ),
        r"^odd\.h5 is the mirror image": sighting(rng, 3e-4, name="odd.h5").mirrored(),
        r"^odd\.h5 locates a reflector only to within 7": sighting(rng, 3e-4, told_m=7e-3, name="odd.h5"),
    }
    for words, odd in cases.items():
        for at in range(4):
            with pytest.raises(DataError, match=words):
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
    captures = [
        Sighting.of(
            synthetic_scans(
                truth.placed(rng.uniform(0, 6), rng.uniform(-0.005, 0.005, 2)), noise=0.3, seed=i
            ),
            f"c{i}",
        )
        for i in range(5)
    ]
    estimate = average(captures, "measured")
    assert estimate.spread_m.max() < 2e-3 and 0 < estimate.layout.sigma_m < 1e-3
    assert rotational_distance(estimate.layout, truth).worst_m < 2e-3
    # The axis averages out: 5 mm uniform in x and y over five captures leaves about 1.3 mm.
    assert np.linalg.norm(estimate.layout.positions, axis=1).max() == pytest.approx(0.1, abs=4e-3)
