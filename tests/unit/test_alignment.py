"""Captures that begin at different angles are referred to one pose, or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.errors import DataError
from tagid.pipeline.alignment import aligned, rotated
from tests.unit.imaging_scenes import record, turn

POINTS = np.array([[0.11, 0.0, 0.04], [-0.03, 0.07, -0.05], [-0.06, -0.09, 0.0]])


def capture(height: float, begin: float, points: np.ndarray = POINTS, seed: int = 0) -> Capture:
    """A turn whose stated angles are smaller than the true ones by `begin`, rad."""
    recorded = record(points, np.ones(len(points)), turn(36, 1.0, height), start_m=0.5, noise=0.1, seed=seed)
    return replace(recorded, angles_rad=recorded.angles_rad - begin)


@pytest.mark.parametrize("begin", [0.0, 1.0, -2.5])
def test_each_capture_is_rotated_to_the_first(begin: float) -> None:
    parts = [capture(0.0, 0.0), capture(0.1, begin, seed=1), capture(0.2, 2 * begin, seed=2)]
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
    parts = [capture(0.15, 0.0, triangle), capture(0.3, 2.4, triangle, 1), capture(0.45, 0.7, triangle, 2)]
    _, alignment = aligned(parts)
    for first, begin in zip(alignment, (0.0, 2.4, 0.7), strict=True):
        assert abs(np.angle(np.exp(1j * (first.rotation_rad - begin)))) < np.deg2rad(1)


def test_captures_that_show_nothing_in_common_are_refused() -> None:
    empty = capture(0.1, 0.0, np.array([[5.0, 5.0, 0.0]]), 3)
    with pytest.raises(DataError, match="rotation of capture 2"):
        aligned([capture(0.0, 0.0), empty])
    free = replace(capture(0.1, 0.0), angles_rad=None, antenna_positions_m=turn(36).positions)
    with pytest.raises(DataError, match="capture 2 has antenna positions"):
        aligned([capture(0.0, 0.0), free])
    with pytest.raises(DataError):
        rotated(free, 1.0)
