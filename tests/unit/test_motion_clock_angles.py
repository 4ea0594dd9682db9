"""Clock, period, angles, thinning and URLs of motion, and the period search against simulated turns."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tagid.angles.align import align
from tagid.angles.clock import fit_clock
from tagid.angles.period import find_period, kinematic_period
from tagid.angles.sinogram import uniform_grid
from tagid.angles.views import average_into_views, first_turn
from tagid.capture import Capture
from tagid.errors import DataError, UsageError
from tagid.metadata import Track
from tagid.motion.turntable import FreeTurntable
from tagid.motion.urls import open_motion
from tagid.pipeline.resolve import clock_of, one_turn, with_angles
from tagid.simulate import Acquisition, Placement, Scene, Wobble, scene_from_name, simulate_capture
from tagid.simulate.acquisition import Recording
from tests.unit.imaging_scenes import record, turn

SCAN_S = 0.021573
"""0.867 ms + (1152 / 12) * 2^11 * 105.31 ns (P440, measured)."""


def stamps(count: int, offset: float = 0.4) -> np.ndarray:
    return np.floor(np.arange(count) * SCAN_S * 1e3 + offset + 5000)


@pytest.mark.parametrize("offset", [0.0, 0.37, 0.9])
def test_whole_millisecond_stamps_give_microseconds(offset: float) -> None:
    clock = fit_clock(stamps(1400, offset))
    assert clock.period_s == pytest.approx(SCAN_S, rel=3e-6)
    assert abs(clock.period_s - SCAN_S) < 4 * clock.period_sigma_s
    np.testing.assert_allclose(clock.times_s, np.arange(1400) * SCAN_S, atol=1e-4)
    assert clock.residual_ms == pytest.approx(1 / np.sqrt(12), rel=0.1)


@pytest.mark.parametrize("with_ids", [True, False])
def test_lost_scans_leave_gaps(with_ids: bool) -> None:
    kept = np.sort(np.random.default_rng(1).permutation(1000)[:900])
    kept = np.unique(np.append(kept, 0))
    clock = fit_clock(stamps(1000)[kept], 7 + kept if with_ids else None)
    assert np.array_equal(clock.index, kept)
    assert clock.period_s == pytest.approx(SCAN_S, rel=1e-5)


@pytest.mark.parametrize("wraps", [1, 2])
def test_times_go_on_over_the_wrap_of_the_32_bit_clock(wraps: int) -> None:
    """Every time, not only the median step, is as if the counter had no end."""
    scan_ms = 21_573.0 if wraps == 1 else 2**31 * 0.7
    whole = np.floor(np.arange(9) * scan_ms + 2**32 - 2.5 * scan_ms)
    wrapped = whole % 2**32
    assert np.count_nonzero(np.diff(wrapped) < 0) >= wraps
    clock, straight = fit_clock(wrapped, np.arange(9)), fit_clock(whole, np.arange(9))
    np.testing.assert_allclose(clock.times_s, straight.times_s, atol=1e-9, rtol=0)
    np.testing.assert_allclose(clock.times_s, np.arange(9) * scan_ms * 1e-3, atol=2e-3)
    assert clock.outliers == 0


def test_the_stated_sigma_of_the_period_is_its_error() -> None:
    """Of 300 fits through jitter of 0.4 ms, error over sigma has unit spread."""
    rng = np.random.default_rng(4)
    ratios = []
    for _ in range(300):
        clock = fit_clock(np.cumsum(np.full(80, 50.0)) + rng.normal(0, 0.4, 80), np.arange(80))
        ratios.append((clock.period_s - 0.05) / clock.period_sigma_s)
    assert np.std(ratios) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize(("off_ms", "outliers"), [(1.4, 0), (1.7, 1), (-1.4, 0), (-1.7, 1)])
def test_a_stamp_further_off_than_rounding_and_jitter_is_not_used(off_ms: float, outliers: int) -> None:
    times = np.arange(101) * 20.0
    times[50] += off_ms  # in the middle, where it turns no line
    clock = fit_clock(times, np.arange(101))
    assert clock.outliers == outliers
    assert clock.residual_ms == pytest.approx(0.0 if outliers else 1.4 / np.sqrt(101), abs=2e-2)
    assert clock.period_s == pytest.approx(0.020, rel=1e-12)


def test_stamps_of_no_uniform_clock_are_all_kept_and_the_residual_shows_it() -> None:
    times = np.cumsum(np.random.default_rng(3).uniform(5, 400, 60))
    clock = fit_clock(times, np.arange(60))
    assert clock.outliers == 0
    line = np.polynomial.Polynomial.fit(np.arange(60), times, 1)
    rms = np.sqrt(np.mean((times - line(np.arange(60))) ** 2))
    assert clock.residual_ms == pytest.approx(rms) and rms > 30
    assert clock.period_s == pytest.approx(line.convert().coef[1] * 1e-3)
    spread = np.sqrt(60 * (60**2 - 1) / 12)
    assert clock.period_sigma_s == pytest.approx(rms / spread * 1e-3)


def test_times_are_worst_known_far_from_the_stamps_that_were_used() -> None:
    """The last five of forty stamps are wrong: the ends' sigma reaches from the middle of the others."""
    times = np.arange(40) * 20.0
    times[35:] += 50.0
    clock = fit_clock(times, np.arange(40))
    assert clock.outliers == 5
    used = np.arange(35)
    rounding_s = 1e-3 / np.sqrt(12)
    period = rounding_s / np.sqrt(np.sum((used - used.mean()) ** 2))
    assert clock.period_sigma_s == pytest.approx(period)
    assert clock.sigma_s == pytest.approx(np.hypot(rounding_s / np.sqrt(35), period * (39 - used.mean())))


def test_a_gap_longer_than_half_the_counter_is_still_a_wrap_and_a_shorter_step_back_is_none() -> None:
    step = 2.0**31 - 1000
    wrapped = (np.arange(4) * step) % 2**32
    np.testing.assert_allclose(fit_clock(wrapped, np.arange(4)).times_s, np.arange(4) * step * 1e-3)
    back = np.arange(30) * 20.0 + 5000
    back[15] -= 4000  # one bad stamp
    clock = fit_clock(back, np.arange(30))
    assert (clock.outliers, clock.times_s[-1]) == (1, pytest.approx(0.58))


def test_two_stamps_are_known_to_their_rounding() -> None:
    two = fit_clock(np.array([1000.0, 1021.0]))
    assert (two.period_s, two.residual_ms, two.outliers) == (0.021, 0.0, 0)
    assert two.period_sigma_s == pytest.approx(1e-3 / np.sqrt(12) / np.sqrt(0.5))


@pytest.mark.parametrize(
    ("times", "ids", "message"),
    [
        ([1.0], None, "."),
        ([5.0, 5.0, 5.0], None, "."),
        ([1.0, 2.0], [3, 3], "scan numbers"),
        ([1.0, np.nan], None, "."),
        ([3.0, 2.0, 1.0], None, "."),
        ([0.0, 20.0, 40.0, 60.0], [0, 1, 2], "scan numbers"),
        ([0.0, 20.0, 40.0], [0, 1, 2, 3], "scan numbers"),
        ([0.0, 20.0, 40.0, 60.0], [0, 2, 1, 3], "scan numbers"),
        ([[1.0, 1.0], [1.0, 1.0]], None, "cannot be fitted through 4"),
    ],
)
def test_impossible_stamps_are_refused(times: list[Any], ids: list[int] | None, message: str) -> None:
    with pytest.raises(DataError, match=message):
        fit_clock(np.array(times), None if ids is None else np.array(ids))


@pytest.mark.parametrize("direction", [1, -1])
def test_the_first_turn_is_every_view_of_it_in_any_order_without_the_overlap(direction: int) -> None:
    angles = direction * np.arange(468) * 2 * np.pi / 360
    assert np.array_equal(first_turn(angles), np.arange(360))
    assert np.array_equal(first_turn(angles[:90]), np.arange(90))
    for first in (90, 200):
        wrapped = direction * np.deg2rad((np.arange(360) + first) % 360)
        assert len(first_turn(wrapped)) == 360
        assert len(first_turn(np.random.default_rng(first).permutation(wrapped))) == 360


@pytest.mark.parametrize("direction", [1, -1])
def test_recording_resolves_to_one_turn_of_right_angles(direction: int) -> None:
    scene = Scene.of_points(np.array([[0.1, 0.02], [-0.05, 0.08], [0.0, -0.12]]))
    acq = Acquisition(views=400, turns=1.35, period_s=20.3, direction=direction, snr_db=15)
    capture, truth = simulate_capture(scene, acq, seed=5)
    bare = replace(capture, angles_rad=None, angle_sigma_rad=None)
    resolved = with_angles(bare, "free?direction=cw" if direction < 0 else "free")
    error = np.abs(resolved.angles_rad - truth.angles_rad)
    assert error.max() < np.deg2rad(0.5)
    assert (error[1:] < 5 * resolved.angle_sigma_rad[1:]).all()
    assert resolved.angle_sigma_rad[0] == 0
    assert (np.diff(resolved.angle_sigma_rad) >= 0).all()
    assert resolved.motion.resolved.source == "data"
    assert one_turn(resolved, 360).views == 360
    assert one_turn(resolved, 500).views == 400


def test_known_angles_stay_and_missing_times_are_told() -> None:
    capture, _ = simulate_capture(Scene.of_points(np.zeros((1, 2))), Acquisition(views=8))
    assert with_angles(capture) is capture
    with pytest.raises(DataError) as error:
        with_angles(Capture(np.ones((20, 8), np.float32), 0.5, 0.01))
    assert error.value.remedy
    host = np.arange(30, dtype=np.int64) * 20_000_000 + 1_700_000_000_000_000_000
    assert clock_of(Capture(np.ones((30, 8), np.float32), 0.5, 0.01, host_time_ns=host)).period_s == (
        pytest.approx(0.02, rel=1e-6)
    )


def test_urls_that_work() -> None:
    free, fast = open_motion("free"), open_motion("free?rpm=2.5&direction=cw&max_seconds=50")
    assert (free.rpm, free.direction, free.needed_seconds()) == (None, 1, None)
    assert (fast.rpm, fast.direction, fast.max_seconds) == (2.5, -1, 50)
    assert fast.needed_seconds() == pytest.approx(1.3 * 24)
    assert open_motion("emulator://helmet-120?seed=1&rpm=6&loss=0.1").rpm == 6
    assert open_motion("emulator://helmet-120").rpm is None


@pytest.mark.parametrize(
    "url",
    [
        "", "fre", "free?rpm=fast", "free?rpm=0", "free?rpm=-1", "free?rpm=nan", "free?rpm", "free?speed=2",
        "free?rpm=1&rpm=2", "free?direction=left", "free?max_seconds=0", "free://x", "roomba+serial://",
        "roomba+usb://NAME", "emulator://", "http://[::1",
    ],
)  # fmt: skip
def test_urls_that_do_not_work_say_what_does(url: str) -> None:
    with pytest.raises(UsageError) as error:
        open_motion(url)
    assert error.value.remedy


@pytest.mark.parametrize("radius_m", [0.03, 0.05, 0.1])
def test_range_and_range_rate_of_a_reflector_tell_the_period_at_any_radius(radius_m: float) -> None:
    """Also where the circle is smaller than the pulse is long."""
    capture = record([(radius_m, 0.0)], [1.0], turn(200))
    moving = (capture.samples - capture.samples.mean(axis=0)).astype(np.float32)
    assert kinematic_period(moving, np.ones(200, dtype=bool), 0.05) == pytest.approx(10.0, rel=0.1)


def test_the_step_of_scans_stamped_in_whole_milliseconds_is_that_of_the_recording() -> None:
    stamps_s = np.floor(21.573 * np.arange(400)) * 1e-3
    _, received, step_s = uniform_grid(np.ones((400, 8), np.float32), stamps_s)
    assert received.sum() >= 390
    assert step_s * (len(received) - 1) == pytest.approx(stamps_s[-1] - stamps_s[0])


def test_a_free_table_is_continued_at_the_speed_that_it_had_at_each_end() -> None:
    """It slows down: 40 degrees a second before the first reading, 20 after the last."""

    def angle(times_s: np.ndarray) -> np.ndarray:
        slowing = np.clip(times_s, 2.0, 8.0) - 2.0
        rate = np.radians(40) - np.radians(20) / 6 * slowing
        before, after = np.minimum(times_s - 2.0, 0.0), np.maximum(times_s - 8.0, 0.0)
        return (np.radians(40) + rate) / 2 * slowing + before * np.radians(40) + after * np.radians(20)

    times_s, read_s = np.arange(0, 10, 0.02), np.arange(2.0, 8.01, 0.1)
    arrivals, moments = (10**18 + (at * 1e9).astype(np.int64) for at in (times_s, read_s))
    track = Track(moments, angle(read_s), np.full(len(read_s), 1e-3), {"runs_on": True})
    result = align(fit_clock(1e3 * times_s), arrivals, track)
    np.testing.assert_allclose(result.angles_rad, angle(times_s), atol=np.radians(1.0))


def test_a_view_is_seen_from_the_mean_angle_of_its_scans() -> None:
    """Not from the middle of its sector, which its scans need not fill."""
    angles = np.array([0.0, 0.10, 0.12, 0.14, 0.16])
    capture = replace(record([(0.05, 0.0)], [1.0], turn(5)), angles_rad=angles + 0.3)
    views = average_into_views(capture, 36)
    np.testing.assert_allclose(views.angles_rad, [0.3, 0.43])
    np.testing.assert_allclose(views.samples[1], capture.samples[1:].mean(axis=0), rtol=1e-5, atol=1e-6)


RATE = 20.0
SYMMETRIC = Scene.of_points(np.array([[0.09, 0.0], [-0.09, 0.0]]))


def scans_of(
    scene: Scene, turns: float, period_s: float = 25.0, seed: int = 1, snr_db: float = 15, **more: Any
):
    """(samples, true times in s) of a recording of 20 scans a second."""
    how = Acquisition(views=round(RATE * period_s), turns=turns, period_s=period_s, snr_db=snr_db, **more)
    capture, truth = simulate_capture(scene, how, seed)
    return capture.samples, truth.times_s


def recording(
    scene: Scene, snr_db: float, turns: float, seed: int, wobble: float = 0.0
) -> tuple[np.ndarray, np.ndarray, float]:
    """(samples, times, true period): 20 scans/s, 20..30 s a turn, off the axis, stamps in whole ms."""
    period_s = round(np.random.default_rng(seed).uniform(20, 30) * RATE) / RATE
    more = {"placement": Placement((0.004, -0.003)), "wobble": Wobble(wobble)}
    samples, times = scans_of(scene, turns, period_s, seed, snr_db, **more)
    return samples, fit_clock(np.floor(1e3 * times)).times_s, period_s


# Worst of 12 seeds was 0.08 / 0.016 / 0.014 % at 10 dB and 0.36 / 0.07 % at 0 dB.
@pytest.mark.parametrize(
    ("snr_db", "turns", "percent"),
    [(10, 1.3, 0.12), (10, 2.3, 0.06), (10, 3.2, 0.03), (0, 3.2, 0.12)],
)
def test_error_of_the_period(snr_db: float, turns: float, percent: float) -> None:
    ratios = []
    for seed in range(5):
        samples, times, truth = recording(scene_from_name("points-4", seed), snr_db, turns, seed)
        period = find_period(samples, times)
        assert abs(period.period_s / truth - 1) * 100 < percent
        assert period.turns == pytest.approx(turns, rel=0.02)
        ratios.append((period.period_s - truth) / period.sigma_s)
    # At 0 dB measured over two turns, which halves the error and its sigma.
    assert (0.15 if snr_db else 0.8) < np.sqrt(np.mean(np.square(ratios))) < 2.0


def test_low_signal_is_not_silently_wrong() -> None:
    for seed in range(8):
        name, snr_db = ("points-4", -8) if seed % 2 else ("container-90", 0)
        samples, times, truth = recording(scene_from_name(name, seed), snr_db, 2.3, seed)
        try:
            period = find_period(samples, times)
        except DataError as error:
            assert error.remedy
            continue
        assert period.harmonic_ambiguous or abs(period.period_s / truth - 1) < 0.02


def test_clutter_leakage_shell_wobble_and_counts() -> None:
    samples, times, truth = recording(scene_from_name("container-90", 2), 15, 1.35, 2, wobble=0.01)
    counts = np.rint(samples * 1000).astype(np.int32)
    assert find_period(counts, times).period_s == pytest.approx(truth, rel=2e-3)


def test_lost_scans_do_not_matter() -> None:
    samples, times, truth = recording(scene_from_name("points-4", 3), 15, 1.4, 3)
    kept = np.sort(np.random.default_rng(0).permutation(len(times))[: int(0.85 * len(times))])
    assert find_period(samples[kept], times[kept]).period_s == pytest.approx(truth, rel=1.5e-3)


def test_nearly_symmetric_target_is_decided_by_the_nominal_period() -> None:
    for seed in range(3):
        samples, times, truth = recording(SYMMETRIC, 15, 1.4, seed)
        period = find_period(samples, times, nominal_s=1.05 * truth)
        assert period.period_s == pytest.approx(truth, rel=2e-3)


def test_exact_symmetry_is_ambiguous_and_without_a_nominal_period_never_silent() -> None:
    """Half a turn is found then, but the echoes are too slow for it."""
    for turns in (0.8, 1.4):
        period = find_period(*scans_of(SYMMETRIC, turns))
        assert period.period_s == pytest.approx(12.5, rel=5e-3)
        assert period.harmonic_ambiguous
        assert period.rivals_s[-1] == pytest.approx(25.0, rel=5e-3)
    period = find_period(*scans_of(SYMMETRIC, 1.4), nominal_s=26.0)
    assert period.period_s == pytest.approx(25.0, rel=2e-3)
    assert period.harmonic_ambiguous
    assert period.rivals_s[0] == pytest.approx(12.5, rel=0.02)


@pytest.mark.parametrize("nominal", [None, 25.0])
def test_a_target_without_symmetry_is_not_ambiguous_and_less_than_a_turn_says_record_longer(
    nominal: float | None,
) -> None:
    scene = scene_from_name("points-4", 2)
    samples, times = scans_of(scene, 1.4, recording=Recording("complex64"))
    period = find_period(samples, times, nominal)
    assert period.period_s == pytest.approx(25.0, rel=1e-3)
    assert not period.harmonic_ambiguous
    assert period.quality > 0.9
    with pytest.raises(DataError) as error:
        find_period(*scans_of(scene, 0.85, snr_db=20), nominal)
    assert "ecord" in error.value.remedy


@pytest.mark.parametrize("kind", ["noise", "constant", "zero"])
def test_nothing_turning_gives_no_period(kind: str) -> None:
    noise = np.random.default_rng(0).standard_normal((600, 192)).astype(np.float32)
    samples = {"noise": noise, "constant": 0 * noise + noise[0], "zero": 0 * noise}[kind]
    with pytest.raises(DataError):
        find_period(samples, np.arange(600) * 0.05)


@pytest.mark.parametrize("times", [np.zeros(50), np.arange(49.0), np.arange(50.0)[::-1]])
def test_bad_times_are_refused(times: np.ndarray) -> None:
    with pytest.raises(DataError):
        find_period(np.ones((50, 8), np.float32), times)


def test_turntable_stops_by_itself_after_a_turn_and_the_overlap() -> None:
    acq = Acquisition(views=400, turns=3.0, period_s=20.0, snr_db=15)
    capture, truth = simulate_capture(scene_from_name("points-4", 4), acq, 1)
    for table, low, high in ((FreeTurntable(3.0), 26.0, 26.5), (FreeTurntable(), 22.0, 40.0)):
        table.start()
        n = next(
            n
            for n in range(1, capture.views, 10)
            if table.finished(list(capture.samples[:n]), list(truth.times_s[:n]))
        )
        assert low <= truth.times_s[n - 1] <= high
        angles = table.resolve(capture.samples[:n], truth.times_s[:n])
        assert np.abs(angles.angles_rad - truth.angles_rad[:n]).max() < np.deg2rad(0.7)


def test_turntable_gives_up_waiting_after_max_seconds() -> None:
    table = FreeTurntable(max_seconds=5)
    scans = list(np.random.default_rng(0).standard_normal((200, 32)).astype(np.float32))
    times = list(np.arange(200) * 0.05)
    assert not table.finished(scans[:90], times[:90])
    assert table.finished(scans[:110], times[:110])


def test_nominal_speed_is_used_and_told_where_the_data_show_no_period() -> None:
    samples = np.random.default_rng(0).standard_normal((600, 64)).astype(np.float32)
    times = np.arange(600) * 0.05
    angles = FreeTurntable(rpm=2.4, direction=-1).resolve(samples, times)
    assert angles.info.source == "nominal"
    assert angles.info.reason
    np.testing.assert_allclose(angles.angles_rad, -2 * np.pi * times / 25.0)
    assert angles.sigma_rad[-1] == pytest.approx(0.01 * abs(angles.angles_rad[-1]))
    with pytest.raises(DataError):
        FreeTurntable().resolve(samples, times)


def test_a_gap_in_the_turn_lowers_the_quality_that_is_stated() -> None:
    """Two seconds of ten without a scan are a gap; scattered losses are none."""
    samples, times = scans_of(scene_from_name("points-4", 3), 1.3, 10.0, 3, 20)
    assert find_period(samples, times).quality > 0.95
    seen = (times < 4.0) | (times > 6.0)
    assert find_period(samples[seen], times[seen]).quality == pytest.approx(0.8, abs=0.05)
    some = np.random.default_rng(1).random(len(times)) > 0.1
    assert find_period(samples[some], times[some]).quality > 0.9
