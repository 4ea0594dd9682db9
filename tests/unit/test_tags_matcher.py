"""The reader against scans made from their definition: places, signs, statuses, and rates of rejection."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tags_synthetic import synthetic_scans

from tagid.errors import DataError, RegistryError
from tagid.geometry import Aperture
from tagid.imaging.types import BasebandScans
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.matching.matcher import ReaderSettings, read_tag
from tagid.tags.matching.reading import Reading
from tagid.tags.reading.aspect import ROUND, TRANSPARENT, Appearance, outward
from tagid.tags.reading.coarse import COARSE_NO_SIDE_M, CoarseImage
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.reflectors import find_reflectors
from tagid.tags.reading.views import fold_views

LAYOUTS = builtin_layouts()
ALL = list(LAYOUTS.values())
SCALENE = np.array([[0.1, 0.0], [-0.02, 0.06], [-0.05, -0.04]])


def turn_error_deg(reading: Reading, truth_deg: float, symmetry: int) -> float:
    """Difference of turns within a layout's symmetry, degrees."""
    period = 360 / symmetry
    return abs((reading.rotation_deg - truth_deg + period / 2) % period - period / 2)


def test_the_fit_of_known_points_gives_their_amplitudes() -> None:
    points = np.array([[0.05, 0.02], [-0.03, 0.06]])
    sigma = np.array([1.0, 0.5j])
    field = MatchedField(synthetic_scans(points, amplitudes=sigma), 0.15)
    d = field.templates(field.distances(points))
    found = np.linalg.solve(field.gram(d), field.correlate(d))
    assert np.allclose(found, sigma, atol=0.01)
    explained = np.vdot(field.correlate(d), found).real
    assert explained == pytest.approx(field.energy, rel=0.01)


def test_static_clutter_changes_nothing() -> None:
    points = LAYOUTS["helmet-linear"].placed(0.3, np.array([0.004, 0.0]))
    scans = synthetic_scans(points)
    wall = 5 * np.exp(1j * np.arange(scans.samples.shape[1]))
    cluttered = MatchedField(scans, 0.15)
    scans.samples[:] += wall.astype(np.complex64)
    assert np.allclose(MatchedField(scans, 0.15).at(points), cluttered.at(points), atol=1e-3)


@pytest.mark.parametrize("name", sorted(LAYOUTS))
@pytest.mark.parametrize(("turn_deg", "centre"), [(40.0, (0.006, -0.005)), (-77.0, (-0.009, 0.002))])
def test_reads_name_turn_and_centre(name: str, turn_deg: float, centre: tuple[float, float]) -> None:
    layout = LAYOUTS[name]
    points = layout.placed(np.deg2rad(turn_deg), np.array(centre))
    reading = read_tag(synthetic_scans(points, noise=0.2, seed=3, distance_error=0.007), ALL)
    assert (reading.status, reading.layout) == ("identified", name)
    # Two neighbouring reflectors turn about either's place for a small shift of the centre: 45 mm lever.
    assert turn_error_deg(reading, turn_deg, layout.symmetry) < 3.0
    assert np.hypot(*(np.array(reading.centre_m) - centre)) < 2.5e-3
    assert reading.score > 0.9
    assert reading.margin > 0.3
    found = np.array([(r.x_m, r.y_m) for r in reading.reflectors if r.matched])
    gap = np.linalg.norm(found[:, None] - points[None], axis=2).min(axis=1)
    assert gap.max() < 2e-3


def test_an_object_turned_further_reads_further() -> None:
    """The scans of an object turned by +a are those of the unturned one rolled by a views."""
    layout = Layout("scalene", SCALENE)
    scans = synthetic_scans(layout.positions, views=36)
    first = read_tag(scans, [layout, *ALL])
    # After a turn of 50 deg, view v sees what the unturned object showed at view v + 5: the table turns on.
    rolled = synthetic_scans(layout.positions, views=36)
    rolled.samples[:] = np.roll(scans.samples, -5, axis=0)
    second = read_tag(rolled, [layout, *ALL])
    assert first.layout == second.layout == "scalene"
    assert turn_error_deg(first, 0.0, 1) < 1.0
    assert turn_error_deg(second, 50.0, 1) < 1.0


def test_the_mirror_image_is_another_layout() -> None:
    layout, mirrored = Layout("right", SCALENE), Layout("left", SCALENE * np.array([1.0, -1.0]))
    for truth in (layout, mirrored):
        scans = synthetic_scans(truth.placed(2.0, np.array([0.003, 0.003])), noise=0.3, seed=1)
        assert read_tag(scans, [layout, mirrored]).layout == truth.name
        other = mirrored if truth is layout else layout
        assert read_tag(scans, [other]).status == "unknown"


def test_nested_layouts_are_told_apart() -> None:
    """Any two reflectors of a helmet are a part of it; a third echo must not be ignored, nor invented."""
    helmet = LAYOUTS["helmet-120"]
    pair = Layout("pair", helmet.positions[:2])
    for truth in (helmet, pair):
        scans = synthetic_scans(truth.placed(1.0, np.zeros(2)), noise=0.3, seed=2)
        reading = read_tag(scans, [helmet, pair])
        assert (reading.status, reading.layout) == ("identified", truth.name)
    assert read_tag(synthetic_scans(pair.positions, noise=0.3), [helmet]).status == "unknown"
    extra = read_tag(synthetic_scans(helmet.positions, noise=0.3), [pair])
    assert extra.status == "unknown"
    assert extra.layout is None


def test_layouts_that_nobody_enrolled_are_unknown() -> None:
    rng = np.random.default_rng(5)
    square = np.array([[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0], [0.0, -0.1]])
    others = [square, np.array([[0.07, 0.0], [-0.07, 0.0]]), rng.uniform(-0.1, 0.1, (4, 2))]
    for seed, points in enumerate(others):
        reading = read_tag(synthetic_scans(points, noise=0.3, seed=seed), ALL)
        assert reading.status == "unknown"
        assert reading.reason


def test_two_layouts_a_millimetre_apart_are_ambiguous() -> None:
    moved = SCALENE.copy()
    moved[0, 0] += 0.001
    scans = synthetic_scans(SCALENE, noise=0.5, seed=4)
    reading = read_tag(scans, [Layout("one", SCALENE), Layout("two", moved)])
    assert reading.status == "ambiguous"
    assert reading.margin < 0.05


def test_noise_holds_no_tag() -> None:
    """12 recordings of noise: the largest statistic stays clear of the threshold."""
    nats = []
    for seed in range(12):
        scans = synthetic_scans(np.zeros((0, 2)), noise=1.0, seed=seed, views=18 if seed % 2 else 36)
        reading = read_tag(scans, ALL)
        assert reading.status == "no_tag"
        assert reading.score == 0.0
        nats.append(reading.evidence.nats)
    assert max(nats) < 20


def test_a_missing_reflector_takes_the_name_away() -> None:
    points = LAYOUTS["helmet-120"].positions
    reading = read_tag(synthetic_scans(points, amplitudes=np.array([1, 1, 0.05]), noise=0.2), ALL)
    assert reading.status == "unknown"


def test_many_views_fold_into_few_without_loss() -> None:
    points = LAYOUTS["helmet-120"].placed(0.2, np.array([0.005, 0.0]))
    many = synthetic_scans(points, views=720)
    few = fold_views(many, 0.15)
    assert few.aperture.views < 120
    truth = synthetic_scans(points, views=few.aperture.views)
    error = np.linalg.norm(few.samples - truth.samples) / np.linalg.norm(truth.samples)
    assert error < 0.01
    noise = synthetic_scans(np.zeros((0, 2)), views=720, noise=1.0)
    folded = fold_views(noise, 0.15)
    assert np.sqrt(np.mean(np.abs(folded.samples) ** 2)) == pytest.approx(folded.noise_std, rel=0.05)
    assert fold_views(synthetic_scans(points, views=36), 0.15).aperture.views == 36


def test_a_part_of_a_turn_is_not_folded() -> None:
    scans = synthetic_scans(SCALENE, views=720)
    half = Aperture.turntable(np.linspace(0, np.pi, 720), 0.5)
    assert fold_views(scans.with_aperture(half), 0.15).aperture.views == 720


def test_the_finder_reports_reflectors_and_no_sidelobes() -> None:
    rng = np.random.default_rng(0)
    for name, layout in LAYOUTS.items():
        points = layout.placed(rng.uniform(0, 6), np.array([0.008, 0.004]))
        found = find_reflectors(synthetic_scans(points, noise=0.2, seed=1))
        assert len(found) == layout.size, name
        places = np.array([(r.x_m, r.y_m) for r in found])
        gap = np.linalg.norm(places[:, None] - points[None], axis=2)
        assert gap.min(axis=1).max() < 2e-3
        assert np.unique(gap.argmin(axis=1)).size == layout.size
        assert all(abs(abs(r.amplitude) - 1) < 0.15 for r in found)
    assert find_reflectors(synthetic_scans(np.zeros((0, 2)), noise=1.0)) == ()


def test_bad_input_is_told() -> None:
    scans = synthetic_scans(SCALENE)
    with pytest.raises(RegistryError):
        read_tag(scans, [])
    with pytest.raises(DataError, match="cover"):
        read_tag(scans.with_aperture(scans.aperture.with_axis_distance(5.0)), ALL)
    scans.samples[:] = 0
    with pytest.raises(DataError, match="zero"):
        read_tag(scans, ALL)


def test_without_the_direction_of_the_turn_mirror_images_read_alike() -> None:
    scalene = Layout("left", np.array([[0.1, 0.0], [-0.02, 0.07], [-0.06, -0.03]]))
    scans = synthetic_scans(scalene.mirrored().placed(0.7, np.zeros(2)), noise=0.1)
    either = ReaderSettings(direction_known=False)
    assert read_tag(scans, [*ALL, scalene]).layout != "left"
    assert read_tag(scans, [*ALL, scalene], either).layout == "left"
    right = replace(scalene.mirrored(), name="right")
    assert read_tag(scans, [scalene, right]).layout == "right"
    assert read_tag(scans, [scalene, right], either).status == "ambiguous"


def seen(points: np.ndarray, facing_deg: np.ndarray, half_width_deg: float, **options: Any) -> BasebandScans:
    """Scans of points each of which is seen only from within half the width of its facing."""
    empty = synthetic_scans(np.zeros((0, 2)), **options)
    antenna = empty.aperture.positions
    for point, facing in zip(points, np.deg2rad(facing_deg), strict=True):
        one = synthetic_scans(point[None], views=len(antenna)).samples
        side = np.arctan2(antenna[:, 1] - point[1], antenna[:, 0] - point[0])
        off = np.abs(np.angle(np.exp(1j * (side - facing))))
        empty.samples[:] += one * (off < np.deg2rad(half_width_deg))[:, None]
    return empty


@pytest.mark.parametrize("name", ["container-90", "container-180", "helmet-120"])
@pytest.mark.parametrize("half_width_deg", [65.0, 90.0, 120.0])
def test_an_opaque_object_is_named(name: str, half_width_deg: float) -> None:
    points = LAYOUTS[name].placed(0.6, np.array([0.005, -0.004]))
    out = np.rad2deg(np.arctan2(points[:, 1], points[:, 0]))
    reading = read_tag(seen(points, out, half_width_deg, noise=0.3, seed=5), ALL)
    assert (reading.status, reading.layout) == ("identified", name)
    assert turn_error_deg(reading, np.rad2deg(0.6), LAYOUTS[name].symmetry) < 3.0


def test_reflectors_seen_from_inside_are_another_object() -> None:
    """Places right, but seen only through the object: a wrong sign of the facing would name it."""
    points = LAYOUTS["helmet-120"].placed(0.6, np.zeros(2))
    inward = np.rad2deg(np.arctan2(points[:, 1], points[:, 0])) + 180
    facing_in = read_tag(seen(points, inward, 75.0, noise=0.3, seed=5), ALL)
    facing_out = read_tag(seen(points, inward + 180, 75.0, noise=0.3, seed=5), ALL)
    assert facing_in.status == "unknown" and "through" in facing_in.reason
    assert facing_out.layout == "helmet-120"
    assert facing_out.evidence.outward > 0.5 > -0.5 > facing_in.evidence.outward


def test_a_transparent_object_has_no_side() -> None:
    reading = read_tag(
        synthetic_scans(LAYOUTS["helmet-120"].placed(0.6, np.zeros(2)), noise=0.3, seed=5), ALL
    )
    assert reading.layout == "helmet-120" and abs(reading.evidence.outward) < 0.1


def test_an_opaque_object_with_one_reflector_too_few_or_too_many_is_not_named() -> None:
    points = LAYOUTS["helmet-120"].placed(0.6, np.array([0.005, -0.004]))
    more = np.concatenate([points, 0.09 * np.array([[np.cos(1.6), np.sin(1.6)]])])
    for placed in (points[:2], more):
        out = np.rad2deg(np.arctan2(placed[:, 1], placed[:, 0]))
        assert read_tag(seen(placed, out, 90.0, noise=0.3, seed=5), ALL).status == "unknown"


def test_a_reflector_behind_a_handle_takes_no_name_away() -> None:
    """120 degrees in which one reflector is hidden: no table of patterns has that."""
    points = LAYOUTS["helmet-120"].placed(0.6, np.array([0.005, -0.004]))
    scans = synthetic_scans(points[:2], noise=0.3, seed=5)
    hidden = seen(points[2:], np.array([100.0]), 120.0)
    scans.samples[:] += hidden.samples
    assert read_tag(scans, ALL).layout == "helmet-120"


def test_fixed_points_are_their_templates() -> None:
    """With an aspect that weighs the views, so that the templates' means over the views are not small."""
    points = np.random.default_rng(1).uniform(-0.12, 0.12, (40, 2))
    field = MatchedField(synthetic_scans(np.array([[0.05, 0.02], [-0.03, 0.06]]), noise=0.1, seed=2), 0.15)
    look = Appearance(ROUND, np.array([0.01, 0.0]), 0.003)
    templates, fixed = look.templates(field, points), look.fixed(field, points)
    assert np.allclose(np.concatenate(list(fixed.templates())), templates, atol=1e-6)
    wanted = field.correlate(templates)
    assert np.abs(fixed.correlate(field.data) - wanted).max() < 1e-5 * np.abs(wanted).max()
    # What is constant over the views does not count, though the points have such a part.
    constant = np.tile(np.arange(field.data.size // field.views) + 1j, field.views).astype(np.complex64)
    assert np.abs(fixed.correlate(field.data + constant) - wanted).max() < 1e-4 * np.abs(wanted).max()


def test_coarse_images_of_several_patterns_are_those_of_each() -> None:
    field = MatchedField(synthetic_scans(np.array([[0.05, 0.02], [-0.03, 0.06]]), noise=0.1, seed=2), 0.15)
    offsets = (-0.008, 0.0, 0.008)
    for image in CoarseImage.of_each(field, 0.1, (TRANSPARENT, ROUND), offsets):
        alone = CoarseImage.of(field, 0.1, image.aspect, offsets)
        assert np.array_equal(image.images, alone.images)
        assert np.array_equal(image.static, alone.static)
        # The pixel at (30, -60) mm, by the definition.
        point = np.array([[0.03, -0.06]])
        facing = outward(point, np.zeros(2), COARSE_NO_SIDE_M)
        weight = image.aspect.weight(field.antenna, point, facing)
        row, column = image.half - 20, image.half + 10
        for k, offset in enumerate(offsets):
            b = field.correlate(field.templates(field.distances(point) + offset, weight))[0]
            assert abs(image.images[k, row, column] - b) < 1e-3 * np.abs(image.images).max()
