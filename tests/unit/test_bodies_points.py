"""Tags without a body: points, the double bounce between them, and arrangements that are not the layout."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.tags.bodies.points import (
    Place,
    PlacedPoints,
    PointFitter,
    PointSettings,
    _waves,
    columns,
    displaced,
    read_points,
)
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import builtin_layouts

LAYOUTS = builtin_layouts()
SETTINGS = PointSettings()


def empty(views: int = 36) -> Spectra:
    kappa = 2 * 83.0 + np.linspace(-33, 33, 9)
    antenna = 1.05 * np.exp(-2j * np.pi * np.arange(views) / views)
    return Spectra(np.zeros((9, views), complex), kappa, antenna, np.full(views, 0.03), 1.05, 1e-9)


def seen(places: np.ndarray, bounce: float = 0.4, noise: float = 0.02, seed: int = 0) -> Spectra:
    """Points and their double bounce, each with a phase of its own at every frequency."""
    rng = np.random.default_rng(seed)
    spectra = empty()
    cols = columns(spectra, places, np.zeros(len(places)))
    phase = np.exp(2j * np.pi * rng.uniform(size=(9, 2)))
    data = (cols * (phase * [1.0, bounce])[:, : cols.shape[1], None]).sum(axis=1)
    data = data + noise * (rng.standard_normal(data.shape) + 1j * rng.standard_normal(data.shape)) / np.sqrt(
        2
    )
    return replace(spectra, data=data - data.mean(axis=1, keepdims=True), noise=noise**2)


def at(name: str, turn: float, centre: complex) -> np.ndarray:
    place = LAYOUTS[name].placed(turn, np.array([centre.real, centre.imag]))
    return np.asarray(place[:, 0] + 1j * place[:, 1])


def starts(turn: float, centre: complex) -> list[Place]:
    return [Place(LAYOUTS[n], turn, (centre.real, centre.imag)) for n in ("container-90", "container-180")]


def test_the_slopes_are_those_of_the_waves() -> None:
    spectra, places = empty(), at("helmet-120", 0.3, 0.003j)
    heights = np.array([0.0, 0.01, 0.0])
    exact = _waves(spectra, places, heights, slopes=True)
    step = 1e-7
    for i in range(6):
        ahead = places.copy()
        ahead[i // 2] += step * (1j if i % 2 else 1)
        numeric = (_waves(spectra, ahead, heights).columns - exact.columns) / step
        # The slope of the phase alone; that of the spreading is a hundredth of it.
        assert np.linalg.norm(numeric - exact.slopes[i]) < 0.1 * np.linalg.norm(numeric)


@pytest.mark.parametrize("bounce", [0.0, 0.4])
def test_a_pair_is_read_with_its_double_bounce(bounce: float) -> None:
    places = at("container-90", 0.7, 0.004 - 0.005j)
    reading = read_points(seen(places, bounce), starts(0.65, 0.003 - 0.004j), places, SETTINGS)
    assert reading.layouts[0].layout == "container-90" and reading.passes(SETTINGS)
    assert np.abs(reading.layouts[0].places - places).max() < 5e-4
    assert reading.unexplained < 0.01 and reading.lead > 5 * SETTINGS.lead


@pytest.mark.parametrize("compiled", [True, False])
def test_a_layout_keeps_its_shape_while_it_turns(compiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps along the tangent of a turn stretched a right angle of 64 mm to a pair of 69 mm."""
    if not compiled:
        monkeypatch.setattr("tagid.tags.bodies.points._compiled", None)
    pair = 0.0347 * np.exp(1j * np.array([0.0, np.pi])) + 0.004j
    fitter = PointFitter(seen(pair), 1e-3)
    start = Place(LAYOUTS["container-90"], 0.0, (-0.020, -0.035))
    found = fitter.rigid(start, rounds=30)
    begun = start.layout.placed(0.0, np.asarray(start.centre_m))
    turned = np.angle(np.diff(found.places)[0] / complex(*np.diff(begun[:, :2], axis=0)[0]))
    assert abs(turned) > 0.1
    assert abs(np.diff(found.places)[0]) == pytest.approx(0.045 * np.sqrt(2), abs=1e-9)


def test_points_alone_would_not_explain_it() -> None:
    places = at("container-90", 0.7, 0.004 - 0.005j)
    spectra = seen(places)
    single = columns(spectra, places, np.zeros(2))[:, :1]
    left = PointFitter(spectra, 1.0)._solved(single)[0]
    assert np.sum(np.abs(left) ** 2) > 0.05 * spectra.energy


@pytest.mark.parametrize("angles_deg", [(0, 70), (0, 110), (0, 90, 180), (0, 90, 225), (0,), (0, 120, 240)])
def test_other_arrangements_are_not_the_layout(angles_deg: tuple[float, ...]) -> None:
    places = 0.003 + 0.045 * np.exp(1j * np.deg2rad(angles_deg))
    reading = read_points(seen(places), starts(0.0, 0.003 + 0j), places, SETTINGS)
    assert not reading.passes(SETTINGS)
    # What is there explains the echo, so that no body need be assumed.
    assert reading.least < 0.01


def test_displacement_is_what_turn_and_shift_leave() -> None:
    places = at("helmet-120", 0.0, 0j)
    moved = places * np.exp(0.1j) + (0.004 - 0.002j)
    assert displaced(places, moved) < 1e-9
    moved[0] += 0.006
    assert 0.002 < displaced(places, moved) < 0.006
    assert displaced(places, places[:2]) == float("inf")


@pytest.mark.parametrize("between_deg", [149.0, 156.0, 204.0])
@pytest.mark.parametrize("noise", [0.02, 0.4])
def test_a_pair_that_is_2_mm_closer_is_not_the_opposite_pair(between_deg: float, noise: float) -> None:
    """Whose centre is free: 149 degrees on a ring of 45 mm are 87 mm, opposite reflectors are 90 mm apart."""
    places = -0.008 + 0.045 * np.exp(1j * np.deg2rad([0.0, between_deg]))
    turn = float(np.angle(places[0] - places[1]))
    near = [Place(LAYOUTS["container-180"], turn, (places.mean().real, places.mean().imag))]
    reading = read_points(seen(places, noise=noise), near, places, SETTINGS)
    assert reading.displaced(SETTINGS) and not reading.passes(SETTINGS)
    right = at("container-180", 0.4, 0.003 + 0.001j)
    near = [Place(LAYOUTS["container-180"], 0.4, (0.003, 0.001))]
    reading = read_points(seen(right, noise=noise), near, right, SETTINGS)
    assert reading.passes(SETTINGS) and not reading.displaced(SETTINGS)


@pytest.mark.parametrize(("between_deg", "noise"), [(156.0, 0.6), (160.0, 0.4)])
def test_noise_that_is_stronger_than_expected_moves_no_reflector(between_deg: float, noise: float) -> None:
    """What noise leaves above its mean, by chance, is no error of the model that could displace a pair."""
    for seed in range(12):
        for angle in (between_deg, 180.0):
            places = -0.004 + 0.045 * np.exp(1j * np.deg2rad([0.0, angle]))
            turn = float(np.angle(places[0] - places[1]))
            near = [Place(LAYOUTS["container-180"], turn, (places.mean().real, places.mean().imag))]
            reading = read_points(seen(places, noise=noise, seed=seed), near, places, SETTINGS)
            assert reading.displaced(SETTINGS) == (angle < 180) and reading.passes(SETTINGS) == (angle == 180)


def test_a_wobble_opens_a_right_angle_and_not_the_opposite_pair() -> None:
    """0.02 rad between two directions: 0.3 mm at each reflector of container-90, nothing at container-180."""
    points = PlacedPoints(np.zeros(2, complex), np.zeros(2), 0.0)
    limits = [SETTINGS.limit_m(points, 0.0, LAYOUTS[name]) for name in ("container-90", "container-180")]
    lever = 0.045 * np.cos(np.pi / 4)
    assert limits == pytest.approx([np.hypot(SETTINGS.pair_m, lever * SETTINGS.wobble_rad / 2), 0.4e-3])


def test_the_spread_is_that_of_repeated_fits() -> None:
    """The Cramer-Rao bound of the spacing against 40 fits of a noisy pair."""
    places = at("container-180", 0.4, 0.003 + 0.001j)
    apart, spreads = [], []
    for seed in range(40):
        spectra = seen(places, noise=0.5, seed=seed)
        found = PointFitter(spectra, spectra.noise).free(places, np.zeros(2))
        apart.append(abs(found.places[0] - found.places[1]))
        spreads.append(found.spread_m)
    # Each reflector moves by half of what the spacing does.
    assert np.std(apart) / 2 == pytest.approx(np.mean(spreads), rel=0.3)
