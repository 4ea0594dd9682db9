"""What is named as the cause of a refusal: lost scans, part of a turn, a wrong axis distance or place."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tagid.capture import Capture, ViewFlag
from tagid.errors import DataError
from tagid.metadata import Ending, MotionInfo, RadarInfo, ResolvedMotion, Standstill
from tagid.pipeline import diagnosis
from tagid.pipeline.answer import Identification
from tagid.pipeline.diagnosis import circling, named_in, recording_remarks, with_causes
from tagid.pipeline.identify import identify, identify_together, of_the_part, widest_gap
from tagid.pipeline.prepared import PreparedCapture, load_capture
from tagid.pipeline.settings import ImagingSettings
from tagid.reading.reading import Kind, Reading, Reflector
from tagid.reading.verdict import ADVICE, Code
from tagid.simulate import Placement, parse_body, parse_reflector
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name, scene_on_body
from tagid.tags.layouts.layout import builtin_layouts

LAYOUTS = list(builtin_layouts().values())


def turns_with_a_hole(turns: float, lost: RadarInfo) -> Capture:
    """Scans of `turns` turns without those between 200 and 274 degrees of each."""
    angles = np.deg2rad(np.arange(0, 360 * turns, 2.0))
    kept = angles[~((np.rad2deg(angles) % 360 > 201) & (np.rad2deg(angles) % 360 < 273))]
    samples = np.random.default_rng(1).normal(size=(len(kept), 192)).astype(np.float32)
    motion = MotionInfo(resolved=ResolvedMotion(turns=turns))
    return Capture(samples, 0.1, 0.0091, kept, axis_distance_m=1.0, radar=lost, motion=motion)


@pytest.mark.parametrize("turns", [1.0, 1.5])
def test_lost_scans_are_the_cause_of_a_gap_inside_a_full_turn(turns: float) -> None:
    capture = load_capture(turns_with_a_hole(turns, RadarInfo(scans_lost=2496)))
    (remark,) = recording_remarks(capture)
    assert remark.startswith(
        f"2496 scans were lost: the views cover 288 of 360 degrees, although {turns:.2f}"
    )
    (single,) = recording_remarks(replace(capture, radar=RadarInfo(scans_lost=1)))
    assert single.startswith("1 scan was lost: ")
    # A gap in which the object did not turn is none of lost scans.
    part = capture.select(capture.angles_rad % (2 * np.pi) < np.deg2rad(201))
    part = replace(part, motion=MotionInfo(resolved=ResolvedMotion(turns=200 / 360)))
    assert recording_remarks(part)[0].startswith("the views cover 2")


@pytest.mark.parametrize(("first", "lost"), [(False, True), (True, False)])
def test_without_recorded_turns_the_flags_beside_the_gap_decide(first: bool, lost: bool) -> None:
    capture = turns_with_a_hole(1.0, RadarInfo())
    flags = np.zeros(capture.views, dtype=np.uint8)
    flag = ViewFlag.FIRST if first else ViewFlag.NONE
    flags[np.argmax(capture.angles_rad > np.deg2rad(250))] = ViewFlag.AFTER_LOSS | flag
    (remark,) = recording_remarks(replace(capture, flags=flags, motion=MotionInfo()))
    assert remark.startswith("scans were lost: ") == lost


def test_a_refused_answer_names_lost_scans_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosis, "named_in", lambda *_: None)
    capture, _ = simulate_capture(scene_from_name("empty", 3), Acquisition(views=36, snr_db=10.0), seed=3)
    hole = (capture.angles_rad > np.deg2rad(200)) & (capture.angles_rad < np.deg2rad(272))
    scans = replace(
        capture.select(np.flatnonzero(~hole)),
        radar=RadarInfo(scans_lost=35),
        motion=MotionInfo(resolved=ResolvedMotion(turns=1.0)),
    )
    prepared = PreparedCapture(load_capture(scans))
    (cause,) = with_causes(refused(Code.NO_TAG), prepared, LAYOUTS).causes
    assert cause.code == "scans_lost" and "35 scans were lost" in cause.text
    assert "tagid radar monitor" in cause.remedy and "one full turn" not in cause.remedy


def turn_of(layout: str, views: int, **more: Placement) -> Capture:
    return simulate_capture(scene_from_name(layout, 3), Acquisition(views=views, snr_db=20.0, **more), 3)[0]


def part_of_a_turn(share: float, views: int = 60) -> PreparedCapture:
    capture = turn_of("helmet-120", views)
    return PreparedCapture(load_capture(capture.select(capture.angles_rad < share * 2 * np.pi)))


@cache
def whole_answer() -> Identification:
    return identify(part_of_a_turn(1.0, 36), LAYOUTS)


def whole_turn() -> Reading:
    return whole_answer().reading


def refused(code: Code) -> Identification:
    """The same without its name, as of an object on a round body."""
    reading = replace(whole_turn().refused(code, ""), kind=Kind.ROUND)
    return replace(whole_answer(), status="unknown", advice="", reading=reading)


def test_a_name_at_a_wrong_axis_distance_comes_with_the_one_that_fits() -> None:
    prepared = PreparedCapture(load_capture(replace(turn_of("helmet-120", 12), axis_distance_m=0.88)))
    answer = with_causes(identify(prepared, LAYOUTS), prepared, LAYOUTS)
    assert answer.status == "identified"
    (remark,) = answer.remarks
    fits = float(remark.split("axis distance of ")[1].split()[0])
    assert fits == pytest.approx(1.0, abs=0.02) and "not 0.88 m" in remark
    right = replace(answer, reading=replace(answer.reading, offset_m=0.02), remarks=())
    assert with_causes(right, prepared, LAYOUTS).remarks == ()


def test_scans_of_one_side_alone_show_the_layout_and_do_not_name_it() -> None:
    """What is withheld is withheld for the sides that were not seen, and absence too."""
    absent = of_the_part(replace(whole_turn(), status="no_tag", layout=None), [part_of_a_turn(0.4).given])
    assert (absent.status, absent.layout, absent.code) == ("unknown", None, "partial_turn")
    assert "144 of 360 degrees" in absent.reason
    answer = identify(part_of_a_turn(0.55), LAYOUTS)
    assert (answer.status, answer.reading.code) == ("unknown", "partial_turn")
    assert "the scans show helmet-120" in answer.reading.reason and answer.reading.nearest == "helmet-120"
    assert answer.coverage == pytest.approx(0.55, abs=0.01)


@pytest.mark.parametrize("ended", [None, Ending("sure", 0.6, "helmet-120")])
@pytest.mark.parametrize(("share", "named"), [(0.55, False), (0.6, True)])
def test_a_name_needs_most_of_a_turn_however_the_recording_ended(
    ended: Ending | None, share: float, named: bool
) -> None:
    given = part_of_a_turn(share).given
    short = replace(given, radar=replace(given.radar, ended=ended))
    reading = of_the_part(whole_turn(), [short])
    assert (reading.status, reading.layout) == (("identified", "helmet-120") if named else ("unknown", None))
    # The bound is of whole turns, and of those that ended early with their own.
    assert whole_turn().bound is not None and (reading.bound is None) == (ended is None or not named)
    if not named:
        assert reading.code == "partial_turn"
        covered = f"the views cover {360 * share:.0f} of 360 degrees"
        assert reading.reason == f"{covered}, and in these the scans show helmet-120, but not every side"


def as_positions(capture: Capture) -> Capture:
    """The same scans with the places of the antenna instead of angles."""
    positions = capture.aperture().antennas[0]
    return replace(capture, angles_rad=None, angle_sigma_rad=None, axis_distance_m=None, antenna_height_m=0.0,
                   antenna_positions_m=positions)  # fmt: skip


def test_positions_cover_the_directions_in_which_they_lie() -> None:
    """Also two scans from opposite sides, a gap inside a whole turn, and positions in any order."""
    whole = part_of_a_turn(1.0).given
    angles = whole.angles_rad
    inside = [angles < np.deg2rad(100), (angles < np.deg2rad(60)) | (angles > np.deg2rad(220))]
    for mask, share in zip(inside, (102 / 360, 198 / 360), strict=True):
        part = whole.select(np.random.default_rng(2).permutation(np.flatnonzero(mask)))
        for capture in (part, as_positions(part)):
            assert widest_gap(capture).share == pytest.approx(share, abs=0.01)
            reading = of_the_part(whole_turn(), [capture])
            assert reading.layout is None and reading.code == "partial_turn"
    free = as_positions(whole)
    both = replace(free, receive_positions_m=free.antenna_positions_m)
    assert widest_gap(both).share == widest_gap(free).share == pytest.approx(1.0)
    (remark,) = recording_remarks(as_positions(whole.select(inside[0])))
    assert "the views cover 102 of 360 degrees" in remark


@pytest.mark.parametrize(
    "degrees",
    [[*range(100), 190, 280], range(0, 193, 24)],
    ids=["two views apart", "coarse gap of 168 degrees"],
)
def test_single_views_and_coarse_steps_show_no_further_side(degrees: Sequence[int]) -> None:
    whole = turn_of("helmet-120", 360)
    reading = of_the_part(whole_turn(), [whole.select(np.array(degrees))])
    assert (reading.status, reading.layout, reading.code) == ("unknown", None, "partial_turn")


def test_a_joint_name_needs_one_recording_that_shows_every_side() -> None:
    short, longer = (part_of_a_turn(share).given for share in (0.4, 0.7))
    named = whole_turn()
    assert of_the_part(named, [short, short]).code == "partial_turn"
    still = Standstill(65, 80, 145, 20.0, 144.0)
    stopped = part_of_a_turn(0.45).given
    stopped = replace(stopped, motion=MotionInfo(resolved=ResolvedMotion(turns=0.45, standstill=still)))
    assert of_the_part(named, [short, stopped]).code == "turn_stopped"
    joint, alone = identify_together([short, longer], LAYOUTS)
    assert [item.status for item in (joint, *alone)] == ["identified", "unknown", "identified"]
    assert joint.reading.bound is None and joint.coverage == pytest.approx(0.7)


def test_views_from_one_place_show_nothing() -> None:
    prepared = part_of_a_turn(1.0)
    still = replace(prepared.given, angles_rad=np.zeros(prepared.given.views))
    with pytest.raises(DataError, match="from one place"):
        identify(PreparedCapture(still), LAYOUTS)


@cache
def can_off_the_axis(off_m: float, body: str) -> PreparedCapture:
    scene = scene_on_body("container-90", parse_body(body), parse_reflector("octahedron:20mm"))
    placed = Placement((0.8 * off_m, 0.6 * off_m), 0.4)
    capture, _ = simulate_capture(scene, Acquisition(views=36, snr_db=20.0, placement=placed), seed=3)
    return PreparedCapture(load_capture(capture))


@pytest.mark.parametrize(
    ("off_mm", "stated"), [(16, "10 to 20 mm"), (35, "about 3[2-7] mm"), (60, "about (59|60|61) mm")]
)
def test_a_can_beside_the_axis_is_told_by_the_circle_of_its_echo(off_mm: float, stated: str) -> None:
    circle = diagnosis._off_the_axis(circling(can_off_the_axis(1e-3 * off_mm, "can:35mm").given))
    cause = diagnosis._of_a_round_body(circle)
    assert cause.code == "off_centre" and "Place" in cause.remedy
    assert re.search(f"a round body {stated} off it$", cause.text)


def test_a_can_far_beside_the_axis_is_the_cause_of_a_refusal() -> None:
    prepared = can_off_the_axis(0.115, "can:35mm")
    answer = with_causes(identify(prepared, LAYOUTS), prepared, LAYOUTS)
    assert answer.status != "identified"
    assert [cause.code for cause in answer.causes] == ["off_centre"]


def test_the_circle_is_about_the_bodys_middle() -> None:
    result = circling(can_off_the_axis(0.05, "can:35mm").given)
    assert result.share == 1.0 and result.spread_m < 0.006
    assert np.hypot(result.centre_m[0] - 0.04, result.centre_m[1] - 0.03) < 0.005


def test_a_handle_circles_but_is_no_body_off_the_axis(monkeypatch: pytest.MonkeyPatch) -> None:
    prepared, other = can_off_the_axis(0.002, "can:35mm,handle"), refused(Code.OTHER)
    # A body is to be centred before it is enrolled, if it may stand off the axis.
    monkeypatch.setattr(diagnosis, "named_in", lambda *_: None)
    said = with_causes(other, can_off_the_axis(0.03, "can:35mm"), LAYOUTS)
    assert said.what_to_do().startswith("Place the object") and ADVICE[Code.OTHER][1:] in said.what_to_do()
    assert said.to_dict()["advice"] == said.what_to_do()
    assert with_causes(other, prepared, LAYOUTS).what_to_do() == ADVICE[Code.OTHER]
    # Of a layout that too few views show nothing else is wrong.
    assert with_causes(refused(Code.UNCALIBRATED), can_off_the_axis(0.03, "can:35mm"), LAYOUTS).causes == ()
    # Without a body there is nothing to enroll but the tag, and an empty scene is not to be centred.
    winner = replace(other.reading.hypotheses[0], unexplained=0.01)
    alone = replace(other.reading, kind=Kind.BARE, hypotheses=(winner,))
    radar = RadarInfo(kind="simulated")
    assert diagnosis._advice(alone, None, radar).startswith("Enroll the tag if it is new. If it is enrolled")
    body = replace(alone, hypotheses=(replace(winner, unexplained=0.3),))
    assert diagnosis._advice(body, None, radar).startswith("Place")
    on_axis = replace(
        other.reading, code=Code.WEAK, reflectors=(Reflector(1e-3, 0.0, 1 + 0j, 0.0, 20.0, True),)
    )
    assert diagnosis._advice(on_axis, None, radar).startswith("Move the object 5 mm")
    for code in (Code.NO_TAG, Code.NO_ECHO):
        simulated, unmeasured, measured = (
            diagnosis._advice(replace(alone, code=code), None, RadarInfo(kind=kind, cable_delay_ps=delay_ps))
            for kind, delay_ps in (("simulated", 0.0), ("p440", 0.0), ("p440", 800.0))
        )
        assert simulated == measured != unmeasured and "tagid commission" in unmeasured
        assert "recorded range" in simulated or code is Code.NO_ECHO
    # Scans that do not reach the object do not show that its speed is wrong.
    noise = np.random.default_rng(1).standard_normal(prepared.given.samples.shape).astype(np.float32)
    motion = MotionInfo(resolved=ResolvedMotion(nominal_rpm=2.0, repeats=False))
    for delay_ps, codes in ((0.0, []), (800.0, ["speed"])):
        recorded = replace(prepared.given, samples=noise, motion=motion)
        recorded = replace(recorded, radar=RadarInfo(kind="p440", cable_delay_ps=delay_ps))
        said = with_causes(refused(Code.NO_TAG), PreparedCapture(recorded, prepared.settings), LAYOUTS)
        assert [cause.code for cause in said.causes] == codes


@pytest.mark.parametrize(("error_m", "causes"), [(0.020, 1), (0.003, 0)])
def test_a_search_that_returns_to_the_given_axis_distance_states_no_cause(
    monkeypatch: pytest.MonkeyPatch, error_m: float, causes: int
) -> None:
    # The image is brightest 20 mm nearer, from where the reader itself finds the distance to a few mm.
    monkeypatch.setattr(diagnosis, "bright_offsets", lambda *_: [-0.020])
    capture = turn_of("container-90", 36)
    true_m = capture.axis_distance_m or 0.0
    prepared = PreparedCapture(load_capture(replace(capture, axis_distance_m=true_m + error_m)))
    result = diagnosis._of_the_axis(prepared, LAYOUTS)
    assert [cause.code for cause in result] == ["axis_distance"] * causes
    assert all(
        cause.settings == {"motion.axis_distance_m": pytest.approx(true_m, abs=0.006)} for cause in result
    )


def test_an_object_is_named_elsewhere_with_the_settings_of_the_answer() -> None:
    right = load_capture(turn_of("helmet-120", 24))
    wrong, away = (replace(right, axis_distance_m=right.axis_distance_m + error_m) for error_m in (0.07, 9.0))
    prepared = PreparedCapture(wrong)
    result = named_in(prepared, right, LAYOUTS)
    assert result is not None and result.layout == "helmet-120" and abs(result.offset_m) < 3e-3
    # Where the scans do not hold the object's range, it is not there.
    assert named_in(prepared, away, LAYOUTS) is None
    strict = PreparedCapture(wrong, ImagingSettings(false_accept=1e-6))
    assert named_in(strict, right, LAYOUTS) is None
