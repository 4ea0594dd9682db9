"""Scans about another axis: what is the same in every view is left out, reflectors stay where they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.pipeline.diagnosis import named_in, recentred
from tagid.pipeline.prepared import PreparedCapture, load_capture
from tagid.pipeline.settings import ImagingSettings
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.tags.layouts.layout import builtin_layouts

START_M, STEP_M, DISTANCE_M, VIEWS = 0.5, 0.009, 1.0, 36
ANGLES = 2 * np.pi * np.arange(VIEWS) / VIEWS
CENTRE = (0.03, -0.02)
LAYOUTS = list(builtin_layouts().values())


def antennas() -> NDArray[np.complex128]:
    """x + jy in the turntable's frame, m."""
    return np.asarray(DISTANCE_M * np.exp(-1j * ANGLES))


def echo(ranges_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(VIEWS, 110) scans of one echo at these ranges: 3.9 GHz, 1 GHz wide."""
    away = START_M + STEP_M * np.arange(110) - ranges_m[:, None]
    return np.asarray(np.exp(-((away / 0.08) ** 2)) * np.cos(2 * np.pi * away / 0.0385))


def scans(samples: NDArray[np.float64]) -> Capture:
    return Capture(samples.astype(np.float32), START_M, STEP_M, ANGLES, axis_distance_m=DISTANCE_M)


def test_the_room_and_a_round_body_about_the_new_axis_are_left_out() -> None:
    room = echo(np.full(VIEWS, 1.03))
    body = echo(np.abs(antennas() - complex(*CENTRE)) - 0.035)
    remaining = recentred(scans(5 * room + body), CENTRE).samples
    assert (remaining**2).sum() < 1e-3 * (body**2).sum()
    whole = np.rint(1e4 * (5 * room + body)).astype(np.int32)
    counts = recentred(Capture(whole, START_M, STEP_M, ANGLES, axis_distance_m=DISTANCE_M), CENTRE).samples
    assert counts.dtype == np.float32 and np.allclose(1e-4 * counts, remaining, atol=2e-4)
    # About another point the body moves, and stays.
    other = recentred(scans(5 * room + body), (-0.03, 0.02)).samples
    assert (other**2).sum() > 0.5 * (body**2).sum()


def test_a_reflector_keeps_its_place_about_the_new_axis() -> None:
    place = complex(0.01, 0.05)
    moved = recentred(scans(echo(np.abs(antennas() - place))), CENTRE)
    assert moved.angles_rad is not None
    seen = DISTANCE_M * np.exp(-1j * moved.angles_rad)
    expected = echo(np.abs(seen - (place - complex(*CENTRE))))
    alike = (moved.samples * expected).sum(axis=1)
    sizes = np.linalg.norm(moved.samples, axis=1) * np.linalg.norm(expected, axis=1)
    assert np.median(alike / sizes) > 0.95


def test_an_object_is_named_elsewhere_with_the_settings_of_the_answer() -> None:
    capture, _ = simulate_capture(
        scene_from_name("helmet-120", 3), Acquisition(views=24, snr_db=20.0), seed=3
    )
    right = load_capture(capture)
    assert right.axis_distance_m is not None
    wrong, away = (replace(right, axis_distance_m=right.axis_distance_m + error_m) for error_m in (0.07, 9.0))
    prepared = PreparedCapture(wrong)
    result = named_in(prepared, right, LAYOUTS)
    assert result is not None and result.layout == "helmet-120" and abs(result.offset_m) < 3e-3
    # Where the scans do not hold the object's range, it is not there.
    assert named_in(prepared, away, LAYOUTS) is None
    strict = PreparedCapture(wrong, ImagingSettings(false_accept=1e-6))
    assert named_in(strict, right, LAYOUTS) is None
