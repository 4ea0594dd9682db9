"""Free antenna positions at metre scale: a rail of 3.4 m, two reflectors, a path delay that nobody knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.errors import UsageError
from tagid.geometry import Aperture, ImageGrid
from tagid.imaging.backprojection import backproject
from tagid.imaging.farfield import polar_format, range_doppler
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.rangefocus import focus_delay
from tagid.imaging.region import choose_region
from tagid.operate.words import region_words
from tagid.pipeline.prepared import prepare
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tests.unit.imaging_scenes import record, scans_from, turn
from train.metrics import localise, pick_peaks

POINTS = np.array([[-0.6, 2.3], [0.5, 3.6]])
GRID = ImageGrid(0.5, 128)
WIDE = PreprocessSettings("none", True, extent_m=12.0, margin_m=1.0)


def passing(
    antenna: np.ndarray,
    points: Sequence[Sequence[float]],
    delay_m: float,
    noise: float,
    seed: int = 5,
    window: tuple[float, int] = (0.0, 960),
) -> Capture:
    """Scans float32 of `window` (start in m, bins) past two reflectors, their ranges `delay_m` too long."""
    start_m, bins = window
    aperture = Aperture(antenna)
    late = record(points, [1.0, 0.7], aperture, start_m=start_m - delay_m, bins=bins, noise=noise, seed=seed)
    return replace(late, range_start_m=start_m)


def rail(delay_m: float, points: np.ndarray = POINTS) -> Capture:
    """Scans from a rail along x at y = 0."""
    u = np.linspace(-1, 1, 150)
    return passing(np.stack([1.7 * u, 0 * u, 0 * u], axis=1), points, delay_m, 0.05, 0)


def bent(sagitta_m: float, delay_m: float) -> Capture:
    """Scans from a path along x that bends by its sagitta, off its targets' middle, at changing heights."""
    u = np.linspace(-1, 1, 300)
    antenna = np.stack([1.7 * u + 0.8, sagitta_m * u**2 - 1.0, 0.25 + 0.08 * np.sin(3 * u)], axis=1)
    return passing(antenna, [[0.4, 1.6], [1.6, 2.4]], delay_m, 0.2)


def bowed(sagitta_m: float) -> Capture:
    """Scans of a rail along x that bows, past two reflectors at y > 1; the origin is on the other side."""
    u = np.linspace(-1, 1, 150)
    antenna = np.stack([1.7 * u, 1.0 + sagitta_m * (1 - u**2), 0 * u], axis=1)
    return passing(antenna, [[-0.6, 3.4], [0.7, 3.9]], 0.3, 0.03, window=(0.8, 480))


def test_the_path_delay_is_found_within_a_metre() -> None:
    scans = preprocess(rail(-0.83), settings=WIDE)
    corrected, focus = focus_delay(scans, 1.0)
    assert focus.reliable
    assert focus.delay_m == pytest.approx(-0.83, abs=0.01)
    assert corrected.range_start_m == pytest.approx(scans.range_start_m - focus.delay_m)
    located = localise(np.array([[p.x_m, p.y_m] for p in focus.points]), POINTS, 0.05)
    assert located.detected == 2


@pytest.mark.parametrize(("sagitta_m", "delay_m"), [(0.0, -0.5), (-0.1, 0.3)])
def test_a_bent_path_off_the_middle_knows_its_delay_and_its_side(sagitta_m: float, delay_m: float) -> None:
    """A path in one upright plane has two sides alike; a few centimetres of bend leave ghosts there."""
    region = choose_region(bent(sagitta_m, delay_m), GRID, None, free_extent=True, free_pixels=True)
    assert region.focus.reliable
    assert region.focus.delay_m == pytest.approx(delay_m, abs=0.008)
    assert region.mirrored == (sagitta_m == 0)
    assert region.grid.extent < 3
    where = np.array([[p.x_m, p.y_m] for p in region.focus.points])
    located = localise(where, np.array([[0.4, 1.6], [1.6, 2.4]]), 0.02)
    assert (located.detected, located.false) == (2, 0)


def test_a_path_that_bows_a_little_is_imaged_on_its_true_side() -> None:
    """Its mirror image is in focus at another delay, with 5 to 10 % less power."""
    region = choose_region(bowed(0.009), GRID, None, free_extent=True)
    assert region.focus is not None and region.focus.alike is False and not region.mirrored
    assert min(p.y_m for p in region.points) > 1
    if region.focus.reliable:
        assert region.focus.delay_m == pytest.approx(0.3, abs=3 * region.focus.sigma_m)
    chosen = choose_region(bowed(0.009), GRID, None, towards_m=(0, 0), free_extent=True)
    assert max(p.y_m for p in chosen.points) < 1


def test_sides_that_explain_the_scans_alike_are_called_alike() -> None:
    region = choose_region(bowed(0.001), GRID, None, free_extent=True)
    assert region.focus is not None and region.focus.alike is True and region.mirrored
    assert max(p.y_m for p in region.points) < 1
    assert "explain the scans alike" in region_words(region)[-1]


def test_the_flank_of_a_delay_is_no_rival_of_its_top() -> None:
    """Past reflectors far off its middle, a raised path focuses echoes a little at 0.15 m from the delay."""
    u = np.linspace(-1, 1, 150)
    antenna = np.stack([1.7 * u + 0.7, 0 * u, 0.4 + 0 * u], axis=1)
    capture = passing(antenna, [[-0.6, 2.2], [0.5, 3.6]], 0.41, 0.1)
    region = choose_region(capture, GRID, None, free_extent=True, free_pixels=True)
    assert region.focus.reliable, region.focus.reason
    assert region.focus.delay_m == pytest.approx(0.41, abs=0.006)


@pytest.mark.parametrize(("delay_m", "taken"), [(-0.03, False), (0.03, True)])
def test_one_echo_that_a_round_body_explains_gives_no_delay(delay_m: float, taken: bool) -> None:
    """Its wall is nearer than its axis in every view: a delay below zero may be a radius."""
    alone = np.array([[0.1, 2.0], [0.1, 2.0]])
    _, focus = focus_delay(preprocess(rail(delay_m, alone), settings=WIDE), 0.5)
    assert focus.reliable == taken
    assert taken or "round body" in focus.reason


def test_noise_alone_gives_no_delay() -> None:
    capture = rail(0.0)
    noise = np.random.default_rng(3).standard_normal(capture.samples.shape).astype(np.float32)
    scans = preprocess(replace(capture, samples=noise), settings=WIDE)
    unchanged, focus = focus_delay(scans, 1.0)
    assert not focus.reliable
    assert unchanged is scans
    with pytest.raises(UsageError):
        focus_delay(scans, 5.0)


def test_a_rail_is_imaged_without_being_told_where_to_look() -> None:
    """A plane wave instead of a sphere moves points off the middle: half a wave at 2.9 m is 0.3 m aside."""
    settings = ImagingSettings(method="polar", free_extent=True, free_pixels=True)
    result = reconstruct(prepare(rail(0.42)), settings)
    assert result.region.mirrored and result.views == 150
    peaks = pick_peaks(result.image, 2, 0.25) + np.array(result.image.centre_m)
    assert localise(peaks, POINTS, 0.2).detected == 2


def test_an_image_about_the_origin_must_show_all_strong_echoes() -> None:
    """The strongest echo lies inside the default square, the other does not."""
    near = np.array([[0.1, 0.4], [0.5, 3.6]])
    capture, grid = rail(0.0, near), ImageGrid(1.0, 128)
    region = choose_region(capture, grid, None, 0.0, free_extent=True, free_pixels=True)
    assert np.abs(near - np.array(region.centre_m)).max() < region.grid.extent / 2
    given = choose_region(capture, grid, None, 0.0)
    assert (given.centre_m, given.grid.extent) == ((0.0, 0.0), 1.0)


def test_a_given_centre_is_imaged_and_the_delay_left_alone() -> None:
    settings = ImagingSettings(method="bp", extent_m=0.5, pixels=64, centre_m=(0.5, 3.6), delay_m=0.0)
    result = reconstruct(prepare(rail(0.0)), settings)
    peak = pick_peaks(result.image, 1)[0] + np.array(result.image.centre_m)
    assert np.hypot(*(peak - POINTS[1])) < 0.015
    assert result.image.grid.extent == 0.5


def test_positions_of_a_partial_turn_equal_its_angles() -> None:
    part = turn(360).select(np.arange(90))
    settings = ImagingSettings(method="bp", pixels=64, focus_m=0.0, delay_m=0.0, centre_m=None)
    turned, free = (
        reconstruct(record([[0.05, 0.08], [-0.06, 0.02]], [1, 1], aperture), settings).image.values
        for aperture in (part, Aperture(part.positions))
    )
    np.testing.assert_allclose(turned, free, atol=1e-5)


def test_polar_format_of_a_far_turn_is_the_backprojection() -> None:
    grid = ImageGrid(0.3, 75)
    scans = scans_from(record([[0.06, 0.032]], [1.0], turn(180, 30.0)), grid.extent, matched=True)
    polar, exact = polar_format(scans, grid), backproject(scans, grid)
    a, b = (np.abs(i.values) / np.abs(i.values).max() for i in (polar, exact))
    assert np.unravel_index(a.argmax(), a.shape) == np.unravel_index(b.argmax(), b.shape)
    # Their weights over the band differ (|k| against 1), hence the sidelobes a little.
    assert np.sqrt(((a - b) ** 2).mean()) < 0.1


def test_range_doppler_finds_points_of_a_small_distant_object_in_part_of_a_turn() -> None:
    points = np.array([[0.06, 0.03], [-0.05, -0.04]])
    few = Aperture.turntable(np.deg2rad(np.arange(-30, 30, 0.5)), 8.0)
    scans = scans_from(record(points, [1, 1], few), 0.3, matched=True)
    image = range_doppler(scans, ImageGrid(0.3, 75))
    assert localise(pick_peaks(image, 2, 0.05), points, 0.03).detected == 2
    assert np.abs(image.values).max() == pytest.approx(1.0, abs=0.35)


def test_ranges_as_given_are_imaged_about_the_strong_echoes() -> None:
    """`--no-focus` with free positions: no delay is searched, and the image is not about the origin."""
    settings = ImagingSettings(method="bp", delay_m=0.0, free_extent=True, free_pixels=True)
    result = reconstruct(prepare(rail(0.0)), settings)
    assert result.region.focus is None
    assert np.hypot(*(np.array(result.image.centre_m) - POINTS.mean(axis=0))) < 0.05
    peaks = pick_peaks(result.image, 2, 0.25) + np.array(result.image.centre_m)
    assert localise(peaks, POINTS, 0.03).detected == 2
    late = reconstruct(prepare(rail(0.42)), settings)
    far = np.hypot(*np.array(late.image.centre_m)) - np.hypot(*POINTS.mean(axis=0))
    assert far == pytest.approx(0.42, abs=0.15)  # the delay stays in the ranges


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_one_side_of_a_straight_path_is_chosen(side: float) -> None:
    """A straight rail cannot tell its sides apart; a point on one of them says which is wanted."""
    settings = ImagingSettings(method="bp", free_extent=True, free_pixels=True, towards_m=(0.0, side))
    result = reconstruct(prepare(rail(0.42)), settings)
    assert result.region.mirrored
    outcome = np.array([[p.x_m, p.y_m] for p in result.region.points])
    assert localise(outcome, POINTS * [1, side], 0.03).detected == 2
    assert result.image.centre_m[1] * side > 1


def coarse_path(views: int, wavelength_m: float = 0.0312) -> Capture:
    """Three points seen at 10 GHz from a path of 3.4 m, 5 m away, with so many views."""
    along = np.linspace(-1.7, 1.7, views)
    path = np.stack([np.full(views, -5.0), along, np.ones(views)], axis=1)
    step, bins = 0.2, 30
    ranges = 3.0 + step * np.arange(bins)
    samples = np.zeros((views, bins), dtype=np.complex64)
    for (x, y), amplitude in (((0.3, 0.8), 1.0), ((0.1, 0.2), 0.7), ((-0.4, 1.5), 0.6)):
        off = ranges - np.linalg.norm(path - [x, y, 0.0], axis=1)[:, None]
        samples += amplitude * np.exp(-((off / 0.22) ** 2) + 4j * np.pi / wavelength_m * off)
    frequency = 299_792_458.0 / wavelength_m
    return Capture(
        samples, 3.0, step, antenna_positions_m=path, center_frequency_hz=frequency, bandwidth_hz=6.2e8
    )


def test_copies_beside_a_coarsely_sampled_path_are_no_echoes_and_warned_of() -> None:
    """Views 103 mm apart, 3.3 wavelengths: copies 0.8 m beside every point, 5 dB weaker."""
    settings = ImagingSettings(
        "bp", background="none", delay_m=0.0, focus_m=0.0, towards_m=(0, 0), free_extent=True, held_out=False
    )
    coarse, dense = (reconstruct(coarse_path(views), settings) for views in (34, 400))
    for made in (coarse, dense):
        (x, y), extent = made.region.centre_m, made.region.grid.extent
        assert np.hypot(x - 0.1, y - 0.8) < 0.6 and extent < 3.7
        assert np.hypot(made.region.points[0].x_m - 0.3, made.region.points[0].y_m - 0.8) < 0.05
    reported = [words for words in coarse.image.settings["warnings"] if "shows again" in words]
    assert len(reported) == 1 and "shows again 0.8" in reported[0], reported
    assert not any("shows again" in words for words in dense.image.settings.get("warnings", ()))
