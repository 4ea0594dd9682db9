"""Which geometry a loaded capture has, how many views of it the image needs, and captures that begin at
different angles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.errors import DataError
from tagid.imaging.lengths import views_needed
from tagid.metadata import MotionInfo
from tagid.pipeline.alignment import aligned, rotated
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


def test_free_positions_are_thinned_to_the_most_views_over_the_whole_path() -> None:
    turned = capture()
    free = replace(turned, angles_rad=None, antenna_positions_m=turned.aperture().positions)
    for most in (36, 35, 20, 12, 7):
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


POINTS = np.array([[0.11, 0.0, 0.04], [-0.03, 0.07, -0.05], [-0.06, -0.09, 0.0]])


def upright(height: float, begin: float, points: np.ndarray = POINTS, seed: int = 0) -> Capture:
    """A turn whose stated angles are smaller than the true ones by `begin`, rad."""
    recorded = record(points, np.ones(len(points)), turn(36, 1.0, height), start_m=0.5, noise=0.1, seed=seed)
    return replace(recorded, angles_rad=recorded.angles_rad - begin)


@pytest.mark.parametrize("begin", [0.0, 1.0, -2.5])
def test_each_capture_is_rotated_to_the_first(begin: float) -> None:
    parts = [upright(0.0, 0.0), upright(0.1, begin, seed=1), upright(0.2, 2 * begin, seed=2)]
    done, alignment = aligned(parts)
    for number, (item, turn_found) in enumerate(zip(done, alignment, strict=True)):
        error = np.angle(np.exp(1j * (turn_found.rotation_rad - number * begin)))
        assert np.rad2deg(abs(error)) < 0.15, "a third of the step between the angles of an image"
        difference = np.exp(1j * (item.angles_rad - turn(36).angles))
        assert abs(np.angle(difference)).max() < np.deg2rad(0.5)


def test_a_tag_that_is_symmetric_only_from_above_is_turned_to_its_own_heights() -> None:
    """Three reflectors at the corners of a triangle: three rotations look alike in the plane."""
    angle = np.arange(3) * 2 * np.pi / 3
    triangle = np.column_stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), [0.06, -0.06, 0.03]])
    parts = [upright(0.15, 0.0, triangle), upright(0.3, 2.4, triangle, 1), upright(0.45, 0.7, triangle, 2)]
    _, alignment = aligned(parts)
    for first, begin in zip(alignment, (0.0, 2.4, 0.7), strict=True):
        assert abs(np.angle(np.exp(1j * (first.rotation_rad - begin)))) < np.deg2rad(1)


def test_captures_that_show_nothing_in_common_are_refused() -> None:
    empty = upright(0.1, 0.0, np.array([[5.0, 5.0, 0.0]]), 3)
    with pytest.raises(DataError, match="rotation of capture 2"):
        aligned([upright(0.0, 0.0), empty])
    free = replace(upright(0.1, 0.0), angles_rad=None, antenna_positions_m=turn(36).positions)
    with pytest.raises(DataError, match="capture 2 has antenna positions"):
        aligned([upright(0.0, 0.0), free])
    with pytest.raises(DataError):
        rotated(free, 1.0)
