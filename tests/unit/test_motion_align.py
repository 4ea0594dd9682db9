"""Two clocks on one axis, angles at the scans, the radar's own turn, what a robot remembers, and its slip."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tagid.angles.align import align, even_times, lower_edge, measured_angles, turn_in_own_angle
from tagid.angles.clock import fit_clock
from tagid.angles.period import find_period
from tagid.errors import ConfigError, DataError
from tagid.metadata import ResolvedMotion, Track
from tagid.motion.calibration import Calibration, recall, remember, wheel_base_from
from tagid.motion.emulation.body import Body, BodySettings
from tagid.motion.roomba.device import SPEED_STEP_MM_S, Roomba
from tagid.motion.roomba.odometry import SpinOdometry
from tagid.motion.urls import open_motion
from tagid.radar.settings import RadarConfig
from tagid.simulate import Acquisition, TurningScene, scene_from_name
from tagid.simulate.scene import Scene

EPOCH_NS = 1_750_000_000_000_000_000
SPEED = np.radians(41.7)
CONFIG = RadarConfig(scan_start_ps=3_336, scan_stop_ps=10_006)


def arrivals_of(times: np.ndarray) -> np.ndarray:
    """Times in s of the host's clock, in ns."""
    return EPOCH_NS + (times * 1e9).astype(np.int64)


def track_of(times: np.ndarray, angles: np.ndarray, sigma_rad: object = 1e-3, **info: object) -> Track:
    """Readings that arrived at these times, in s."""
    return Track(arrivals_of(times), angles, np.broadcast_to(sigma_rad, angles.shape), info)


def late(times: np.ndarray, rng: np.random.Generator, mean_s: float) -> np.ndarray:
    """When what was sent at these times arrives, in s."""
    return times + rng.exponential(mean_s, len(times))


def test_the_lower_edge_is_the_true_clock() -> None:
    rng = np.random.default_rng(1)
    times = np.arange(0, 20, 0.02)
    offset, slope = lower_edge(times, 3.0 + (1 + 50e-6) * times + rng.exponential(0.02, len(times)))
    assert slope - 1 == pytest.approx(50e-6, abs=30e-6)
    assert offset == pytest.approx(3.0, abs=1e-3)


def test_late_readings_move_back_to_their_place() -> None:
    rng = np.random.default_rng(2)
    taken = np.arange(0, 10, 0.015)
    arrivals = np.maximum.accumulate(taken + rng.exponential(0.02, len(taken)))
    result = even_times(arrivals, 0.015)
    assert np.std(result - taken) < 1e-3
    assert np.std(arrivals - taken) > 5e-3


@pytest.mark.parametrize("direction", [1, -1])
def test_angles_are_those_of_the_scans_moments(direction: int) -> None:
    rng = np.random.default_rng(3)
    scans, frames = np.arange(0, 12, 0.0216), np.arange(-0.5, 13, 0.015)

    def angle(times: np.ndarray) -> np.ndarray:
        return direction * SPEED * np.maximum(times - 0.4, 0)

    track = track_of(late(frames, rng, 0.012), angle(frames), step_s=0.015, kind="test")
    clock = fit_clock(np.floor(scans * (1 + 80e-6) * 1e3))
    result = align(clock, arrivals_of(late(scans, rng, 0.004)), track)
    error = np.degrees(result.angles_rad - angle(scans))
    assert np.abs(error - np.median(error)).max() < 0.15
    assert np.abs(np.median(error)) < 0.1
    assert result.drift == pytest.approx(-80e-6, abs=60e-6)
    assert 1 < result.radar_residual_ms < 12 and 5 < result.motion_residual_ms < 30
    assert np.all(result.sigma_rad < np.radians(2)) and result.outside == 0


def test_angles_beyond_the_last_reading_say_that_they_are_guesses() -> None:
    scans, frames = np.arange(0, 10, 0.02), np.arange(0, 5, 0.015)
    clock, arrivals = fit_clock(np.floor(scans * 1e3)), arrivals_of(scans)
    result = align(clock, arrivals, track_of(frames, SPEED * frames, step_s=0.015))
    assert result.sigma_rad[-1] == pytest.approx(SPEED * 5, rel=0.02)
    assert result.outside == pytest.approx(245, abs=2)
    # A table that turns by itself did not stop there.
    runs_on = track_of(frames, SPEED * frames, runs_on=True)
    assert align(clock, arrivals, runs_on).angles_rad[-1] == pytest.approx(SPEED * scans[-1], rel=1e-3)
    with pytest.raises(DataError):
        align(clock, arrivals, Track.of([], {}))


def scans_over(angles: np.ndarray, snr_db: float = 20.0) -> np.ndarray:
    """Scans of the helmet at these angles."""
    acquisition, helmet = Acquisition(snr_db=snr_db), scene_from_name("helmet-120", 1)
    scene = TurningScene(helmet, 0, 1, acquisition, true_angle=lambda i: angles[round(i)])
    scene.follow(lambda moment: moment)
    return np.stack([scene.scan(i, float(i), CONFIG) for i in range(len(angles))])


def test_the_radar_sees_how_far_a_turn_is_whatever_the_speed_does() -> None:
    """The device overstates its angle by 7 % and swings its speed by 30 %; its direction is clockwise."""
    turns = np.linspace(0, 2 * np.pi * 1.4, 500)
    true = -(turns + 0.3 * np.sin(turns))
    result = turn_in_own_angle(scans_over(true), 1.07 * true, 0.06)
    assert result.period_s == pytest.approx(1.07 * 2 * np.pi, rel=2e-3)


def test_a_scan_scales_its_own_angles() -> None:
    times = np.arange(0, 12, 0.024)
    true = SPEED * times
    info = {"scale_sigma": 0.06, "step_s": 0.024, "robot": "r", "wheel_base_mm": 235.0}
    track, clock = track_of(times, 0.92 * true, 0.0, **info), fit_clock(np.floor(times * 1e3))
    angles = measured_angles(scans_over(true), clock, arrivals_of(times), track)
    assert np.abs(angles.angles_rad - true).max() < np.radians(1.5)
    assert angles.info.checked_by_radar and angles.info.quality > 0.8
    robot, result = wheel_base_from(angles.info)
    # The robot thinks that it turned less than it did: its wheels are nearer together than it thinks.
    assert (robot, result.wheel_base_mm) == ("r", pytest.approx(0.92 * 235, rel=2e-3))


def test_a_marker_breaks_a_symmetry() -> None:
    """Two equal reflectors repeat after half a turn; a third one off the axis, 9 dB weaker, does not."""
    positions = np.array([[0.1, 0.0], [-0.1, 0.0], [0.0, 0.15]])
    times = np.arange(0, 2.5, 1 / 200) * 20
    scene = Scene.of_points(positions, np.array([1.0, 1.0, 0.35]))
    turning = TurningScene(scene, 3.0, 1, Acquisition(snr_db=20))
    samples = np.stack([turning.scan(i, float(moment), CONFIG) for i, moment in enumerate(times)])
    assert find_period(samples, times).period_s == pytest.approx(10, rel=5e-3)
    assert find_period(samples, times, marker=True).period_s == pytest.approx(20, rel=5e-3)


def test_a_robot_is_remembered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TAGID_DATA", str(tmp_path))
    assert recall("/dev/x") is None
    remember("/dev/x", Calibration(250.0, 0.002, 2.0))
    remember("other", Calibration(240.0, 0.003, 2.0))
    known = recall("/dev/x")
    assert known is not None and known.wheel_base_mm == 250.0 and known.date_utc
    (tmp_path / "robots.toml").write_text("nonsense =")
    with pytest.raises(ConfigError, match="damaged"):
        recall("/dev/x")
    with pytest.raises(DataError, match="did not see"):
        wheel_base_from(ResolvedMotion(checked_by_radar=False, reason="no period"))


STEP_S = 0.024


def spun(turns: float) -> np.ndarray:
    """True angles, the odometry's and its sigmas (3, steps) of a robot that slips on the floor by 5 %."""
    body, odometry = Body(BodySettings(slip=0.05, seed=1)), SpinOdometry(1)
    body.drive(3 * SPEED_STEP_MM_S, -3 * SPEED_STEP_MM_S)
    rows, time_s = [], 0.0
    while body.heading_rad < turns * 2 * np.pi:
        body.advance(time_s)
        rows.append((body.heading_rad, odometry.add(*body.encoders()), odometry.sigma_rad))
        time_s += STEP_S
    return np.array(rows).T


@pytest.fixture(params=[False, True], ids=["new", "calibrated"])
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Roomba:
    """A calibrated wheel base does not know today's floor."""
    monkeypatch.setenv("TAGID_DATA", str(tmp_path))
    if request.param:
        remember("/dev/robot", Calibration(235.0, 0.002, 2.3))
    motion = open_motion("roomba+serial:///dev/robot?step=3")
    assert isinstance(motion, Roomba)
    return motion


@pytest.mark.parametrize("turns", [0.15, 1.0, 1.2])
def test_the_stated_sigma_holds_with_five_per_cent_of_slip(robot: Roomba, turns: float) -> None:
    true, reported, sigma = spun(turns)
    stated = np.hypot(sigma, robot.scale_sigma * reported)
    error = np.abs(reported - true)[1:]
    assert error[-1] > np.radians(2.5), "there is something to state"
    assert (error < 3 * stated[1:] + 1e-3).all()
    assert error[-1] > 0.3 * stated[-1], "and it is not stated so widely that it says nothing"


@pytest.mark.parametrize("robot", [True], indirect=True)
def test_a_full_turn_is_closed_by_the_radar_also_for_a_calibrated_robot(robot: Roomba) -> None:
    true, reported, sigma = spun(robot.turns)
    times = STEP_S * np.arange(len(true))
    track = track_of(times, reported, sigma, scale_sigma=robot.scale_sigma, step_s=STEP_S)
    clock = fit_clock(np.floor(times * 1e3))
    angles = measured_angles(scans_over(true), clock, arrivals_of(times), track)
    assert angles.info.checked_by_radar
    assert angles.info.scale == pytest.approx(0.95, rel=3e-3)
    error = np.abs(angles.angles_rad - (true - true[0]))
    assert error.max() < np.radians(1.5) and (error < 4 * angles.sigma_rad + np.radians(0.2)).all()
