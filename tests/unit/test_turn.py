"""Symmetric tags on a table whose speed nobody told: the image decides what a turn is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.pipeline.turn import resolve_turn
from tagid.simulate import Acquisition, scene_from_name, simulate_capture


def recording(name: str, turns: float, seed: int, axis_error: float = 0.0):
    acquisition = Acquisition(views=200, turns=turns, snr_db=10, axis_distance_error_m=axis_error)
    capture, _ = simulate_capture(scene_from_name(name, seed), acquisition, seed)
    return replace(capture, angles_rad=None, angle_sigma_rad=None)


@pytest.mark.parametrize(
    ("name", "repetitions"),
    [("container-90", 1), ("container-180", 2), ("helmet-linear", 2), ("helmet-120", 3)],
)
@pytest.mark.parametrize("axis_error", [0.0, 0.015])
def test_the_turn_is_found_without_a_speed(name: str, repetitions: int, axis_error: float) -> None:
    found = resolve_turn(recording(name, 1.3, 5, axis_error))
    resolved = found.motion.resolved
    assert resolved.repetitions_a_turn == repetitions
    assert resolved.period_s == pytest.approx(30.0, rel=0.01)
    assert found.angles_rad is not None
    assert np.ptp(found.angles_rad) == pytest.approx(1.3 * 2 * np.pi, rel=0.02)


def test_a_speed_that_is_given_is_not_doubted() -> None:
    found = resolve_turn(recording("helmet-120", 1.3, 5), "free?rpm=2")
    assert found.motion.resolved.repetitions_a_turn is None
    assert found.motion.resolved.period_s == pytest.approx(30.0, rel=0.01)


def test_angles_that_are_there_stay() -> None:
    capture, _ = simulate_capture(scene_from_name("container-90", 1), Acquisition(views=36), 1)
    assert resolve_turn(capture) is capture


@pytest.mark.parametrize(
    ("name", "axis_error"), [("container-90", 0.1), ("helmet-120", -0.1), ("helmet-linear", 0.1)]
)
def test_a_wrong_axis_distance_does_not_contradict_the_right_speed(name: str, axis_error: float) -> None:
    found = resolve_turn(recording(name, 1.34, 5, axis_error), "free?rpm=2")
    assert found.motion.resolved.measured_rpm is None


@pytest.mark.parametrize("axis_error", [0.0, 0.015])
def test_a_wrong_speed_is_contradicted(axis_error: float) -> None:
    found = resolve_turn(recording("container-90", 1.34, 5, axis_error), "free?rpm=3")
    assert found.motion.resolved.measured_rpm == pytest.approx(2.0, rel=0.01)
