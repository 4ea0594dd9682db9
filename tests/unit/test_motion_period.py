"""The period search against simulated turns of known period."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.angles.clock import fit_clock
from tagid.angles.period import find_period
from tagid.errors import DataError
from tagid.motion.turntable import FreeTurntable
from tagid.simulate import Acquisition, Placement, Scene, Wobble, scene_from_name, simulate_capture
from tagid.simulate.acquisition import Recording

RATE = 20.0
SYMMETRIC = Scene.of_points(np.array([[0.09, 0.0], [-0.09, 0.0]]))


def recording(
    scene: Scene, snr_db: float, turns: float, seed: int, wobble: float = 0.0
) -> tuple[np.ndarray, np.ndarray, float]:
    """(samples, times, true period): 20 scans/s, 20..30 s a turn, stamps in whole ms."""
    views = round(np.random.default_rng(seed).uniform(20, 30) * RATE)
    acq = Acquisition(
        views=views,
        turns=turns,
        period_s=views / RATE,
        snr_db=snr_db,
        placement=Placement((0.004, -0.003)),
        wobble=Wobble(wobble),
    )
    capture, _ = simulate_capture(scene, acq, seed)
    return capture.samples, fit_clock(capture.radar_time_ms).times_s, acq.period_s


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
    scene = scene_from_name("container-90", 2)
    samples, times, truth = recording(scene, 15, 1.35, 2, wobble=0.01)
    counts = np.rint(samples * 1000).astype(np.int32)
    assert find_period(counts, times).period_s == pytest.approx(truth, rel=2e-3)


def test_complex_samples() -> None:
    acq = Acquisition(views=500, turns=1.4, period_s=25.0, snr_db=10, recording=Recording("complex64"))
    capture, truth = simulate_capture(scene_from_name("points-3", 1), acq)
    assert find_period(capture.samples, truth.times_s).period_s == pytest.approx(25.0, rel=1e-3)


def test_lost_scans_do_not_matter() -> None:
    samples, times, truth = recording(scene_from_name("points-4", 3), 15, 1.4, 3)
    kept = np.sort(np.random.default_rng(0).permutation(len(times))[: int(0.85 * len(times))])
    assert find_period(samples[kept], times[kept]).period_s == pytest.approx(truth, rel=1.5e-3)


def test_nearly_symmetric_target_is_decided_by_the_nominal_period() -> None:
    for seed in range(3):
        samples, times, truth = recording(SYMMETRIC, 15, 1.4, seed)
        period = find_period(samples, times, nominal_s=1.05 * truth)
        assert period.period_s == pytest.approx(truth, rel=2e-3)


def exactly_symmetric(turns: float) -> tuple[np.ndarray, np.ndarray]:
    acq = Acquisition(views=500, turns=turns, period_s=25.0, snr_db=15)
    capture, truth = simulate_capture(SYMMETRIC, acq, 1)
    return capture.samples, truth.times_s


def test_exact_symmetry_is_ambiguous() -> None:
    samples, times = exactly_symmetric(1.4)
    period = find_period(samples, times, nominal_s=26.0)
    assert period.period_s == pytest.approx(25.0, rel=2e-3)
    assert period.harmonic_ambiguous
    assert period.rivals_s[0] == pytest.approx(12.5, rel=0.02)


def test_exact_symmetry_without_a_nominal_period_is_never_silent() -> None:
    """Half a turn is found, but the echoes are too slow for it."""
    for turns in (0.8, 1.4):
        samples, times = exactly_symmetric(turns)
        period = find_period(samples, times)
        assert period.period_s == pytest.approx(12.5, rel=5e-3)
        assert period.harmonic_ambiguous
        assert period.rivals_s[-1] == pytest.approx(25.0, rel=5e-3)


def test_unlike_target_is_not_ambiguous() -> None:
    for nominal in (None, 25.0):
        acq = Acquisition(views=500, turns=1.4, period_s=25.0, snr_db=15)
        capture, truth = simulate_capture(scene_from_name("points-4", 2), acq, 1)
        period = find_period(capture.samples, truth.times_s, nominal)
        assert not period.harmonic_ambiguous
        assert period.quality > 0.9


@pytest.mark.parametrize("nominal", [None, 25.0])
def test_less_than_a_turn_says_record_longer(nominal: float | None) -> None:
    acq = Acquisition(views=500, turns=0.85, period_s=25.0, snr_db=20)
    capture, truth = simulate_capture(scene_from_name("points-4", 2), acq, 1)
    with pytest.raises(DataError) as error:
        find_period(capture.samples, truth.times_s, nominal)
    assert "ecord" in error.value.remedy


@pytest.mark.parametrize("kind", ["noise", "constant", "zero"])
def test_nothing_turning_gives_no_period(kind: str) -> None:
    rng = np.random.default_rng(0)
    samples = {
        "noise": rng.standard_normal((600, 192)),
        "constant": np.tile(rng.standard_normal(192), (600, 1)),
        "zero": np.zeros((600, 192)),
    }[kind].astype(np.float32)
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
        scans = list(capture.samples)
        stopped = None
        for n in range(1, len(scans), 10):
            if table.finished(scans[:n], list(truth.times_s[:n])):
                stopped = truth.times_s[n - 1]
                break
        assert low <= stopped <= high
        n = int(np.searchsorted(truth.times_s, stopped)) + 1
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
    scene, turn_s = scene_from_name("points-4", 3), 10.0
    acq = Acquisition(views=400, turns=1.3, period_s=turn_s, snr_db=20)
    capture, truth = simulate_capture(scene, acq, 3)
    times = truth.times_s
    whole = find_period(capture.samples, times)
    assert whole.quality > 0.95
    seen = (times < 4.0) | (times > 6.0)
    assert find_period(capture.samples[seen], times[seen]).quality == pytest.approx(0.8, abs=0.05)
    some = np.random.default_rng(1).random(len(times)) > 0.1
    assert find_period(capture.samples[some], times[some]).quality > 0.9
