"""Periods and angles of single recordings against the motion that they were made with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.angles.align import align
from tagid.angles.clock import fit_clock
from tagid.angles.period import kinematic_period
from tagid.angles.sinogram import uniform_grid
from tagid.angles.views import average_into_views
from tagid.metadata import Track
from tests.unit.imaging_scenes import record, turn


@pytest.mark.parametrize("radius_m", [0.03, 0.05, 0.1])
def test_range_and_range_rate_of_a_reflector_tell_the_period_at_any_radius(radius_m: float) -> None:
    """Also where the circle is smaller than the pulse is long."""
    capture = record([(radius_m, 0.0)], [1.0], turn(200))
    moving = (capture.samples - capture.samples.mean(axis=0)).astype(np.float32)
    assert kinematic_period(moving, np.ones(200, dtype=bool), 0.05) == pytest.approx(10.0, rel=0.1)


def test_the_step_of_scans_stamped_in_whole_milliseconds_is_that_of_the_recording() -> None:
    stamps_s = np.floor(21.573 * np.arange(400)) * 1e-3
    _, received, step_s = uniform_grid(np.ones((400, 8), np.float32), stamps_s)
    assert received.sum() >= 390
    assert step_s * (len(received) - 1) == pytest.approx(stamps_s[-1] - stamps_s[0])


def test_a_free_table_is_continued_at_the_speed_that_it_had_at_each_end() -> None:
    """It slows down: 40 degrees a second before the first reading, 20 after the last."""

    def angle(times_s: np.ndarray) -> np.ndarray:
        slowing = np.clip(times_s, 2.0, 8.0) - 2.0
        rate = np.radians(40) - np.radians(20) / 6 * slowing
        before, after = np.minimum(times_s - 2.0, 0.0), np.maximum(times_s - 8.0, 0.0)
        return (np.radians(40) + rate) / 2 * slowing + before * np.radians(40) + after * np.radians(20)

    times_s, read_s = np.arange(0, 10, 0.02), np.arange(2.0, 8.01, 0.1)
    arrivals = 10**18 + (times_s * 1e9).astype(np.int64)
    moments = 10**18 + (read_s * 1e9).astype(np.int64)
    track = Track(moments, angle(read_s), np.full(len(read_s), 1e-3), {"runs_on": True})
    result = align(fit_clock(1e3 * times_s), arrivals, track)
    np.testing.assert_allclose(result.angles_rad, angle(times_s), atol=np.radians(1.0))


def test_a_view_is_seen_from_the_mean_angle_of_its_scans() -> None:
    """Not from the middle of its sector, which its scans need not fill."""
    angles = np.array([0.0, 0.10, 0.12, 0.14, 0.16])
    capture = replace(record([(0.05, 0.0)], [1.0], turn(5)), angles_rad=angles + 0.3)
    views = average_into_views(capture, 36)
    np.testing.assert_allclose(views.angles_rad, [0.3, 0.43])
    np.testing.assert_allclose(views.samples[1], capture.samples[1:].mean(axis=0), rtol=1e-5, atol=1e-6)
