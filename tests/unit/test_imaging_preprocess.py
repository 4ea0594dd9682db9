"""Preprocessing against the analytic echo: response, calibration, background, gate, noise, bad input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.capture import Capture, Pulse
from tagid.errors import DataError, UsageError
from tagid.imaging.preprocess import PreprocessSettings, preprocess, select_views
from tagid.imaging.rangefilter import band_of
from tagid.waveform import nominal_pulse
from tests.benchmarks.provenance import SHARED
from tests.unit.imaging_scenes import FC, STEP_M, C, helix, record, turn

MEASURED = SHARED / "data" / "p440" / "pulse.npz"
RAW = PreprocessSettings(background="none")


def predicted(scans, points, amplitudes):
    xyz = np.column_stack([np.asarray(points, float).reshape(-1, 2), np.zeros(len(amplitudes))])
    d = np.linalg.norm(scans.aperture.positions[:, None] - xyz, axis=2)[:, None, :]
    g = scans.response(scans.ranges_m[None, :, None] - d)
    return (np.asarray(amplitudes) * g * np.exp(-2j * scans.wavenumber * d)).sum(axis=-1)


@pytest.mark.parametrize("matched", [True, False])
@pytest.mark.parametrize(
    "kind",
    [
        {},
        {"analytic": True},
        {"analytic": True, "step_m": 6 * STEP_M, "bins": 40},  # sampled below the carrier
        {"bins": 1152, "start_m": -3.0},
        {"aperture": helix(12)},
    ],
    ids=["real", "analytic", "undersampled", "p440-window", "free positions"],
)
def test_a_point_gives_exactly_the_response(matched, kind):
    points, amplitudes = [(0.1, 0.05), (-0.12, 0.0)], [1.0, 2.0]
    capture = record(points, amplitudes, **{"aperture": turn(12, height=0.2), **kind})
    scans = preprocess(capture, settings=replace(RAW, matched_filter=matched))
    assert scans.samples.dtype == np.complex64
    assert abs(scans.response(np.array([0.0]))[0]) == pytest.approx(1, abs=1e-6)
    model = predicted(scans, points, amplitudes)
    assert np.abs(scans.samples - model).max() < 0.01 * 2.0
    assert np.vdot(model, scans.samples) / np.vdot(model, model) == pytest.approx(1, rel=0.005)


def test_counts_and_floats_are_treated_alike():
    capture = record([(0.1, 0.0)], [1e4], turn(8))
    counts = replace(capture, samples=np.rint(capture.samples).astype(np.int32))
    a, b = preprocess(capture), preprocess(counts)
    assert np.abs(a.samples - b.samples).max() < 1.0


@pytest.mark.parametrize("background", ["mean", "median"])
def test_static_clutter_is_removed(background):
    aperture = turn(72)
    clean = record([(0.1, 0.0)], [1.0], aperture)
    static = record([(0.0, 0.0)], [50.0], aperture)  # on the axis: the same in every view
    cluttered = replace(clean, samples=clean.samples + static.samples)
    settings = PreprocessSettings(background=background)
    with_clutter, without = preprocess(cluttered, settings=settings), preprocess(clean, settings=settings)
    assert np.abs(with_clutter.samples - without.samples).max() < 1e-4 * 50


@pytest.mark.parametrize("matched", [True, False])
@pytest.mark.parametrize("window", [{"bins": 1152, "start_m": -3.0}, {}], ids=["off-target bins", "off-band"])
def test_noise_is_estimated_beside_a_target(matched, window):
    settings = PreprocessSettings(matched_filter=matched)
    truth = preprocess(record([], [], turn(72), noise=0.3, **window), settings=settings).samples.std()
    scans = preprocess(record([(0.1, 0)], [5.0], turn(72), noise=0.3, seed=1, **window), settings=settings)
    assert scans.noise_std == pytest.approx(float(truth), rel=0.1)


@pytest.mark.parametrize("background", ["mean", "median"])
@pytest.mark.parametrize("views", [2, 3, 12])
def test_the_noise_is_that_of_the_radar_and_not_what_the_background_left(background, views):
    """Subtracting the mean of n views leaves 1 - 1/n of the noise's power; the estimate makes up for it."""
    capture = record([(0.1, 0)], [5.0], turn(views), noise=0.3, bins=4608, start_m=-18.0)
    known = preprocess(capture, settings=RAW).noise_std
    result = preprocess(capture, settings=PreprocessSettings(background)).noise_std
    assert result == pytest.approx(known, rel=0.05 if background == "mean" or views == 2 else 0.2)


def test_the_gate_keeps_what_the_object_can_reach_and_not_more():
    capture = record([(0.2, 0.2)], [1.0], turn(24), bins=1152, start_m=-3.0)
    scans = preprocess(capture, settings=RAW)
    assert scans.ranges_m[0] < 1 - 0.25 * np.sqrt(2)
    assert scans.ranges_m[-1] > 1 + 0.25 * np.sqrt(2)
    assert scans.ranges_m[-1] - scans.ranges_m[0] < 1.2
    assert scans.range_step_m > 4 * STEP_M
    assert 0.5 * scans.samples.size < scans.independent_samples < 0.8 * scans.samples.size
    half = select_views(scans, slice(None, None, 2))
    assert half.aperture.views == len(half.samples) == 12
    assert half.independent_samples == pytest.approx(scans.independent_samples / 2)


def test_a_measured_pulse_is_taken_from_the_capture_in_any_unit():
    pulse = nominal_pulse()
    capture = record([(0.1, 0.05)], [2.0], turn(12))
    plain = preprocess(capture, settings=RAW)
    louder = preprocess(replace(capture, pulse=Pulse(7 * pulse.samples, pulse.step)), settings=RAW)
    assert np.allclose(plain.samples, louder.samples, atol=1e-4)


def test_the_pulse_decides_the_carrier():
    low, high = band_of(nominal_pulse(4.3e9, 1.4e9))
    assert (low + high) / 2 == pytest.approx(4.3e9, rel=2e-3)
    assert high - low == pytest.approx(1.4e9, rel=0.02)
    scans = preprocess(record([(0.1, 0)], [1.0], turn(4)), settings=RAW)
    assert scans.carrier_hz == pytest.approx(FC, rel=0.01)


def test_axis_outside_the_data_names_both_distances():
    capture = record([(0.0, 0.1)], [1.0], turn(12), start_m=2.0, noise=0.1)
    with pytest.raises(DataError, match=r"2\.000 to .* axis is at 1\.000 m"):
        preprocess(capture)


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (np.ones((1, 130), np.float32), "1 view"),
        (np.zeros((12, 130), np.float32), "zero"),
        (np.ones((12, 130), np.float32), "nothing changes"),
        (np.ones((12, 4), np.float32), "4 range bins"),
        (np.full((12, 130), 1e30, np.float32), "overflow"),
        (np.full((12, 130), 3e38 + 3e38j, np.complex64), "overflow"),
    ],
)
def test_unusable_scans_are_refused(samples, message):
    capture = Capture(samples, 0.4, STEP_M, angles_rad=np.arange(len(samples)) * 0.5, axis_distance_m=1.0)
    with pytest.raises(DataError, match=message) as caught:
        preprocess(capture)
    assert message in caught.value.message


@pytest.mark.parametrize(
    "wrong", [{"background": "mode"}, {"extent_m": 0.0}, {"margin_m": -1.0}, {"oversampling": 1.0}]
)
def test_senseless_settings_are_refused(wrong):
    with pytest.raises(UsageError):
        PreprocessSettings(**wrong)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"range_step_m": 1e-9, "range_start_m": 1.0}, "."),
        ({"bandwidth_hz": 1.0}, "."),
        ({"range_step_m": 3 * STEP_M}, "sampling"),
    ],
)
def test_absurd_numbers_end_in_an_error_and_not_in_memory(wrong, message):
    capture = record([(0.1, 0.0)], [1.0], turn(1))
    assert preprocess(capture, settings=RAW).samples.shape[0] == 1
    with pytest.raises(DataError, match=message):
        preprocess(replace(capture, **wrong), settings=RAW)


@pytest.mark.skipif(not MEASURED.is_file(), reason="the measured pulses are not in the shared data folder")
@pytest.mark.parametrize("name", ["cr02", "cr07"])
@pytest.mark.parametrize("matched", [True, False])
def test_measured_pulses_give_their_response_too(name, matched):
    """Ringing, asymmetric pulses: the model of a point holds to 1 % for them as for the nominal one."""
    with np.load(MEASURED) as data:
        pulse = Pulse(data[name], float(data["dt_ns"]) * 1e-9)
    point, aperture = (0.08, -0.05), turn(10)
    ranges = 0.2 + STEP_M * np.arange(220)
    time = 2 * (ranges - aperture.distances(np.array([point]))) / C
    shape_time = (np.arange(len(pulse.samples)) - len(pulse.samples) // 2) * pulse.step
    samples = np.interp(time, shape_time, pulse.samples, left=0, right=0).astype(np.float32)
    capture = Capture(samples, 0.2, STEP_M, angles_rad=aperture.angles, axis_distance_m=1.0, pulse=pulse)
    scans = preprocess(capture, settings=replace(RAW, matched_filter=matched))
    model = predicted(scans, [point], [1.0])
    sigma = np.vdot(model, scans.samples) / np.vdot(model, model)
    assert abs(sigma) == pytest.approx(sigma.real, rel=1e-3)  # no phase error
    assert np.abs(scans.samples - sigma * model).max() < 0.01 * np.abs(scans.samples).max()
