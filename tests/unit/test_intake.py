"""What commands say of other people's files: units, gaps, order, sign of phase, baseband, magnitudes."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import hilbert

from tagid.capture import Capture
from tagid.constants import CENTER_FREQUENCY_HZ, RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.errors import DataError, FileFormatError
from tagid.imaging.bandcheck import sample_fault
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import intake_remarks, load_capture
from tagid.pipeline.resolve import with_angles
from tagid.simulate.capture import Acquisition, simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.storage.importers import read_any
from tagid.tags.layouts.layout import builtin_layouts

RAIL = np.stack([np.full(60, -5.1), np.linspace(-1.7, 1.7, 60), np.full(60, 1.8)], axis=1)
SAMPLES = np.random.default_rng(6).standard_normal((60, 64)).astype(np.float32)


def npz(path: Path, **values: Any) -> Path:
    np.savez(path, **{"samples": SAMPLES, "range_start_m": 5.0, "range_step_m": RANGE_STEP_M, **values})
    return path


@pytest.mark.parametrize(
    ("scale", "unit", "conversion"),
    [
        (1e3, "millimetres", "by 1000"), (1e2, "centimetres", "by 100"), (1e-3, "kilometres", "by 1000"),
        (1 / 0.0254, "inches", "multiply by 0.0254"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("offset", [0.0, 4e3])
def test_positions_in_other_units_name_the_unit(
    tmp_path: Path, scale: float, unit: str, conversion: str, offset: float
) -> None:
    positions = (RAIL + np.array([offset, 0, 0])) * scale
    with pytest.raises(FileFormatError, match=r"not metres|kilometres") as raised:
        read_any(npz(tmp_path / "a.npz", antenna_positions_m=positions))
    assert unit in f"{raised.value.message} {raised.value.remedy}"
    assert conversion in raised.value.remedy and "axis-distance" not in raised.value.remedy
    assert read_any(npz(tmp_path / "b.npz", antenna_positions_m=RAIL + np.array([offset, 0, 0]))).views == 60


def test_positions_in_degrees_name_the_conversion(tmp_path: Path) -> None:
    degrees = np.stack([48.1 + RAIL[:, 1] / 111e3, np.full(60, 11.5), np.full(60, 520.0)], axis=1)
    for order in ([0, 1, 2], [1, 0, 2]):
        with pytest.raises(FileFormatError, match="latitude and longitude") as raised:
            read_any(npz(tmp_path / "a.npz", antenna_positions_m=degrees[:, order]))
        assert "6.371e6" in raised.value.remedy


def test_a_long_flight_in_metres_is_read(tmp_path: Path) -> None:
    for step in (0.5, 1.0):
        flight = np.arange(60)[:, None] * [step, 0.0, 0.0] + [0.0, 5.0, 3.0]
        assert read_any(npz(tmp_path / "a.npz", antenna_positions_m=flight)).views == 60


def test_a_path_with_y_up_is_remarked(tmp_path: Path) -> None:
    turn = np.linspace(0, 6, 60)
    circle = np.stack([5 * np.cos(turn), np.full(60, 1.8), 5 * np.sin(turn)], axis=1)
    capture = read_any(npz(tmp_path / "a.npz", antenna_positions_m=circle))
    assert any("if y is up" in remark for remark in intake_remarks(capture))
    for positions in (circle[:, [0, 2, 1]], RAIL):
        capture = read_any(npz(tmp_path / "b.npz", antenna_positions_m=positions))
        assert not any("if y is up" in remark for remark in intake_remarks(capture))


@pytest.mark.parametrize("key", ["antenna_positions_m", "angles_rad", "timestamps_s"])
def test_views_without_a_place_are_left_out_and_named(tmp_path: Path, key: str) -> None:
    values = {
        "antenna_positions_m": RAIL.copy(), "angles_rad": np.arange(60) * np.pi / 30,
        "timestamps_s": np.arange(60) * 0.02,
    }[key]  # fmt: skip
    values[[20, 21, 22, 40]] = np.nan
    extra = {"axis_distance_m": 1.0, "scan_id": np.arange(60)}
    capture = read_any(npz(tmp_path / "a.npz", **{key: values}, **extra))
    np.testing.assert_array_equal(capture.samples, np.delete(SAMPLES, [20, 21, 22, 40], axis=0))
    assert capture.scan_id is not None and 21 not in capture.scan_id and len(capture.scan_id) == 56
    (remark,) = (remark for remark in intake_remarks(capture) if "not finite" in remark)
    assert (
        "4 of 60 views" in remark and "20 to 22, 40" in remark and "interpolate" in remark and key in remark
    )
    values[10:45] = np.nan
    with pytest.raises(FileFormatError, match="35 of 60 views"):
        read_any(npz(tmp_path / "b.npz", **{key: values}, **extra))


@pytest.mark.parametrize(
    ("times", "unit", "factor"),
    [
        (np.arange(60) * 833.3, "milliseconds", "1000"),
        (np.arange(60) * 20e3, "microseconds", "1e+06"),
        (np.arange(60) * 20e6, "ticks of 100 ns|microseconds", ""),
        (1.7e12 + np.arange(60) * 20, "milliseconds", "1000"),
        (1.7e15 + np.arange(60) * 20e3, "microseconds", "1e+06"),
        (1.7e18 + np.arange(60) * 20e6, "nanoseconds", "1e+09"),
        (6.39e17 + np.arange(60) * 2e5, "ticks of 100 ns", "1e+07"),
    ],
)
def test_times_in_other_units_name_the_unit(tmp_path: Path, times: Any, unit: str, factor: str) -> None:
    with pytest.raises(FileFormatError, match=unit) as raised:
        read_any(npz(tmp_path / "a.npz", timestamps_s=times, axis_distance_m=1.0))
    assert f"Divide timestamps_s by {factor}" in raised.value.remedy


def test_times_that_no_turn_explains_name_the_unit(tmp_path: Path) -> None:
    # Milliseconds at 50 scans per second might be seconds of a slow table: only the stated speed tells.
    capture = read_any(npz(tmp_path / "a.npz", timestamps_s=np.arange(60) * 20.0, axis_distance_m=5.2))
    with pytest.raises(DataError, match=r"20 s apart.* and a turn takes 30 s") as raised:
        with_angles(capture, "free?rpm=2")
    assert "timestamps_s is in seconds" in raised.value.remedy


def test_an_axis_in_millimetres_names_the_unit(tmp_path: Path) -> None:
    turn = np.arange(60) * 2 * np.pi / 60
    with pytest.raises(FileFormatError, match="axis_distance_m is 5200, but the scans reach") as raised:
        read_any(npz(tmp_path / "a.npz", angles_rad=turn, axis_distance_m=5200.0))
    assert "millimetres (divide by 1000)" in raised.value.remedy


def test_times_of_a_whole_recording_name_the_unit(tmp_path: Path) -> None:
    for times, unit in ((np.arange(3750) * 8.0, "milliseconds"), (np.arange(36) / 36 * 30 / 86400, "days")):
        samples = np.ones((len(times), 8), np.float32)
        with pytest.raises(FileFormatError, match=unit):
            read_any(npz(tmp_path / "a.npz", samples=samples, timestamps_s=times, axis_distance_m=1.0))


@pytest.mark.parametrize(
    ("values", "units", "others"),
    [
        ({"angles_rad": np.arange(60) * 400 / 60}, "gon (times pi/200)", "degrees"),
        ({"angles_rad": np.arange(60) * 2000 * np.pi / 60}, "mrad", "degrees"),
        ({"angles_rad": np.arange(60) * 200.0}, "minutes of arc, steps", ""),
        ({"angles_rad": np.arange(60) * 6.0}, "degrees (numpy.deg2rad(angles))", "gon"),
        ({"range_step_m": 100 * RANGE_STEP_M}, "centimetres", "millimetres"),
        ({"range_step_m": 1000 * RANGE_STEP_M}, "millimetres", "centimetres"),
        ({"range_step_m": 61.0}, "picoseconds", "millimetres"),
        ({"center_frequency_hz": 3.95}, "GHz", "MHz"),
        ({"center_frequency_hz": 3950.0}, "MHz", "GHz"),
        ({"bandwidth_hz": 1.7}, "GHz", "MHz"),
    ],
)
def test_of_several_units_those_that_fit_are_named(
    tmp_path: Path, values: dict[str, Any], units: str, others: str
) -> None:
    angles = {"angles_rad": np.arange(60) * np.pi / 30, "axis_distance_m": 5.2}
    with pytest.raises(FileFormatError) as raised:
        read_any(npz(tmp_path / "a.npz", **{**angles, **values}))
    assert all(unit in raised.value.remedy for unit in units.split(", "))
    assert not others or others not in raised.value.remedy


def test_scans_in_another_order_are_sorted_by_their_times(tmp_path: Path) -> None:
    for order in (np.arange(60)[::-1], np.random.default_rng(1).permutation(60)):
        times = 1.7e9 + 0.5 * np.arange(60)[order]
        capture = read_any(npz(tmp_path / "a.npz", samples=SAMPLES[order], timestamps_s=times))
        np.testing.assert_array_equal(capture.samples, SAMPLES)
        assert any("sorted by timestamps_s" in remark for remark in intake_remarks(capture))


@pytest.fixture(scope="module")
def turn() -> Capture:
    acquisition = Acquisition(views=36, snr_db=20)
    return simulate_capture(scene_from_name("helmet-120"), acquisition, seed=3)[0]


def analytic(capture: Capture) -> np.ndarray:
    return np.asarray(hilbert(capture.samples.astype(np.float64), axis=1), np.complex64)


def kinds(capture: Capture) -> dict[str, tuple[np.ndarray, str, str]]:
    """Wrong samples: what the scans show, and the remedy."""
    signal = analytic(capture)
    carrier = np.exp(-4j * np.pi * CENTER_FREQUENCY_HZ * capture.ranges_m / SPEED_OF_LIGHT)
    magnitude = np.abs(signal)
    waveform = "store the waveform itself"
    return {
        "conjugate": (signal.conj(), "negative frequencies", "complex conjugate"),
        "baseband": (signal * carrier, "baseband", "multiply the samples"),
        "envelope": (magnitude, "magnitudes", waveform),
        "rectified": (np.abs(capture.samples), "magnitudes", waveform),
        "power": (magnitude**2, "magnitudes", waveform),
        "signed decibels": (20 * np.log10(magnitude + 1e-9), "low frequencies", waveform),
        "real part": ((signal * carrier).real, "low frequencies", waveform),
        "imaginary part": ((signal * carrier).imag, "low frequencies", waveform),
        "opposite phase": ((signal * carrier).conj(), "baseband", "conjugate first"),
        "decibels": (20 * np.log10(magnitude / magnitude.max() + 1e-9), "no sample is positive", waveform),
    }


def test_every_command_says_what_is_wrong_with_the_samples(turn: Capture) -> None:
    for kind, (samples, shown, remedy) in kinds(turn).items():
        dtype = np.complex64 if np.iscomplexobj(samples) else np.float32
        wrong = replace(turn, samples=samples.astype(dtype))
        assert any(shown in remark and remedy in remark for remark in intake_remarks(wrong)), kind
        with pytest.raises(DataError, match=shown) as raised:
            identify(load_capture(wrong), [*builtin_layouts().values()])
        assert remedy in raised.value.remedy.lower(), kind
        assert "larger reflector" not in raised.value.remedy, kind


def test_the_band_of_conjugate_samples_is_one_of_negative_frequencies(turn: Capture) -> None:
    """Not both ends of the sampled band, whose middle the assumed band is."""
    fault = sample_fault(replace(turn, samples=analytic(turn).conj()))
    edges = re.findall(r"(-?[\d.]+) GHz", fault.text.split("between")[1])
    assert -5 < float(edges[0]) < -3.95 < float(edges[1]) < -3


def test_valid_samples_have_no_fault(turn: Capture) -> None:
    counts = np.rint(turn.samples / np.abs(turn.samples).max() * 3000 + 32768).astype(np.float32)
    for samples in (turn.samples, analytic(turn), counts):
        assert sample_fault(replace(turn, samples=samples)) is None
    assert sample_fault(turn.select(slice(0, 1))) is None, "one view"


def test_too_few_bins_have_no_fault() -> None:
    for bins in (1, 2, 7):
        assert intake_remarks(Capture(np.ones((4, bins), np.float32), 0.1, RANGE_STEP_M)) == ()


@pytest.mark.parametrize("dtype", [np.float32, np.complex64])
def test_noise_has_no_fault(dtype: Any) -> None:
    for views in (1, 2, 3, 4, 8, 36, 200):
        rng = np.random.default_rng(views)
        for _ in range(10):
            noise = rng.standard_normal((2, views, 192))
            samples = (noise[0] + 1j * noise[1] if dtype is np.complex64 else noise[0]).astype(dtype)
            assert sample_fault(Capture(samples, 0.1, RANGE_STEP_M)) is None, views


def test_tags_are_read_in_their_band_alone(turn: Capture) -> None:
    """At 17 mm reading failed on a signature that nobody had enrolled."""
    scale = 17 / 75.9
    small = replace(
        turn,
        range_start_m=turn.range_start_m * scale,
        range_step_m=turn.range_step_m * scale,
        axis_distance_m=(turn.axis_distance_m or 1.0) * scale,
        center_frequency_hz=CENTER_FREQUENCY_HZ / scale,
        bandwidth_hz=turn.bandwidth_hz / scale,
    )
    with pytest.raises(DataError, match=r"2 to 8 GHz.* is 17 mm") as raised:
        identify(load_capture(small), [*builtin_layouts().values()])
    assert "tagid reconstruct" in raised.value.remedy
