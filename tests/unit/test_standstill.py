"""A turn that stops half-way: found in the scans, and not where the object merely looks the same."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tagid.angles.standstill import find_standstill
from tagid.capture import Capture
from tagid.errors import DataError
from tagid.live.angles import LiveAngles
from tagid.metadata import Track
from tagid.motion.urls import open_motion
from tagid.pipeline.diagnosis import _of_the_turn, recording_remarks
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import load_capture
from tagid.pipeline.turn import resolve_turn
from tagid.radar.assembler import Scan
from tagid.simulate import Acquisition, scene_from_name, simulate_capture
from tagid.simulate.capture import Truth
from tagid.tags.layouts.layout import builtin_layouts

VIEWS = 240
"""Scans per turn."""
TURNS = 1.3
TOLERANCE = 0.15


def path(stop: float, pause: float = math.inf, turns: float = TURNS) -> np.ndarray:
    """(scans,) true turns of a table that stops after a part of a turn, and goes on after another."""
    reported = np.arange(round(VIEWS * turns)) / VIEWS
    return np.where(reported < stop, reported, np.maximum(stop, reported - pause))


@cache
def turning(name: str, seed: int) -> tuple[Capture, Truth]:
    """At 0 dB."""
    acquisition = Acquisition(views=VIEWS, turns=TURNS, snr_db=0.0)
    return simulate_capture(scene_from_name(name, seed), acquisition, seed)


def recording(
    name: str, true_turns: np.ndarray, snr_db: float, seed: int, told_rpm: float | None = 2.0
) -> Capture:
    """A recording without angles whose object really was at `true_turns`, 30 s for a told turn."""
    capture, truth = turning(name, seed)
    noise = np.random.default_rng(seed).standard_normal((len(true_turns), capture.bins))
    noise *= truth.noise_std * 10 ** (-snr_db / 20)
    seen = truth.clean[np.rint(true_turns * VIEWS).astype(int) % VIEWS]
    url = "free" if told_rpm is None else f"free?rpm={told_rpm:g}"
    return replace(
        capture, samples=(seen + noise).astype(np.float32), angles_rad=None, angle_sigma_rad=None, flags=None,
        radar_time_ms=np.floor(np.arange(len(true_turns)) / VIEWS * 30e3),
        scan_id=np.arange(len(true_turns)), motion=replace(capture.motion, url=url, resolved=None),
    )  # fmt: skip


@pytest.mark.parametrize("snr_db", [20, 10])
@pytest.mark.parametrize("stop", [0.25, 0.5, 0.9])
def test_a_stop_is_found_at_a_told_speed(stop: float, snr_db: float) -> None:
    result = resolve_turn(recording("helmet-120", path(stop), snr_db, 5), "free?rpm=2")
    still = result.motion.resolved.standstill
    assert not still.goes_on
    assert still.turned_deg == pytest.approx(360 * stop, abs=9)
    assert still.first_scan + still.scans == still.of_scans == result.views
    error = np.abs(np.abs(result.angles_rad) / (2 * np.pi) - path(stop))
    assert error.max() < 0.025


def test_at_five_decibels_a_stop_is_found_where_it_was_or_not_at_all() -> None:
    found = 0
    for seed, stop in itertools.product((5, 6), (0.25, 0.5, 0.75)):
        result = resolve_turn(recording("points-3", path(stop), 5, seed), "free?rpm=2")
        still = result.motion.resolved.standstill
        if still is not None:
            assert still.turned_deg == pytest.approx(360 * stop, abs=15) and not still.goes_on
            found += 1
    assert found >= 2


@pytest.mark.parametrize("stop", [0.25, 0.75])
def test_a_table_that_goes_on_keeps_its_true_angles(stop: float) -> None:
    true = path(stop, 0.3)
    result = resolve_turn(recording("helmet-120", true, 15, 7), "free?rpm=2")
    still = result.motion.resolved.standstill
    assert still.goes_on and still.seconds == pytest.approx(9.0, abs=0.7)
    assert np.abs(np.abs(result.angles_rad) / (2 * np.pi) - true).max() < 0.025


@pytest.mark.parametrize("name", ["can", "container-180", "corner", "empty"])
@pytest.mark.parametrize("snr_db", [20, 5])
@pytest.mark.parametrize("scale", [0.4, 0.9, 1.0])
def test_a_turning_object_does_not_stop(name: str, snr_db: float, scale: float) -> None:
    """Not even one that looks the same from many sides, or a table much slower than told."""
    samples = recording(name, scale * path(9), snr_db, 11).samples
    assert find_standstill(samples, path(9), TOLERANCE) is None


def test_nothing_turns_is_no_stop() -> None:
    samples = recording("helmet-120", path(0.0), 20, 3).samples
    assert find_standstill(samples, path(9), TOLERANCE) is None


@pytest.mark.parametrize("count", [2, 30, 100])
def test_a_few_scans_of_a_slow_table_are_no_stop(count: int) -> None:
    """At 1 rpm and 230 scans a second a degree holds 38 scans: fewer are not one place of the turn."""
    samples = np.random.default_rng(1).standard_normal((count, 64)).astype(np.float32)
    assert find_standstill(samples, np.arange(count) / (38.5 * 360), 0.1) is None


def test_the_stop_is_the_cause_and_the_part_before_is_used() -> None:
    capture = recording("points-5", path(0.5), 20, 4)
    loaded = load_capture(capture)
    assert loaded.views < 0.6 * capture.views, "the scans of the standstill are no views"
    assert recording_remarks(loaded) == (
        "the turn stopped at about 181 degrees (scan 122 of 312); the scans meanwhile are not used",
    )
    (cause,) = _of_the_turn(loaded)
    assert cause.code == "turn_stopped" and "(scan 122 of 312)" in cause.text and "holds" in cause.remedy


def test_less_than_most_of_a_turn_names_nothing() -> None:
    """A reflector on the far side would be one more than the layout has."""
    loaded = load_capture(recording("helmet-120", path(0.45), 20, 4))
    part = loaded.select(np.arange(0, loaded.views, 5))
    answer = identify(part, list(builtin_layouts().values()))
    assert (answer.status, answer.reading.layout) == ("unknown", None)
    assert answer.reading.code.value == "turn_stopped"
    assert answer.reading.advice.startswith("Check what holds")
    assert "show helmet-120, but not every side" in answer.reading.reason


@pytest.mark.parametrize(
    ("name", "true_turns", "code", "says"),
    [
        ("container-90", path(0.6, turns=4.0), "turn_stopped", r"the turn stopped \(scan 14\d of 960\)"),
        ("helmet-120", path(0.6, turns=4.0), "turn_stopped", r"the turn stopped \(scan 14\d of 960\)"),
        ("container-90", path(9, turns=0.8), "bad_data", "period"),
    ],
)
def test_a_stop_without_a_speed_is_an_error_of_its_own_unlike_a_short_turn(
    name: str, true_turns: np.ndarray, code: str, says: str
) -> None:
    with pytest.raises(DataError, match=says) as caught:
        resolve_turn(recording(name, true_turns, 15, 8, None), "free")
    assert caught.value.code == code


@pytest.mark.parametrize("pause", [math.inf, 0.3])
def test_a_device_that_turns_without_the_object_is_found_out(pause: float) -> None:
    true = path(0.5, pause)
    capture = recording("helmet-120", true, 15, 9)
    arrivals = 10**18 + (capture.radar_time_ms * 1e6).astype(np.int64)
    track = Track(arrivals, 2 * np.pi * path(9), np.full(len(true), 1e-3), {"scale_sigma": 0.02})
    url = "roomba+serial:///dev/robot"
    motion = replace(capture.motion, url=url, track=track)
    result = resolve_turn(replace(capture, host_time_ns=arrivals, motion=motion), url)
    standstill = result.motion.resolved.standstill
    assert standstill.goes_on == (pause < math.inf)
    assert standstill.turned_deg == pytest.approx(180, abs=9)
    assert np.abs(result.angles_rad / (2 * np.pi) - true).max() < 0.03


@pytest.mark.parametrize(("direction", "pause"), [("ccw", math.inf), ("cw", 0.3)])
def test_live_angles_are_held(direction: str, pause: float) -> None:
    true = path(0.5, pause)
    capture = recording("helmet-120", true, 20, 5)
    angles = LiveAngles(open_motion(f"free?rpm=2&direction={direction}"))
    moments = enumerate(zip(capture.radar_time_ms, capture.samples, strict=True))
    scans = [Scan(number, int(ms), 0, samples, 0, 0, 0) for number, (ms, samples) in moments]
    early = angles.of(scans[: VIEWS // 2])
    assert early is not None and angles.stopped == ""
    angles._next_look_s = 0.0
    late = angles.of(scans)
    assert angles.stopped.startswith("the turn stopped at about 18")
    sign = 1 if direction == "ccw" else -1
    assert np.abs(sign * late / (2 * np.pi) - true).max() < 0.05
