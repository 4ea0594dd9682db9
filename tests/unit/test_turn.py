"""Symmetric tags on a table whose speed nobody told: the image decides what a turn is."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.metadata import ResolvedMotion
from tagid.operate.words import turn_line
from tagid.pipeline.diagnosis import _of_the_turn
from tagid.pipeline.resolve import speed_contradiction
from tagid.pipeline.turn import resolve_turn
from tagid.simulate import (
    Acquisition,
    ReflectorSpec,
    Scene,
    parse_body,
    scene_from_name,
    scene_on_body,
    simulate_capture,
)
from tagid.simulate.acquisition import Wobble
from tagid.tags.layouts.design import DesignRules, design
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.layouts.objects import object_named


def without_angles(scene: Scene, seed: int, **acquisition: Any) -> Capture:
    capture, _ = simulate_capture(scene, Acquisition(views=200, **acquisition), seed)
    return replace(capture, angles_rad=None, angle_sigma_rad=None)


def recording(name: str, turns: float, seed: int, axis_error: float = 0.0) -> Capture:
    scene = scene_from_name(name, seed)
    return without_angles(scene, seed, turns=turns, snr_db=10, axis_distance_error_m=axis_error)


@pytest.mark.parametrize(
    ("name", "repetitions"),
    [("container-90", 1), ("container-180", 2), ("helmet-linear", 2), ("helmet-120", 3)],
)
def test_the_turn_is_found_without_a_speed(name: str, repetitions: int) -> None:
    result = resolve_turn(recording(name, 1.3, 5, axis_error=0.015))
    resolved = result.motion.resolved
    assert resolved.repetitions_a_turn == repetitions
    assert resolved.period_s == pytest.approx(30.0, rel=0.01)
    assert np.ptp(result.angles_rad) == pytest.approx(1.3 * 2 * np.pi, rel=0.02)


def test_angles_that_are_there_stay() -> None:
    capture, _ = simulate_capture(scene_from_name("container-90", 1), Acquisition(views=36), 1)
    assert resolve_turn(capture) is capture


@pytest.mark.parametrize(
    ("name", "axis_error"),
    [("container-90", 0.1), ("helmet-120", -0.1), ("helmet-120", 0.0), ("helmet-linear", 0.1)],
)
def test_the_right_speed_is_not_doubted_at_a_wrong_axis_distance(name: str, axis_error: float) -> None:
    resolved = resolve_turn(recording(name, 1.34, 5, axis_error), "free?rpm=2").motion.resolved
    assert (resolved.measured_rpm, resolved.repetitions_a_turn) == (None, None)
    assert resolved.period_s == pytest.approx(30.0, rel=0.01)


def test_a_wrong_speed_is_contradicted() -> None:
    result = resolve_turn(recording("container-90", 1.34, 5, axis_error=0.015), "free?rpm=3")
    assert result.motion.resolved.measured_rpm == pytest.approx(2.0, rel=0.01)


@cache
def layouts() -> dict[str, Layout]:
    family = design(object_named("mug").with_rows(1), DesignRules(3, 12, 0.04), 4, "mug").layouts
    return builtin_layouts() | {layout.name: layout for layout in family}


def _mug(turns: float, layout: str, seed: int, body: str = "none", **more: Any) -> Capture:
    reflector = ReflectorSpec("octahedron", 0.04)
    scene = scene_on_body(layout, parse_body(body), reflector, seed, layouts=layouts())
    return without_angles(scene, seed, **{"turns": turns, "snr_db": 15, **more})


@pytest.mark.parametrize(
    ("turns", "stated", "said"), [(0.65, 4.0, True), (0.13, 20.0, True), (0.6, 4.0, False)]
)
def test_scans_that_do_not_repeat_as_stated_contradict_the_speed(
    turns: float, stated: float, said: bool
) -> None:
    # Of 1.2 stated turns, a table 15 % slower than stated shows no repetition either.
    result = resolve_turn(_mug(turns, "mug-01", 5), f"free?rpm={stated}")
    causes = [cause for cause in _of_the_turn(result) if cause.code == "speed"]
    assert [cause.settings for cause in causes] == [{}] * said
    if said:
        assert causes[0].text == f"the scans do not repeat after the stated {60 / stated:.1f} s"
        assert "`motion.url=free`" in causes[0].remedy


@pytest.mark.parametrize("snr_db", [-5.0, 20.0])
@pytest.mark.parametrize("stated", [1.8, 2.0, 2.2])
def test_the_speed_of_a_table_that_turns_unevenly_is_not_contradicted(stated: float, snr_db: float) -> None:
    scene = scene_from_name("container-90", 5)
    capture = without_angles(scene, 5, turns=1.45, snr_db=snr_db, wobble=Wobble(0.03))
    result = resolve_turn(capture, f"free?rpm={stated}")
    assert speed_contradiction(result.motion.resolved) == ""


def test_a_recording_that_holds_a_turn_is_read_again_with_its_own_speed() -> None:
    # At a wrong axis distance the image cannot say which multiple of the repetition is a turn.
    resolved = ResolvedMotion(nominal_rpm=12.0, direction=-1, repeats=False, shortest_repetition_s=10.0)
    capture = _mug(1.3, "mug-01", 5)
    cause = _of_the_turn(replace(capture, motion=replace(capture.motion, resolved=resolved)))[0]
    assert cause.settings == {"motion.url": "free?direction=cw"}


def test_a_part_of_a_tag_that_repeats_is_not_a_turn() -> None:
    # Two of three reflectors at 0, 60 and 120 degrees repeat after a sixth of a turn.
    free = resolve_turn(_mug(1.35, "mug-01", 5)).motion.resolved
    assert free.period_s == pytest.approx(30.0, rel=0.01)
    stated = resolve_turn(_mug(1.95, "mug-01", 5), "free?rpm=1.333").motion.resolved
    assert stated.measured_rpm == pytest.approx(2.0, rel=0.01)
    assert re.search(r"s \(free\) as stated; the scans show (29.9|30.0)\d s$", turn_line(stated))


@pytest.mark.parametrize(
    ("layout", "body", "seed", "stated"),
    [("mug-04", "none", 725875, 3.3), ("container-180", "can:35mm", 516068, 4.0)],
)
def test_a_wrong_speed_of_a_symmetric_tag_is_contradicted_by_every_speed_that_fits(
    layout: str, body: str, seed: int, stated: float
) -> None:
    # On a smaller ring, a faster turn explains it with fewer points: that alone would be a false number.
    bare = _mug(1.35, layout, seed, body, snr_db=10, period_s=6.0)
    resolved = resolve_turn(bare, f"free?rpm={stated}").motion.resolved
    assert resolved.measured_rpm is None and len(resolved.likely_rpms) > 1
    assert any(rpm == pytest.approx(10, rel=0.01) for rpm in resolved.shown_rpms)
    said = speed_contradiction(resolved)
    assert f"stated speed of {stated:g} rpm" in said and "they show" in said
    assert all(f"{rpm:.3g}" in said for rpm in resolved.likely_rpms)
    assert re.search(r"as stated; the scans show .* or .* s$", turn_line(resolved))
    cause = _of_the_turn(replace(bare, motion=replace(bare.motion, resolved=resolved)))[0]
    assert cause.code == "speed" and cause.remedy.count("free?rpm=") == len(resolved.likely_rpms)


def test_the_right_speed_of_a_symmetric_tag_is_not_contradicted() -> None:
    # Of a small ring, a third of a turn at three times the speed is explained as well by fewer points.
    result = resolve_turn(_mug(1.3, "mug-04", 3), "free?rpm=2").motion.resolved
    assert result.measured_rpm is None and "stated" not in turn_line(result)
