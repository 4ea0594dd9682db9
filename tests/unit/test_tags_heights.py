"""Reflectors at several heights: what the antenna's height does to an echo, and how the reader uses it."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest

from tagid.enrolling.field import MatchedField
from tagid.geometry import Aperture
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import PreparedCapture, prepare
from tagid.reading.alike import Conditions, told_apart
from tagid.reading.views import fold_views
from tagid.tags.layouts.codebook import all_distances, height_weight, in_space, rotational_distance
from tagid.tags.layouts.design import DesignRules, design
from tagid.tags.layouts.objects import Row, TaggedObject
from tests.unit.heights_scenes import DOWN, FLAT, OTHER, PLAN, UP, scan
from tests.unit.imaging_scenes import turn

HEIGHTS = (0.0, 0.1, 0.2)
ALL = [UP, DOWN, OTHER, FLAT]
OBJECT = TaggedObject("two-rows", "other", (Row(0.1), Row(0.1, 0.06)))


def test_a_higher_point_is_nearer_to_a_higher_antenna() -> None:
    """d(z) - d(0) = (z^2 - 2 z h) / 2 D to second order: -10.2 mm for z = 0.06 m, h = 0.2 m, D = 1 m."""
    aperture = scan(FLAT, HEIGHTS).aperture()
    low, high = aperture.distances(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.06]])).T
    change = high - low
    for views, height in zip(aperture.height_groups(), HEIGHTS, strict=True):
        exact = np.hypot(1, 0.06 - height) - np.hypot(1, height)
        assert change[views] == pytest.approx(exact, abs=1e-12)
    assert change[-1] == pytest.approx(-0.0100, abs=3e-4)
    assert change[0] == pytest.approx(+0.0018, abs=1e-5)


def test_layouts_that_differ_in_height_alone_are_told_apart() -> None:
    reading = identify(prepare(scan(UP, (0.0, 0.2), 0.02, views=24)), ALL).reading
    assert (reading.status, reading.layout) == ("identified", "up")
    measured = [reflector.z_m for reflector in reading.reflectors]
    assert measured == pytest.approx(np.asarray(UP.heights) + 0.02, abs=0.01)


def test_each_height_has_a_room_of_its_own() -> None:
    """The static part of each height is subtracted from data and templates."""
    prepared = PreparedCapture(prepare(scan(UP, HEIGHTS)))
    scans = prepared.scans(prepared.settings.preprocessing(matched_filter=False))
    field = MatchedField(scans, 0.15)
    for rows in (field.templates(PLAN), field.data[None]):
        by_view = rows.reshape(len(rows), field.views, -1)
        for views in scans.aperture.height_groups():
            assert abs(by_view[:, views].mean(axis=1)).max() < 1e-5 * abs(rows).max()


def test_many_views_of_every_height_are_folded() -> None:
    prepared = PreparedCapture(prepare(scan(UP, HEIGHTS, views=300)))
    scans = prepared.scans(prepared.settings.preprocessing(matched_filter=False))
    few = fold_views(scans, 0.15)
    assert few.aperture.views < scans.aperture.views / 2
    levels = [few.aperture.positions[views[0], 2] for views in few.aperture.height_groups()]
    assert levels == pytest.approx(HEIGHTS)
    fields = MatchedField(few, 0.15), MatchedField(scans, 0.15)
    values = [field.correlate(field.templates(PLAN)) / field.template_energy for field in fields]
    np.testing.assert_allclose(values[0], values[1], atol=0.02 * abs(values[1]).max())
    free = replace(scans, aperture=Aperture(scans.aperture.positions * np.array([1.0, 1.1, 1.0])))
    assert fold_views(free, 0.15) is free


def test_heights_count_as_much_as_the_antennas_reach() -> None:
    assert height_weight((0.3,), 1.0) == 0
    weight = height_weight((0.0, 0.2, 0.4), 1.0)
    assert height_weight((0.0, 0.2, 0.4), 2.0) == pytest.approx(weight / 2)
    # The mean change of the range over a turn and the antenna heights is that of the plane displacement.
    aperture = Aperture(np.concatenate([turn(90, 1.0, h).positions for h in (0.0, 0.2, 0.4)]))
    base, risen, moved = np.array([[0, 0, 0.0], [0, 0, 1e-4], [1e-4 * weight, 0, 0]])[:, None]
    change = [np.std(aperture.distances(p) - aperture.distances(base)) for p in (risen, moved)]
    assert change[0] == pytest.approx(change[1], rel=0.1)
    assert rotational_distance(UP, FLAT).worst_m < 1e-9
    apart = rotational_distance(UP, DOWN, height_weight=weight).rms_m
    assert apart == pytest.approx(weight * np.std([0, 0.12, 0]), abs=1e-9)
    raised = replace(UP, heights=np.asarray(UP.heights) + 0.02)
    assert rotational_distance(UP, raised, height_weight=weight).worst_m < 1e-9
    space = np.array([in_space(layout, weight) for layout in ALL])
    matrix = all_distances(space)
    for i, j in combinations(range(4), 2):
        assert matrix[i, j] == pytest.approx(rotational_distance(ALL[i], ALL[j], height_weight=weight).rms_m)


def test_recordings_of_several_heights_tell_rows_apart() -> None:
    flat, tall = (told_apart(UP, DOWN, Conditions(height_weight=weight)) for weight in (0.0, 0.2))
    assert flat.unresolved() > 0.9 and tall.lead > flat.lead + 50


def test_rows_carry_more_layouts_where_several_heights_are_recorded() -> None:
    rules = DesignRules(3, 8)
    several = replace(rules, antenna_heights_m=(0.0, 0.3, 0.6))
    flat, tall = design(OBJECT, rules, 4), design(OBJECT, several, 4)
    assert tall.candidates > 2 * flat.candidates
    weight = several.height_weight
    apart = [rotational_distance(a, b, height_weight=weight).rms_m for a, b in combinations(tall.layouts, 2)]
    assert tall.distance_m == pytest.approx(min(apart), abs=1e-6)
    assert tall.distance_m > flat.distance_m
    beside = design(OBJECT, several, 4, beside=tall.layouts)
    for a, b in product(tall.layouts, beside.layouts):
        assert rotational_distance(a, b, height_weight=weight).worst_m >= 0.012
    assert len({layout.name for layout in (*tall.layouts, *beside.layouts)}) == 8
