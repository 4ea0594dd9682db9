"""Tags in cartons that nobody enrolled.

The responses of tests/data/cartons were solved by the method of moments: cardboard 105 by 140 mm wide with a
bottom, of which the reader's four endless walls know nothing.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from solved_shells import recorded_at

from tagid.fields.thin_shell import BoxShell, ShellView
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.tags.bodies.body_reading import BodySettings
from tagid.tags.bodies.hypothesis import Kind
from tagid.tags.bodies.shell_decide import decide_on_shell
from tagid.tags.bodies.shell_model import ShellBody, likely_boxes
from tagid.tags.bodies.shell_reader import ShellReading, read_in_box
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.matcher import read_tag
from tagid.tags.matching.on_shell import on_shell
from tagid.tags.matching.reading import Reading
from tagid.tags.verdicts.verdict import Code
from train.population import draw

LAYOUTS = list(builtin_layouts().values())
CENTRE_M = (-0.003, 0.005)


@cache
def recorded(name: str, views: int = 36, snr_db: float = 20.0) -> BasebandScans:
    """A recording 6 mm off the axis."""
    return recorded_at(CENTRE_M, "cartons", name, views, snr_db)


def read(name: str, views: int = 36, snr_db: float = 20.0) -> Reading:
    return read_tag(recorded(name, views, snr_db), LAYOUTS)


@cache
def box_reading(name: str) -> ShellReading:
    found = read_in_box(Spectra.of(recorded(name)), LAYOUTS, BodySettings())
    assert found is not None
    return found


@pytest.mark.parametrize(("views", "snr_db"), [(36, 20.0), (36, 10.0), (18, 20.0)])
def test_a_tag_in_a_carton_is_named_without_enrolment(views: int, snr_db: float) -> None:
    reading = read("carton140_c90", views, snr_db)
    assert (reading.status, reading.layout, reading.kind) == ("identified", "container-90", Kind.BOX)
    assert np.hypot(*np.subtract(reading.centre_m, CENTRE_M)) < 2.5e-3
    assert reading.bound is None
    assert reading.hypotheses[0].kind is Kind.BOX and reading.hypotheses[0].left < 0.02
    body = reading.body
    assert body is not None and isinstance(body.body, ShellBody)
    sides = sorted((body.body.fit.shell.across_m, body.body.fit.shell.along_m))
    np.testing.assert_allclose(sides, [0.0525, 0.070], atol=1.5e-3)


@pytest.mark.parametrize("name", ["carton140", "carton140_three"])
@pytest.mark.parametrize("views", [18, 36])
def test_an_untagged_carton_and_a_foreign_tag_are_not_named(name: str, views: int) -> None:
    assert read(name, views).status != "identified"


@pytest.mark.parametrize("wrong", ["none", "conjugate", "inverse"])
def test_the_walls_fix_what_reflectors_between_them_return(
    wrong: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reflectors that they do not change, or change with a wrong sign, leave more of the echo."""
    right, relative = box_reading("carton140_c90").reading, ShellView.relative
    made = {"none": np.ones_like, "conjugate": np.conj, "inverse": lambda x: 1 / x}[wrong]
    monkeypatch.setattr(ShellView, "relative", lambda *a: made(relative(*a)))
    found = read_in_box(Spectra.of(recorded("carton140_c90")), LAYOUTS, BodySettings())
    assert found is None or found.reading.unexplained > 2 * right.unexplained


def test_the_sides_of_an_empty_carton_are_found_from_its_flashes() -> None:
    best = likely_boxes(Spectra.of(recorded("carton140")), 3)[0].shell
    np.testing.assert_allclose(sorted((best.across_m, best.along_m)), [0.0525, 0.070], rtol=0.05)


def test_reflectors_that_are_not_where_the_layout_has_them_are_refused() -> None:
    """Two reflectors of another spacing seem nearer to their middle, or further from it."""
    found = box_reading("carton140_c90")
    decision = ContestSettings().box
    assert decide_on_shell(found, decision).status == "identified"
    best = found.reading.layouts[0]
    at = best.batch.at.copy()
    at[0, 2] = 1.5 * decision.shift_m
    moved = replace(best, batch=replace(best.batch, at=at))
    other = replace(found, reading=replace(found.reading, layouts=(moved, *found.reading.layouts[1:])))
    assert decide_on_shell(other, decision).code is Code.RADIUS


def test_reflectors_before_a_wall_are_refused_and_those_far_from_it_are_not() -> None:
    found, decision = box_reading("carton140_c90"), ContestSettings().box
    assert (found.outside_m < 0).all()
    near = np.array([0.015, -0.02])
    for lead, is_refused in ((1.4, True), (1.6, False)):
        led = replace(found, outside_m=near, reading=replace(found.reading, lead=lead))
        before = decide_on_shell(led, decision)
        assert (before.code is Code.BODY and "would stand before them" in before.reason) == is_refused
    assert decide_on_shell(replace(found, outside_m=np.array([0.05, 0.06])), decision).status == "identified"


def test_a_box_is_as_wide_as_its_diagonal() -> None:
    shell = BoxShell(0.03, 0.04, 2.8e-3)
    assert shell.radius_m == pytest.approx(0.05)
    assert np.abs(shell.outline(400).contour).max() == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize("seed", [9022715, 9023039, 9024196, 9025789])
def test_objects_that_are_no_cartons_are_not_named_in_one(seed: int) -> None:
    """Two bare reflectors, a can with three, a box and a shell without any: a round body explains more than
    the walls, other arrangements nearly as much, or the reflectors would answer 44 mm before their places."""
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    reading = read_tag(preprocess(draw(seed).capture, settings=settings), LAYOUTS)
    assert reading.status == "unknown"


@pytest.mark.parametrize(("left", "stands"), [(0.012, True), (0.05, False)])
def test_a_name_beside_a_glass_that_leaves_nothing_does_not_give_way(left: float, stands: bool) -> None:
    """The carton leaves half a per cent: of what is left beside the glass, too little for another body."""
    scans = recorded("carton140_c90")
    found = read("carton140_c90")
    glass = next(one for one in found.hypotheses if one.kind is Kind.ROUND)
    plain = tuple(one for one in found.hypotheses if one.kind in (Kind.BARE, Kind.NO_TAG))
    settled = replace(found, kind=Kind.ROUND, hypotheses=(replace(glass, left=left), *plain))
    said = on_shell(settled, scans, LAYOUTS, ContestSettings())
    assert (said is None) == stands


@pytest.mark.parametrize(("share", "stands"), [(0.008, True), (0.05, False)])
def test_a_name_on_a_cup_that_a_free_pattern_explains_does_not_give_way_to_a_box(
    share: float, stands: bool
) -> None:
    """The wall of a cup on the axis left 4 % at 20 dB, the sides of a box 1 %, with the same layout."""
    scans = recorded("carton140_c90")
    found = read("carton140_c90")
    assert found.body is not None
    glass = next(one for one in found.hypotheses if one.kind is Kind.ROUND)
    plain = tuple(one for one in found.hypotheses if one.kind in (Kind.BARE, Kind.NO_TAG))
    freely = found.body.noise + share * (found.body.energy - found.body.noise)
    settled = replace(
        found,
        kind=Kind.ROUND,
        body=replace(found.body, freely=freely),
        hypotheses=(replace(glass, left=0.05), *plain),
    )
    said = on_shell(settled, scans, LAYOUTS, ContestSettings())
    assert (said is None) == stands
