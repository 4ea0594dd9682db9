"""Reflectors before a round wall: the pattern against solved waves, and what tells a pair from neighbours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import h2vp, hankel2, jv, jvp

from tagid.constants import SPEED_OF_LIGHT
from tagid.fields.shells import Shell
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.simulate import Acquisition, Placement, Wobble, simulate_capture
from tagid.simulate.response import Response
from tagid.simulate.response_file import read_response
from tagid.simulate.response_scene import response_scene
from tagid.tags.bodies import on_body
from tagid.tags.bodies import reader as reader_module
from tagid.tags.bodies.body_reading import BodyReading, BodySettings
from tagid.tags.bodies.decide import BodyDecision, decide_on_body
from tagid.tags.bodies.hypothesis import BodyModel, Candidate, Enrolled, Explanation, Kind, Pose
from tagid.tags.bodies.neighbours import lefts_before_walls
from tagid.tags.bodies.on_body import read_on_body
from tagid.tags.bodies.points import PointReading
from tagid.tags.bodies.reader import BodyReader
from tagid.tags.bodies.reflectors_fit import POINTS
from tagid.tags.bodies.revolution import RoundBody
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.bodies.starts import Row, Start
from tagid.tags.bodies.wall import METAL, SERIES, Material, Wall, series
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching import contest
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.matcher import read_tag
from tagid.tags.matching.reading import Reading
from tagid.tags.verdicts.verdict import Code, Verdict

RESPONSES = Path(__file__).parents[1] / "data" / "responses"
KAPPA = 4 * np.pi / SPEED_OF_LIGHT * 2e8 * np.arange(16, 25)
PSI = np.linspace(0, np.pi, 37)
TURN_DEG = 10.0
AIR = Material(0.001, 1.0)
METAL_WALL = Shell(0.035, 0.001, 1.0, metal=True, polarisation="H")
POSE = Pose((0.003, -0.004), 1.1)


@cache
def response(name: str) -> Response:
    return read_response(RESPONSES / f"{name}.npz")


def tag_of(one: str, body: str) -> Response:
    """What one reflector adds to its body."""
    return response(one).without(response(body))


def tagged(*degrees: float, on: str = "handle34") -> Response:
    """A mug with a handle and, at each angle, what one reflector adds to a can; coupling is left out."""
    body, added = response(on), tag_of("can40_one", "can40").scattering_length_m
    m = np.fft.fftfreq(added.shape[2], 1 / added.shape[2])
    turns = sum(np.exp(-1j * m * np.deg2rad(a + TURN_DEG)) for a in degrees)
    values = body.scattering_length_m + np.fft.ifft(np.fft.fft(added, axis=2) * turns, axis=2)
    return replace(body, scattering_length_m=values.astype(np.complex64))


def waves(wall: Wall) -> NDArray[np.complex128]:
    """(F, 2, V) patterns of a wall over PSI."""
    return np.asarray(series(KAPPA, [wall])[0] @ np.cos(np.outer(np.arange(SERIES), PSI)))


def along(one: NDArray[np.complex128], other: NDArray[np.complex128]) -> float:
    """Cosine of the angle between two patterns."""
    return float(abs(np.vdot(one, other)) / np.linalg.norm(one) / np.linalg.norm(other))


def test_without_a_wall_a_reflector_looks_alike_from_all_sides() -> None:
    upright = waves(Wall(False, 0.045, 0.01, AIR))
    assert np.abs(upright[:, 0] - upright[0, 0, 0]).max() < 1e-5
    assert along(upright[3, 1], np.cos(PSI) ** 2 + 0j) > 0.99999
    across = waves(Wall(True, 0.045, 0.01, AIR))
    assert along(across[3, 0], np.cos(PSI) ** 2 + 0j) > 0.99999
    assert along(across[3, 1], np.sin(PSI) ** 2 + 0j) > 0.99999


@pytest.mark.parametrize("horizontal", [False, True])
def test_a_dense_sheet_is_metal(horizontal: bool) -> None:
    metal, dense = (waves(Wall(horizontal, 0.045, 0.01, made)) for made in (METAL, Material(1e-6, 1e8)))
    assert np.abs(metal - dense).max() < 1e-3


def test_the_field_of_a_metal_cylinder_is_that_of_its_series() -> None:
    wall = Wall(False, 0.047, 0.012, METAL)
    n = np.arange(40)
    k = KAPPA[4] / 2
    x, y = k * 0.035, k * 0.047
    inner, weight = -jv(n, x) / hankel2(n, x), 1j**n * np.where(n > 0, 2, 1)
    turned = np.cos(np.outer(n, PSI))
    phase = np.exp(-2j * y * np.cos(PSI))
    field = (weight * (jv(n, y) + inner * hankel2(n, y))) @ turned
    slope = (weight * (jvp(n, y) + inner * h2vp(n, y))) @ turned
    found = waves(wall)[4]
    assert along(found[0], field**2 * phase) > 0.99999
    assert along(found[1], slope**2 * phase) > 0.99999


@pytest.mark.parametrize(
    ("one", "body", "polarisation", "wall", "most"),
    [
        ("can40_one", "can40", "V", Wall(False, 0.049, 0.009, METAL), 0.01),
        ("can40_one", "can40", "H", Wall(True, 0.049, 0.009, METAL), 0.07),
        ("cup36_one", "cup36", "V", Wall(False, 0.045, 0.009, Material(0.003, 5.0)), 0.10),
        ("cup36_one", "cup36", "H", Wall(True, 0.045, 0.009, Material(0.003, 5.0)), 0.08),
    ],
)
def test_two_amplitudes_hold_a_solved_reflector_before_its_wall(
    one: str, body: str, polarisation: str, wall: Wall, most: float
) -> None:
    """As many free cosines leave twice as much or more."""
    added = tag_of(one, body)
    angle = 2 * np.pi * np.arange(72) / 72
    antennas = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    kappa = 2 * added.wavenumber[4:17]
    echo = added.seen_from(antennas, polarisation).T[4:17]
    distance = np.abs(np.exp(1j * angle) - wall.radius_m)
    psi = np.angle(np.exp(1j * angle) - wall.radius_m)
    carrier = np.exp(-1j * kappa[:, None] * (distance - 1)) / distance**2
    cosines = np.cos(np.outer(np.arange(SERIES), psi))

    def left(patterns: NDArray[np.complex128]) -> float:
        rest = 0.0
        for values, wave, columns in zip(echo, carrier, patterns, strict=True):
            own = (columns * wave).T
            rest += float(np.linalg.norm(values - own @ np.linalg.lstsq(own, values, rcond=None)[0]) ** 2)
        return rest / float(np.linalg.norm(echo) ** 2)

    walled = left(series(kappa, [wall])[0] @ cosines)
    free = left(np.broadcast_to(cosines[:2], (len(kappa), 2, len(angle))).astype(np.complex128))
    assert walled < most
    assert walled < free / 2


class Solved:
    """A solved body that is known exactly, where it stands."""

    turns, slack_m, turning_share = True, 5e-3, 0.3

    def __init__(self, polarisation: str, name: str = "handle34") -> None:
        self.polarisation = polarisation
        self.name = name

    def poses(self, spectra: Spectra) -> list[Candidate]:
        echo = self.echo(spectra, np.array([POSE.centre]), np.array([POSE.turn_rad]))[0]
        echo = echo - echo.mean(axis=1, keepdims=True)
        level = (echo.conj() * spectra.data).sum(axis=1) / (np.abs(echo) ** 2).sum(axis=1)
        return [Candidate(POSE, float((np.abs(spectra.data - level[:, None] * echo) ** 2).sum()))]

    def seen(self, *given: object) -> None:
        return None

    def echo(
        self, spectra: Spectra, centres: NDArray[np.complex128], turns: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        own = response(self.name)
        kappa = 2 * own.wavenumber
        found = []
        for centre, turn in zip(centres, turns, strict=True):
            place = (spectra.antenna - centre) * np.exp(-1j * turn)
            seen = own.seen_from(
                np.stack([place.real, place.imag, 0 * place.real], axis=1), self.polarisation
            )
            values = np.stack(
                [np.interp(spectra.wavenumbers, kappa, one) for one in seen * np.exp(-0.03j * kappa)], axis=1
            )
            near = (spectra.distance_m / np.abs(place)) ** 2
            late = np.exp(-1j * spectra.wavenumbers[:, None] * (np.abs(place) - spectra.distance_m - 0.03))
            found.append(values * late * near)
        return np.array(found)


def scans_of(thing: Response, polarisation: str, snr_db: float, seed: int, views: int = 36) -> BasebandScans:
    """Of an uneven turn."""
    acquisition = Acquisition(
        views=views,
        snr_db=snr_db,
        placement=Placement(POSE.centre_m, POSE.turn_rad),
        wobble=Wobble(speed=0.01),
    )
    scene = response_scene(thing, acquisition, polarisation, response("free30_one"), None)
    capture, _ = simulate_capture(scene, acquisition, seed)
    return preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))


def spectra_of(thing: Response, polarisation: str, snr_db: float, seed: int) -> Spectra:
    return Spectra.of(scans_of(thing, polarisation, snr_db, seed))


def read(thing: Response, polarisation: str, settings: BodySettings, snr_db: float, seed: int) -> BodyReading:
    spectra = spectra_of(thing, polarisation, snr_db, seed)
    found = read_on_body(spectra, list(builtin_layouts().values()), Solved(polarisation), settings)
    assert found is not None
    return found


def read_on_box(carried: str, snr_db: float, views: int) -> BodyReading:
    spectra = Spectra.of(scans_of(response(f"box60_{carried}"), "V", snr_db, 2, views))
    layouts = list(builtin_layouts().values())
    found = read_on_body(spectra, layouts, Solved("V", "box60"), BodySettings())
    assert found is not None
    assert found.layouts[0].layout == "container-180"
    assert found.unexplained < 0.05
    return found


@pytest.mark.parametrize(("snr_db", "views"), [(20.0, 36), (10.0, 36), (20.0, 24)])
def test_neighbours_on_the_faces_of_a_box_are_not_one_reflector_each(snr_db: float, views: int) -> None:
    """Octahedra 29 mm apart on opposite faces do not shine outward, each along its own radius."""
    assert read_on_box("quad", snr_db, views).lead < BodyDecision().lead
    assert read_on_box("c180", snr_db, views).lead > 2 * BodyDecision().lead


@pytest.mark.parametrize("seed", [3, 7])
def test_neighbours_no_longer_hide_a_pair_on_a_metal_mug(seed: int) -> None:
    """Polarised horizontally, neighbours 42 degrees apart imitate the pair by patterns that are free."""
    settings = BodySettings()
    found = read(tagged(0, 180), "H", settings, 20.0, seed)
    assert found.layouts[0].layout == "container-180"
    assert found.lead >= BodyDecision().lead
    free = read(tagged(0, 180), "H", replace(settings, nested_lead=0.0), 20.0, seed)
    assert 0 < free.lead < BodyDecision().lead
    assert len(free.others[0].angles) == 4


def test_neighbours_in_place_of_a_pair_are_tried_where_the_search_missed_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a full-wave can, in one of eight recordings; the pair led by 3.5 and was named."""
    layouts, settings = list(builtin_layouts().values()), BodySettings()
    spectra = spectra_of(tagged(0, 45, 180, 225, on="can40"), "V", 10.0, 3)

    def two_at_most(reader: BodyReader, starts: list[Start], *patterns: object) -> list[Row]:
        return free_rows(reader, [start for start in starts if len(start.angles) <= 2])

    free_rows = BodyReader._free_rows
    monkeypatch.setattr(BodyReader, "_free_rows", two_at_most)
    monkeypatch.setattr(BodyReader, "_rigid_rows", lambda *given: [])
    found = read_on_body(spectra, layouts, RoundBody(), settings)
    monkeypatch.setattr(BodyReader, "_halved", lambda *given: [])
    without = read_on_body(spectra, layouts, RoundBody(), settings)
    assert found is not None and without is not None
    assert found.layouts[0].layout == without.layouts[0].layout == "container-180"
    assert found.lead < 0 < BodyDecision().lead < without.lead


@pytest.mark.parametrize("polarisation", ["V", "H"])
@pytest.mark.parametrize("apart", [40, 46, 52])
def test_before_a_wall_neighbours_and_a_pair_are_told_from_each_other(polarisation: str, apart: int) -> None:
    angles = {2: np.array([0.0, 180.0]), 4: np.array([0, apart, 180, 180 + apart]) - apart / 2}
    layout = builtin_layouts()["container-180"]
    for count, own in angles.items():
        spectra = spectra_of(tagged(*own), polarisation, 20.0, 1)
        body = Solved(polarisation)
        reader = BodyReader(spectra, [layout], body, BodySettings(), body.poses(spectra))
        rows = []
        for some in angles.values():
            turned = np.deg2rad(some + TURN_DEG) + POSE.turn_rad
            start = Start(0.0, POSE.centre, 0.045, tuple(turned))
            rows.append(reader._ring_row(start, POINTS, free=True))
        pair, quad = lefts_before_walls(reader.fitter, rows, 0.045).min(axis=1)
        assert (pair < quad) == (count == 2)


def test_an_echo_that_is_polarised_upright_shows_it() -> None:
    """By this the reader knows that neighbours are no artefact of a pattern that is too simple."""
    layout, shares = builtin_layouts()["container-180"], []
    for polarisation in ("V", "H"):
        spectra = spectra_of(tagged(0, 180), polarisation, 20.0, 3)
        body = Solved(polarisation)
        reader = BodyReader(spectra, [layout], body, BodySettings(), body.poses(spectra))
        angles = tuple(np.deg2rad([TURN_DEG, 180 + TURN_DEG]) + POSE.turn_rad)
        row = reader._ring_row(Start(0.0, POSE.centre, 0.045, angles), POINTS, free=True)
        upright, horizontal = lefts_before_walls(reader.fitter, [row], 0.045)[0]
        shares.append((horizontal - upright) / (reader.poses[0].left - min(upright, horizontal)))
    assert shares[0] > BodySettings().upright_share > shares[1]


def test_with_few_views_neighbours_are_not_compared_before_a_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 18 views, neighbours on one face of a box passed for a pair by it."""
    asked: list[int] = []
    monkeypatch.setattr(reader_module, "led_before_wall", lambda *given: bool(asked.append(1)))
    layouts, settings = list(builtin_layouts().values()), BodySettings(nested_lead=0.4)
    for views in (24, 36):
        asked.clear()
        spectra = Spectra.of(scans_of(tagged(0, 180), "H", 20.0, 3, views))
        found = read_on_body(spectra, layouts, Solved("H"), settings)
        assert found is not None
        assert bool(asked) == (views == 36)


def test_a_body_that_explains_the_echo_alone_leaves_no_name_to_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An untagged box was "identified" as no layout: by the verdict on a round body that only imitates it."""
    layouts = list(builtin_layouts().values())
    scans = scans_of(tagged(0, 180), "H", 20.0, 3)
    own = read(tagged(0, 180), "H", BodySettings(), 20.0, 3)

    def verdict(reading: BodyReading, settings: BodyDecision) -> Verdict:
        if reading.body.name:
            return Verdict("no_tag", Code.NO_TAG, "the body alone")
        return Verdict("identified")

    def read_on(spectra: Spectra, layouts: object, body: BodyModel, *rest: object) -> BodyReading:
        less = replace(own.layouts[0], left=own.layouts[0].left * (1.0 if body.name else 0.5))
        return replace(own, body=body, layouts=(less, *own.layouts[1:]))

    monkeypatch.setattr(on_body, "read_on_body", read_on)
    monkeypatch.setattr(contest, "decide_on_body", verdict)
    monkeypatch.setattr(contest, "_shows", lambda *given: True)
    monkeypatch.setattr(contest, "kept", lambda bound, verdict: verdict)
    enrolled = Enrolled((Solved("H"),))
    answer = read_tag(scans, layouts, enrolled=enrolled)
    assert answer.status != "identified" or answer.layout is not None
    assert (answer.status, answer.code) == ("no_tag", Code.NO_TAG)


def contested(
    monkeypatch: pytest.MonkeyPatch,
    read_on: Callable[..., BodyReading],
    verdict: Callable[..., Verdict],
    beside: Callable[..., BodyReading | None],
) -> Reading:
    """The answer where a round body and an enrolled mug show, and these say what stands on them."""
    monkeypatch.setattr(on_body, "read_on_body", read_on)
    monkeypatch.setattr(contest, "decide_on_body", verdict)
    monkeypatch.setattr(contest, "borne_out", lambda *given: True)
    monkeypatch.setattr(contest, "read_beside_wall", beside)
    monkeypatch.setattr(contest, "_shows", lambda *given: True)
    monkeypatch.setattr(contest, "kept", lambda bound, verdict: verdict)
    scans = scans_of(tagged(0, 180), "H", 20.0, 3)
    return read_tag(scans, list(builtin_layouts().values()), enrolled=Enrolled((Solved("H"),)))


@pytest.mark.parametrize(
    ("ahead", "layout", "status"),
    [
        (1.5, "container-180", "unknown"),
        (0.5, "container-180", "identified"),
        (0.7, "container-180", "identified"),
        (0.7, "container-90", "unknown"),
        (0.4, "container-90", "identified"),
    ],
)
def test_an_enrolled_body_that_explains_more_refuses_a_name_on_a_round_one(
    ahead: float, layout: str, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 24 views neighbours on a box were a pair on a round body, which left seventeen times more."""
    own = read(tagged(0, 180), "H", BodySettings(), 20.0, 3)

    def verdict(reading: BodyReading, settings: BodyDecision) -> Verdict:
        return Verdict("unknown", Code.OTHER, "neighbours") if reading.body.name else Verdict("identified")

    def read_on(spectra: Spectra, layouts: object, body: BodyModel, *rest: object) -> BodyReading:
        least = min(placed.charged for placed in (*own.layouts, *own.others))
        left = own.layouts[0].left if body.name else least + ahead * own.error
        best = replace(own.layouts[0], left=left, layout=layout if body.name else own.layouts[0].layout)
        return replace(own, body=body, layouts=(best, *own.layouts[1:]))

    answer = contested(monkeypatch, read_on, verdict, lambda *given: None)
    assert answer.status == status
    assert ("the enrolled body handle34 explain the echo better" in answer.reason) == (status == "unknown")


@pytest.mark.parametrize(
    ("known", "layout", "status"),
    [(True, None, "unknown"), (True, "container-180", "identified"), (False, None, "identified")],
)
def test_what_stands_beside_the_wall_of_an_enrolled_body_refuses_another_name_on_a_round_one(
    known: bool, layout: str | None, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A handle and one reflector were `container-90` on a round body; only beside its wall the mug led.

    With the same layout the wall of its own body leads in any case: that bears the name out.
    """
    own = read(tagged(0, 180), "H", BodySettings(), 20.0, 3)
    least = min(placed.charged for placed in (*own.layouts, *own.others))
    named = replace(own, body=RoundBody(), layouts=(replace(own.layouts[0], left=least), *own.layouts[1:]))

    def verdict(reading: BodyReading, settings: BodyDecision) -> Verdict:
        return Verdict("unknown", Code.OTHER, "one reflector") if reading.body.name else Verdict("identified")

    def beside(reading: BodyReading, *rest: object) -> BodyReading | None:
        ahead = 0.6 if layout is None else 5.0
        led = replace(own.layouts[0], layout=layout, charged=least - ahead * own.error)
        asked = bool(reading.body.name) == known
        walled = replace(own, body=Solved("H"), others=(led, *own.others), wall=METAL_WALL)
        return walled if asked else None

    def read_on(spectra: Spectra, layouts: object, body: BodyModel, *rest: object) -> BodyReading:
        return replace(own, body=body) if body.name else named

    answer = contested(monkeypatch, read_on, verdict, beside)
    assert answer.status == status
    assert ("the enrolled body handle34 explain the echo better" in answer.reason) == (status == "unknown")


def test_a_wide_layout_on_an_enrolled_mug_is_asked_beside_its_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 18 views `container-180` on a mug was `helmet-linear` by a free pattern that left a tenth."""
    own = read(tagged(0, 180), "H", BodySettings(), 20.0, 3)
    batch = own.layouts[0].batch
    wide = replace(own.layouts[0], batch=replace(batch, radii=2 * batch.radii), layout="helmet-linear")

    def verdict(reading: BodyReading, settings: BodyDecision) -> Verdict:
        return Verdict("identified") if reading.body.name else Verdict("unknown", Code.BODY, "")

    def read_on(spectra: Spectra, layouts: object, body: BodyModel, *rest: object) -> BodyReading:
        return replace(own, body=body, layouts=(wide, *own.layouts[1:]))

    def beside(reading: BodyReading, *rest: object) -> BodyReading | None:
        return replace(own, body=reading.body, wall=METAL_WALL) if reading.body.name else None

    monkeypatch.setattr(contest, "_borne_out", lambda reading, verdict, *rest: verdict)
    answer = contested(monkeypatch, read_on, verdict, beside)
    assert replace(own, layouts=(wide,)).nominal_m > BodySettings().wide_m
    assert (answer.layout, answer.kind) == ("container-180", Kind.BODY)


def test_what_an_enrolled_body_must_show_for_a_name_on_it() -> None:
    """Its place, a tag above the noise, and reflectors where they are, but for a delay that both have."""
    own, settings = read(tagged(0, 180), "H", BodySettings(), 20.0, 3), BodyDecision()
    strong = replace(own, body_energy=0.5 * own.energy)

    def code(reading: BodyReading) -> Code:
        return decide_on_body(reading, settings).code

    assert code(own) is code(strong) is Code.NONE
    assert code(replace(strong, early_m=0.05, front_m=0.0)) is Code.BODY
    assert code(replace(strong, early_m=0.05, front_m=0.04)) is Code.NONE
    elsewhere = decide_on_body(replace(strong, front_m=-0.08), settings)
    assert elsewhere.code is Code.BODY
    assert "is 80 mm behind where it was at enrolment" in elsewhere.reason
    # A weak echo below a loud tag tells no place.
    assert code(replace(own, body_energy=0.2 * own.energy, front_m=-0.08)) is Code.NONE
    gain = own.body_left - own.least
    assert code(replace(own, variance=gain / 125)) is Code.NONE
    assert code(replace(own, variance=gain / 115)) is Code.WEAK
    assert code(replace(own, variance=gain / 50)) is Code.NO_TAG
    # Before flat faces, seen from all sides, they are no further in than the layout has them.
    batch = own.layouts[0].batch
    cases = (0.8, -0.010, 1.0), (0.8, -0.014, 1.0), (0.8, -0.014, 0.1), (0.8, 0.017, 1.0), (0.3, -0.014, 1.0)
    for share, outside_m, back in cases:
        at = batch.at.copy()
        at[0, 2] = outside_m
        placed = replace(own.layouts[0], batch=replace(batch, at=at))
        thing = cast("BodyModel", SimpleNamespace(name="crate", turns=True, turning_share=share))
        shifted = replace(own, body=thing, layouts=(placed, *own.layouts[1:]), back=back)
        refused = (share, outside_m, back) == (0.8, -0.014, 1.0)
        assert code(shifted) is (Code.RADIUS if refused else Code.NONE)
    # A wall's two amplitudes fit less of the noise.
    walled = replace(own, wall=METAL_WALL)
    assert code(replace(walled, lead=0.7, variance=gain / 85)) is Code.NONE
    assert code(replace(walled, lead=0.7, variance=gain / 75)) is Code.WEAK
    assert code(replace(walled, lead=0.4, variance=gain / 85)) is Code.NONE
    assert code(replace(walled, lead=0.2, variance=gain / 85)) is Code.OTHER


@pytest.mark.parametrize(("times", "status"), [(1.3, "unknown"), (1.5, "identified")])
def test_a_name_on_an_enrolled_body_is_borne_out_by_what_a_round_one_leaves(
    times: float, status: str
) -> None:
    own, settings = read(tagged(0, 180), "H", BodySettings(), 20.0, 3), ContestSettings()
    much, named = replace(own, unexplained=0.12), Verdict("identified")
    left = own.noise + times * (own.layouts[0].left - own.noise)
    round_ = replace(own, body=RoundBody(), layouts=(replace(own.layouts[0], left=left), *own.layouts[1:]))
    assert own.layouts[0].left > own.noise
    assert contest._borne_out(much, named, round_, settings).status == status
    # What leaves little needs no such proof.
    assert contest._borne_out(replace(own, unexplained=0.05), named, round_, settings) is named


@pytest.mark.parametrize(("alone", "status"), [(0.4, "unknown"), (0.6, "identified")])
def test_an_enrolled_body_that_stands_there_refuses_another_name_on_a_round_one(
    alone: float, status: str
) -> None:
    """A shell with `helmet-linear` passed for a cup with `container-180`."""
    own, settings = read(tagged(0, 180), "H", BodySettings(), 20.0, 3), ContestSettings()
    other = replace(own.layouts[0], layout="helmet-linear", charged=own.layouts[0].left)
    enrolled = replace(own, layouts=(other,), others=(), body_left=alone * own.body_left)
    round_ = replace(own, body=RoundBody())
    verdict = contest._outdone(round_, Verdict("identified"), [enrolled], settings)
    assert verdict.status == status
    same = replace(enrolled, layouts=(replace(other, layout=own.layouts[0].layout),))
    assert contest._outdone(round_, Verdict("identified"), [same], settings).status == "identified"


def test_a_bare_name_that_points_do_not_explain_is_held_against_an_enrolled_body(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One reflector on a mug and its handle were two without a body."""
    layouts, asked = list(builtin_layouts().values()), list[int]()
    acquisition = Acquisition(views=36, snr_db=20.0, placement=Placement(POSE.centre_m, POSE.turn_rad))
    scene = response_scene(response("free30_c90"), acquisition, "H", response("free30_one"), None)
    capture, _ = simulate_capture(scene, acquisition, 3)
    scans = preprocess(capture, settings=PreprocessSettings(matched_filter=False, extent_m=0.5))
    against, points_of = contest._against_bodies, contest.points_of

    def counted(known: contest._Bare, *rest: Any) -> Reading:
        asked.append(1)
        return against(known, *rest)

    monkeypatch.setattr(contest, "_against_bodies", counted)
    for unexplained, bodies, times in ((0.02, True, 0), (0.3, False, 0), (0.3, True, 1)):
        asked.clear()

        def points(*given: Any, share: float = unexplained) -> PointReading:
            return replace(points_of(*given), unexplained=share, lead=5.0)

        monkeypatch.setattr(contest, "points_of", points)
        enrolled = Enrolled((Solved("H"),) if bodies else ())
        assert read_tag(scans, layouts, enrolled=enrolled).status in ("identified", "unknown")
        assert len(asked) == times


@pytest.mark.parametrize(("left", "status"), [(0.45, "unknown"), (0.35, "identified")])
def test_a_bare_name_that_leaves_much_is_contested_where_no_wall_shows(left: float, status: str) -> None:
    """Neighbours on a can on the axis, whose wall does not move, were a pair without a body."""
    layouts, settings = list(builtin_layouts().values()), ContestSettings()
    own = read(tagged(0, 180), "H", BodySettings(), 20.0, 3)
    best = replace(own.layouts[0], layout=None, left=own.noise)
    round_ = replace(own, body=RoundBody(), body_energy=0.0, layouts=(best,), others=())
    scans = scans_of(response("free30_c90"), "H", 20.0, 3)
    bare = replace(read_tag(scans, layouts), status="identified", layout="container-90", kind=Kind.BARE)
    named = Explanation(Kind.BARE, "", "container-90", left, None, POSE)
    assert not contest._walled(round_, settings) and bare.evidence.outward <= settings.outward
    assert contest._contested(bare, named, round_, layouts, settings).status == status
