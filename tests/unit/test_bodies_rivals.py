"""Objects without an enrolled tag that a flexible model explains: the simpler explanation must win."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from any_evidence import SETTINGS
from numpy.typing import NDArray

from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.simulate import Acquisition, NoiseShape, Placement, parse_body, simulate_capture
from tagid.simulate.objects import object_scene
from tagid.simulate.presets import room_clutter, scene_from_layout
from tagid.simulate.response import Response
from tagid.simulate.response_file import read_response
from tagid.simulate.response_scene import response_scene
from tagid.simulate.scattering import Points
from tagid.simulate.scene import Scene
from tagid.simulate.specification import ReflectorSpec
from tagid.tags.bodies import cylinder_reader, reader
from tagid.tags.bodies.arrangement import can_stand
from tagid.tags.bodies.body_reading import BodySettings
from tagid.tags.bodies.decide import BodyDecision, decide_on_body
from tagid.tags.bodies.hypothesis import Kind
from tagid.tags.bodies.on_body import read_on_body
from tagid.tags.bodies.reflectors_fit import FACING, FEWEST_TERMS
from tagid.tags.bodies.revolution import RoundBody
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.bodies.symmetric import symmetric_left
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching.alone import BODY_LEAVES, pointed, points_of, undisputed
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.matcher import read_tag
from tagid.tags.matching.reading import Reading
from tagid.tags.matching.vote import read_together
from tagid.tags.verdicts.verdict import Code
from train.population import draw

RESPONSES = Path(__file__).parents[1] / "data" / "responses"
LAYOUTS = list(builtin_layouts().values())
RING_M = 0.045


def empty(views: int = 36) -> Spectra:
    kappa = 2 * 83.0 + np.linspace(-33, 33, 9)
    antenna = np.exp(-2j * np.pi * np.arange(views) / views)
    return Spectra(np.zeros((9, views), complex), kappa, antenna, np.zeros(views), 1.0, 1e-6)


def wall(centre: complex, turn: float, swing_m: float, noise: float = 0.01) -> Spectra:
    """A wall whose distance from its centre varies by +-`swing_m`, twice in a turn."""
    spectra, rng = empty(), np.random.default_rng(3)
    toward = spectra.antenna - centre
    path = np.abs(toward) - swing_m * np.cos(2 * (np.angle(toward) - turn))
    data = np.exp(2j * np.pi * rng.uniform(size=(9, 1))) * spectra.waves(path)
    data = data + noise * (rng.standard_normal(data.shape) + 1j * rng.standard_normal(data.shape))
    return replace(spectra, data=centred(data), noise=2 * noise**2)


def test_an_oval_wall_is_a_body_with_two_planes_of_symmetry() -> None:
    centre = -0.0072 + 0.0041j
    oval = wall(centre, 0.7, 0.008)
    assert symmetric_left(oval, 2) < 1e-3 * oval.energy
    # No body of revolution leaves so little, nor one with three planes.
    assert RoundBody().poses(oval)[0].left > 0.2 * oval.energy
    assert symmetric_left(oval, 3) > 0.1 * oval.energy


def scans_of(scene: Scene, acquisition: Acquisition, seed: int = 1) -> BasebandScans:
    capture, _ = simulate_capture(scene, acquisition, seed)
    return preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))


def pair(between_deg: float, seed: int = 1, views: int = 36) -> BasebandScans:
    """Two points on a ring of 45 mm, which stands 5 mm off the axis."""
    rng = np.random.default_rng(seed)
    place = RING_M * np.exp(1j * np.deg2rad([0.0, between_deg]))
    positions = np.stack([place.real, place.imag, 0 * place.real], axis=1)
    side = rng.uniform(0, 2 * np.pi)
    placed = Placement((0.005 * np.cos(side), 0.005 * np.sin(side)), rng.uniform(0, 2 * np.pi))
    scene = Scene("pair", (Points(positions, np.ones(2)),))
    return scans_of(scene, Acquisition(views=views, snr_db=20.0, placement=placed), seed)


@pytest.mark.parametrize("views", [18, 36])
def test_two_bare_reflectors_150_degrees_apart_are_not_opposite_ones(views: int) -> None:
    assert read_tag(pair(180.0, views=views), LAYOUTS, SETTINGS).layout == "container-180"
    reading = read_tag(pair(150.0, views=views), LAYOUTS, SETTINGS)
    assert reading.layout is None and reading.advice
    assert reading.code is Code.DISPLACED


def test_points_name_no_layout_where_another_is_nearest_and_refused() -> None:
    """At 12 views a pair before a shell passed for three reflectors twice as far apart."""
    scans = pair(180.0, views=12)
    bare, spectra, settings = read_tag(scans, LAYOUTS, SETTINGS), Spectra.of(scans), SETTINGS.contest
    points = points_of(bare, spectra, LAYOUTS, settings.points)
    assert pointed(bare, points, settings) and points.layouts[0].layout == "container-180"
    refused = bare.refused(Code.ELSEWHERE, "")
    assert pointed(refused, points, settings)
    assert not pointed(replace(refused, nearest="helmet-linear"), points, settings)


def test_nor_are_they_in_a_vote() -> None:
    joint, _ = read_together([pair(150.0, seed) for seed in (1, 2, 3)], LAYOUTS, SETTINGS)
    assert (joint.status, joint.code) == ("unknown", Code.DISPLACED)


def test_two_bare_reflectors_of_another_spacing_need_no_body() -> None:
    """A pair 47 mm apart was read as container-90 on a round body: points alone explain it."""
    specimen = draw(700414)
    assert (specimen.body, specimen.reflectors) == ("none", 2)
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    reading = read_tag(preprocess(specimen.capture, settings=settings), LAYOUTS, SETTINGS)
    assert reading.layout is None
    assert reading.body is not None and reading.body.points_lead < 0


@pytest.mark.parametrize("seed", [5, 11, 13])
def test_only_an_opaque_wall_moves_what_is_seen(seed: int) -> None:
    """A pair 140 mm apart before a thin shell was read as one of 90 mm that a bounce moves by 25 mm.

    Or as the outer ones of three 180 mm apart, from inside.
    """
    rng = np.random.default_rng(seed)
    scene = scene_from_layout(np.array([[0.07, 0.0], [-0.07, 0.0]]), "pair", seed)
    placed = Placement((0.006 * rng.uniform(-1, 1), 0.006 * rng.uniform(-1, 1)), rng.uniform(0, 2 * np.pi))
    scans = scans_of(scene, Acquisition(views=36, snr_db=20.0, placement=placed), seed)
    answer = read_tag(scans, LAYOUTS, SETTINGS)
    assert answer.status != "identified"
    reading = answer.body
    assert reading is not None
    expected = {"container-180": 0.025, "helmet-linear": -0.018}[str(reading.layouts[0].layout)]
    assert reading.outside_m == pytest.approx(expected, abs=0.002) and reading.back > 0.5
    assert decide_on_body(reading, BodyDecision()).code is Code.RADIUS
    # Seen from outside only, as before metal, it could be one that bounces.
    assert decide_on_body(replace(reading, back=0.2), BodyDecision()).code is not Code.RADIUS


def test_a_pair_on_a_can_that_an_oval_explains_without_a_body_is_sought_on_one() -> None:
    """Points explain it, and an oval about as well: only the layout on a round body leaves nothing."""
    specimen = draw(172, tagged=True, views=36, snr_db=20.0)
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    reading = read_tag(preprocess(specimen.capture, settings=settings), LAYOUTS, SETTINGS)
    assert (reading.status, reading.layout) == ("identified", specimen.truth)
    assert reading.kind is Kind.ROUND


@cache
def response(name: str) -> Response:
    return read_response(RESPONSES / f"{name}.npz")


def arranged(body: str, angles_deg: tuple[float, ...]) -> Response:
    """A body with reflectors at any angles: turned copies of what one of them adds to it."""
    plain = response(body)
    added = np.fft.fft(response(f"{body}_one").without(plain).scattering_length_m, axis=2)
    order = np.fft.fftfreq(added.shape[2], 1 / added.shape[2])
    turned = sum(added * np.exp(-1j * order * np.deg2rad(angle)) for angle in angles_deg)
    total = plain.scattering_length_m + np.fft.ifft(turned, axis=2)
    return replace(plain, name=body, scattering_length_m=total.astype(np.complex64))


def on_body(
    body: str, angles_deg: tuple[float, ...], polarisation: str, seed: int = 2, snr_db: float = 20.0
) -> Reading:
    rng = np.random.default_rng(seed)
    side = rng.uniform(0, 2 * np.pi)
    placed = Placement((0.006 * np.cos(side), 0.006 * np.sin(side)), rng.uniform(0, 2 * np.pi))
    acquisition = Acquisition(views=36, snr_db=snr_db, placement=placed)
    reference = response("free30_one")
    scene = response_scene(
        arranged(body, angles_deg), acquisition, polarisation, reference, room_clutter(rng)
    )
    return read_tag(scans_of(scene, acquisition, seed), LAYOUTS, SETTINGS)


@pytest.mark.parametrize("seed", [2, 4])
def test_crossed_pairs_on_a_can_are_not_one_pair(seed: int) -> None:
    """Two pairs of opposite reflectors, 45 degrees apart: a pattern of five terms makes them one pair."""
    reading = on_body("can40", (0.0, 45.0, 180.0, 225.0), "H", seed)
    assert reading.layout is None and reading.advice
    named = on_body("can40", (0.0, 180.0), "H", seed)
    assert named.layout == "container-180"


@pytest.mark.parametrize(("between_deg", "polarisation", "seed"), [(45.0, "V", 14), (40.0, "H", 24)])
def test_crossed_pairs_are_a_rival_where_few_terms_explain_them(
    between_deg: float, polarisation: str, seed: int
) -> None:
    """In noise a pattern of three terms is enough for one pair to leave nearly as little as crossed ones."""
    crossed = (0.0, between_deg, 180.0, 180.0 + between_deg)
    reading = on_body("can40", crossed, polarisation, seed, snr_db=10.0)
    assert reading.layout is None and reading.body is not None
    assert reading.body.lead < 0.1 and reading.body.layouts[0].batch.terms[0] <= FACING.terms


def test_crossed_pairs_pay_for_their_angles() -> None:
    """Two crossed pairs with every angle free leave less than the one pair that is there."""
    reading = on_body("can40", (0.0, 180.0), "V", seed=8, snr_db=10.0)
    assert reading.layout == "container-180"


@pytest.mark.parametrize(("snr_db", "seed"), [(8.0, 0), (8.0, 6), (10.0, 6)])
def test_one_reflector_on_a_can_is_no_pair_without_a_body(snr_db: float, seed: int) -> None:
    """In a weak echo two points leave nothing but noise, and the can with its one reflector much less."""
    noise, size = NoiseShape(0.4), ReflectorSpec("octahedron", 0.040)

    def reading(positions: NDArray[np.float64], body: str) -> Reading:
        rng = np.random.default_rng(seed)
        scene = object_scene("scene", positions, parse_body(body), size, rng=rng)
        placed = Placement((0.006, 0.0), 0.5 * seed)
        acquisition = Acquisition(views=36, snr_db=snr_db, noise=noise, placement=placed)
        capture, _ = simulate_capture(scene, acquisition, seed)
        scans = preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))
        return read_tag(scans, LAYOUTS, SETTINGS)

    assert reading(np.array([[RING_M, 0.0]]), "can:27mm,height=108mm,seam").layout is None
    pair = builtin_layouts()["container-180"].positions
    assert reading(pair, "none").layout == "container-180"


def test_no_body_is_tried_where_its_charge_alone_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a body every arrangement leaves its share of the noise, and is charged for its amplitudes."""
    spectra = replace(empty(12), noise=1.0)
    cost, settings = (FEWEST_TERMS - 1) * spectra.amplitude_cost, ContestSettings()
    tried: list[float] = []

    def read_on_body(*_: object) -> None:
        tried.append(own)

    monkeypatch.setattr("tagid.tags.bodies.on_body.read_on_body", read_on_body)
    bare = SimpleNamespace(status="identified", kind=Kind.BARE, layout="pair", body=None, centre_m=(0.0, 0.0))
    floor = BODY_LEAVES * spectra.noise_energy + settings.disputed_nats
    for own in (floor + 0.5 * cost, floor + 0.99 * cost, floor + 1.01 * cost):
        points = SimpleNamespace(layouts=[SimpleNamespace(layout="pair", left=own)], tag=0.0)
        assert undisputed(bare, points, spectra, LAYOUTS, settings) is bare
    assert tried == [floor + 1.01 * cost]


def test_every_arrangement_on_a_body_pays_for_its_amplitudes() -> None:
    rng = np.random.default_rng(8)
    spectra = empty(12)
    data = rng.standard_normal((9, 12)) + 1j * rng.standard_normal((9, 12))
    spectra = replace(spectra, data=centred(data), noise=2.0)
    settings = BodySettings()
    reading = read_on_body(spectra, LAYOUTS, settings.body, settings)
    assert reading is not None
    least = (FEWEST_TERMS - 1) * spectra.amplitude_cost
    for placed in (*reading.layouts, *reading.others):
        assert placed.charged - placed.left >= least * (1 - 1e-9)


def on_can(seed: int, snr_db: float) -> BasebandScans:
    """`container-90` of small reflectors on a can of our simulator, 4 mm off the axis."""
    rng, positions = np.random.default_rng(seed), builtin_layouts()["container-90"].positions
    small, can = ReflectorSpec("octahedron", 0.020), parse_body("can:33mm")
    placed = Placement((0.004, 0.0), 0.5 * seed)
    scene = object_scene("scene", positions, can, small, rng=rng)
    return scans_of(scene, Acquisition(views=36, snr_db=snr_db, placement=placed), seed)


def test_two_reflectors_in_one_place_are_no_rival(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pairs 8 to 13 mm apart in a layout's places fit noise a little better, and no object has them."""
    scans = on_can(34, snr_db=4.0)
    assert read_tag(scans, LAYOUTS).layout == "container-90"
    with monkeypatch.context() as without:
        for module in (reader, cylinder_reader):
            without.setattr(module, "can_stand", lambda *given: True)
        assert read_tag(scans, LAYOUTS).layout is None
    assert can_stand(np.deg2rad([0.0, 20.0, 180.0]), 0.045)
    assert not can_stand(np.deg2rad([0.0, 180.0, 355.0]), 0.045)
    assert can_stand(np.zeros(1), 0.045)


@pytest.mark.parametrize(
    ("early_m", "lead", "code"),
    [(0.045, 2.2, Code.NONE), (0.045, 1.8, Code.BODY), (0.065, 2.2, Code.BODY), (-0.070, 2.2, Code.BODY)],
)
def test_an_unstated_pulse_is_early_where_the_layout_leads_clearly(
    early_m: float, lead: float, code: Code
) -> None:
    found = read_on_body(Spectra.of(on_can(3, snr_db=20.0)), LAYOUTS, RoundBody(), BodySettings())
    assert found is not None and not found.through
    moved = replace(found, early_m=early_m, lead=lead, front_m=early_m + 0.030)
    assert decide_on_body(moved, BodyDecision()).code is code
