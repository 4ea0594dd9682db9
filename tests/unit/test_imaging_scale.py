"""The same scene at another wavelength and wave speed, and what follows from wavelength and band."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.errors import UsageError
from tagid.imaging.bandcheck import band_warning
from tagid.imaging.lengths import pixel_warning
from tagid.pipeline.prepared import prepare
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings

VACUUM, AIR = 299_792_458.0, 345.0
POINTS = np.array([[1.2, 0.4], [-0.8, 1.5], [0.3, -1.6]])
"""Reflectors, in wavelengths."""


def capture_of(
    center_hz: float,
    speed: float,
    error: float = 0.0,
    views: int = 36,
    points: np.ndarray = POINTS,
    away: float = 13.0,
    half: int = 60,
) -> Capture:
    """Reflectors on a turntable `away` wavelengths from it, stated wrong by `error` wavelengths; bandwidth
    0.43 of the centre frequency, 0.12 wavelengths a bin, `half` bins on both sides of the axis."""
    lam = speed / center_hz
    tau = np.sqrt(np.log(10)) / (np.pi * 0.43)
    angles = np.arange(views) * 2 * np.pi / views
    antenna = away * np.stack([np.cos(-angles), np.sin(-angles)], axis=1)
    ranges = away + 0.12 * np.arange(-half, half + 1)
    distance = np.linalg.norm(antenna[:, None] - points, axis=2)
    # Two-way time in periods of the carrier.
    t = 2 * (ranges[None, :, None] - distance[:, None, :])
    echoes = (np.exp(-(t**2) / (2 * tau**2)) * np.cos(2 * np.pi * t)).sum(axis=2)
    echoes += 0.05 * np.random.default_rng(1).standard_normal(echoes.shape)
    return Capture(
        echoes.astype(np.float32),
        float(ranges[0] * lam),
        0.12 * lam,
        angles_rad=angles,
        axis_distance_m=(away + error) * lam,
        center_frequency_hz=center_hz,
        bandwidth_hz=0.43 * center_hz,
        wave_speed_m_s=speed,
    )


@pytest.mark.parametrize("method", ["bp", "sparse", "ats"])
def test_sound_in_air_and_radar_in_vacuum_give_the_identical_image(method: str) -> None:
    images, remaining = [], []
    for center_hz, speed in ((4e9, VACUUM), (20e3, AIR)):
        settings = ImagingSettings(method, extent_m=5 * speed / center_hz, pixels=48, background="none")
        result = reconstruct(capture_of(center_hz, speed, error=0.2), settings)
        assert result.focus.reliable
        assert result.focus.axis_distance_m == pytest.approx(13 * speed / center_hz, rel=3e-3)
        images.append(np.abs(result.image.values))
        remaining.append(result.image.settings["held_out"]["residual"])
    # Single-precision rounding differs between the scales; Adam lets it grow a little.
    np.testing.assert_allclose(*images, atol=(2e-2 if method == "ats" else 2e-3) * images[0].max())
    assert remaining[0] == pytest.approx(remaining[1], abs=0.02)


def test_an_object_of_many_wavelengths_keeps_its_views() -> None:
    """At 24 GHz averaging to one degree would turn the phase of an echo at 0.2 m by three radians a view."""
    lam = VACUUM / 24e9
    dense = capture_of(24e9, VACUUM, 0.0, 800, np.array([[16.0, 0.0]]), 52.0, 200)
    prepared = prepare(dense)
    assert prepared.views == 800
    assert prepare(dense, extent_m=0.1).views == 437
    settings = ImagingSettings(method="bp", extent_m=0.5, pixels=400, focus_m=0.0, held_out=False)
    image = reconstruct(prepared, settings).image
    row, column = np.unravel_index(int(np.argmax(np.abs(image.values))), image.values.shape)
    assert np.hypot(image.grid.axis[column] - 16 * lam, image.grid.axis[row]) < lam / 8


def test_pixels_that_miss_points_are_warned_of() -> None:
    lam = VACUUM / 77e9
    assert pixel_warning(0.4, 512, lam) is None
    assert "pixels=" not in str(pixel_warning(1.0, 512, lam))
    reported = pixel_warning(0.8, 512, lam)
    assert "give `imaging.pixels=867` or an `imaging.extent_m` of up to 0.47 m" in str(reported)
    capture = capture_of(4e9, VACUUM)
    settings = ImagingSettings(method="bp", extent_m=1.0, pixels=32, background="none", held_out=False)
    assert "coarser" in reconstruct(capture, settings).image.settings["warnings"][0]
    assert "warnings" not in reconstruct(capture, replace(settings, pixels=64)).image.settings


def test_energy_outside_the_assumed_band_is_named() -> None:
    capture = capture_of(4e9, VACUUM)
    assert band_warning(capture) is None
    warning = band_warning(replace(capture, center_frequency_hz=2e9, bandwidth_hz=0.5e9))
    low, high = map(float, re.search(r"between ([\d.]+)(?: GHz)? and ([\d.]+) GHz;", warning).groups())
    assert 3.0 < low < 3.6
    assert 4.4 < high < 5.0


def test_the_extent_may_be_anything_up_to_the_range_window() -> None:
    capture = capture_of(4e9, VACUUM)
    reach = 2 * (13 * capture.wavelength_m + float(capture.ranges_m[-1]))
    wide = ImagingSettings(method="bp", extent_m=0.99 * reach, pixels=32, background="none", held_out=False)
    assert reconstruct(capture, wide).image.grid.extent == pytest.approx(0.99 * reach)
    with pytest.raises(UsageError, match="beyond the recorded ranges"):
        reconstruct(capture, replace(wide, extent_m=1.01 * reach))
