"""Slip that both wheels share: no encoder sees it; the sigma must allow for it, or the radar close it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tagid.angles.align import measured_angles
from tagid.angles.clock import fit_clock
from tagid.motion.calibration import Calibration, remember
from tagid.motion.device import Track
from tagid.motion.emulation.body import Body, BodySettings
from tagid.motion.roomba.device import SPEED_STEP_MM_S, Roomba
from tagid.motion.roomba.odometry import SpinOdometry
from tagid.motion.urls import open_motion
from tests.unit.test_motion_align import EPOCH_NS, scans_over

STEP_S = 0.024


def spun(slip: float, turns: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True angles, the odometry's and its sigmas of a robot that slips on the floor."""
    body = Body(BodySettings(slip=slip, seed=1))
    odometry = SpinOdometry(1)
    speed = 3 * SPEED_STEP_MM_S
    body.drive(speed, -speed)
    rows = []
    time_s = 0.0
    while body.heading_rad < turns * 2 * np.pi:
        body.advance(time_s)
        rows.append((body.heading_rad, odometry.add(*body.encoders()), odometry.sigma_rad))
        time_s += STEP_S
    true, reported, sigma = np.array(rows).T
    return true, reported, sigma


def robot_at(port: str) -> Roomba:
    motion = open_motion(f"roomba+serial://{port}?step=3")
    assert isinstance(motion, Roomba)
    return motion


@pytest.mark.parametrize("calibrated", [False, True])
@pytest.mark.parametrize("turns", [0.15, 1.0, 1.2])
def test_the_stated_sigma_holds_with_five_per_cent_of_slip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calibrated: bool, turns: float
) -> None:
    """A calibrated wheel base does not know today's floor."""
    monkeypatch.setenv("TAGID_DATA", str(tmp_path))
    if calibrated:
        remember("/dev/robot", Calibration(235.0, 0.002, 2.3))
    robot = robot_at("/dev/robot")
    true, reported, sigma = spun(0.05, turns)
    stated = np.hypot(sigma, robot.scale_sigma * reported)
    error = np.abs(reported - true)[1:]
    assert error[-1] > np.radians(2.5), "there is something to state"
    assert (error < 3 * stated[1:] + 1e-3).all()
    assert error[-1] > 0.3 * stated[-1], "and it is not stated so widely that it says nothing"


def test_a_full_turn_is_closed_by_the_radar_also_for_a_calibrated_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TAGID_DATA", str(tmp_path))
    remember("/dev/robot", Calibration(235.0, 0.002, 2.3))
    robot = robot_at("/dev/robot")
    true, reported, sigma = spun(0.05, robot.turns)
    times = STEP_S * np.arange(len(true))
    arrivals = EPOCH_NS + (times * 1e9).astype(np.int64)
    info = {"scale_sigma": robot.scale_sigma, "step_s": STEP_S}
    track = Track(arrivals, reported, sigma, info)
    angles = measured_angles(scans_over(true), fit_clock(np.floor(times * 1e3)), arrivals, track)
    assert angles.info.checked_by_radar
    assert angles.info.scale == pytest.approx(0.95, rel=3e-3)
    error = np.abs(angles.angles_rad - (true - true[0]))
    assert error.max() < np.radians(1.5) and (error < 4 * angles.sigma_rad + np.radians(0.2)).all()
