"""Warnings of a geometry that does not fit the scans, and none of one that does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tests.unit.imaging_scenes import record, turn

NEAR_AXIS_M = [[0.05, 0.02], [-0.04, 0.03], [0.01, -0.05]]
SETTINGS = ImagingSettings("bp", extent_m=0.3, pixels=48, held_out=False, outside=False)
WARNINGS = ("does not close", "repeat those", "as alike as neighbours", "the axis seems to be")


def turned(
    views: int = 180,
    part: float = 1.0,
    factor: float = 1.0,
    noise: float = 0.05,
    *,
    axis_m: float = 1.0,
    height_m: float = 0.0,
) -> Capture:
    """A part of a turn of so many views, or more than one, whose angles are given times a factor, and axis
    and antenna at 1 m and in the object's plane."""
    aperture = turn(views, axis_m, height_m)
    kept = np.arange(round(part * views))
    capture = record(NEAR_AXIS_M, [1, 0.8, 0.9], aperture, start_m=0.55, noise=noise).select(kept % views)
    angles = kept * 2 * np.pi / views * factor
    return replace(capture, angles_rad=angles, axis_distance_m=1.0, antenna_height_m=0.0)


def said(capture: Capture, settings: ImagingSettings = SETTINGS) -> str:
    warnings = reconstruct(capture, settings).image.settings.get("warnings", ())
    return " ".join(text for text in warnings if any(words in text for words in WARNINGS))


@pytest.mark.parametrize(
    "right", [turned(), turned(360), turned(part=0.5), turned(part=0.9), turned(noise=3.0), turned(24)]
)
def test_nothing_is_said_of_a_right_geometry(right: Capture) -> None:
    """Whole turns, parts of turns, noise, and few views that do not resemble each other."""
    assert not said(right)


def test_angles_from_the_middle_of_a_turn_are_no_gap() -> None:
    part = turned(part=0.5)
    assert not said(replace(part, angles_rad=(part.angles_rad + 5.0) % (2 * np.pi)))


def test_half_a_turn_given_as_a_whole_one_does_not_close() -> None:
    words = said(turned(part=0.5, factor=2.0))
    assert "does not close" in words and "half of angles_rad" in words
    assert "does not close" in said(turned(part=0.5, factor=-2.0))


def test_two_turns_given_as_one_repeat() -> None:
    assert "twice the speed" in said(turned(part=2.0, factor=0.5))


def test_one_turn_of_an_object_that_is_nearly_alike_from_both_sides_is_none_of_two() -> None:
    pair = record([[0.1005, 0.0], [-0.0995, 0.0]], [1, 1], turn(120), start_m=0.55, noise=0.02)
    assert not said(replace(pair, axis_distance_m=1.0))


def test_a_whole_turn_given_as_half_of_one_has_ends_that_are_neighbours() -> None:
    assert "store angles_rad times 2, or" in said(turned(factor=0.5))


@pytest.mark.parametrize("true_m", [1.08, 0.92])
def test_an_axis_that_is_off_by_a_wavelength_is_named(true_m: float) -> None:
    words = said(turned(axis_m=true_m))
    assert f"seems to be {true_m:.2f}" in words and "focus_m=0.09" in words
    assert ("higher than given" in words) == (true_m > 1)
    assert not said(turned(axis_m=true_m), replace(SETTINGS, focus_m=0.0)), "the distance is known"


def test_an_antenna_higher_than_given_is_named() -> None:
    words = said(turned(height_m=0.5))
    assert "or the antenna 0.5 m higher" in words
