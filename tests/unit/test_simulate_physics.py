"""The simulator against closed formulas and moments: distances, signs, amplitudes, noise, recording."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tagid.capture import Pulse, ViewFlag
from tagid.constants import RANGE_STEP_M, SPEED_OF_LIGHT
from tagid.errors import DataError, UsageError
from tagid.geometry import Aperture
from tagid.simulate import (
    Acquisition,
    Box,
    Cylinder,
    Placement,
    Points,
    RangeWindow,
    Recording,
    Scene,
    StaticReturns,
    TurningScene,
    Wobble,
    preset_names,
    scene_from_name,
    simulate_capture,
)
from tagid.waveform import nominal_pulse, pulse_at
from tests.benchmarks.electromagnetic import (
    BAND_HZ,
    ConductingCylinder,
    cylinder_series,
    field,
    metal_box,
)

POINTS = np.array([[0.11, 0.05], [-0.03, 0.12]])


def clean(scene: Scene, **acquisition: object) -> np.ndarray:
    """Analytic samples without noise."""
    how = Acquisition(recording=Recording("complex64"), **acquisition)  # type: ignore[arg-type]
    return simulate_capture(scene, how)[1].clean


def envelope_peak_m(row: np.ndarray, window: RangeWindow) -> float:
    """Range of the strongest envelope sample, by parabola through complex samples."""
    e = np.abs(row)
    i = int(np.argmax(e))
    left, mid, right = np.log(e[i - 1 : i + 2])
    return window.start_m + window.step_m * (i + 0.5 * (left - right) / (left - 2 * mid + right))


def test_samples_are_the_sum_of_delayed_pulses() -> None:
    capture, truth = simulate_capture(Scene.of_points(POINTS), Acquisition(views=24, antenna_height_m=0.2))
    antenna = Aperture.turntable(truth.angles_rad, 1.0, 0.2).positions
    d = np.linalg.norm(antenna[:, None] - np.append(POINTS, np.zeros((2, 1)), 1), axis=2)
    delay = 2 * (capture.ranges_m[None, :, None] - d[:, None]) / SPEED_OF_LIGHT
    expected = pulse_at(nominal_pulse(), delay).sum(axis=2).real
    np.testing.assert_allclose(capture.samples, expected, atol=2e-3)


def test_placed_positions_are_where_the_echoes_are() -> None:
    placement = Placement((0.01, -0.006), 0.7)
    a, truth = simulate_capture(Scene.of_points(POINTS), Acquisition(views=12, placement=placement))
    b, _ = simulate_capture(Scene.of_points(truth.positions_m), Acquisition(views=12))
    np.testing.assert_allclose(a.samples, b.samples, atol=1e-5)


def test_clockwise_is_the_mirror_in_time() -> None:
    a, _ = simulate_capture(Scene.of_points(POINTS), Acquisition(views=12))
    b, _ = simulate_capture(Scene.of_points(POINTS), Acquisition(views=12, direction=-1))
    np.testing.assert_allclose(b.samples[1:], a.samples[:0:-1], atol=1e-5)


def test_range_law_is_one_over_r_squared_in_amplitude() -> None:
    peaks = []
    for x in (0.0, -1.0):  # at 1 m and at 2 m from the antenna
        scene = Scene.of_points(np.array([[x, 0.0]]))
        peaks.append(np.abs(clean(scene, views=1, window=RangeWindow(0.5, 300), range_law=True)).max())
    assert peaks[0] == pytest.approx(1.0, rel=0.01)
    assert peaks[0] / peaks[1] == pytest.approx(4.0, rel=0.02)


def test_beam_halves_two_way_amplitude_at_its_edge() -> None:
    width = np.deg2rad(20.0)
    scene = Scene.of_points(np.array([[0.0, np.tan(width / 2)]]))
    assert np.abs(clean(scene, views=1, beam_width_rad=width)).max() == pytest.approx(0.5, rel=0.01)


def test_far_side_is_dimmer() -> None:
    scene = Scene("x", (Points(np.array([[0.1, 0.0]]), np.ones(1), np.zeros(1), np.pi, 0.25),))
    near, far = np.abs(clean(scene, views=2)).max(axis=1)
    assert near == pytest.approx(1.0, rel=0.01)
    # floor + (1 - floor) 2^-(2 pi / pi)^2 at psi = pi
    assert far == pytest.approx(0.25 + 0.75 / 16, rel=0.02)


def test_cylinder_is_seen_at_its_near_surface_and_shell_is_constant() -> None:
    capture, _ = simulate_capture(
        Scene("can", (Cylinder(0.033, 1.0, (0.05, 0.0)),)),
        Acquisition(views=2, recording=Recording("complex64")),
    )
    window = RangeWindow(capture.range_start_m, capture.bins)
    assert envelope_peak_m(capture.samples[0], window) == pytest.approx(1 - 0.05 - 0.033, abs=2e-4)
    assert envelope_peak_m(capture.samples[1], window) == pytest.approx(1 + 0.05 - 0.033, abs=2e-4)
    shell, _ = simulate_capture(Scene("shell", (Cylinder(0.1),)), Acquisition(views=16))
    assert np.ptp(shell.samples, axis=0).max() < 1e-6
    assert np.abs(shell.samples).max() > 0.9


def test_box_flashes_four_times_a_turn_at_its_faces() -> None:
    capture, truth = simulate_capture(
        Scene("box", (Box(0.3, 0.2, 3.0, 0.0),)), Acquisition(views=360, recording=Recording("complex64"))
    )
    strength = np.abs(truth.clean).max(axis=1)
    assert strength[[0, 90, 180, 270]] == pytest.approx(np.full(4, 3.0), rel=0.02)
    assert strength[45] < 0.1
    window = RangeWindow(capture.range_start_m, capture.bins)
    assert envelope_peak_m(capture.samples[0], window) == pytest.approx(1 - 0.15, abs=2e-4)
    assert envelope_peak_m(capture.samples[90], window) == pytest.approx(1 - 0.10, abs=2e-4)


def test_box_edges_hide_behind_the_box() -> None:
    amplitudes = (
        Box(0.2, 0.2, edge_amplitude=1.0).returns(np.array([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])).amplitudes
    )
    assert np.count_nonzero(amplitudes[0, 4:]) == 2  # head-on: the two near edges
    assert np.count_nonzero(amplitudes[1, 4:]) == 3  # corner-on: all but the far one


def test_room_is_constant_and_outside_echoes_are_dropped() -> None:
    room = StaticReturns(np.array([0.9, 50.0, -3.0]), np.array([2.0, 9.0, 9.0]))
    capture, _ = simulate_capture(Scene("room", room=room), Acquisition(views=4))
    assert np.ptp(capture.samples, axis=0).max() == 0
    assert np.abs(capture.samples).max() == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("snr_db", [0.0, 20.0])
def test_snr_is_the_strongest_reflectors_peak_over_the_noise(snr_db: float) -> None:
    room = StaticReturns(np.array([1.4]), np.array([30.0]))  # neither room nor body counts
    scene = Scene("x", (Points(POINTS, np.array([1.0, 0.3])), Cylinder(0.05, 8.0)), room=room)
    capture, truth = simulate_capture(scene, Acquisition(views=90, snr_db=snr_db), seed=4)
    noise = capture.samples - truth.clean
    assert truth.levels.reflector == pytest.approx(1.0, rel=0.01)
    assert 20 * np.log10(truth.levels.reflector / noise.std()) == pytest.approx(snr_db, abs=0.15)
    assert noise.std() == pytest.approx(truth.noise_std, rel=0.02)


def test_complex_noise_has_the_stated_std_in_all() -> None:
    acq = Acquisition(views=60, noise_std=0.316, recording=Recording("complex64"))
    capture, truth = simulate_capture(Scene.of_points(POINTS), acq)
    assert np.std(capture.samples - truth.clean) == pytest.approx(0.316, rel=0.02)


def test_counts_are_rounded_and_clipped() -> None:
    acq = Acquisition(views=6, recording=Recording("int32", 1000.0, 700.0))
    capture, truth = simulate_capture(Scene.of_points(POINTS), acq)
    assert capture.samples.dtype == np.int32
    assert np.abs(capture.samples).max() == 700
    inside = np.abs(truth.clean) < 699
    assert np.abs(capture.samples - truth.clean)[inside].max() <= 0.5
    assert capture.flags.max() & ViewFlag.CLIPPED


def test_claims_may_be_wrong_and_truth_is_not() -> None:
    acq = Acquisition(views=90, axis_distance_error_m=0.012, angle_error_rad=0.02, wobble=Wobble(0.01, 0.002))
    capture, truth = simulate_capture(Scene.of_points(POINTS), acq, seed=3)
    assert capture.axis_distance_m == pytest.approx(1.012)
    assert truth.axis_distance_m == 1.0
    uniform = 2 * np.pi * np.arange(90) / 90
    assert np.std(capture.angles_rad - uniform) == pytest.approx(0.02, rel=0.3)
    assert 0 < np.abs(truth.angles_rad - uniform).max() < 0.05


def test_wobble_is_a_fraction_of_the_speed_and_closes_after_a_turn() -> None:
    acq = Acquisition(views=1000, turns=2, wobble=Wobble(0.05))
    _, truth = simulate_capture(Scene.of_points(POINTS), acq, seed=8)
    speed = np.diff(truth.angles_rad) * 1000 / (2 * np.pi)
    assert np.std(speed[:1000]) == pytest.approx(0.05, rel=0.02)
    np.testing.assert_allclose(truth.angles_rad[1000:] - truth.angles_rad[:1000], 2 * np.pi, atol=1e-9)


def test_pulse_of_the_user_is_rendered_and_told() -> None:
    pulse = Pulse(np.array([0.0, 1.0, 3.0, -2.0, 0.5, 0.0]), 61e-12)
    acq = Acquisition(views=1, pulse=pulse, tell_pulse=True, window=RangeWindow(0.9, 40, RANGE_STEP_M / 4))
    capture, _ = simulate_capture(Scene.of_points(np.zeros((1, 2))), acq)
    assert capture.pulse is pulse
    expected = pulse_at(pulse, 2 * (capture.ranges_m - 1.0) / SPEED_OF_LIGHT).real
    scale = np.abs(capture.samples[0]).max() / np.abs(expected).max()
    np.testing.assert_allclose(capture.samples[0], scale * expected, atol=5e-3)


def test_same_seed_same_capture() -> None:
    scene, acq = scene_from_name("helmet-120", 5), Acquisition(views=12, snr_db=10)
    a, b, c = (simulate_capture(scene, acq, seed)[0].samples for seed in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


def test_every_preset_renders() -> None:
    for name in preset_names():
        capture, _ = simulate_capture(
            scene_from_name(name.replace("N", "7"), 2), Acquisition(views=8, snr_db=20)
        )
        assert np.abs(capture.samples).max() > 0
        assert capture.object.scene == name.replace("N", "7")


def test_bad_values_are_refused() -> None:
    for name in ("", "nonsense", "points-0", "points-999", "points-"):
        with pytest.raises(UsageError) as error:
            scene_from_name(name)
        assert error.value.remedy, "it says what there is"
    for make, wrong in (
        (lambda: Points(np.zeros((3, 4)), np.ones(3)), DataError),
        (lambda: Points(np.zeros((3, 2)), np.ones(2)), DataError),
        (lambda: Acquisition(views=0), UsageError),
        (lambda: Acquisition(views=10**9), UsageError),
        (lambda: Recording("float16"), UsageError),
        (lambda: TurningScene(Scene.of_points(POINTS), rpm=-1), UsageError),
    ):
        with pytest.raises(wrong):
            make()


def config(samples: int = 288, scan_start_ps: int = 3000, index: int = 11) -> SimpleNamespace:
    return SimpleNamespace(samples=samples, scan_start_ps=scan_start_ps, base_integration_index=index)


def test_turning_scene_noise_and_integration() -> None:
    source = TurningScene(scene_from_name("empty", 1), seed=1)
    quiet = config(960, 70_000)
    a = source.scan(5, 0.0, quiet)
    assert a.dtype == np.int32
    assert a.shape == (960,)
    assert a.std() == pytest.approx(120, rel=0.1)
    assert np.array_equal(a, source.scan(5, 0.0, quiet))
    assert not np.array_equal(a, source.scan(6, 0.0, quiet))
    assert source.scan(5, 0.0, config(960, 70_000, index=7)).std() == pytest.approx(30, rel=0.1)


def test_turning_scene_cable_delay_moves_the_echo_out() -> None:
    scene = Scene.of_points(np.zeros((1, 2)))
    near = TurningScene(scene, seed=0).clean(0.0, config())
    far = TurningScene(scene, seed=0, cable_delay_s=16 * 61.03515625e-12).clean(0.0, config())
    np.testing.assert_allclose(far[16:], near[:-16], atol=1e-2)


def test_turning_scene_saturates() -> None:
    scene = Scene("x", room=StaticReturns(np.array([1.0]), np.array([1e4])))
    assert np.abs(TurningScene(scene).scan(0, 0.0, config(index=6))).max() == 127 * 2**6


def test_series_reaches_geometrical_optics() -> None:
    ka = np.array([60.0])
    # Physical optics of the lit side: -sqrt(pi ka) / 2 exp(2j ka - j pi / 4), echo width pi a.
    optics = -np.sqrt(np.pi * ka) / 2 * np.exp(2j * ka - 1j * np.pi / 4)
    assert abs(cylinder_series(ka) / optics - 1)[0] < 0.02


def test_points_carry_the_series_over_the_band() -> None:
    can = ConductingCylinder(0.033, 0.12, (0.1, -0.05))
    frequency = np.linspace(*BAND_HZ, 101)
    distance = np.hypot(1.0 - 0.1, 0.05)
    k = 2 * np.pi * frequency / SPEED_OF_LIGHT
    expected = can.scattering_length(frequency) * np.exp(-2j * k * distance)
    got = field(can, (1.0, 0.0, 0.0), frequency)
    assert np.abs(got - expected).max() < 0.02 * np.abs(expected).max()


def test_a_large_metal_wall_is_a_mirror_at_half_the_power_of_its_image() -> None:
    """Many Fresnel zones: the field of the image source at distance 2R, b / R^2 = -1 / (2 R)."""
    distance, turn, frequency = 0.5, 0.3, np.linspace(3e9, 5e9, 41)
    k = 2 * np.pi * frequency / SPEED_OF_LIGHT
    position = (1.5 + distance) * np.array([[np.cos(turn), np.sin(turn), 0.0]])
    seen = np.zeros(len(k), dtype=complex)
    for wall in metal_box(3.0, 3.0, rotation_rad=turn):
        returns = wall.returns(position)
        lit = returns.amplitudes[0] != 0
        r = np.linalg.norm(returns.points[0, lit] - position, axis=1)
        seen += (np.exp(-2j * np.outer(k, r)) / r**2) @ returns.amplitudes[0, lit]
    expected = -np.exp(-2j * k * distance) / (2 * distance)
    assert np.abs((seen / expected).mean() - 1) < 0.05
