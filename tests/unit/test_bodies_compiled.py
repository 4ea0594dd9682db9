"""The compiled loops of the reading on bodies and their stand-in: the same numbers, nothing out of bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tagid.tags.bodies import compiled, symmetric
from tagid.tags.bodies.cylinder_fit import CylinderFitter, Ringed, _Many
from tagid.tags.bodies.cylinder_patterns import Patterns
from tagid.tags.bodies.reflectors_fit import COMMON, OPEN, THROUGH, Batch, Fitter, Pattern, Priors
from tagid.tags.bodies.revolution import RoundBody
from tagid.tags.bodies.ring import PairSearch, Ring
from tagid.tags.bodies.spectra import Spectra

pytestmark = pytest.mark.skipif(
    compiled._arrangements is None, reason="no compiler was present at installation"
)

ROWS, REFLECTORS, MOVES = 12, 4, 9


class Turning(RoundBody):
    """A body whose echo depends on its turn."""

    @property
    def turns(self) -> bool:
        return True

    def echo(
        self, spectra: Spectra, centres: NDArray[np.complex128], turns: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        seen = np.angle(spectra.antenna - np.asarray(centres)[:, None]) - turns[:, None]
        return super().echo(spectra, centres, turns) * (2 + np.cos(seen) + 1j * np.sin(2 * seen))[:, None]


def noise(views: int) -> Spectra:
    rng = np.random.default_rng(views)
    data = rng.standard_normal((9, views)) + 1j * rng.standard_normal((9, views))
    antenna = 1.02 * np.exp(-1j * np.sort(rng.uniform(0, 2 * np.pi, views)))
    data -= data.mean(axis=1, keepdims=True)
    return Spectra(data, np.linspace(140, 190, 9), antenna, np.full(views, 0.03), 1.0, 1.0)


def arrangements() -> Batch:
    """Rows of unlike patterns, numbers of reflectors and moves; the last move is none."""
    rng = np.random.default_rng(2)
    at = rng.normal(0, 5e-3, (ROWS, COMMON + REFLECTORS))
    at[:, COMMON:] = rng.uniform(0, 2 * np.pi, (ROWS, REFLECTORS))
    present = (rng.uniform(size=(ROWS, REFLECTORS)) < 0.8).astype(float)
    present[:, 0] = 1
    moves = rng.standard_normal((ROWS, MOVES, COMMON + REFLECTORS))
    moves[:, -1] = 0
    return Batch(
        at,
        np.full((ROWS, REFLECTORS), 0.045),
        rng.normal(0, 0.01, (ROWS, REFLECTORS)),
        present,
        0 * present,
        2.0 * (np.arange(ROWS) % 2),
        1.0 + np.arange(ROWS) % 7,
        moves,
        np.full(ROWS, -0.02),
        np.full(ROWS, 0.02),
        np.zeros(ROWS),
    )


def assert_alike(found: np.ndarray, wanted: np.ndarray, share: float) -> None:
    assert found.shape == wanted.shape
    assert np.abs(found - wanted).max() <= share * np.abs(wanted).max()


@pytest.mark.parametrize("body", [None, RoundBody(), Turning()], ids=["none", "round", "turning"])
@pytest.mark.parametrize("views", [12, 13])
def test_arrangements_on_a_body(body: RoundBody | None, views: int, monkeypatch: pytest.MonkeyPatch) -> None:
    fitter, batch = Fitter(noise(views), body, Priors(), 1.0), arrangements()
    found, left = fitter._linear(batch), fitter.left(batch)
    monkeypatch.setattr(compiled, "_arrangements", None)
    wanted = fitter._linear(batch)
    assert_alike(found.left, wanted.left, 1e-9)
    assert_alike(left, wanted.left, 1e-9)
    assert_alike(found.normal, wanted.normal, 1e-8)
    assert_alike(found.gradient, wanted.gradient, 1e-8)


def test_too_many_terms_are_left_to_numpy() -> None:
    batch = arrangements()
    assert batch.rows.fits()
    assert not replace(batch, terms=batch.terms + 1).rows.fits()


@pytest.mark.parametrize("pattern", [OPEN, THROUGH, Pattern(2, 2)])
def test_sets_on_a_ring(pattern: Pattern, monkeypatch: pytest.MonkeyPatch) -> None:
    spectra, rng = noise(14), np.random.default_rng(4)
    echo = RoundBody().echo(spectra, np.array([0.002 + 0j]), np.zeros(1))[0]
    ring = Ring.of(spectra, echo, 0.001 + 0j, 0.045, pattern, 48)
    every = [np.sort(rng.integers(0, 48, (60, n)), axis=1) for n in (1, 2, 3, 4)]
    found = [ring.explained(sets) for sets in every]
    monkeypatch.setattr(compiled, "_arrangements", None)
    for one, sets in zip(found, every, strict=True):
        assert_alike(one, ring.explained(sets), 1e-5)


def test_pairs_about_many_centres(monkeypatch: pytest.MonkeyPatch) -> None:
    search = PairSearch(noise(12).thinned(4), 0.045, 36)
    centres = np.array([0j, 0.003 + 0.001j, -0.002j])
    echoes = RoundBody().echo(search.spectra, centres, np.zeros(3))
    left, angles = search.left(centres, echoes)
    monkeypatch.setattr(compiled, "_arrangements", None)
    other, wanted = search.left(centres, echoes)
    assert_alike(left, other, 1e-5)
    assert np.array_equal(angles, wanted)


def test_waves(monkeypatch: pytest.MonkeyPatch) -> None:
    spectra = noise(12)
    distance = np.linspace(0.8, 1.3, 30).reshape(5, 6)
    found = spectra.waves(distance)
    monkeypatch.setattr(compiled, "_arrangements", None)
    assert_alike(found, spectra.waves(distance), 1e-12)


@pytest.mark.skipif(compiled._walls is None, reason="no compiler was present at installation")
@pytest.mark.parametrize("views", [12, 13])
@pytest.mark.parametrize("order", [2, 3])
def test_walls_with_planes_of_symmetry(views: int, order: int, monkeypatch: pytest.MonkeyPatch) -> None:
    spectra, rng = noise(views), np.random.default_rng(3)
    places = rng.normal(0, 5e-3, (9, 3)) + np.array([0, 0, 1])
    places[4:7, :2] = places[4, :2]  # one centre, several directions
    numbers = (1, 2, 4, compiled.MOST_AMPLITUDES)
    found = [symmetric._left(spectra, order, number, places) for number in numbers]
    least = symmetric.symmetric_left(spectra, order, 2, (0.002 + 0.001j,))
    monkeypatch.setattr(compiled, "_walls", None)
    for number, left in zip(numbers, found, strict=True):
        assert_alike(left, symmetric._left(spectra, order, number, places), 1e-9)
    assert least == pytest.approx(symmetric.symmetric_left(spectra, order, 2, (0.002 + 0.001j,)), rel=1e-6)


@pytest.mark.skipif(compiled._walls is None, reason="no compiler was present at installation")
def test_walls_that_do_not_fit_are_refused() -> None:
    tables = noise(12).tables
    with pytest.raises(ValueError, match="bytes"):
        compiled.walls_left(tables, np.zeros((3, 2)), 2, 2)
    with pytest.raises(ValueError, match="too few amplitudes"):
        compiled.walls_left(tables, np.zeros((3, 3)), 2, 0)
    with pytest.raises(ValueError, match="together"):
        compiled.walls_left(replace(tables, data=tables.data[:, :1].copy()), np.zeros((3, 3)), 2, 2)


def beside_walls(views: int) -> CylinderFitter:
    spectra = noise(views)
    return CylinderFitter(spectra, Patterns.of(spectra, 0.045), RoundBody(), 0j, Priors().centre_m, 1.0)


def ringed(shell: int, layout: str | None, *angles: float) -> Ringed:
    many = len(angles)
    radii, heights = 0.045 + 1e-3 * np.arange(many), 0.01 * np.arange(many)
    return Ringed(shell, 0.002 - 0.001j, 0.001, np.array(angles), radii, heights, layout)


@pytest.mark.skipif(compiled._cylinders is None, reason="no compiler was present at installation")
@pytest.mark.parametrize("views", [12, 13])
def test_reflectors_beside_walls(views: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unlike numbers of reflectors beside unlike walls, seen from all sides: angles of all quadrants."""
    fitter = beside_walls(views)
    last = len(fitter.patterns.shells) - 1
    rows = [ringed(0, "a", 0.1, 3.0), ringed(7, None, -2.0), ringed(last, None, 0.5, 1.9, 4.0, 5.5)]
    rings = _Many.of(rows).rings
    found, fitted = fitter._left(rings), fitter.fitted(rows, 3)
    other = fitter.beside_other_walls(rows[0])
    monkeypatch.setattr(compiled, "_cylinders", None)
    wanted = fitter._left(rings)
    assert_alike(found.energy, wanted.energy, 1e-9)
    assert_alike(found.rest, wanted.rest, 1e-8)
    assert other.shell == fitter.beside_other_walls(rows[0]).shell
    for one, two in zip(fitted, fitter.fitted(rows, 3), strict=True):
        assert one.left == pytest.approx(two.left, rel=1e-6)
        assert np.abs(one.angles - two.angles).max() < 1e-4 and abs(one.centre - two.centre) < 1e-6


@pytest.mark.skipif(compiled._cylinders is None, reason="no compiler was present at installation")
def test_reflectors_beside_the_wall_of_an_enrolled_body(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its echo stays where its pose has it, whatever the reflectors' centre."""
    round_fitter = beside_walls(13)
    spectra = round_fitter.spectra
    known = Turning().echo(spectra, np.array([0.003 + 0.002j]), np.array([0.7]))[0]
    fitter = replace(round_fitter, known=known)
    rows = [ringed(0, "a", 0.1, 3.0), ringed(7, None, -2.0)]
    rings = _Many.of(rows).rings
    found = fitter._left(rings)
    assert (np.abs(found.energy / round_fitter._left(rings).energy - 1) > 1e-3).all()
    with pytest.raises(ValueError, match="bytes"):
        rings.rest(spectra.tables, fitter.patterns.relative, known[:-1])
    monkeypatch.setattr(compiled, "_cylinders", None)
    wanted = fitter._left(rings)
    assert_alike(found.energy, wanted.energy, 1e-9)
    assert_alike(found.rest, wanted.rest, 1e-8)


@pytest.mark.skipif(compiled._cylinders is None, reason="no compiler was present at installation")
def test_reflectors_beside_no_wall_are_refused() -> None:
    fitter = beside_walls(12)
    tables, patterns = fitter.spectra.tables, fitter.patterns.relative
    rings = _Many.of([ringed(0, None, 0.0, 1.0)]).rings
    with pytest.raises(ValueError, match="no such wall"):
        replace(rings, shells=np.array([len(fitter.patterns.shells)])).rest(tables, patterns)
    with pytest.raises(ValueError, match="1 to 8 reflectors"):
        replace(rings, at=rings.at[:, :3]).rest(tables, patterns)
    with pytest.raises(ValueError, match="fit together"):
        rings.rest(tables, np.ascontiguousarray(patterns[:, :1, :4]))
    with pytest.raises(ValueError, match="bytes"):
        replace(rings, radii=rings.radii[:, :1], heights=rings.heights[:, :1]).rest(tables, patterns)
    many = np.zeros((1, 3 + compiled.MOST_RINGED + 1))
    assert rings.fits() and not replace(rings, at=many, radii=many[:, 3:]).fits()


def test_more_amplitudes_of_a_wall_than_the_loop_takes_are_left_to_numpy() -> None:
    places = np.array([[0.001, 0.002, 0.3], [0.0, 0.0, 0.1]])
    left = symmetric._left(noise(24), 2, compiled.MOST_AMPLITUDES + 1, places)
    assert (left > 0).all() and (left < symmetric._left(noise(24), 2, 2, places)).all()


def test_what_does_not_fit_is_refused() -> None:
    spectra, rows, steps = noise(12), arrangements().rows, np.ones(3)
    echoes = np.zeros((1, ROWS, 9, 12), complex)
    rows.left(spectra.tables, echoes, steps)
    with pytest.raises(ValueError):
        rows.left(spectra.tables, echoes[:, :-1], steps)
    with pytest.raises(ValueError):
        replace(rows, radii=rows.radii[:, :-1]).left(spectra.tables, echoes, steps)
    with pytest.raises(ValueError):
        replace(rows, terms=rows.terms * 0).left(spectra.tables, echoes, steps)
    gram, right, ridge = (
        np.zeros((1, 2, 12, 12), np.complex64),
        np.zeros((1, 2, 12), np.complex64),
        np.ones((1, 2)),
    )
    sets = np.array([[0, 3]])
    assert compiled.set_energies(gram, right, ridge.astype(np.float32), sets, 3) is not None
    with pytest.raises(ValueError):
        compiled.set_energies(gram, right, ridge.astype(np.float32), sets + 1, 3)
    with pytest.raises(ValueError):
        compiled.set_energies(gram[:, :1], right, ridge.astype(np.float32), sets, 3)
