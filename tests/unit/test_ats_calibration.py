"""What is learned beside the scene: distance, wobble, gain and static component come out as put in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.errors import DataError
from tagid.geometry import Aperture, ImageGrid
from tagid.imaging.ats.calibration import Unknowns, _gains, _solve, angle_error, illumination, improve
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.settings import AtsSettings, FitSettings
from tagid.imaging.preprocess import PreprocessSettings, preprocess, select_views
from tagid.imaging.types import BasebandScans
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.scattering import Points
from tagid.simulate.scene import Scene
from tests.unit.imaging_scenes import record, scans_from, turn

GRID = ImageGrid(0.4, 48)
POINTS = np.array([[0.12, -0.05], [-0.08, 0.11], [0.02, 0.15]])
WOBBLE = np.array([0.015 + 0.01j, -0.006j])
VIEWS = 48


def scans_of(wobble=WOBBLE, offset_m=0.004, noise=0.05, gain=None, static=0.0, seed=3) -> BasebandScans:
    """Scans that claim an even turn at 1 m; the truth is `wobble` and `offset_m`."""
    nominal = np.arange(VIEWS) * 2 * np.pi / VIEWS
    truth = Aperture.turntable(nominal + angle_error(nominal, wobble), 1.0 + offset_m)
    capture = record(POINTS, [1.0, 0.8, 0.9], truth, analytic=True, noise=noise, seed=seed)
    scans = scans_from(capture, 0.4)
    samples = scans.samples * (1 if gain is None else gain[:, None]) + static
    return replace(scans, aperture=turn(VIEWS), samples=samples.astype(np.complex64))


def test_a_scene_that_explains_a_tenth_less_than_the_last_teaches_no_geometry() -> None:
    scans, what = scans_of(), ("axis", "wobble")
    sigma = np.array([1.0, 0.8, 0.9], dtype=np.complex64)
    free = improve(scans, POINTS, sigma, Unknowns.none(scans, 2), what)
    assert 0 < free.unexplained < np.inf and free.offset_m != 0
    for share, taken in ((1.09, True), (1.11, False)):
        before = replace(Unknowns.none(scans, 2), unexplained=free.unexplained / share)
        after = improve(scans, POINTS, sigma, before, what)
        if taken:
            assert (after.offset_m, after.unexplained) == (free.offset_m, free.unexplained)
            np.testing.assert_array_equal(after.wobble, free.wobble)
        else:
            assert (after.offset_m, after.unexplained) == (0.0, before.unexplained)
            assert not after.wobble.any()


def test_samples_that_repeat_the_noise_count_once() -> None:
    """Noise sampled three times as densely as it changes: the same estimates with the same errors."""
    rng = np.random.default_rng(2)
    scans = scans_of(np.zeros(2), 0.0, noise=0.3, gain=1 + 0.1 * rng.standard_normal(VIEWS))
    once = replace(scans, independent_samples=float(scans.samples.size))
    dense = replace(once, samples=np.repeat(scans.samples, 3, axis=1))
    seen = scans_of(np.zeros(2), 0.0, noise=0.0).samples
    known = _gains(once, seen, Unknowns.none(once, 2))
    same = _gains(dense, np.repeat(seen, 3, axis=1), Unknowns.none(dense, 2))
    np.testing.assert_allclose(same.gain, known.gain, rtol=1e-6)
    np.testing.assert_allclose(same.gain_sigma, known.gain_sigma, rtol=1e-6)
    blind = _gains(
        replace(dense, independent_samples=0.0), np.repeat(seen, 3, axis=1), Unknowns.none(dense, 2)
    )
    assert (blind.gain_sigma < 0.75 * known.gain_sigma).all()  # unknown: taken as white

    columns = [rng.standard_normal((VIEWS, 8)) + 1j * rng.standard_normal((VIEWS, 8)) for _ in range(3)]
    noise = rng.standard_normal((VIEWS, 8)) + 1j * rng.standard_normal((VIEWS, 8))
    data = 0.3 * columns[0] - 0.1 * columns[2] + 0.5 * noise
    change, error = _solve(columns, data, [0.2, 1.0, 0.1], [0.05], 1.0)
    dense_columns = [np.repeat(column, 3, axis=1) for column in columns]
    again, dense_error = _solve(dense_columns, np.repeat(data, 3, axis=1), [0.2, 1.0, 0.1], [0.05], 3.0)
    np.testing.assert_allclose(again, change, rtol=1e-5)
    np.testing.assert_allclose(dense_error, error, rtol=1e-5)


def test_the_stated_error_of_a_gain_is_its_error() -> None:
    """With gains drawn from the prior, error over sigma has unit spread, in noise that filters correlate."""
    rng = np.random.default_rng(5)
    ratios = []
    for seed in range(20):
        gain = 1 + 0.1 * rng.standard_normal(VIEWS)
        gain /= gain.mean()
        clean = scans_of(np.zeros(2), 0.0, noise=0.0)
        noisy = scans_of(np.zeros(2), 0.0, noise=0.2, gain=gain, seed=seed)
        now = Unknowns.none(noisy, 2)
        for _ in range(3):
            now = _gains(noisy, clean.samples, now)
        ratios.append((now.gain - gain) / now.gain_sigma)
    assert np.std(ratios) == pytest.approx(1.0, abs=0.12)


def test_gain_and_static_component_of_a_known_scene() -> None:
    gain = 1 + 0.2 * np.sin(np.arange(VIEWS))
    scans = scans_of(np.zeros(2), 0.0, gain=gain, static=0.3 - 0.2j)
    sigma = np.array([1.0, 0.8, 0.9], dtype=np.complex64)
    now = Unknowns.none(scans, 2)
    for _ in range(5):
        now = improve(scans, POINTS, sigma, now, ("gain", "static"))
    assert np.corrcoef(now.gain, gain)[0, 1] > 0.98
    assert np.abs(now.static - (0.3 - 0.2j)).max() < 0.05


def test_scene_and_calibration_are_learned_together() -> None:
    scans = scans_of(2 * WOBBLE)
    plain = fit(scans, GRID, AtsSettings())
    joint = fit(scans, GRID, AtsSettings(calibrate=("axis", "wobble")))
    assert joint.held_out < 0.75 * plain.held_out
    assert joint.calibration.offset_m == pytest.approx(0.004, abs=5e-4)
    assert np.abs(joint.calibration.wobble[:2] - 2 * WOBBLE).max() < 3e-3
    assert joint.calibration.sigma_m < 0.001


def test_robust_weights_resist_a_few_wild_scans() -> None:
    scans = scans_of(np.zeros(1), 0.0)
    wild = scans.samples.copy()
    rng = np.random.default_rng(0)
    wild[5::16] += 3 * (rng.standard_normal(wild[5::16].shape) + 1j * rng.standard_normal(wild[5::16].shape))
    broken = replace(scans, samples=wild)
    clean = fit(scans, GRID).image.values
    plain = fit(broken, GRID, FitSettings(held_out=0.0)).image.values
    robust = fit(broken, GRID, FitSettings(held_out=0.0, robust=3.0)).image.values
    assert np.linalg.norm(robust - clean) < 0.9 * np.linalg.norm(plain - clean)


def test_samples_that_are_not_finite_are_refused() -> None:
    scans = scans_of()
    with pytest.raises(DataError, match="finite"):
        fit(replace(scans, samples=scans.samples * np.float32(np.nan)), GRID)


def test_a_removed_mean_is_part_of_the_model() -> None:
    """With the mean over the views goes a part of every echo; the fit knows, and sees unseen views better."""
    capture = record(POINTS, [1.0, 0.8, 0.9], turn(24), noise=0.02, analytic=True)
    scans = preprocess(capture, settings=PreprocessSettings("mean", False, extent_m=0.4))
    assert scans.background_removed
    unaware = replace(scans, background_removed=False)
    knowing, ignorant = (fit(s, GRID, FitSettings(held_out=0.1)) for s in (scans, unaware))
    assert knowing.held_out < 0.8 * ignorant.held_out
    assert "static" not in knowing.image.settings["calibration"]
    assert np.abs(knowing.calibration.static).max() > 0


def test_spreading_and_beam_are_the_simulators() -> None:
    """Three times as near is nine times as strong; what lies at half the beam's width is half."""
    light = illumination(np.array([[0.0, 0.0], [2 / 3, 0.0]]), np.array([[1.0, 0.0, 0.0]]), 2.0, 0.0)
    np.testing.assert_allclose(light, [[1.0, 9.0]], rtol=1e-5)
    side = np.array([[1.0 - np.cos(0.3), np.sin(0.3)]])
    np.testing.assert_allclose(illumination(side, np.array([[1.0, 0.0, 0.0]]), 0.0, 0.6), 0.5, rtol=1e-5)


def test_what_is_near_is_not_a_stronger_reflector() -> None:
    """From one side the echo of the nearer point is (1.15 / 0.85)^2 = 1.8 times as strong; told so, they are
    alike."""
    points = np.array([[0.15, 0.0, 0.0], [-0.15, 0.0, 0.0]])
    acquisition = Acquisition(views=144, noise_std=0.02, range_law=True)
    capture, _ = simulate_capture(Scene("two", (Points(points, np.ones(2)),)), acquisition, seed=4)
    scans = scans_from(capture, 0.4)
    side = select_views(scans, np.flatnonzero(np.cos(scans.aperture.angles) > np.cos(np.deg2rad(40))))

    def near_over_far(settings: AtsSettings) -> float:
        values = np.abs(fit(side, GRID, settings).image.values).ravel()
        near, far = (values[np.linalg.norm(GRID.points - p[:2], axis=1) < 0.05].max() for p in points)
        return float(near / far)

    assert near_over_far(AtsSettings()) > 1.4
    assert near_over_far(AtsSettings(spreading=2.0)) == pytest.approx(1.0, abs=0.2)
