"""Which geometry a loaded capture has, and how many views of it the image needs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.imaging.lengths import views_needed
from tagid.metadata import MotionInfo
from tagid.pipeline.prepared import LoadDefault, LoadSettings, load_capture, prepare
from tagid.pipeline.resolve import clock_of, one_turn
from tests.unit.imaging_scenes import record, turn


def capture(views: int = 36, **changes: object) -> Capture:
    return replace(record([(0.05, 0.0)], [1.0], turn(views)), **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("explicit", "configured", "given", "used"),
    [(1.0, 1.5, False, 1.0), (1.0, 1.5, True, 1.5), (1.0, None, False, 1.0), (None, 1.5, False, 1.5)],
)
def test_the_axis_distance_of_the_recording_yields_only_to_the_command_line(
    explicit: float | None, configured: float | None, given: bool, used: float
) -> None:
    settings = LoadSettings(axis_distance_m=LoadDefault(configured, given))
    assert load_capture(capture(axis_distance_m=explicit), settings, turn=False).axis_distance_m == used


@pytest.mark.parametrize(("given", "used"), [(False, 0.2), (True, 0.7)])
def test_so_do_the_height_and_the_separation_of_the_antennas(given: bool, used: float) -> None:
    configured = LoadDefault(0.7, given)
    settings = LoadSettings(antenna_height_m=configured, antenna_separation_m=configured)
    loaded = load_capture(capture(antenna_height_m=0.2, antenna_separation_m=0.2), settings, turn=False)
    assert (loaded.antenna_height_m, loaded.antenna_separation_m) == (used, used)


def test_dense_scans_become_the_views_that_the_image_needs_and_lose_noise() -> None:
    dense = capture(1500)
    noise = np.random.default_rng(1).standard_normal(dense.samples.shape).astype(np.float32)
    needed = views_needed(0.2, dense.wavelength_m)
    assert needed < 500
    alone = prepare(replace(dense, samples=noise), extent_m=0.2)
    assert alone.views == needed
    assert np.std(alone.samples) == pytest.approx(np.sqrt(needed / 1500), rel=0.02)
    # Errors of the angles are common to neighbouring scans.
    unsure = prepare(replace(dense, angle_sigma_rad=np.full(1500, 0.01)), extent_m=0.2)
    np.testing.assert_allclose(unsure.angle_sigma_rad, 0.01)


@pytest.mark.parametrize("most", [36, 35, 20, 12, 7])
def test_free_positions_are_thinned_to_the_most_views_over_the_whole_path(most: int) -> None:
    turned = capture()
    free = replace(turned, angles_rad=None, antenna_positions_m=turned.aperture().positions)
    some = one_turn(free, most)
    assert most / 2 < some.views <= most
    whole, kept = (np.ptp(item.aperture().positions, axis=0)[:2] for item in (free, some))
    np.testing.assert_allclose(kept, whole, atol=0.5)


def test_arrival_times_are_seconds_where_the_radar_gives_none() -> None:
    times_s = 0.02 * np.arange(50)
    clock = clock_of(capture(50, angles_rad=None, host_time_ns=10**18 + (times_s * 1e9).astype(np.int64)))
    np.testing.assert_allclose(clock.times_s, times_s, atol=1e-4)


def test_a_file_from_elsewhere_keeps_what_it_says_of_its_turn_and_place() -> None:
    """A station of its own table, started with its speed and distance, read every file with them."""
    speed = LoadDefault("free?rpm=6", True)
    ours = LoadSettings(axis_distance_m=LoadDefault(1.5, True), motion=speed, motion_is_default=False)
    angles = np.arange(12) * np.pi / 6
    turned = Capture(np.ones((12, 8), np.float32), 0.5, 0.009, angles_rad=angles, axis_distance_m=1.0)
    unturned = replace(turned, angles_rad=None, motion=MotionInfo(url="free?rpm=9"))
    assert [ours.motion_for(capture) for capture in (turned, unturned)] == ["free?rpm=6"] * 2
    assert [ours.yielding.motion_for(capture) for capture in (turned, unturned)] == [None, "free?rpm=9"]
    assert load_capture(turned, ours, turn=False).axis_distance_m == 1.5
    assert load_capture(turned, ours.yielding, turn=False).axis_distance_m == 1.0
