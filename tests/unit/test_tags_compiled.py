"""The compiled loops of the finder and of the coarse search, and their stand-in: the same numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tags_synthetic import synthetic_scans

from tagid.geometry import Aperture
from tagid.imaging.types import BasebandScans
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.reading import compiled
from tagid.tags.reading.coarse import CoarseImage
from tagid.tags.reading.coarse_grid import CoarseGrid, SearchSettings
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.reflectors import SearchDisc, find_reflectors, refine_positions

pytestmark = pytest.mark.skipif(
    compiled._matched is None or compiled._coarse is None, reason="no compiler was present at installation"
)

LAYOUTS = builtin_layouts()
PLACES = LAYOUTS["helmet-120"].placed(0.3, np.array([0.004, -0.003]))


def two_heights(scans: BasebandScans) -> BasebandScans:
    """The same samples, half of them seen from 0.1 m above."""
    positions = scans.aperture.positions.copy()
    positions[::2, 2] = 0.1
    return replace(scans, aperture=Aperture(positions))


def two_antennas(scans: BasebandScans) -> BasebandScans:
    """The same samples, transmitter and receiver 0.1 m apart."""
    positions = scans.aperture.positions
    return replace(
        scans, aperture=Aperture(positions, half_baseline=np.tile([0.0, 0.0, 0.05], (len(positions), 1)))
    )


SCENES = {"turntable": lambda scans: scans, "two heights": two_heights, "two antennas": two_antennas}


def scans_of(kind: str, views: int = 13) -> BasebandScans:
    return SCENES[kind](synthetic_scans(PLACES, views=views, noise=0.1, seed=5))


def fields(kind: str, monkeypatch: pytest.MonkeyPatch) -> tuple[MatchedField, MatchedField]:
    """A matched field with the compiled loops, and one without."""
    fast, plain = (MatchedField(scans_of(kind), 0.15) for _ in range(2))
    assert fast.tables is not None
    with monkeypatch.context() as patch:
        patch.setattr(compiled, "_matched", None)
        assert plain.tables is None
    return fast, plain


def assert_alike(result: np.ndarray, wanted: np.ndarray, share: float) -> None:
    assert result.shape == wanted.shape
    assert np.abs(result - wanted).max() <= share * np.abs(wanted).max()


def explained(field: MatchedField, points: np.ndarray) -> float:
    """Energy that points explain with free amplitudes."""
    templates = field.templates(points).astype(complex)
    amplitudes = np.linalg.lstsq(templates.T, field.data, rcond=None)[0]
    return field.energy - float(np.sum(np.abs(field.data - amplitudes @ templates) ** 2))


@pytest.mark.parametrize("kind", sorted(SCENES))
def test_free_points_come_to_the_same_places(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fast, plain = fields(kind, monkeypatch)
    start = LAYOUTS["helmet-120"].placed(0.33, np.array([0.006, -0.001]))
    first, other = (refine_positions(f, start) for f in (fast, plain))
    np.testing.assert_allclose(first[0], other[0], atol=2e-5)
    assert_alike(first[1], other[1], 2e-3)
    # They have moved, and explain more than where they began.
    assert explained(plain, first[0]) > 1.05 * explained(plain, start)


@pytest.mark.parametrize("kind", sorted(SCENES))
def test_the_disc_holds_what_points_leave(kind: str) -> None:
    """The pixels are correlated from tables, and with their templates here."""
    field = MatchedField(scans_of(kind), 0.08)
    disc = SearchDisc(field, 0.06)
    amplitudes = np.array([0.3 + 0.2j, -0.5j])
    positions = np.array([[0.04, -0.03], [-0.05, 0.02]])
    for count in (0, 2):
        data = field.data - amplitudes[:count] @ field.templates(positions[:count])
        wanted = np.abs(field.templates(disc.points).conj() @ data) ** 2
        assert_alike(disc.residual(positions[:count], amplitudes[:count]), wanted, 1e-4)


@pytest.mark.parametrize("kind", ["turntable", "two antennas"])
def test_reflectors_are_found_without_a_compiler(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scans = scans_of(kind, views=36)
    result = find_reflectors(scans)
    monkeypatch.setattr(compiled, "_matched", None)
    other = find_reflectors(scans)
    assert len(result) == len(other) == 3
    for a, b in zip(result, other, strict=True):
        assert (a.x_m, a.y_m) == pytest.approx((b.x_m, b.y_m), abs=2e-5)
        assert (a.amplitude_db, a.snr_db) == pytest.approx((b.amplitude_db, b.snr_db), abs=0.05)
        assert min(np.hypot(*(PLACES - (a.x_m, a.y_m)).T)) < 3e-3


FOUR = Layout("four", np.array([[0.1, 0.0], [0.0, 0.08], [-0.09, 0.02], [0.03, -0.1]]))
NINE_OFFSETS = tuple(i * 4e-3 for i in range(-4, 5))


@pytest.mark.parametrize("kind", ["turntable", "two antennas"])
@pytest.mark.parametrize(
    "layout", [LAYOUTS["container-90"], LAYOUTS["helmet-120"], FOUR], ids=lambda item: item.name
)
@pytest.mark.parametrize("offsets", [SearchSettings.offsets_m, NINE_OFFSETS], ids=len)
def test_the_coarse_search_explains_the_same(
    kind: str, layout: Layout, offsets: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = SearchSettings(offsets_m=offsets)
    field, grid = MatchedField(scans_of(kind), 0.15), CoarseGrid.of(layout, settings)
    for aspect in settings.aspects:
        image = CoarseImage.of(field, 0.13, aspect, settings.offsets_m)
        gram = field.full_gram(grid.placed, aspect.weight(field.antenna, grid.placed, grid.facing))
        result = grid.energies(image, gram, field.template_energy, settings.balance).best
        with monkeypatch.context() as patch:
            patch.setattr(compiled, "_coarse", None)
            again = replace(image)
            wanted = grid.energies(again, gram, field.template_energy, settings.balance).best
        assert image.tables is not None and again.tables is None
        assert_alike(result, wanted, 1e-4)


def test_the_image_holds_b_and_what_is_constant() -> None:
    field = MatchedField(scans_of("turntable"), 0.15)
    aspect = SearchSettings().aspects[0]
    image = CoarseImage.of(field, 0.1, aspect, (0.0,))
    some = image.disc.points[::97]
    wanted = field.correlate(field.templates(some))
    assert_alike(image.values.images[0, ::97], wanted, 1e-4)
    assert_alike(image.read(some)[0], wanted, 1e-3)
    whole, remaining = field.full_gram(some, None), field.gram(field.templates(some))
    assert_alike(whole - image.static_overlap(some), remaining, 1e-4)


def test_what_does_not_fit_is_refused() -> None:
    field = MatchedField(scans_of("turntable"), 0.15)
    tables = field.tables
    assert tables is not None
    moved = np.zeros((2, 2)), 2e-3, 12e-3, 6
    with pytest.raises(ValueError, match="together"):
        tables.moved_points(np.zeros((30, 2)), *moved[1:])
    with pytest.raises(ValueError, match="together"):
        tables.moved_points(np.zeros(3), *moved[1:])
    with pytest.raises(ValueError, match="bytes"):
        replace(tables, data=tables.data[:, :5].copy()).moved_points(*moved)
    antennas, circle, *others = tables.field
    with pytest.raises(ValueError, match="circle"):
        replace(tables, field=(antennas, circle + 1, *others)).moved_points(*moved)
    with pytest.raises(ValueError, match="antennas"):
        replace(tables, field=(antennas[..., :5].copy(), circle, *others)).moved_points(*moved)
    settings = SearchSettings()
    grid = CoarseGrid.of(FOUR, settings)
    image = CoarseImage.of(field, 0.13, settings.aspects[0], settings.offsets_m)
    gram = field.full_gram(grid.placed, None)
    with pytest.raises(ValueError, match="bytes"):
        grid.energies(image, gram[:3], 1.0, 0.35)
    coarse = image.tables
    assert coarse is not None
    vars(image)["tables"] = replace(coarse, static=coarse.static[..., :3].copy())
    with pytest.raises(ValueError, match="together"):
        grid.energies(image, gram, 1.0, 0.35)
