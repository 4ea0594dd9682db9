"""Whether a whole turn closes: told where views are dense, never of a right turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tests.unit.imaging_scenes import record, turn

POINTS = [[0.05, 0.02], [-0.04, 0.03], [0.01, -0.05]]
SETTINGS = ImagingSettings("bp", extent_m=0.3, pixels=48, focus_m=0.0, held_out=False)


def turned(views: int = 180, part: float = 1.0, factor: float = 1.0, noise: float = 0.05) -> Capture:
    """A part of a turn of so many views, whose angles are given times a factor."""
    kept = slice(0, round(part * views))
    aperture = turn(views)
    assert aperture.angles is not None
    capture = record(POINTS, [1, 0.8, 0.9], aperture, noise=noise).select(kept)
    return replace(capture, angles_rad=aperture.angles[kept] * factor, axis_distance_m=1.0)


def said(capture: Capture) -> str:
    warnings = reconstruct(capture, SETTINGS).image.settings.get("warnings", ())
    return " ".join(words for words in warnings if "does not close" in words)


@pytest.mark.parametrize(
    "right", [turned(), turned(360), turned(part=0.5), turned(part=0.9), turned(noise=3.0), turned(24)]
)
def test_nothing_is_said_of_right_angles(right: Capture) -> None:
    """Whole turns, parts of turns, noise, and few views that do not resemble each other."""
    assert not said(right)


def test_angles_from_the_middle_of_a_turn_are_no_gap() -> None:
    part = turned(part=0.5)
    assert part.angles_rad is not None
    assert not said(replace(part, angles_rad=(part.angles_rad + 5.0) % (2 * np.pi)))


def test_half_a_turn_given_as_a_whole_one_does_not_close() -> None:
    words = said(turned(part=0.5, factor=2.0))
    assert "does not close" in words and "half of angles_rad" in words
    assert "does not close" in said(turned(part=0.5, factor=-2.0))
