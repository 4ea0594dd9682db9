"""Tags beside round walls of known waves: full-wave cups and cans, which are not of this model's making."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from any_evidence import SETTINGS
from numpy.typing import NDArray

from tagid.fields.shells import Shell
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.simulate import Acquisition, Placement, simulate_capture
from tagid.simulate.presets import room_clutter
from tagid.simulate.response import Response
from tagid.simulate.response_file import read_response
from tagid.simulate.response_scene import response_scene
from tagid.tags.bodies import cylinder_reader
from tagid.tags.bodies.body_reading import BodyReading, BodySettings
from tagid.tags.bodies.cylinder_fit import CylinderFitter, Ringed
from tagid.tags.bodies.cylinder_patterns import Paths, Patterns
from tagid.tags.bodies.cylinder_reader import _CylinderReader, read_on_cylinder
from tagid.tags.bodies.decide import BodyDecision, decide_on_body, is_in_place
from tagid.tags.bodies.hypothesis import BodyModel, Pose
from tagid.tags.bodies.on_body import read_on_body
from tagid.tags.bodies.reflectors_fit import Solved, solve
from tagid.tags.bodies.revolution import RoundBody
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching import contest
from tagid.tags.matching.beside import borne_out, disputed, is_doubted
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.matcher import read_tag
from tagid.tags.verdicts.verdict import Code, Verdict
from train.calibrate import one

RESPONSES = Path(__file__).parents[1] / "data" / "responses"
LAYOUTS = list(builtin_layouts().values())


@cache
def response(name: str) -> Response:
    return read_response(RESPONSES / f"{name}.npz")


def spectra_of(
    name: str, polarisation: str, views: int = 36, snr_db: float = 20.0, reference: str = "free30_one"
) -> Spectra:
    """A solved object 6 mm off the axis, the antenna's distance wrong by 10 mm."""
    rng = np.random.default_rng(5)
    placed = Placement((0.004, -0.0045), 1.0)
    acquisition = Acquisition(views=views, snr_db=snr_db, placement=placed, axis_distance_error_m=0.01)
    scene = response_scene(response(name), acquisition, polarisation, response(reference), room_clutter(rng))
    capture, _ = simulate_capture(scene, acquisition, 7)
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    return Spectra.of(preprocess(capture, settings=settings))


def reading_of(spectra: Spectra) -> BodyReading | None:
    settings = BodySettings()
    first = read_on_body(spectra, LAYOUTS, RoundBody(), settings)
    assert first is not None
    return read_on_cylinder(spectra, LAYOUTS, first, settings)


def beside(spectra: Spectra) -> BodyReading:
    found = reading_of(spectra)
    assert found is not None
    return found


@pytest.mark.parametrize(("polarisation", "most"), [("V", 0.08), ("H", 0.12)])
def test_a_pair_on_a_ceramic_cup_is_told_from_every_other_arrangement(polarisation: str, most: float) -> None:
    """Upright, the wall comes out as well: 36 mm, 3 mm thick, of permittivity 5."""
    found = beside(spectra_of("cup36_c180", polarisation))
    assert found.layouts[0].layout == "container-180"
    assert found.unexplained < most and found.lead > 1
    assert found.wall is not None and found.wall.polarisation == polarisation
    if polarisation == "V":
        assert not found.wall.metal and found.wall.radius_m == pytest.approx(0.036, abs=3e-3)
    # The reflectors answer from where they are: the wrong distance is all that is left.
    assert abs(found.early_m) < 0.02
    off = (np.sort(found.layouts[0].angles) - np.deg2rad([0, 180]) - 1.0) % np.pi
    assert np.minimum(off, np.pi - off).max() < np.deg2rad(3)


def test_metal_is_told_from_ceramic() -> None:
    found = beside(spectra_of("can30_c180", "V"))
    assert found.layouts[0].layout == "container-180" and found.unexplained < 0.03
    assert found.wall is not None and found.wall.metal
    # Two amplitudes for the tag leave a radius that is less sharp.
    assert found.wall.radius_m == pytest.approx(0.030, abs=7e-3)


@pytest.mark.parametrize("name", ["can30_foreign", "cup36_one", "can40_one"])
@pytest.mark.parametrize("polarisation", ["V", "H"])
def test_other_tags_on_round_bodies_are_other_arrangements(name: str, polarisation: str) -> None:
    found = reading_of(spectra_of(name, polarisation, reference="free20_foreign"))
    assert found is None or found.lead < 0


@pytest.mark.parametrize("name", ["box_c90", "handle34_c90"])
def test_bodies_that_are_not_round_are_not_explained(name: str) -> None:
    found, decision = reading_of(spectra_of(name, "V")), BodyDecision()
    assert found is None or (
        found.unexplained > 0.199 and decide_on_body(found, decision).status == "unknown"
    )


def test_a_tag_on_a_cup_is_named_with_few_views_and_in_noise() -> None:
    """Free patterns need 30 views for five terms, and find an arrangement of four that is as good."""
    for views, snr_db in ((18, 20.0), (18, 10.0), (24, 10.0)):
        rng = np.random.default_rng(3)
        acquisition = Acquisition(views=views, snr_db=snr_db, placement=Placement((0.003, 0.002), 0.4))
        scene = response_scene(
            response("cup36_c180"), acquisition, "V", response("free30_one"), room_clutter(rng)
        )
        capture, _ = simulate_capture(scene, acquisition, 3)
        settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
        reading = read_tag(preprocess(capture, settings=settings), LAYOUTS, SETTINGS)
        assert (reading.status, reading.layout) == ("identified", "container-180")
        assert reading.body is not None and reading.body.wall is not None


@pytest.mark.parametrize("views", [12, 36])
def test_the_search_keeps_starts_that_the_fit_cannot_reach(views: int) -> None:
    """It moves to other walls of a polarisation: with 12 views cans were lost to the other one."""
    few = views < 24
    spectra = spectra_of("can30_c180", "V", views)
    first = read_on_body(spectra, LAYOUTS, RoundBody(), BodySettings())
    assert first is not None
    reader = _CylinderReader(spectra, 0.045, 0.0, LAYOUTS[:2], first, BodySettings())
    shells = reader.fitter.patterns.shells
    every = [(polarisation, metal) for polarisation in "VH" for metal in (True, False)]

    def start(of: tuple[str, bool], layout: str | None, left: float, angles: tuple[float, ...]) -> Ringed:
        shell = next(i for i, one in enumerate(shells) if (one.polarisation, one.metal) == of)
        radii = np.full(len(angles), 0.045)
        return Ringed(shell, 0j, 0.0, np.array(angles), radii, 0 * radii, layout, left)

    best = [start(every[0], "container-180", 0.1 * i, (0.1 * i, np.pi + 0.1 * i)) for i in range(4)]
    others = [start(every[0], None, 1 + i, (0.0, 0.4 + 0.34 * i)) for i in range(8)]
    worse = [start(of, "container-180", 50.0, (0.0, np.pi)) for of in every[1:]]
    worst = [start(of, None, 60.0, (0.0, 0.4)) for of in every[1:]]
    kept = reader._kept([*worst, *worse, *others, *best])
    assert kept[0] is best[0] and any(best[1] is row for row in kept)
    assert not any(one is row for one in best[2:] for row in kept)
    assert all(any(one is row for row in kept) for one in others)
    assert all(any(one is row for row in kept) == few for one in worse)
    # Of another kind than the best 12, and in another polarisation or material.
    assert all(any(one is row for row in kept) == few for one in worst)
    assert len(kept) == (16 if few else 10)


@pytest.mark.parametrize(("snr_db", "level"), [(6.0, 1.6), (3.0, 0.8)])
def test_walls_are_asked_where_little_stands_out_of_the_noise(snr_db: float, level: float) -> None:
    """Whose level is known to a quarter: below it there is no share of the echo to be explained."""
    spectra = spectra_of("cup36_c180", "V", snr_db=snr_db)
    found = beside(replace(spectra, noise=level * spectra.noise))
    assert found.layouts[0].layout == "container-180" and found.lead > 0.1


def test_what_chance_adds_to_the_noise_is_no_error_of_the_model() -> None:
    spectra = spectra_of("cup36_c180", "V", snr_db=10.0)
    found = beside(spectra)
    above = found.unexplained * found.tag
    settings, spread = BodySettings(), spectra.noise_spread
    assert spread == pytest.approx(spectra.noise_energy / np.sqrt(9 * 35), rel=1e-6)
    # Its level is known to an eighth.
    assert spectra.noise_doubt == pytest.approx(np.hypot(spread, 0.12 * spectra.noise_energy), rel=1e-6)
    assert above > 0
    error = max(above - spread, 0.0) + settings.priors.model_error * found.tag
    assert found.error == pytest.approx(error + settings.noise_nats * spectra.noise)


def test_delays_count_amplitudes_by_what_the_noise_lets_be_known() -> None:
    """Frequencies that the wall hides carry noise alone, however large the amplitudes that explain it."""
    spectra = spectra_of("cup36_c180", "V")
    energy = np.ones(len(spectra.wavenumbers))
    energy[:3] = 1e-3
    response = np.exp(1j * spectra.wavenumbers * 0.02)
    response[:3] = 30 * np.exp(1j * spectra.wavenumbers[:3] * -0.07)
    gram = np.zeros((1, len(energy), 3, 3))
    gram[0, :, 1, 1] = gram[0, :, 2, 2] = energy / 2
    amplitudes = np.stack([0 * response, response, response], axis=1)[None]
    solved = cast("Solved", SimpleNamespace(gram=gram, amplitudes=amplitudes))
    assert cylinder_reader._early_m(spectra, solved) == pytest.approx(0.02, abs=0.003)
    assert abs(spectra.early_m(response) - 0.02) > 0.01


def test_delays_are_those_of_the_mix_of_dipoles_that_sends_most() -> None:
    """Beside a cup, the dipoles' sum answered from 90 mm behind, the stronger one where it stood."""
    spectra = spectra_of("cup36_c180", "V")
    sent = np.exp(1j * spectra.wavenumbers * 0.02)
    stray = 0.1 * np.exp(1j * spectra.wavenumbers * -0.09)
    gram = np.broadcast_to(np.array([[2.0, 0.5j], [-0.5j, 1.0]]), (1, len(sent), 2, 2))
    whole = np.zeros((1, len(sent), 3, 3), dtype=np.complex128)
    whole[:, :, 1:, 1:] = gram
    # What either column sends on average cancels in their sum.
    mix = np.array([1.0, -(2.0 - 0.5j) / (1.0 + 0.5j)])
    dipoles = sent[:, None] * mix + stray[:, None] * np.array([1.0, 0.0])
    amplitudes = np.concatenate([0 * sent[:, None], dipoles], axis=1)[None]
    solved = cast("Solved", SimpleNamespace(gram=whole, amplitudes=amplitudes))
    assert spectra.early_m((gram[0] @ dipoles[..., None]).sum(axis=(-1, -2))) < -0.05
    assert cylinder_reader._early_m(spectra, solved) == pytest.approx(0.02, abs=0.005)


def test_a_wall_must_bear_out_a_pattern_of_many_free_terms() -> None:
    """The same layout ahead of all others beside a wall, which may be thicker than those tried."""
    beside_wall, decision = beside(spectra_of("cup36_c180", "V")), BodyDecision()
    named = replace(beside_wall, through=True, wall=None)
    assert borne_out(named, beside_wall, decision)
    assert borne_out(named, replace(beside_wall, unexplained=0.25), decision)
    assert not borne_out(named, replace(beside_wall, unexplained=0.35), decision)
    assert not borne_out(named, replace(beside_wall, lead=0.1), decision)
    assert not borne_out(named, None, decision)
    other = replace(beside_wall, layouts=beside_wall.layouts[1:])
    assert other.layouts and not borne_out(named, other, decision)


def test_a_wall_and_reflectors_that_cancel_each_other_name_nothing() -> None:
    """A helmet's tag of 18 views was fitted by a pair beside a small glass, each as loud as their sum."""
    own, decision = beside(spectra_of("cup36_c180", "V")), BodyDecision()
    assert own.body_energy + own.body_left < 1.5 * own.energy
    for lead, times, status in (
        (1.9, 1.5, "identified"),
        (1.9, 1.7, "unknown"),
        (2.1, 1.7, "identified"),
        (2.1, 1.8, "unknown"),
    ):
        loud = replace(own, lead=lead, body_energy=times * own.energy - own.body_left)
        verdict = decide_on_body(loud, decision)
        assert verdict.status == status
        assert ("would undo" in verdict.reason) == (status == "unknown")


def test_reflectors_behind_a_wall_that_the_wave_passes_answer_from_their_places() -> None:
    """Neighbours on a crate passed for an opposite pair that answered from 44 and 56 mm behind its places."""
    # Pairs are held closer, see `test_a_pair_beside_a_glass_answers_from_its_place`.
    own, decision = beside(spectra_of("cup36_c180", "V")), BodyDecision(pair_lead=0.0)
    named = replace(own, through=True, wall=None)
    assert own.through
    for lead, early_m, is_named in (
        (0.6, -0.038, True),
        (0.6, -0.044, False),
        (1.1, -0.056, True),
        (2.1, -0.056, True),
        (0.6, 0.048, True),
        (0.6, 0.054, False),
        (1.1, 0.062, True),
    ):
        late = replace(own, lead=lead, early_m=early_m)
        assert (decide_on_body(late, decision).status == "identified") == is_named
        assert borne_out(named, late, decision) == is_named
        # What stands beside metal is held alike.
        assert is_in_place(replace(late, through=False), decision) == is_named
    assert decide_on_body(replace(own, lead=2.1, early_m=-0.07), decision).status == "unknown"
    # A pulse that is later than at the enrolment delays the body as well.
    known = replace(own, lead=0.6, early_m=-0.07, front_m=-0.04, body_energy=0.5 * own.energy)
    assert not is_in_place(known, decision)
    body = SimpleNamespace(name="mug", turns=True)
    assert is_in_place(replace(known, body=cast("BodyModel", body)), decision)
    ahead = replace(known, early_m=0.072, front_m=0.036)
    assert not is_in_place(ahead, decision)
    assert is_in_place(replace(ahead, body=cast("BodyModel", body)), decision)
    assert not is_in_place(replace(ahead, early_m=0.105, body=cast("BodyModel", body)), decision)


def test_a_wall_speaks_against_a_free_pattern_where_it_explains_the_echo() -> None:
    """One reflector and a mug's handle passed for a layout on the enrolled mug, by 0.4."""
    beside_wall = beside(spectra_of("cup36_c180", "V"))
    named = replace(beside_wall, wall=None)
    assert not disputed(named, beside_wall) and not disputed(named, None)
    assert not disputed(named, replace(beside_wall, lead=0.1))
    doubted = replace(beside_wall, lead=-0.1)
    assert disputed(named, doubted)
    other = replace(beside_wall, layouts=beside_wall.layouts[1:])
    assert other.layouts and disputed(named, other)
    # A wall beside which nothing explains the echo has no say.
    least = beside_wall.noise + 0.4 * beside_wall.tag
    far = tuple(replace(placed, left=max(placed.left, least)) for placed in beside_wall.layouts)
    assert not disputed(named, replace(doubted, layouts=far, others=()))


def test_walls_take_back_a_name_on_a_can_that_others_explain_better() -> None:
    """Three reflectors on a can passed for two of them by 0.7, with a free pattern."""
    beside_wall = beside(spectra_of("can40_c90", "V"))
    named = replace(beside_wall, wall=None, through=False, lead=0.7)
    right, contest_settings = Verdict("identified"), ContestSettings()
    assert is_doubted(named, right, False)
    assert not is_doubted(replace(named, lead=1.2), right, False)
    assert is_doubted(replace(named, lead=1.2, through=True), right, False)
    known = cast("contest._Bare", None)
    for other, status in ((beside_wall, "identified"), (replace(beside_wall, lead=-0.5), "unknown")):
        kept, verdict = contest._after_wall(known, named, right, other, LAYOUTS, contest_settings)
        assert kept is named and verdict.status == status
    assert verdict.code is Code.OTHER


def test_walls_between_those_of_the_family_hold_one_that_is_not_in_it() -> None:
    """A mug of 33.1 mm, 3.5 mm of permittivity 8.5: the family has 32 and 34 mm, 2.5 and 4.5 mm."""
    spectra = spectra_of("cup36_c180", "V")
    family = Patterns.of(spectra, 0.045)
    cup = Shell(0.0331, 3.5e-3, 8.5, False)
    one = np.ones((1, 2))
    paths = Paths.of(spectra, np.zeros(1, complex), 0.045 * one, np.array([[0.4, 2.0]]), 0 * one)

    def columns(patterns: Patterns, wall: int) -> NDArray[np.complex128]:
        return np.asarray(patterns.columns(paths, np.array([wall]))[:, 0].sum(axis=2))

    true = family.beside(spectra, (cup,))
    made = replace(spectra, data=centred(columns(true, 0)[0]))
    left = [_left(made, columns(family, i)) for i in range(len(family.shells))]
    best = int(np.argmin(left))
    finer = family.finer(spectra, [best])
    assert family.shells[best] in finer.shells
    assert all(one.polarisation == "V" and not one.metal for one in finer.shells)
    least = min(_left(made, columns(finer, i)) for i in range(len(finer.shells)))
    assert least < 0.02 < 0.08 < left[best]


@pytest.mark.parametrize("centre", [0j, 0.004 - 0.005j])
def test_the_centre_of_a_wall_is_found_beside_its_handle(centre: complex) -> None:
    """On the rotation axis, too, where only the handle moves; a pose is known to within 3 mm of it."""
    spectra, body = spectra_of("cup36_c180", "V"), RoundBody()
    wall = body.echo(spectra, np.array([centre]), np.zeros(1))[0]
    handle = body.echo(spectra, np.array([centre + 0.06j]), np.zeros(1))[0]
    found = body.middle(spectra, wall + 0.5 * handle, centre + 0.002 + 0.002j)
    assert abs(found.pose.centre - centre) < 1e-3
    assert 0.1 < found.left < 0.3


def test_an_enrolled_wall_holds_the_centre_of_the_tag() -> None:
    """Free of it, a pair 163 degrees apart passes for an opposite one about a centre 6 mm off."""
    spectra = spectra_of("cup36_c180", "V")
    patterns = Patterns.of(spectra, 0.045)
    angles, radii = np.array([1.0, 1.0 + np.pi]), np.full(2, 0.045)
    start = Ringed(0, 0.004 - 0.0045j, 0.0, angles, radii, np.zeros(2), "pair")
    moved = []
    for spread_m in (8e-3, 1e-5):
        fitter = CylinderFitter(spectra, patterns, RoundBody(), 0.01 - 0.01j, spread_m, 10 * spectra.noise)
        moved.append(abs(fitter.fitted([start], 4)[0].centre - (0.01 - 0.01j)))
    assert moved[1] < 1e-3 < 3e-3 < moved[0]


@pytest.mark.parametrize(
    ("explained", "tag", "is_known"), [(100.0, 150.0, True), (40.0, 150.0, False), (40.0, 30.0, True)]
)
def test_a_wall_that_noise_and_tag_hide_tells_no_centre(explained: float, tag: float, is_known: bool) -> None:
    """The pose of a filled cup, 40 variances of the noise beside a tag of 110, was 10 mm wrong."""
    spectra, body, centre = spectra_of("cup36_c180", "V"), RoundBody(), 0.004 - 0.005j
    wall = body.echo(spectra, np.array([centre]), np.zeros(1))[0]
    first = SimpleNamespace(
        energy=900.0 + explained,
        body_left=900.0,
        tag=tag,
        variance=1.0,
        pose=Pose((0.005, -0.004)),
        body=body,
    )
    searched = SimpleNamespace(spectra=spectra, first=first, settings=BodySettings())
    found, spread_m = _CylinderReader._expected(cast("_CylinderReader", searched), wall)
    if is_known:
        assert abs(found - centre) < 1e-3 and spread_m == cylinder_reader.MOUNTED_M
    else:
        assert (found, spread_m) == (0j, BodySettings().priors.centre_m)


def test_what_free_patterns_found_is_tried_beside_walls(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search on the ring missed a pair 110 degrees apart on a can; a right angle led by 0.9."""
    monkeypatch.setattr(cylinder_reader, "HOPEFUL", 0.0)
    monkeypatch.setattr(_CylinderReader, "_others_about", lambda *_: [])
    found = beside(spectra_of("can30_foreign", "V"))
    assert found.others and found.others[0].layout is None and found.lead < -0.5


def test_the_wall_of_an_oval_shell_is_no_pair_beside_a_round_one() -> None:
    """With two amplitudes it is one in everything but that it answers from 6 cm before the pair's places."""
    assert one(974605)["body"] == "refused"


def test_one_reflector_beside_a_cup_has_the_pattern_of_its_wall() -> None:
    """In range and angle, against the solved one: half of it is the lens, which no free wave has."""
    tag = response("cup36_one").without(response("cup36"))
    ring = next(i for i, one in enumerate(tag.rings) if one.polarisation == "V")
    band = (tag.frequency_hz > 3.1e9) & (tag.frequency_hz < 4.8e9)
    echo = tag.scattering_length_m[band, ring].astype(np.complex128)
    angles = 2 * np.pi * np.arange(tag.aspects) / tag.aspects
    distance = tag.rings[ring].distance_m
    antenna = np.asarray(distance * np.exp(1j * angles), dtype=np.complex128)
    spectra = Spectra(centred(echo), 2 * tag.wavenumber[band], antenna, 0 * angles, distance, 0.0)
    patterns = Patterns.of(spectra, 0.045)
    one = np.ones((1, 1))
    paths = Paths.of(spectra, np.zeros(1, complex), 0.045 * one, 0 * one, 0 * one)
    beside = [patterns.columns(paths, np.array([i]))[:, 0, :, 0] for i in range(len(patterns.shells))]
    left = [_left(spectra, columns[:1]) for columns in beside]
    best = patterns.shells[int(np.argmin(left))]
    assert min(left) < 0.10 < 0.25 < _left(spectra, paths.waves[:, :, 0])
    # A reflector answers both fields.
    assert _left(spectra, beside[int(np.argmin(left))]) < 0.8 * min(left)
    assert (best.metal, best.polarisation) == (False, "V") and abs(best.radius_m - 0.036) < 3e-3


def _left(spectra: Spectra, columns: NDArray[np.complex128]) -> float:
    """Share of the echo that amplitudes per frequency of columns (C, F, V) leave."""
    found = solve(spectra.data, centred(columns.swapaxes(0, 1))[None])
    return float(found.left[0]) / spectra.energy
