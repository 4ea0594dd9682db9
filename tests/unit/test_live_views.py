"""Angles, views and speed during the recording: directions, more than a turn, small corrections."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.geometry import ImageGrid
from tagid.live.angles import GrowingSpeed, _measured
from tagid.live.views import GrowingViews
from tagid.metadata import Track
from tagid.pipeline.settings import ImagingSettings
from tagid.radar.assembler import Scan
from tagid.radar.settings import RadarConfig
from tagid.recording.plan import RecordingPlan, plan_window
from tagid.recording.session import Session
from tagid.simulate.spec import SceneSpec, turning_scene
from tests.unit.imaging_scenes import record, turn

GRID = ImageGrid(0.4, 32)
IMAGING = ImagingSettings(extent_m=0.4)


def a_turn(views: int = 60) -> tuple[Capture, np.ndarray]:
    """Scans without angles, and their angles, rad."""
    capture = record([(0.08, 0.0), (-0.03, 0.05)], [1.0, 0.8], turn(views))
    angles = capture.angles_rad
    return replace(capture, angles_rad=None), angles


@pytest.mark.parametrize("direction", [1, -1])
def test_what_exceeds_a_turn_makes_no_view_in_either_direction(direction: int) -> None:
    plain, angles = a_turn()
    samples = np.concatenate([plain.samples, plain.samples[:15]])
    more = np.concatenate([angles, angles[:15] + 2 * np.pi])
    views = GrowingViews(GRID, (), IMAGING)
    views.update(replace(plain, samples=samples), direction * more)
    assert views.count == 60
    np.testing.assert_allclose(views.capture.angles_rad, direction * angles, atol=1e-9)


def test_a_correction_by_a_degree_forms_the_views_again() -> None:
    plain, angles = a_turn()
    views, exact = (GrowingViews(GRID, (), IMAGING) for _ in range(2))
    views.update(plain.select(slice(0, 30)), angles[:30] * (1 + np.radians(1) / angles[29]))
    assert views.count == 29 and views.image() is not None, "the last one is still open"
    for item in (views, exact):
        item.update(plain, angles)
    corrected, right = views.image(), exact.image()
    np.testing.assert_allclose(corrected.values, right.values, atol=1e-6 * np.abs(right.values).max())


def test_measured_angles_begin_at_the_first_scan_wherever_the_device_stands() -> None:
    times_s = 0.02 * np.arange(200)
    arrivals = 10**18 + (times_s * 1e9).astype(np.int64)
    track = Track(arrivals, 0.7 - 0.5 * times_s, np.full(200, 1e-3), {})
    some = range(50, 150)
    scans = [Scan(n, 20 * n, int(arrivals[n]), np.zeros(4, np.int32), 0, 1, 2) for n in some]
    angles = _measured(scans, track)
    np.testing.assert_allclose(angles, -0.5 * (times_s[50:150] - times_s[50]), atol=2e-3)


def test_a_period_is_believed_when_a_second_search_finds_it_again() -> None:
    config = plan_window(1.0, 0.5, 0.0, RadarConfig(base_integration_index=13))
    plan = RecordingPlan(config, 1.0)
    session = cast(Session, SimpleNamespace(plan=plan, config=config))
    source = turning_scene(SceneSpec("container-90", rpm=10))
    times_s = 0.05 * np.arange(200)
    scans = [
        Scan(n, round(1e3 * t), 0, source.scan(n, float(t), config), 0, 1, 2) for n, t in enumerate(times_s)
    ]
    speed = GrowingSpeed()
    assert speed.period_s(session, scans[:30]) is None, "too few"
    assert speed.period_s(session, scans[:160]) is None, "the first search"
    assert speed.period_s(session, scans[:161]) is None, "none is due"
    assert speed.period_s(session, scans) == pytest.approx(6.0, rel=0.01)
