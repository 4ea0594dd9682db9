"""Names, refusals and their reasons on simulated recordings, of one and of several of an object."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from reader_scenes import LAYOUTS, prepared, scans_at, scans_of

from tagid.imaging.types import BasebandScans
from tagid.reading.decision import SURE, Decision, decide
from tagid.reading.hypotheses import Contest
from tagid.reading.several import decide_together
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE, POINTS
from tagid.reading.transfers.shade import SHADES
from tagid.reading.transfers.wall import WALLS
from tagid.reading.verdict import Code
from tagid.tags.layouts.layout import Layout, builtin_layouts
from train.population import draw


def ring(*angles_deg: float, radius_m: float = 0.045) -> np.ndarray:
    """(K, 2) places on a ring, m."""
    angle = np.deg2rad(angles_deg)
    return radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def bare(scans: BasebandScans) -> Decision:
    """The decision among hypotheses without sheets and walls, which none of these objects has."""
    return decide(Contest(Spectra.of(scans), LAYOUTS, (BARE, POINTS), ()).run())


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_a_tag_is_named(layout: Layout) -> None:
    answer = bare(scans_of(layout.name, views=24))
    assert (answer.status, answer.name) == ("identified", layout.name)
    assert answer.lead > SURE


def test_a_tag_is_named_on_part_of_a_turn() -> None:
    assert bare(scans_of("container-90", turns=0.75)).name == "container-90"


STRANGERS = {
    "another angle": (ring(0, 130), "2 reflectors"),
    "another radius": (ring(0, 180, radius_m=0.07), "2 reflectors 1"),
    "one more": (np.concatenate([ring(0, 90), [[-0.09, -0.02]]]), "3 reflectors"),
    "one less": (ring(0, 120, radius_m=0.11), "2 reflectors 1"),
    "one": (ring(0), "one reflector"),
    "on no ring": (np.array([[0.09, 0.03], [-0.05, 0.03], [0.02, -0.05], [-0.03, -0.11]]), "4 reflectors"),
}


@cache
def stranger(kind: str) -> Decision:
    return bare(scans_at(STRANGERS[kind][0], views=24))


@pytest.mark.parametrize("kind", STRANGERS)
def test_a_stranger_is_described_and_not_named(kind: str) -> None:
    answer, words = stranger(kind), STRANGERS[kind][1]
    # One alone is no tag: a round body echoes as it does.
    assert answer.status == ("no_tag" if kind == "one" else "unknown") and answer.name is None
    assert answer.lead < SURE
    assert words in answer.reason


def test_two_of_three_reflectors_are_found_where_they_stand() -> None:
    """Their angle depends on the centre, which little but the prior tells; their distance does not."""
    answer = stranger("one less")
    first, other = answer.rival.estimate.positions
    assert abs(first - other) == pytest.approx(2 * 0.11 * np.sin(np.pi / 3), abs=2e-3)


def test_a_tag_without_its_middle_on_a_body_that_waves_pass_is_not_named() -> None:
    answer = bare(scans_at(ring(0, 180, radius_m=0.09), offset_m=0.007))
    assert answer.name is None
    assert "2 reflectors 180 degrees apart, 90 mm from the centre on a body" in answer.reason


def test_a_tag_that_an_opaque_body_hides_beyond_an_edge_is_named() -> None:
    (layout,) = (layout for layout in LAYOUTS if layout.name == "helmet-120")
    scans = scans_at(layout.positions, shaded=True, offset_m=0.004)
    answer = decide(Contest(Spectra.of(scans), LAYOUTS, (POINTS, SHADES[0], WALLS[0]), ()).run())
    assert answer.name == "helmet-120"
    assert answer.best is not None and answer.best.estimate.model.transfer is SHADES[0]


def test_a_foreign_pair_on_an_oval_shell_is_not_named() -> None:
    scans = prepared(draw(6_000_150).capture)
    answer = decide(Contest(Spectra.of(scans), LAYOUTS, (BARE, POINTS, WALLS[0]), ()).run())
    assert answer.name is None
    assert "2 reflectors 132 degrees apart, 116 mm" in answer.reason
    assert answer.reason.endswith("; this arrangement is not enrolled")


@pytest.mark.parametrize(
    ("seed", "code"),
    [
        # A box and something beside it, at 12 views: without sheets a layout explains it by 6.5 nats.
        (300_186, Code.NO_TAG),
        # A loud tag moves the centre that its body seems to have.
        (300_146, Code.EXTRA),
    ],
)
def test_a_stranger_beside_a_body_is_not_named(seed: int, code: Code) -> None:
    scans = prepared(draw(seed).capture)
    answer = decide(Contest(Spectra.of(scans), LAYOUTS).run())
    assert answer.name is None and answer.lead < 0
    assert answer.code is code


def test_a_layout_with_a_reflector_more_on_its_ring_is_not_named() -> None:
    """On a metal box, beside another object: two of three stand as those of helmet-linear do."""
    scans = prepared(draw(379_288, views=18).capture)
    answer = decide(Contest(Spectra.of(scans), LAYOUTS).run())
    assert answer.name is None and answer.lead < -20
    assert answer.code is Code.EXTRA and "3 reflectors 48, 130 and 182 degrees apart, 87 mm" in answer.reason


def test_bodies_are_tried_again_for_what_is_found_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search goes other ways under slightly other clutter: a layout's four reflectors are found late."""
    grid = np.linspace(0, 100, 10_001)
    angle = (np.arange(128) + 0.5) * np.pi / 128
    waves = np.outer(grid, np.sin(angle))
    # The same average over a disc in closed form, J0 + J2.
    exact = np.cos(waves).mean(axis=1) + np.cos(2 * angle - waves).mean(axis=1)
    monkeypatch.setattr("tagid.reading.spectra._disc_table", lambda: (grid, exact))
    scans = prepared(draw(300_146).capture)
    answer = decide(Contest(Spectra.of(scans), LAYOUTS, sheets=()).run())
    assert (answer.name, answer.code) == (None, Code.EXTRA)
    assert answer.lead < -20


def test_a_layout_far_from_its_places_is_another_tag() -> None:
    """A can with a handle and a pair: 89 degrees apart fits, but 18 and 8 mm from where the layout has it."""
    scans = prepared(draw(340_353, views=36).capture)
    answer = decide(Contest(Spectra.of(scans), LAYOUTS, sheets=()).run())
    assert answer.name is None and answer.lead < -20


@cache
def contested(positions: tuple[tuple[float, float], ...], seed: int, snr_db: float) -> Contest:
    scans = scans_at(np.array(positions), views=18, snr_db=snr_db, seed=seed, offset_m=0.002 + 0.001 * seed)
    result = Contest(Spectra.of(scans), LAYOUTS, (BARE, POINTS), ())
    result.run()
    return result


def placed(name: str) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in builtin_layouts()[name].positions)


def together(
    positions: tuple[tuple[float, float], ...], snr_db: float, seeds: tuple[int, ...]
) -> tuple[list[Decision], Decision]:
    contests = [contested(positions, seed, snr_db) for seed in seeds]
    return [decide(contest.hypotheses) for contest in contests], decide_together(contests)


def test_recordings_that_name_nothing_alone_name_the_tag_together() -> None:
    alone, joint = together(placed("container-90"), -1.5, (1, 2, 3))
    assert [design.name for design in alone] == [None] * 3
    assert (joint.status, joint.name) == ("identified", "container-90")
    assert joint.lead > max(design.lead for design in alone)


def test_a_stranger_loses_farther_with_more_recordings() -> None:
    positions = tuple((0.045 * np.cos(a), 0.045 * np.sin(a)) for a in np.deg2rad([0, 130]))
    alone, joint = together(positions, 5.0, (1, 2))
    assert joint.status == "unknown" and joint.reason.startswith("2 reflectors")
    assert joint.lead < min(design.lead for design in alone)


def test_recordings_of_two_tags_are_not_named() -> None:
    contests = [contested(placed(name), 2, 15.0) for name in ("container-90", "container-180")]
    assert [decide(contest.hypotheses).name for contest in contests] == ["container-90", "container-180"]
    assert decide_together(contests).name is None


def test_one_recording_is_decided_as_alone() -> None:
    single = contested(placed("container-90"), 2, 15.0)
    assert decide_together([single]).lead == decide(single.hypotheses).lead
