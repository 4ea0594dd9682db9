"""One axis distance for every method, and none where the echo has no one delay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.autofocus import (
    BIAS_WAVELENGTHS,
    MOST_SIGMA_WAVELENGTHS,
    PART_OF_TURN,
    AxisFocus,
    focus_axis_distance,
)
from tagid.imaging.pointmodel import BAND_PARTS, BandDelays, PointSearch, band_delays
from tagid.imaging.preprocess import preprocess
from tagid.imaging.types import BasebandScans
from tagid.operate.words import focus_words
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tagid.storage.hdf5 import write_capture
from tests.unit.imaging_scenes import BANDWIDTH, FC, C, record, scans_from, turn

GRID = ImageGrid(0.4, 64)
POINTS = [(0.05, 0.03), (-0.04, 0.06)]
LAM = C / FC


def turned(capture: Capture, axis_distance_m: float = 1.0) -> Capture:
    """A whole turn, its axis distance as stated."""
    angles = np.arange(capture.views) * 2 * np.pi / capture.views
    return replace(capture, angles_rad=angles, axis_distance_m=axis_distance_m)


def through(response: Callable[[np.ndarray], np.ndarray], error_m: float = 0.0) -> Capture:
    """Two points of such a response over frequency (Hz); the axis distance stated `error_m` too long."""
    capture = record(POINTS, [1.0, 1.0], turn(36), noise=0.05, analytic=True)
    rate = C / (2 * capture.range_step_m)
    # The band of a carrier under the sampling rate of complex samples.
    frequency = np.fft.fftfreq(capture.bins, 1 / rate) % rate
    spectrum = np.fft.fft(capture.samples, axis=1) * response(frequency)
    samples = np.fft.ifft(spectrum, axis=1).astype(np.complex64)
    return turned(replace(capture, samples=samples), 1.0 + error_m)


def resonant(edge_m: float, error_m: float = 0.0) -> Capture:
    """An echo from `edge_m` farther at the upper edge of the band, and as much nearer at the lower one."""
    return through(lambda f: np.exp(-4j * np.pi / C * edge_m * (f - FC) ** 2 / BANDWIDTH), error_m)


def resonator(resonance_hz: float, quality: float, error_m: float) -> Capture:
    """The echo of a damped resonator, h = x^2 / (1 - x^2 + jx / Q) with x = f / f0: the current of a short
    dipole, E ~ f^2 far below its resonance, late by up to Q / (pi f0) at it."""

    def response(frequency: np.ndarray) -> np.ndarray:
        x = frequency / resonance_hz
        return x**2 / (1 - x**2 + 1j * x / quality)

    return through(response, error_m)


def scans_of(capture: Capture) -> BasebandScans:
    return scans_from(capture, GRID.extent)


@pytest.mark.parametrize("edge_wavelengths", [0.0, 0.2])
def test_every_part_of_the_band_gets_the_delay_of_its_echo(edge_wavelengths: float) -> None:
    scans = scans_of(resonant(edge_wavelengths * LAM))
    delays = band_delays(scans, PointSearch(scans, GRID).explain(scans.aperture)).thirds / LAM
    # The middles of the thirds lie two thirds of the way to the edges; where the pulse is strong counts more.
    expected = edge_wavelengths * np.linspace(-1, 1, 2 * BAND_PARTS + 1)[1::2]
    np.testing.assert_allclose(delays, expected, atol=0.04)


def test_an_echo_of_one_delay_tells_the_axis_and_one_that_resonates_does_not() -> None:
    for error in (-0.2 * LAM, 0.2 * LAM):
        focused, plain = focus_axis_distance(scans_of(resonant(0.0, error)), GRID)
        assert plain.reliable
        assert plain.axis_distance_m == pytest.approx(1.0, abs=0.02 * LAM)
        assert plain.offset_m == pytest.approx(-error, abs=0.02 * LAM)
        assert focused.aperture.axis_distance == plain.axis_distance_m
    same, focus = focus_axis_distance(scans_of(resonant(0.4 * LAM, error)), GRID)
    assert not focus.reliable
    assert focus.reason == "the parts of the band do not agree on one distance"
    assert focus.sigma_m > MOST_SIGMA_WAVELENGTHS * LAM
    assert same.aperture.axis_distance == pytest.approx(1.0 + error)


@pytest.mark.parametrize(("resonance_hz", "sign"), [(3.4e9, -1), (4.8e9, 1)])
def test_what_resonates_at_a_flank_of_the_band_does_not_tell_the_axis(
    resonance_hz: float, sign: float
) -> None:
    """A resonance of Q = 2 delays the distance by over a fifth of a wavelength. The thirds of the band give a
    standard error that would be taken; the halves differ."""
    error = 0.1 * LAM
    scans = scans_of(resonator(resonance_hz, 2.0, error))
    same, focus = focus_axis_distance(scans, GRID)
    assert focus.best_m is not None and focus.best_m - 1.0 > LAM / 5
    assert not focus.reliable
    assert focus.reason == "the parts of the band do not agree on one distance"
    assert same.aperture.axis_distance == pytest.approx(1.0 + error)
    there = scans.with_aperture(scans.aperture.with_axis_distance(focus.best_m))
    delays = band_delays(there, PointSearch(there, GRID).explain(there.aperture))
    assert delays.thirds.std(ddof=1) / np.sqrt(BAND_PARTS) < MOST_SIGMA_WAVELENGTHS * LAM
    # Below its resonance it follows at once, at it late, above it at once again.
    assert sign * delays.apart_m > 10 * delays.apart_error_m
    assert delays.error_m > MOST_SIGMA_WAVELENGTHS * LAM


def test_the_noise_of_the_halves_of_the_band_is_not_taken_for_a_resonance() -> None:
    """Two halves that differ by their standard error say nothing; the mean of the thirds remains."""
    thirds = np.array([-0.002, 0.0, 0.002])
    mean = 0.002 / np.sqrt(3)
    assert BandDelays(thirds, 0.004, 0.004).error_m == pytest.approx(mean)
    assert BandDelays(thirds, -0.003, 0.004).error_m == pytest.approx(mean)
    # 5^2 - 4^2 = 3^2; two values 3 apart have the standard deviation 3 / sqrt 2.
    assert BandDelays(thirds, -0.005, 0.004).error_m == pytest.approx(np.hypot(mean, 0.003 / np.sqrt(2)))
    assert np.isnan(BandDelays(thirds, 0.005, float("nan")).error_m)


def test_every_method_images_about_the_same_axis() -> None:
    """Each on its own filter, the methods found axes up to millimetres apart in one capture."""
    given = turned(record(POINTS, [1.0, 0.7], turn(36), noise=0.3, seed=3), 1.02)
    results = []
    for method in ("bp", "bp-raw", "polar", "sparse"):
        settings = ImagingSettings(method=method, extent_m=0.4, pixels=48, background="none", held_out=False)
        result = reconstruct(given, settings, tell_outside=False)
        assert result.focus.reliable
        assert result.image.settings["axis_distance_m"] == result.focus.axis_distance_m
        results.append(result.focus.axis_distance_m)
    assert len(set(results)) == 1
    assert results[0] == pytest.approx(1.0, abs=0.005)


def test_the_search_is_made_once_for_a_prepared_capture() -> None:
    capture = turned(record(POINTS, [1.0, 0.7], turn(36), noise=0.1), 1.02)
    settings = ImagingSettings(method="bp", extent_m=0.4, pixels=48, background="none")
    prepared = PreparedCapture(capture, settings)
    assert prepared.focus() is prepared.focus()
    assert reconstruct(prepared).focus is prepared.focus()
    assert PreparedCapture(capture, replace(settings, focus_m=0.0)).focus() is None


def test_a_distance_beyond_the_search_is_found_by_a_wider_one(tagid: Any, tmp_path: Path) -> None:
    """1.2 wavelengths off; the command that can widen the search says so, and no other."""
    recorded = record(POINTS, [1.0, 0.7], turn(60), noise=0.05, start_m=0.2, bins=220)
    capture = turned(recorded, 1.0 + 1.2 * LAM)
    settings = ImagingSettings(method="bp", extent_m=0.4, pixels=48, background="none", held_out=False)
    near = reconstruct(capture, settings, tell_outside=False).focus
    assert near is not None and not near.reliable
    assert "seems to be 1.00 m" in near.reason and "`focus_m=0.1`" in near.reason
    write_capture(tmp_path / "far.tagid.h5", capture)
    words = ("--method", "bp", "--extent", 0.4, "--pixels", 48, "--background", "none", "--png", "a.png")
    assert "search farther with --axis-search 0.1\n" in tagid("reconstruct", "far.tagid.h5", *words).out
    far = reconstruct(capture, replace(settings, focus_m=1.9 * LAM), tell_outside=False).focus
    assert far is not None and far.reliable
    assert far.axis_distance_m == pytest.approx(1.0, abs=0.002)


@pytest.mark.parametrize("change", [{"towards_m": (0.0, 1.0)}, {"delay_m": 0.5}, {"centre_m": (0.1, 0.0)}])
def test_searches_of_paths_are_refused_for_a_turntable(change: dict[str, Any]) -> None:
    capture = turned(record(POINTS, [1.0, 0.7], turn(12)))
    with pytest.raises(UsageError, match="turntable"):
        reconstruct(capture, ImagingSettings(method="bp", **change))
    positions = replace(capture, angles_rad=None, antenna_positions_m=turn(12).positions)
    with pytest.raises(UsageError, match="antenna positions") as raised:
        reconstruct(replace(positions, axis_distance_m=None), ImagingSettings(method="bp", focus_m=0.1))
    assert "`delay_m`" in raised.value.remedy


@pytest.mark.parametrize("evidence", [4.1, 1.2])
def test_a_rejected_axis_distance_is_one_statement(evidence: float) -> None:
    """Not "not determined" beside a best estimate and evidence for it."""
    focus = AxisFocus(1.1, best_m=1.044, evidence=evidence, needed=2.8, reason="it is at the edge")
    assert focus_words(focus) == ["the given axis distance is used: it is at the edge"]


@pytest.mark.parametrize(("views", "taken"), [(36, True), (35, True), (26, False), (18, False)])
def test_part_of_a_turn_gives_no_axis_distance(views: int, taken: bool) -> None:
    """Its standard error covers what the scans cannot show: a delay that passes for distance."""
    whole = record(POINTS, [1.0, 1.0], turn(36), noise=0.05)
    kept = np.arange(views)
    capture = replace(
        whole, samples=whole.samples[kept], angles_rad=kept * 2 * np.pi / 36, axis_distance_m=1.004
    )
    _, focus = focus_axis_distance(preprocess(capture), GRID)
    assert focus.reliable == taken
    assert taken or focus.reason == PART_OF_TURN
    if taken:
        assert focus.axis_distance_m == pytest.approx(1.0, abs=0.002)
        assert focus.sigma_m >= BIAS_WAVELENGTHS * LAM
