"""The compiled loops of the reader and their stand-in: the same numbers, and nothing out of bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tags_synthetic import synthetic_scans

from tagid.geometry import Aperture
from tagid.imaging.types import BasebandScans
from tagid.tags.bodies import points as point_model
from tagid.tags.bodies.points import PointFitter, columns
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.matching.matcher import read_tag
from tagid.tags.reading import compiled
from tagid.tags.reading.aspect import ROUND, TRANSPARENT, Appearance, Aspect, outward
from tagid.tags.reading.coarse import CoarseImage
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.hypotheses import CoarseGrid, SearchSettings, search
from tagid.tags.reading.reflectors import SearchDisc, refine_positions
from tagid.tags.reading.squares import explained_by, separate_sets, whole_grams

pytestmark = pytest.mark.skipif(not compiled.is_compiled(), reason="no compiler was present at installation")

LAYOUTS = builtin_layouts()
HARD = Aspect(cos_edge=0.4, softness=0.25)


def two_heights(scans: BasebandScans) -> BasebandScans:
    """The same samples, half of them seen from 0.1 m above."""
    places = scans.aperture.positions.copy()
    places[::2, 2] = 0.1
    return replace(scans, aperture=Aperture(places))


def two_antennas(scans: BasebandScans) -> BasebandScans:
    """The same samples, transmitter and receiver 0.1 m apart."""
    places = scans.aperture.positions
    return replace(
        scans, aperture=Aperture(places, half_baseline=np.tile([0.0, 0.0, 0.05], (len(places), 1)))
    )


SCENES = {"turntable": lambda scans: scans, "two heights": two_heights, "two antennas": two_antennas}


def fields(kind: str, monkeypatch: pytest.MonkeyPatch, views: int = 13) -> tuple[MatchedField, MatchedField]:
    """A matched field with the compiled loops, and one without."""
    points = LAYOUTS["helmet-120"].placed(0.3, np.array([0.004, -0.003]))
    scans = SCENES[kind](synthetic_scans(points, views=views, noise=0.1, seed=5))
    fast = MatchedField(scans, 0.15, (-0.1, 0.1))
    with monkeypatch.context() as patch:
        patch.setattr(compiled, "_matched", None)
        return fast, MatchedField(scans, 0.15, (-0.1, 0.1))


def assert_alike(found: np.ndarray, wanted: np.ndarray, share: float = 2e-6) -> None:
    assert found.shape == wanted.shape
    assert np.abs(found - wanted).max() <= share * np.abs(wanted).max()


@pytest.mark.parametrize("kind", sorted(SCENES))
@pytest.mark.parametrize("aspect", [TRANSPARENT, ROUND, HARD])
def test_least_squares_on_sets_of_points(kind: str, aspect: Aspect, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-0.1, 0.1, (8, 2)), rng.uniform(-0.05, 0.05, 8)])
    points[3, :2] = 0.001  # too near to the middle to have a side
    facing, offsets = outward(points, np.zeros(2)), rng.uniform(-0.01, 0.01, 8)
    fast, plain = fields(kind, monkeypatch)
    assert fast.tables is not None and plain.tables is None
    for sets in (separate_sets(2, 4), np.array([[0, 1, 2], [7, 1, 0], [3, 3 - 1, 5]])):
        one = explained_by(fast, aspect, points, facing, offsets, sets)
        other = explained_by(plain, aspect, points, facing, offsets, sets)
        assert_alike(one.gram, other.gram)
        assert_alike(one.explained, other.explained, 1e-5)
        assert_alike(one.amplitudes, other.amplitudes, 1e-5)
    places, faced = points.reshape(2, 4, 3), facing.reshape(2, 4, 2)
    grams = [whole_grams(f, aspect, places[..., :2], np.zeros(4), faced) for f in (fast, plain)]
    assert_alike(*grams)


@pytest.mark.parametrize("kind", sorted(SCENES))
def test_free_points_come_to_the_same_places(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fast, plain = fields(kind, monkeypatch)
    start = LAYOUTS["helmet-120"].placed(0.33, np.array([0.006, -0.001]))
    if kind == "two heights":
        start = np.column_stack([start, np.zeros(3)])
    for aspect in (TRANSPARENT, ROUND):
        look = Appearance(aspect, np.array([0.004, -0.003]), 0.001)
        one, other = (refine_positions(f, start, look) for f in (fast, plain))
        assert one[2] == pytest.approx(other[2], rel=1e-5)
        np.testing.assert_allclose(one[0], other[0], atol=2e-5)
        assert_alike(one[1], other[1], 2e-3)
        # They have moved, and explain more than where they began.
        facing = outward(start, look.centre_m)
        begun = explained_by(plain, aspect, start, facing, 0.001, separate_sets(1, 3))
        assert one[2] > 1.05 * begun.explained[0]


@pytest.mark.parametrize("kind", sorted(SCENES))
@pytest.mark.parametrize("count", [0, 2])
def test_points_leave_alike(kind: str, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    fast, plain = fields(kind, monkeypatch)
    heights = np.array([-0.02, 0.03]) if kind == "two heights" else None
    places = np.array([[0.04, -0.03, 0.01], [-0.05, 0.02, -0.01]])[:count, : 2 if heights is None else 3]
    for aspect in (TRANSPARENT, ROUND):
        look = Appearance(aspect, np.array([0.004, -0.003]), 0.001)
        one, other = (SearchDisc(f, 0.06, 5e-3, look, heights) for f in (fast, plain))
        amplitudes = np.array([0.3 + 0.2j, -0.5j])[:count]
        assert_alike(one.left(places, amplitudes), other.left(places, amplitudes), 1e-5)
        if count:
            found, wanted = one.fitted(places), other.fitted(places)
            assert_alike(found[0], wanted[0], 1e-5)
            assert found[1] == pytest.approx(wanted[1], rel=1e-5)
    # The scans themselves, without a point.
    if not count:
        assert_alike(one.power, other.power, 1e-5)


FOUR = Layout("four", np.array([[0.1, 0.0], [0.0, 0.08], [-0.09, 0.02], [0.03, -0.1]]))
NINE_OFFSETS = tuple(i * 4e-3 for i in range(-4, 5))


@pytest.mark.parametrize("kind", ["turntable", "two antennas"])
@pytest.mark.parametrize(
    "layout", [LAYOUTS["container-90"], LAYOUTS["helmet-120"], FOUR], ids=lambda one: one.name
)
@pytest.mark.parametrize("offsets", [SearchSettings.offsets_m, NINE_OFFSETS], ids=len)
def test_the_coarse_search_explains_the_same(
    kind: str, layout: Layout, offsets: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    fast, plain = fields(kind, monkeypatch)
    settings = SearchSettings(offsets_m=offsets)
    grid = CoarseGrid.of(layout, settings)
    for aspect in settings.aspects:
        one, other = (CoarseImage.of(f, 0.13, aspect, settings.offsets_m) for f in (fast, plain))
        assert_alike(one.images, other.images, 1e-5)
        assert_alike(one.static, other.static, 1e-5)
        facing = outward(grid.placed, np.zeros(2))
        gram = whole_grams(plain, aspect, grid.placed, np.zeros(layout.size), facing)
        energies = grid.energies(one, gram, plain.template_energy, settings.balance)
        with monkeypatch.context() as patch:
            patch.setattr(compiled, "_matched", None)
            wanted = grid.energies(other, gram, plain.template_energy, settings.balance)
        assert_alike(energies.values, wanted.values, 1e-4)
        assert np.array_equal(energies.best, energies.values.max(axis=2))
        assert_alike(energies.best, wanted.best, 1e-4)


@pytest.mark.parametrize("kind", sorted(SCENES))
def test_the_search_for_layouts_finds_the_same(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    layouts = list(LAYOUTS.values())
    fast, plain = fields(kind, monkeypatch, views=24)
    found = search(fast, layouts, SearchSettings())
    with monkeypatch.context() as patch:
        patch.setattr(compiled, "_matched", None)
        wanted = search(plain, layouts, SearchSettings())
    best, right = (min(fits, key=lambda fit: fit.criterion) for fits in (found, wanted))
    assert best.layout.name == right.layout.name == "helmet-120"
    assert best.charged == pytest.approx(right.charged, rel=1e-4)
    np.testing.assert_allclose(best.positions, right.positions, atol=1e-4)


@pytest.mark.parametrize("kind", sorted(SCENES))
@pytest.mark.parametrize("count", [3, 8, 11])
def test_points_explain_alike_beyond_templates(
    kind: str, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    fast, plain = fields(kind, monkeypatch)
    points = np.random.default_rng(1).uniform(-0.12, 0.12, (40, 2))
    look = Appearance(ROUND, np.array([0.01, 0.0]), 0.003)
    others = look.templates(plain, points[:count] + 0.01)
    inverse = np.linalg.inv(plain.gram(others) + 0.1 * plain.template_energy * np.eye(count))
    one, other = (look.fixed(f, points).beyond(others, inverse) for f in (fast, plain))
    assert_alike(one, other, 1e-5)
    assert one.min() < 0.8 * plain.template_energy
    assert_alike(
        look.fixed(fast, points).correlate(plain.data), plain.correlate(look.templates(plain, points)), 1e-5
    )


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_model_of_points_and_bounces_is_the_same(count: int) -> None:
    rng = np.random.default_rng(count)
    views = 17
    data = rng.standard_normal((9, views)) + 1j * rng.standard_normal((9, views))
    antenna = 1.05 * np.exp(-2j * np.pi * np.arange(views) / views)
    kappa = 2 * 83.0 + np.linspace(-33, 33, 9)
    data -= data.mean(axis=1, keepdims=True)
    spectra = Spectra(data, kappa, antenna, np.full(views, 0.03), 1.05, 1e-9)
    places = rng.uniform(-0.1, 0.1, count) + 1j * rng.uniform(-0.1, 0.1, count)
    heights = rng.uniform(0, 0.03, count)
    fitter = PointFitter(spectra, 1.0)
    still, found = fitter._descended(places, heights, 0, rigid=False)
    wanted = fitter._linear(places, heights)
    assert np.array_equal(still, places)
    assert found.left == pytest.approx(wanted.left, rel=1e-10)
    assert_alike(found.normal, wanted.normal, 1e-6)
    assert_alike(found.gradient, wanted.gradient, 1e-6)


@pytest.mark.parametrize("rigid", [False, True])
def test_fits_of_points_end_in_the_same_places(rigid: bool) -> None:
    rng = np.random.default_rng(6)
    antenna = 1.05 * np.exp(-2j * np.pi * np.arange(17) / 17)
    kappa, height = 2 * 83.0 + np.linspace(-33, 33, 9), np.full(17, 0.03)
    exact = np.array([0.04 + 0.01j, -0.03 + 0.05j, 0.02 - 0.06j])
    empty = Spectra(np.zeros((9, 17), complex), kappa, antenna, height, 1.05, 1e-3)
    noise = rng.standard_normal((9, 17)) + 1j * rng.standard_normal((9, 17))
    data = columns(empty, exact, np.zeros(3)).sum(axis=1) + 0.03 * (noise - noise.mean(axis=1, keepdims=True))
    fitter = PointFitter(replace(empty, data=data), 1e-3)
    start = exact * np.exp(0.05j) + (0.002 - 0.001j)
    found, at = fitter._descended(start, np.zeros(3), 8, rigid=rigid)
    wanted, there = fitter._descended_slowly(start, np.zeros(3), 8, rigid=rigid)
    assert np.abs(found - wanted).max() < 1e-8
    assert np.abs(found - exact).max() < 2e-3 < np.abs(start - exact).max()
    assert at.left == pytest.approx(there.left, rel=1e-8)
    assert_alike(at.normal, there.normal, 1e-5)


def test_without_a_compiler_the_answer_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    points = LAYOUTS["container-90"].placed(0.3, np.array([0.004, -0.003]))
    scans = synthetic_scans(points, noise=0.1, seed=4)
    one = read_tag(scans, list(LAYOUTS.values()))
    monkeypatch.setattr(compiled, "_matched", None)
    monkeypatch.setattr(point_model, "_compiled", None)
    other = read_tag(scans, list(LAYOUTS.values()))
    assert (one.status, one.layout, one.code) == (other.status, other.layout, other.code)
    assert one.layout == "container-90"
    assert one.score == pytest.approx(other.score, abs=1e-4)


def test_what_does_not_fit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    fast, _ = fields("turntable", monkeypatch)
    tables = fast.tables
    assert tables is not None
    points, facing, offsets = np.zeros((2, 3)), np.zeros((2, 2)), np.zeros(2)
    with pytest.raises(ValueError, match="out of range"):
        tables.explained(points, facing, offsets, ROUND.numbers, np.array([[0, 2]]))
    with pytest.raises(ValueError, match="bytes"):
        tables.explained(points, facing[:1], offsets, ROUND.numbers, np.array([[0, 1]]))
    with pytest.raises(ValueError, match="together"):
        tables.explained(points, facing, offsets, ROUND.numbers, np.zeros((1, 30), dtype=int))
    looked = tables.looked(points, facing, 0.0, ROUND.numbers)
    with pytest.raises(ValueError, match="out of range"):
        tables.correlated(fast.data, replace(looked, index=looked.index + 100_000))
    pixel = np.array([0, 4], dtype=np.int32)
    with pytest.raises(ValueError, match="out of range"):
        tables.coarse(points, facing, pixel, 2, [ROUND.numbers], [0.0])
    narrow = replace(tables, table=tables.table[:, :5].copy())
    with pytest.raises(ValueError, match="bytes"):
        narrow.coarse(points, facing, pixel, 3, [ROUND.numbers], [0.0])
    broken = replace(tables, field=(*tables.field[:2], tables.field[2] + 1, *tables.field[3:]))
    with pytest.raises(ValueError, match="circle"):
        broken.looked(points, facing, 0.0, ROUND.numbers)
