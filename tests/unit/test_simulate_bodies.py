"""Physical bodies: they move with their tag, return what solved ones return, and turn the phase of a tag.

Levels in dBsm are those of method-of-moments solutions (shared/fullwave/README.md), at 3.1 / 4.0 / 4.9 GHz.
"""

from __future__ import annotations

import inspect
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tagid.cli.options import SceneOptions
from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import DataError, UsageError
from tagid.query import parse_point
from tagid.simulate import (
    Acquisition,
    BodySpec,
    Interference,
    NoiseShape,
    Placement,
    RangeWindow,
    Recording,
    ReflectorSpec,
    Scene,
    TurningScene,
    Wobble,
    parse_body,
    parse_elevation,
    parse_reflector,
    random_pulse,
    scene_from_name,
    scene_on_body,
    simulate_capture,
)
from tagid.simulate.beside import BesideRound
from tagid.simulate.bodies import Carton, RoundBody, Shell, sheet
from tagid.simulate.multipole import Layer, Multipoles
from tagid.simulate.noise import draw_noise
from tagid.simulate.objects import METAL, Variation, tagged_object
from tagid.simulate.response_file import read_response
from tagid.simulate.scatterers import Mounted, Octahedron, Rod, unit_of
from tagid.simulate.spec import SceneSpec, turning_scene
from tagid.simulate.specification import parse_length
from tests.benchmarks.electromagnetic import cylinder_series, field
from tests.benchmarks.provenance import SHARED

DATA = Path(__file__).parents[1] / "data"
BAND_HZ = np.array([3.1e9, 4.0e9, 4.9e9])
BODIES = ("can:35mm,handle,seam", "cup:38mm,handle,filled,oval=1mm", "helmet:98mm,seam", "box:120mm", "none")
FIXED = RangeWindow.around(1.0)


def dbsm(length_m: np.ndarray) -> np.ndarray:
    """Radar cross-section 4 pi |b|^2, dB over 1 m^2."""
    return 10 * np.log10(4 * np.pi * np.abs(length_m) ** 2)


def clean(scene: Scene, views: int = 4, **acquisition: object) -> np.ndarray:
    """Noise-free analytic samples."""
    how = Acquisition(views=views, window=FIXED, recording=Recording("complex64"), **acquisition)  # type: ignore[arg-type]
    return simulate_capture(scene, how)[1].clean


def scene_of(text: str, tagged: bool = True) -> Scene:
    """A preset by name, or a layout on a body."""
    if text in ("helmet-120", "untagged", "can", "box"):
        return scene_from_name(text, 3)
    layout = "helmet-120" if text.startswith("helmet:") else "container-90"
    return scene_on_body(layout if tagged else "untagged", parse_body(text), ReflectorSpec(), 3)


@pytest.mark.parametrize("text", [*BODIES, "helmet-120", "untagged", "can", "box"])
def test_everything_on_an_object_moves_and_turns_with_it(text: str) -> None:
    """Shifted by +x, the object is seen from +x as from an antenna that much nearer, and from -x, half a turn
    later, as from one that much farther."""
    scene = replace(scene_of(text), room=None)
    moved = clean(scene, 2, placement=Placement((0.01, 0.0)))
    for view, distance_m in enumerate((0.99, 1.01)):
        np.testing.assert_allclose(moved[view], clean(scene, 2, axis_distance_m=distance_m)[view], atol=1e-9)
    turned = clean(scene, 12, placement=Placement(rotation_rad=2 * np.pi * 5 / 12))
    np.testing.assert_allclose(turned, np.roll(clean(scene, 12), -5, axis=0), atol=1e-9)


@pytest.mark.parametrize(("size_mm", "levels"), [(20, (-45.1, -40.5, -36.8)), (40, (-26.9, -25.1, -25.9))])
def test_octahedra_have_the_solved_cross_section(size_mm: float, levels: tuple[float, ...]) -> None:
    assert dbsm(Octahedron(size_mm * 1e-3).scattering_length(BAND_HZ)) == pytest.approx(levels, abs=0.3)
    # Rayleigh's law of small ones: the square of the frequency, and the cube of the size.
    small, double = (np.abs(Octahedron(d).scattering_length(np.array([3e9, 4e9]))) for d in (0.005, 0.010))
    assert (small[1] / small[0], double[0] / small[0]) == pytest.approx(((4 / 3) ** 2, 8))


def test_cans_and_shells_have_the_solved_cross_section() -> None:
    can = RoundBody((Layer(0.035, METAL),), 0.1).scattering_length(BAND_HZ)
    assert dbsm(can) == pytest.approx((-16.5, -14.1, -13.1), abs=1.3)
    all_round = np.arange(72) * 2 * np.pi / 72
    shell = Shell().scattering_length(BAND_HZ, all_round)
    assert 10 * np.log10(np.mean(10 ** (dbsm(shell) / 10), axis=1)) == pytest.approx((-29, -27, -25), abs=1.3)
    # Front and back wall interfere: 13 to 18 dB over a turn between the 10 % quantiles and more at the nulls.
    low, high = np.quantile(dbsm(shell), [0.1, 0.9], axis=1)
    assert ((high - low > 7) & (high - low < 20)).all()


@pytest.mark.parametrize("body", [RoundBody((Layer(0.035, METAL),), 0.1), Shell()])
def test_points_carry_the_response_over_the_band(body: RoundBody | Shell) -> None:
    frequency = np.linspace(2.4e9, 5.6e9, 81)
    far = 200.0
    got = field(body, (far, 0.0, 0.0), frequency) * np.exp(4j * np.pi * frequency / SPEED_OF_LIGHT * far)
    towards = (np.zeros(1),) if isinstance(body, Shell) else ()
    expected = body.scattering_length(frequency, *towards).ravel()
    assert np.abs(got - expected).max() < 0.01 * np.abs(expected).max()


def test_a_carton_echoes_as_a_solved_one() -> None:
    """105 by 140 mm, 120 mm high, of 5 mm cardboard, by the method of moments: size, phase and aspect."""
    solved = read_response(DATA / "cartons" / "carton140.npz")
    frequency = solved.frequency_hz
    carton, ring = Carton(0.145, 0.110, 0.120, 0.005, 1.5), solved.rings[0]
    towards = ring.distance_m * np.exp(2j * np.pi * np.arange(0, solved.aspects, 6) / solved.aspects)
    antennas = np.stack([towards.real, towards.imag, np.full(len(towards), ring.height_m)], axis=1)
    turn = np.exp(4j * np.pi * frequency / SPEED_OF_LIGHT * ring.distance_m)
    echo = field(carton, antennas, frequency) * turn[:, None]
    expected = solved.scattering_length_m[:, 0, ::6]
    error = np.linalg.norm(echo - expected) / np.linalg.norm(expected)
    # Nothing is fitted: 0.3 dB of level, and half a percent of pattern.
    assert error**2 < 0.02


def test_a_reflector_in_a_carton_is_seen_through_its_walls() -> None:
    """Turned with the box; in a wall there is no room for one."""
    carton = Carton(0.145, 0.110, 0.120, 0.005, 1.5, centre_m=(0.01, 0.0))
    turned = replace(carton, rotation_rad=0.5, centre_m=(0.0, 0.01))
    place = np.array([0.030, 0.020])
    along = np.exp(0.5j) * complex(*(place - carton.centre_m))
    first, other = carton.around(place), turned.around(np.array([along.real, along.imag + 0.01]))
    assert first == other
    effect = np.abs(first.effect(BAND_HZ, AROUND))
    assert 0.05 < np.abs(effect - 1).max() < 0.5
    with pytest.raises(DataError, match="in a wall"):
        carton.around(np.array([0.0, 0.0535]))


def test_a_sheet_keeps_the_energy() -> None:
    reflection, transmission = sheet(BAND_HZ, 0.003, 2.8)
    assert np.abs(reflection) ** 2 + np.abs(transmission) ** 2 == pytest.approx(np.ones(3))


WAVENUMBER = np.linspace(40, 125, 9)
AROUND = np.linspace(0, np.pi, 13)


def test_multipoles_of_metal_are_the_series_and_have_no_field_on_it() -> None:
    metal = Multipoles.of(WAVENUMBER, (Layer(0.033, METAL),))
    np.testing.assert_allclose(metal.backscatter(), cylinder_series(WAVENUMBER * 0.033), atol=1e-12)
    assert np.abs(metal.field(0.033, AROUND)).max() < 1e-9


def test_in_a_body_of_air_is_the_plane_wave() -> None:
    air = Multipoles.of(WAVENUMBER, (Layer(0.03), Layer(0.04)))
    plane = np.exp(1j * WAVENUMBER[:, None] * 0.02 * np.cos(AROUND))
    np.testing.assert_allclose(air.field(0.02, AROUND), plane, atol=1e-9)


def on_can(what: object, place_m: complex) -> Mounted:
    """Something beside a can of 35 mm radius."""
    around = (BesideRound((Layer(0.035, METAL),), abs(place_m)),)
    return Mounted(what, np.array([[place_m.real, place_m.imag, 0]]), np.ones(1, complex), around)


def from_around(body: object, far_m: float, angles: np.ndarray) -> np.ndarray:
    """What a body sends back at 4 GHz to antennas all round."""
    antennas = far_m * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    return field(body, antennas, np.array([4e9]))[0]


def test_double_bounce_turns_the_phase_and_the_body_shadows() -> None:
    """On a 35 mm can a tag at 45 mm looks like a point at 38 to 39 mm, 14 dB down at 90 degrees."""
    k = 2 * np.pi * 4e9 / SPEED_OF_LIGHT
    antenna_angles = np.deg2rad([*range(-50, 51, 5), 90, 180])
    tag, far = on_can(Octahedron(0.02), 0.045 + 0j), 500.0
    echo = from_around(tag, far, antenna_angles) * np.exp(2j * k * far)
    phase = np.unwrap(np.angle(echo[:-2]))
    apparent = np.polyfit(np.cos(antenna_angles[:-2]), phase, 1)[0] / (2 * k)
    assert apparent == pytest.approx(0.0385, abs=0.002)
    bright = dbsm(echo[10])
    assert dbsm(echo[-2]) - bright == pytest.approx(-14, abs=3)
    assert dbsm(echo[-1]) - bright < -30
    free = from_around(replace(tag, bodies=(None,)), far, np.zeros(1)) * np.exp(2j * k * (far - 0.045))
    own = Octahedron(0.02).scattering_length(np.array([4e9]))
    assert np.angle(free / own) == pytest.approx(0, abs=0.02)


@pytest.mark.skipif(not (SHARED / "fullwave").is_dir(), reason="solved responses are not beside the checkout")
def test_a_tag_and_a_handle_on_a_can_are_what_the_solved_ones_are() -> None:
    """Aspect patterns at 4 GHz, vertical polarisation at 1 m: alike in shape and level."""

    def solved(name: str) -> np.ndarray:
        with np.load(SHARED / "fullwave" / "responses" / f"{name}.npz") as file:
            at = int(np.argmin(np.abs(file["freqs"] - 4e9)))
            return np.asarray(file["S"][at, 1], dtype=complex)

    angles = np.arange(72) * 2 * np.pi / 72
    models = {
        "can35_one": on_can(Octahedron(0.02), 0.045 + 0j),
        "can35_handle": on_can(Rod.metal_strip(0.01, 0.06), 0.063 * np.exp(1j * np.deg2rad(250))),
    }
    for name, model in models.items():
        truth = solved(name) - solved("can35")
        made = from_around(model, 1.0, angles)
        alike = np.abs(np.vdot(made, truth)) / np.linalg.norm(made) / np.linalg.norm(truth)
        assert alike > 0.9, name
        assert 20 * np.log10(np.linalg.norm(made) / np.linalg.norm(truth)) == pytest.approx(0, abs=2.5), name


def test_a_tag_on_a_helmet_is_what_the_solved_one_is() -> None:
    """One free amplitude per frequency: reflectors without the shell leave 18 % of the solved echo."""
    folder = DATA / "shells"
    tagged, shell = (read_response(folder / f"{name}.npz") for name in ("shell74_h120", "shell74"))
    turn = 2 * np.pi * np.arange(24) / 24
    antenna = shell.rings[0].distance_m * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    ring = np.deg2rad([25, 145, 265])
    positions = 0.112 * np.stack([np.cos(ring), np.sin(ring)], axis=1)
    frequency = shell.frequency_hz[3:-3:4]
    truth = (tagged.seen_from(antenna) - shell.seen_from(antenna)).T[3:-3:4]

    def left(body: str, mirrored: int = 1) -> float:
        places, rng = positions * (1, mirrored), np.random.default_rng(1)
        made = tagged_object(places, parse_body(body), ReflectorSpec("octahedron", 0.02), rng)[0]
        echo = field(made, antenna, frequency)
        echo, seen = (item - item.mean(axis=1, keepdims=True) for item in (echo, truth))
        along = np.abs((echo.conj() * seen).sum(axis=1)) ** 2 / (np.abs(echo) ** 2).sum(axis=1)
        return float(1 - along.sum() / (np.abs(seen) ** 2).sum())

    assert left("none") > 0.15
    assert left("helmet:96mm") < 0.055
    assert left("helmet:96mm", mirrored=-1) > 0.5


def test_elevation_is_in_the_echo() -> None:
    scene = Scene.of_points(np.zeros((1, 2)))
    raised = clean(scene, 1, placement=Placement(height_m=0.1))
    np.testing.assert_allclose(raised, clean(scene, 1, axis_distance_m=np.hypot(1, 0.1)), atol=1e-5)


@pytest.mark.parametrize("text", ["can:35mm", "box:120mm", "helmet:98mm"])
def test_a_wall_is_weaker_from_above(text: str) -> None:
    body = replace(scene_of(text, tagged=False), room=None)
    level = [np.abs(clean(body, 36, placement=Placement(height_m=h))).max() for h in (0.0, 0.1, 0.25)]
    assert level[0] > level[1] > level[2] > 0


@pytest.mark.parametrize(("reference", "index"), [("reflector", 0), ("summed", 1)])
def test_snr_is_measured_on_the_samples(reference: str, index: int) -> None:
    """Both SNRs of a tag on a can, from the samples of its parts; the can, 20 dB stronger, does not count."""
    scene = scene_on_body("container-180", parse_body("can:30mm"), ReflectorSpec(), 1, 2.0)
    how = Acquisition(
        views=180, window=FIXED, snr_db=12.0, snr_reference=reference, placement=Placement((0.004, 0.0))
    )
    capture, truth = simulate_capture(scene, how, seed=2)
    noise = float((capture.samples - truth.clean).std())
    first, other, both = (
        np.abs(clean(Scene("x", (part,)), 180, placement=how.placement)).max()
        for part in (scene.tag.single(0), scene.tag.single(1), scene.tag)
    )
    measured = [20 * np.log10(level / noise) for level in (max(first, other), both)]
    assert measured[index] == pytest.approx(12.0, abs=0.1)
    assert (truth.snr.reflector_db, truth.snr.summed_db) == pytest.approx(measured, abs=0.1)
    reported = capture.object.truth
    assert (reported.snr_reflector_db, reported.snr_summed_db) == pytest.approx(measured, abs=0.1)
    with pytest.raises(UsageError):
        Acquisition(snr_reference="loudest")


@pytest.mark.parametrize(
    ("text", "against"),
    [("untagged", "a single reflector"), ("can:35mm", "a single reflector"), ("can", "the whole")],
)
def test_without_a_tag_one_snr_is_told_and_what_it_is_against(text: str, against: str) -> None:
    capture, truth = simulate_capture(scene_of(text, tagged=False), Acquisition(views=12, snr_db=12.0))
    assert f"peak over noise 12.0 dB, of {against}" in str(truth.snr)
    reported = capture.object.truth
    assert (reported.snr_reflector_db, reported.snr_summed_db) == (None, None)
    assert reported.snr_reference_db == pytest.approx(12.0)


@pytest.mark.parametrize("colour", [0.0, 0.5, 1.0])
def test_noise_has_its_strength_whatever_its_colour(colour: float) -> None:
    ranges = FIXED.ranges_m
    noise = draw_noise(NoiseShape(colour), ranges, 4000, np.random.default_rng(1))
    assert noise.std() == pytest.approx(1.0, abs=0.01)
    assert noise.std(axis=0) == pytest.approx(np.ones(len(ranges)), abs=0.06)
    power = (np.abs(np.fft.rfft(noise, axis=1)) ** 2).mean(axis=0)
    frequency = np.fft.rfftfreq(len(ranges), 2 * FIXED.step_m / SPEED_OF_LIGHT)
    inside, outside = np.abs(frequency - 3.95e9) < 0.3e9, np.abs(frequency - 3.95e9) > 1.6e9
    ratio = power[inside].mean() / power[outside].mean()
    assert ratio == pytest.approx(1.0, abs=0.05) if colour == 0 else ratio > 3


def test_interference_is_a_tone_of_the_stated_level() -> None:
    shape = NoiseShape(interference=Interference(20.0, 3.5e9, 0.5))
    noise = draw_noise(shape, FIXED.ranges_m, 2000, np.random.default_rng(1))
    hit = noise.std(axis=1) > 3
    assert hit.mean() == pytest.approx(0.5, abs=0.05)
    assert noise[hit].std() == pytest.approx(np.sqrt(101), rel=0.05)
    frequency = np.fft.rfftfreq(FIXED.bins, 2 * FIXED.step_m / SPEED_OF_LIGHT)
    spectrum = (np.abs(np.fft.rfft(noise[hit], axis=1)) ** 2).mean(axis=0)
    assert frequency[int(np.argmax(spectrum))] == pytest.approx(3.5e9, abs=0.06e9)


def test_the_truth_is_in_the_capture_and_nothing_else_tells_it() -> None:
    scene = scene_on_body("container-90", parse_body("can:35mm,handle"), ReflectorSpec(), 7)
    pulse, other = (random_pulse(np.random.default_rng(seed)) for seed in (1, 2))
    assert not np.allclose(pulse.samples, other.samples)
    placement = Placement((0.003, -0.002), np.deg2rad(40), 0.1)
    capture, _ = simulate_capture(
        scene, Acquisition(4, placement=placement, wobble=Wobble(0.01), pulse=pulse)
    )
    reported, truth = capture.object, capture.object.truth
    assert (reported.layout, reported.body) == ("container-90", "can:35mm,handle")
    assert reported.reflector == "octahedron:20mm"
    assert truth.rotation_deg == pytest.approx(40)
    assert (truth.centre_m, truth.elevation_m) == ((0.003, -0.002), 0.1)
    assert (truth.wobble_speed, truth.pulse) == (0.01, "other")
    assert (capture.pulse, capture.antenna_height_m) == (None, 0.0)


CONFIG = SimpleNamespace(samples=288, scan_start_ps=3000, base_integration_index=11)


def test_the_emulator_sees_a_body_off_the_axis_as_the_simulator_does() -> None:
    scene = scene_of("can:35mm,handle,seam")
    how = Acquisition(
        views=10, placement=Placement((0.006, -0.003), 0.4, 0.05), wobble=Wobble(0.02), range_law=True
    )
    source = TurningScene(scene, rpm=3.0, seed=6, acquisition=how)
    window, gain = source.window(CONFIG), source.counts_per_unit(CONFIG)
    assert (window.start_m, window.bins) == (pytest.approx(3e-9 * SPEED_OF_LIGHT / 2), 288)
    how = replace(how, window=window, recording=Recording(counts_per_unit=gain))
    truth = simulate_capture(scene, how, seed=6)[1]
    for view in range(10):
        np.testing.assert_allclose(source.clean(view * 2.0, CONFIG), truth.clean[view], atol=1e-6 * gain)
        assert source.angle(view * 2.0) == pytest.approx(truth.angles_rad[view])
    assert source.about().truth.rotation_deg == pytest.approx(np.rad2deg(0.4)), "at time zero"
    assert source.snr.reflector_db == pytest.approx(20.0)
    assert source.snr.summed_db > 20


def test_reflectors_stand_off_the_middle_of_their_body() -> None:
    variation = Variation(ring_m=(0.002, 0.0))
    rng, place = np.random.default_rng(0), np.array([[0.045, 0.0]])
    tag, can = tagged_object(place, parse_body("can:30mm"), ReflectorSpec(), rng, variation)
    assert isinstance(tag, Mounted) and isinstance(can, RoundBody)
    assert tag.axis_m == can.centre_m == (-0.002, 0.0)
    assert unit_of(Octahedron(0.02)) == tag.unit_m == can.unit_m


def test_an_emulated_radars_scene_takes_a_body_and_its_place() -> None:
    options = {
        "body": "can:35mm",
        "reflector": "octahedron:20mm",
        "centre": "0.004,-0.002",
        "elevation": "5cm",
    }
    source = turning_scene(SceneSpec.from_url("container-90", options))
    scene = scene_on_body("container-90", parse_body("can:35mm"), ReflectorSpec())
    placed = Acquisition(placement=Placement((0.004, -0.002), height_m=0.05))
    expected = TurningScene(scene, 6.0, acquisition=placed)
    np.testing.assert_allclose(source.clean(1.0, CONFIG), expected.clean(1.0, CONFIG))
    for wrong in ("body=can:35", "centre=1", "centre=a,b", "elevation=3", "handle=1"):
        with pytest.raises(UsageError) as error:
            turning_scene(SceneSpec.from_url("container-90", dict([wrong.split("=")])))
        assert error.value.remedy


def test_command_line_url_and_api_request_one_scene() -> None:
    url = {"rotation": "30", "centre": "0.004,-0.002", "rpm": "7", "body": "can:35mm", "budget": "1"}
    spec = SceneSpec("mine", rotation=30, centre=(0.004, -0.002), rpm=7, body="can:35mm", budget=True)
    typed = SceneOptions(rotation=30, centre="0.004,-0.002", body="can:35mm")
    assert SceneSpec.from_url("mine", url) == typed.spec(scene="mine", rpm=7, budget=True) == spec
    for option in inspect.signature(SceneOptions).parameters.values():
        if option.name != "centre":
            assert option.default == getattr(SceneSpec("mine"), option.name)


@pytest.mark.parametrize(
    "options",
    [
        {}, {"scene": "can", "response": Path("r.npz")}, {"scene": "can", "polarisation": "H"},
        {"response": Path("r.npz"), "budget": True}, {"scene": "can", "unlike": 3.0},
        {"scene": "can", "reflector": "octahedron", "unlike": float("nan")},
    ],
)  # fmt: skip
def test_options_of_a_scene_that_contradict_each_other(options: dict[str, Any]) -> None:
    with pytest.raises(UsageError) as error:
        SceneSpec(**options)
    assert error.value.remedy


@pytest.mark.parametrize("text", ["1", "1,2,3", "a,b", "0,nan", "inf,0", ""])
def test_what_is_not_a_pair_of_numbers(text: str) -> None:
    with pytest.raises(UsageError, match=r"--centre is .* not two numbers"):
        parse_point("--centre", text)


@pytest.mark.parametrize(
    ("text", "spec"),
    [
        ("none", BodySpec()),
        ("can:35mm", BodySpec("can", 0.035)),
        ("cup:4cm,handle,wall=5mm", BodySpec("cup", 0.04, ("handle",), (("wall", 0.005),))),
        ("helmet", BodySpec("helmet", 0.101)),
    ],
)
def test_bodies_are_read_and_written(text: str, spec: BodySpec) -> None:
    assert parse_body(text) == parse_body(str(spec)) == spec


@pytest.mark.parametrize(
    "text",
    [
        "", "can:35", "can:35 mm", "can:mm", "can:-35mm", "can:1e1mm", "can:nanmm", "can:9m", "can:",
        "cone:3mm", "can:35mm,", "can:35mm,spout", "can:35mm,handle,handle", "can:35mm,wall=3mm", "can,35mm",
        "none:3mm", "none,handle", "box:120mm,handle", "can:35mm,height=3", "can:35mm,height=3cm,height=4cm",
    ],
)  # fmt: skip
def test_bodies_that_cannot_be_read_say_what_can(text: str) -> None:
    with pytest.raises(UsageError) as error:
        parse_body(text)
    assert error.value.remedy


def test_other_texts_are_read_strictly() -> None:
    assert parse_reflector("octahedron:40mm") == ReflectorSpec("octahedron", 0.04)
    assert parse_reflector("octahedron").size_m == 0.02
    assert parse_length("x", "3.5cm") == pytest.approx(0.035)
    assert parse_elevation("-50mm") == pytest.approx(-0.05)
    wrong = (parse_reflector, "corner:20mm"), (parse_reflector, "octahedron:20"), (parse_elevation, "1m")
    for read, text in wrong:
        with pytest.raises(UsageError):
            read(text)


def test_objects_that_cannot_be_built_are_refused() -> None:
    with pytest.raises(UsageError, match="the antenna stands at"):
        simulate_capture(scene_from_name("helmet-120"), Acquisition(views=12, axis_distance_m=0.1))
    with pytest.raises(UsageError, match="inside the wall"):
        scene_on_body("container-90", parse_body("can:50mm"), ReflectorSpec())
    for scene in ("empty", "corner", "box"):
        with pytest.raises(UsageError):
            scene_on_body(scene, parse_body("can:35mm"), ReflectorSpec())
    for make in (
        lambda: Octahedron(0.1),
        lambda: Layer(-1.0),
        lambda: Layer(0.1, -2.0),
        lambda: RoundBody((Layer(0.03, METAL),), 0.0),
        lambda: Multipoles.of(WAVENUMBER, (Layer(0.04), Layer(0.03))),
        lambda: Multipoles.of(WAVENUMBER, (Layer(0.04), Layer(0.044, 6.0))).field(0.042, AROUND),
    ):
        with pytest.raises(DataError):
            make()
