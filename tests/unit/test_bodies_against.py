"""What counts for and against a name that one hypothesis gives: middles, points, enrolled bodies, shells."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tagid.capture import Capture
from tagid.fields.shells import Shell
from tagid.pipeline.answer import Identification
from tagid.pipeline.identify import aspect_spectra, identify
from tagid.simulate import (
    Acquisition,
    NoiseShape,
    Placement,
    ReflectorSpec,
    Wobble,
    parse_body,
    simulate_capture,
)
from tagid.simulate.objects import Variation, object_scene
from tagid.tags.bodies import cylinder_reader, reader
from tagid.tags.bodies.body_reading import BodyReading, BodySettings
from tagid.tags.bodies.cylinder_reader import read_on_cylinder
from tagid.tags.bodies.decide import BodyDecision, decide_on_body, is_in_place
from tagid.tags.bodies.enrolled import EnrolledBody, Searches
from tagid.tags.bodies.hypothesis import Enrolled, Explanation, Kind, Pose
from tagid.tags.bodies.joint import Named, enrol_signature
from tagid.tags.bodies.middle import with_middles
from tagid.tags.bodies.on_body import read_on_body
from tagid.tags.bodies.points import PointReading
from tagid.tags.bodies.revolution import RoundBody
from tagid.tags.bodies.signature import Signature
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching import alone, beside, contest, matcher, on_shell
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.reading import Reading
from tagid.tags.verdicts.verdict import Code, Verdict
from train.population import draw

LAYOUTS = list(builtin_layouts().values())
BOX = "box:120mm,height=110mm"


def recorded(
    body: str, tag: np.ndarray, seed: int, snr_db: float, views: int = 36, off_m: float = 0.005
) -> Capture:
    """A tag on a body of our simulator, off the axis."""
    scene = object_scene(
        "scene",
        tag,
        parse_body(body),
        ReflectorSpec("octahedron", 0.020),
        rng=np.random.default_rng(3),
        variation=Variation(0.7, (0.0004, -0.0003), 0.3),
    )
    rng = np.random.default_rng(seed)
    side, turn = rng.uniform(0, 2 * np.pi, 2)
    placed = Placement((off_m * np.cos(side), off_m * np.sin(side)), turn)
    uneven = Wobble(speed=0.01 if views == 36 else 0.0)
    noise = NoiseShape(0.5)
    acquisition = Acquisition(views=views, snr_db=snr_db, placement=placed, wobble=uneven, noise=noise)
    return simulate_capture(scene, acquisition, seed)[0]


@cache
def known(body: str) -> Signature:
    """A body as three captures without a tag show it."""
    captures = [
        Named(f"c{i}", aspect_spectra(recorded(body, np.zeros((0, 2)), 900 + i, 20.0, 72, 0.002 * (i + 1))))
        for i in range(3)
    ]
    return enrol_signature(captures, "its-body", "body").signature


def read(body: str, tag: np.ndarray, seed: int, snr_db: float) -> Identification:
    return identify(recorded(body, tag, seed, snr_db), LAYOUTS, signatures=(known(body),))


def positions(name: str) -> np.ndarray:
    return builtin_layouts()[name].positions


@pytest.mark.parametrize("seed", [1, 3])
def test_a_reflector_in_the_middle_of_a_known_box_counts_for_its_layout(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Off the axis it returns as much as the others, and no ring holds it."""

    def lead() -> float:
        reading = read(BOX, positions("helmet-linear"), seed, 12.0).reading
        assert reading is not None and reading.layout == "helmet-linear"
        assert reading.kind is Kind.BODY and reading.body is not None
        return reading.body.lead

    held = lead()
    monkeypatch.setattr(reader, "with_middles", lambda *given: list(given[-1]))
    assert held > 3 * lead()


def test_a_layout_without_a_reflector_in_its_middle_is_given_none() -> None:
    answer = read(BOX, positions("helmet-120"), 1, 20.0)
    assert answer.reading is not None and answer.reading.body is not None
    found = answer.reading.body
    placed = found.layouts[0]
    assert placed.layout == "helmet-120"
    given = (found.spectra, found.body, LAYOUTS, 0.076, [replace(placed, layout="helmet-linear")])
    # Nothing stands there: an amplitude a frequency is hardly worth its charge.
    assert 0 <= placed.charged - with_middles(*given)[0].charged < 0.01 * found.tag
    assert with_middles(*given[:4], [placed]) == [placed]
    assert with_middles(found.spectra, found.body, [], 0.076, [placed]) == [placed]


@cache
def on_box() -> Reading:
    reading = read(BOX, positions("helmet-linear"), 1, 8.0).reading
    assert reading is not None and reading.body is not None and reading.layout == "helmet-linear"
    assert reading.kind is Kind.BODY
    return reading


@pytest.mark.parametrize(
    ("nearest", "leads", "refused"),
    [("container-180", 0.0, True), ("container-90", 0.4, False), ("container-90", 0.6, True)],
)
def test_a_bare_name_is_held_against_points_and_a_known_body(
    nearest: str, leads: float, refused: bool
) -> None:
    """Near the noise the image explained all of the echo of another tag, on a cup that was enrolled."""
    reading, body = on_box(), cast("BodyReading", on_box().body)
    least = min(placed.charged for placed in (*body.layouts, *body.others))
    fit = SimpleNamespace(layout=nearest, left=least + leads * body.error)
    own = Explanation(Kind.BARE, "", "container-90", 0.0, None, Pose())
    points = cast("PointReading", SimpleNamespace(layouts=(fit,)))
    known_of = contest._Bare(replace(reading, layout="container-90"), own, points, opaque=False)
    taken = contest._disputed(known_of, body, ContestSettings())
    assert (taken is not None) == refused
    if taken is not None:
        assert (taken.status, taken.layout, taken.code) == ("unknown", None, Code.OTHER)
    assert contest._disputed(replace(known_of, points=None), body, ContestSettings()) is None


@pytest.mark.parametrize(
    ("explained", "nats", "shows"),
    [(0.6, 100.0, True), (0.4, 100.0, False), (0.6, 50.0, False)],
)
def test_a_body_that_explains_most_of_the_echo_alone_shows(
    explained: float, nats: float, shows: bool
) -> None:
    """The wall of an empty cup answers from behind its centre, as what bare reflectors exchange does."""
    reading, body = on_box(), cast("BodyReading", on_box().body)
    variance, settings = body.noise / 500, ContestSettings()
    energy = body.noise + nats * variance / explained
    empty = replace(
        body,
        body=RoundBody(),
        energy=energy,
        body_left=energy - nats * variance,
        variance=variance,
        front_m=-0.09,
        points_lead=0.5,
    )
    own = Explanation(Kind.BARE, "", None, 0.0, None, Pose())
    points = cast("PointReading", SimpleNamespace(least=0.0, layouts=()))
    assert contest._shows(contest._Bare(reading, own, points, False), empty, settings) == shows


@pytest.mark.parametrize(
    ("status", "unexplained", "bodies", "asked"),
    [
        ("ambiguous", 0.45, 0, True),
        ("ambiguous", 0.10, 0, False),
        ("identified", 0.45, 0, False),
        ("identified", 0.45, 1, True),
    ],
)
def test_bodies_are_asked_where_points_leave_much_and_name_nothing(
    status: str, unexplained: float, bodies: int, asked: bool
) -> None:
    """A pair on a cup was ambiguous with another layout; both left half of the echo."""
    done = replace(on_box(), status=status)
    points = cast("PointReading", SimpleNamespace(unexplained=unexplained))
    enrolled = Enrolled(bodies=(RoundBody(),) * bodies)
    assert contest._leaves_much(done, points, enrolled, ContestSettings()) == asked


@pytest.mark.parametrize(
    ("code", "excess", "silent"),
    [(Code.NO_ECHO, 0.3, True), (Code.NO_ECHO, 0.5, False), (Code.MISSING, 0.0, False)],
)
def test_an_echo_that_is_no_point_is_not_silent(code: Code, excess: float, silent: bool) -> None:
    """What a cup makes of its reflectors looks like no point: 0.8 of the noise's energy was "no echo"."""
    body = cast("BodyReading", on_box().body)
    spectra = body.spectra
    level = spectra.energy / (1 + excess) / (len(spectra.data) * (spectra.views - 1))
    assert alone.is_silent(replace(on_box(), code=code), replace(spectra, noise=level)) == silent


@pytest.mark.parametrize(
    ("lead", "explains", "carried"), [(-1.2, 0.3, True), (-1.2, 0.1, False), (0.2, 0.3, False)]
)
def test_a_body_hides_the_reflectors_that_it_carries(lead: float, explains: float, carried: bool) -> None:
    """Without the half that a can hid, two reflectors on it were `container-90` without a body."""
    body = cast("BodyReading", on_box().body)
    on_can = replace(body, lead=lead, body_left=(1 - explains) * body.energy)
    assert matcher._carried(on_can) == carried and not matcher._carried(None)
    settled = replace(on_box(), status="unknown", layout=None, body=on_can)
    bare = replace(on_box(), kind=Kind.BARE, hidden_deg=185.0, hypotheses=())
    found = SimpleNamespace(reading=bare)
    scan = cast("matcher.MatchedScan", SimpleNamespace(cleared=lambda: found))
    assert (matcher.MatchedScan._cleared_of(scan, settled) is None) == carried
    # A wall that was taken out hides nothing.
    found.reading = replace(bare, hidden_deg=0.0)
    assert matcher.MatchedScan._cleared_of(scan, settled) is not None


@pytest.mark.parametrize(
    ("share", "nats", "lead", "named"),
    [
        (0.7, 20.0, 1.0, True),
        (0.3, 20.0, 1.0, False),
        (0.3, 80.0, 1.0, True),
        (0.1, 80.0, 1.0, False),
        (0.1, 20.0, 5.0, True),
    ],
)
def test_a_round_body_moves_with_its_tag(share: float, nats: float, lead: float, named: bool) -> None:
    """Reflectors 165 degrees apart are 180 degrees apart about a point where nothing stands."""
    capture = recorded("can:33mm", positions("container-180"), 5, 20.0)
    reading = identify(capture, LAYOUTS).reading
    assert reading is not None and reading.body is not None and reading.layout == "container-180"
    found = reading.body
    assert found.body_over_tag > 1
    energy = found.body_energy * share / found.body_over_tag
    weak = replace(found, body_energy=energy, lead=lead, variance=energy / nats)
    assert weak.body_over_tag == pytest.approx(share)
    verdict = decide_on_body(weak, BodyDecision(no_tag_nats=0.0))
    assert (verdict.status == "identified") == named
    assert named or "no body moves" in verdict.reason


@pytest.mark.parametrize(
    ("lead", "wide", "passed", "named"),
    [(1.4, True, True, False), (2.5, True, True, True), (1.4, False, True, True), (1.4, True, False, True)],
)
def test_a_row_on_a_shell_is_no_pair_beside_a_glass(
    monkeypatch: pytest.MonkeyPatch, lead: float, wide: bool, passed: bool, named: bool
) -> None:
    """With a free pattern the three of `helmet-linear` explain the echo, beside a small glass two do."""
    reading = identify(recorded("can:33mm", positions("container-180"), 5, 20.0), LAYOUTS).reading
    assert reading is not None and reading.body is not None
    beside = replace(reading.body, lead=lead, through=passed)
    other = SimpleNamespace(layout="helmet-linear" if wide else "container-90", left=1.0)
    nominal_m = 0.09 if wide else 0.045
    freely = SimpleNamespace(layouts=[other], nominal_m=nominal_m, body=SimpleNamespace(name=""))
    monkeypatch.setattr(contest, "_judged", lambda *_: Verdict("identified"))
    verdict = Verdict("unknown", Code.BODY, "before")
    arguments: Any = (None, freely, verdict, beside, LAYOUTS, ContestSettings())
    assert (contest._after_wall(*arguments)[1].status == "identified") == named


@pytest.mark.parametrize(
    ("lead", "early_mm", "named"),
    [(1.5, 64, True), (1.5, 70, False), (5.0, 78, True), (5.0, -78, True), (5.0, 82, False)],
)
def test_a_clear_layout_may_answer_from_farther_off(lead: float, early_mm: float, named: bool) -> None:
    """Pulses that nobody stated delay the whole echo."""
    reading = identify(recorded("can:33mm", positions("container-180"), 5, 20.0), LAYOUTS).reading
    assert reading is not None and reading.body is not None
    beside = replace(
        reading.body, lead=lead, early_m=1e-3 * early_mm, front_m=0.0, wall=Shell(0.033, 0.0, 1.0, True, "V")
    )
    assert is_in_place(beside, BodyDecision()) == named


@pytest.mark.parametrize(
    ("lead", "early_mm", "passed", "named"),
    [
        (2.0, 28, True, True),
        (2.0, 34, True, False),
        (2.0, -34, True, False),
        (2.0, 34, False, True),
        (3.0, -45, True, True),
    ],
)
def test_a_pair_beside_a_glass_answers_from_its_place(
    lead: float, early_mm: float, passed: bool, named: bool
) -> None:
    """Three in a line on a helmet's shell passed for an opposite pair from 34 mm behind it and more."""
    reading = identify(recorded("can:33mm", positions("container-180"), 5, 20.0), LAYOUTS).reading
    assert reading is not None and reading.body is not None
    wall = Shell(0.033, 0.004, 6.0, not passed, "V")
    early_m = 1e-3 * early_mm
    beside = replace(reading.body, lead=lead, early_m=early_m, front_m=0.0, wall=wall, through=passed)
    assert is_in_place(beside, BodyDecision()) == named
    three = next(one for one in (*beside.layouts, *beside.others) if len(one.angles) > 2)
    assert is_in_place(replace(beside, layouts=(three, *beside.layouts)), BodyDecision())


def test_bare_pairs_of_an_enrolled_spacing_are_no_foreign_objects() -> None:
    """63.9 mm for the 63.6 of `container-90`; with a body there is a centre, and an angle about it."""
    drawn = draw(4060594)
    own, other = np.array([0.0, 0.0639 + 0j]), np.array([0.0, 0.0670 + 0j])
    assert drawn.body == "none" and drawn.is_enrolled_pair
    assert replace(drawn, places=own).is_enrolled_pair
    assert not replace(drawn, places=other).is_enrolled_pair
    assert not replace(drawn, body="can").is_enrolled_pair
    assert not replace(drawn, places=np.append(own, 0.1j)).is_enrolled_pair
    assert not replace(drawn, truth="container-90").is_enrolled_pair


@pytest.mark.parametrize(
    ("cup", "name", "seed"),
    [
        ("cup:37mm,wall=3.7mm", "container-180", 0),
        ("cup:37mm,wall=3.7mm", "container-90", 4),
        ("cup:36mm,wall=4.2mm", "container-180", 5),
    ],
)
def test_walls_are_asked_of_weak_tags_on_empty_cups(
    cup: str, name: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few points about the axis explain the echo of a cup 2 mm off it."""
    capture = recorded(cup, positions(name), seed, 10.0, off_m=0.002)
    reading = identify(capture, LAYOUTS).reading
    assert reading is not None and reading.body is not None and reading.body.front_m < 0
    assert (reading.layout, reading.kind) == (name, Kind.ROUND)
    monkeypatch.setattr(contest, "stands_alone", lambda *given: False)
    refused = identify(capture, LAYOUTS).reading
    assert refused is not None and refused.layout is None


@pytest.mark.parametrize(
    ("body", "enrolled", "seed", "snr_db"),
    [
        ("cup:36mm,wall=4.7mm,oval=0.3mm", False, 0, 15.0),
        ("cup:36mm,wall=4.7mm,oval=0.3mm", False, 2, 15.0),
        ("cup:34mm,wall=4.5mm,handle", True, 4, 20.0),
        ("cup:34mm,wall=4.5mm,handle", True, 5, 20.0),
    ],
)
def test_what_a_body_tells_of_the_scans_is_asked_again_beside_its_wall(
    body: str, enrolled: bool, seed: int, snr_db: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside free patterns little is seen of how oval a cup is, or how unevenly a mug was turned."""

    def lead() -> float:
        off_m = 0.005 if enrolled else 0.002
        capture = recorded(body, positions("container-90"), seed, snr_db, off_m=off_m)
        spectra, of = aspect_spectra(capture), known(body) if enrolled else None
        model = EnrolledBody(of, Searches(of.order)) if of is not None else RoundBody()
        first = read_on_body(spectra, LAYOUTS, model, BodySettings())
        assert first is not None
        beside = read_on_cylinder(first.spectra, LAYOUTS, first, BodySettings())
        assert beside is not None and beside.layouts[0].layout == "container-90"
        return beside.lead

    told = lead()
    monkeypatch.setattr(cylinder_reader, "ENOUGH", 1.0)
    assert told > 2 * max(lead(), 1.0)


@pytest.mark.parametrize("nearest", ["container-180", "container-90"])
def test_an_image_whose_name_points_contradict_does_not_contest_a_body(
    nearest: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Near the noise it explains all of an echo: a pair on a cup was ambiguous with its `container-90`."""
    capture = recorded("cup:37mm,wall=3.7mm", positions("container-180"), 3, 10.0, off_m=0.002)
    plain = identify(capture, LAYOUTS).reading
    assert plain is not None and (plain.layout, plain.kind) == ("container-180", Kind.ROUND)
    settle, points_of = matcher.settle, contest.points_of

    def named(bare: Reading, *rest: Any, **more: Any) -> Reading:
        seen = replace(bare, status="ambiguous", layout="container-90", code=Code.AMBIGUOUS)
        return settle(replace(seen, evidence=replace(seen.evidence, share=1.0)), *rest, **more)

    def points(*given: Any) -> PointReading:
        found = points_of(*given)
        own = [p for p in found.layouts if p.layout == nearest]
        return replace(found, lead=-1.0, layouts=(*own, *(p for p in found.layouts if p not in own)))

    monkeypatch.setattr(matcher, "settle", named)
    monkeypatch.setattr(contest, "points_of", points)
    monkeypatch.setattr(contest, "without_body", lambda *given: None)
    reading = identify(capture, LAYOUTS).reading
    assert reading is not None
    assert (reading.status == "ambiguous") == (nearest == "container-90")


@pytest.mark.parametrize(
    ("named", "left", "status"),
    [("container-180", 0.08, "ambiguous"), ("container-180", 0.0, None), ("helmet-linear", 0.08, None)],
)
def test_two_names_on_two_bodies_are_none_where_points_leave_nothing(
    named: str, left: float, status: str | None
) -> None:
    """A tag on a helmet, at 18 views and 10 dB, was a pair beside a glass: its shell left less."""
    reading, shell = on_box(), cast("BodyReading", on_box().body)
    best = replace(shell.layouts[0], left=0.5 * shell.noise)
    other = Explanation(Kind.BARE, "", None, 0.0, None, Pose())
    own = Explanation(Kind.ROUND, "", named, left, left, Pose())
    settled = replace(reading, layout=named, kind=Kind.ROUND, hypotheses=(other, own), body=None)
    found = replace(shell, layouts=(best, *shell.layouts[1:]))
    said = on_shell._said(Kind.SHELL, found, Verdict("identified"), settled, LAYOUTS)
    assert (said.status if said is not None else None) == status
    if said is not None:
        assert said.code is Code.AMBIGUOUS and "on a thin shell" in said.reason


def test_what_points_at_other_places_explain_needs_no_walls(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two bare octahedra 160 degrees apart passed for a pair in a box: their image left a third of them."""
    pair = 0.045 * np.array([[1.0, 0.0], [np.cos(np.deg2rad(150)), np.sin(np.deg2rad(150))]])
    settle = matcher.settle

    def unexplained(bare: Reading, *rest: Any, **more: Any) -> Reading:
        seen = replace(bare.refused(Code.ELSEWHERE, ""), evidence=replace(bare.evidence, share=0.6))
        return settle(seen, *rest, **more)

    monkeypatch.setattr(matcher, "settle", unexplained)
    reading = identify(recorded("none", pair, 1, 20.0, 18), LAYOUTS).reading
    assert reading is not None and reading.layout is None
    # Not the 0.4 that the image leaves.
    bare = next(one for one in reading.hypotheses if one.kind is Kind.BARE)
    assert bare.left < 0.02
    assert list(reading.hypotheses) == sorted(reading.hypotheses, key=lambda one: one.left)


@pytest.mark.parametrize(
    ("least", "enrolled", "other", "out"),
    [(2.0, True, 1.0, True), (1.2, True, 1.0, False), (2.0, False, 1.0, False), (0.5, True, 1.0, False)],
)
def test_walls_are_not_asked_of_a_body_that_another_one_outdoes(
    least: float, enrolled: bool, other: float, out: bool
) -> None:
    name = SimpleNamespace(name="mug" if enrolled else "")
    reading = cast(BodyReading, SimpleNamespace(body=name, least=least, error=1.0))
    rival = cast(BodyReading, SimpleNamespace(least=other))
    assert beside.outdone(reading, [rival], ContestSettings()) is out
    assert not beside.outdone(reading, [], ContestSettings())


def test_no_wall_is_asked_after_a_body_that_is_there_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """An enrolled box without a tag, and a mug that is not there."""
    asked: list[str] = []

    def never(reading: BodyReading, *_: object) -> None:
        asked.append(reading.body.name)

    monkeypatch.setattr(contest, "read_beside_wall", never)
    monkeypatch.setattr(contest, "outdone", lambda *_: False)
    capture = recorded(BOX, np.zeros((0, 2)), 1, 20.0)
    mug = replace(known("cup:40mm,handle"), name="a-mug")
    assert identify(capture, LAYOUTS, signatures=(known(BOX), mug)).status == "no_tag"
    assert "a-mug" not in asked
    identify(capture, LAYOUTS, signatures=(mug,))
    assert "a-mug" in asked
