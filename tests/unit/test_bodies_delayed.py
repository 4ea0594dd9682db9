"""Pairs on a thin plastic wall: solved waves of a bottle of 60 mm, 1.8 mm thick (tests/data/bottles).

The wall returns a thirtieth of what its tag does, and delays the reflector behind it. One bottle carries
`container-180`, the other two reflectors 155 degrees apart, which nobody enrolled.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from solved_shells import recorded_at

from tagid.tags.bodies.cylinder_patterns import ANY, THIN, between, bodies_of
from tagid.tags.bodies.hypothesis import Kind
from tagid.tags.bodies.points import PlacedPoints, columns, tapered_left
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching.delayed import pair_on_thin_wall
from tagid.tags.matching.matcher import MatchedScan, ReaderSettings, read_tag
from tagid.tags.matching.reading import Reading
from tagid.tags.verdicts.verdict import Code

LAYOUTS = list(builtin_layouts().values())
NEVER = replace(
    ReaderSettings(), contest=replace(ReaderSettings().contest, undone_share=inf, delayed_share=inf)
)
"""No thin wall is asked."""


def read(
    name: str,
    centre_m: tuple[float, float],
    views: int,
    snr_db: float,
    settings: ReaderSettings | None = None,
) -> Reading:
    return read_tag(recorded_at(centre_m, "bottles", name, views, snr_db), LAYOUTS, settings)


@pytest.mark.parametrize(("views", "snr_db"), [(36, 20.0), (72, 14.0)])
def test_a_pair_that_a_thin_wall_moves_apart_is_named(views: int, snr_db: float) -> None:
    place = (0.003, 0.0)
    reading = read("bottle30_c180", place, views, snr_db)
    assert (reading.status, reading.layout, reading.kind) == ("identified", "container-180", Kind.ROUND)
    assert reading.body is not None and reading.body.wall is not None and not reading.body.wall.metal
    assert reading.bound is not None and reading.bound.kept
    assert reading.hypotheses[0].layout == "container-180"
    assert np.hypot(*np.subtract(reading.centre_m, place)) < 1.5e-3
    # To points its reflectors lie elsewhere.
    refused = read("bottle30_c180", place, views, snr_db, NEVER)
    assert refused.status == "unknown" and refused.code in (Code.DISPLACED, Code.ELSEWHERE)


def test_a_pair_that_a_thin_wall_makes_an_enrolled_one_is_not_named() -> None:
    place = (-0.0007, -0.0008)
    assert read("bottle30_pair155", place, 72, 20.0, NEVER).layout == "container-180"
    reading = read("bottle30_pair155", place, 72, 20.0)
    assert (reading.status, reading.code) == ("unknown", Code.OTHER)
    assert reading.reason.startswith("beside a thin wall")
    assert reading.body is not None and reading.body.lead < 0


def test_a_wall_is_asked_of_refused_pairs_alone() -> None:
    scan = MatchedScan(recorded_at((0.003, 0.0), "bottles", "bottle30_c180"), LAYOUTS, ReaderSettings())
    spectra, contest = Spectra.of(scan.scans), ReaderSettings().contest
    from tagid.tags.matching.alone import points_of

    points = points_of(scan.own, spectra, LAYOUTS, contest.points)
    refused = scan.own.refused(Code.ELSEWHERE, "")
    found = pair_on_thin_wall(refused, points, spectra, LAYOUTS, contest)
    assert found is not None and found.layouts[0].layout == "container-180" and found.lead > 0.6
    silent = replace(refused, code=Code.WEAK)
    assert pair_on_thin_wall(silent, points, spectra, LAYOUTS, contest) is None
    strict = replace(contest, delayed_share=0.2)
    assert pair_on_thin_wall(refused, points, spectra, LAYOUTS, strict) is None


def test_points_that_are_darker_from_behind_need_no_wall() -> None:
    """A share of 1 + cos psi, which a thin wall imitates, is explained by points and nothing else."""
    rng = np.random.default_rng(3)
    kappa = 2 * 83.0 + np.linspace(-33, 33, 9)
    antenna = 1.05 * np.exp(-2j * np.pi * np.arange(36) / 36)
    none = np.zeros((9, 36), complex)
    spectra = Spectra(none, kappa, antenna, np.full(36, 0.03), 1.05, 1e-9)
    centre = 0.004 - 0.002j
    places = np.array(centre + 0.045 * np.exp(1j * np.array([0.4, 0.4 + np.pi])))
    placed = PlacedPoints(places, np.zeros(2), 0.0)
    each = [columns(spectra, places[k : k + 1], np.zeros(1))[:, 0] for k in range(2)]
    psi = [np.angle(antenna - z) - np.angle(z - centre) for z in places]
    phase = np.exp(2j * np.pi * rng.uniform(size=(9, 1)))
    data = phase * sum(one * (0.75 + 0.25 * np.cos(p)) for one, p in zip(each, psi, strict=True))
    spectra = replace(spectra, data=data - data.mean(axis=1, keepdims=True))
    energy = float((np.abs(spectra.data) ** 2).sum())
    # `each` lost its mean over the views before it was shaded: a thousandth of the energy.
    assert tapered_left(spectra, placed, centre) < 2e-3 * energy
    assert tapered_left(spectra, placed, centre + 0.5) > 1e-2 * energy


def test_families_keep_to_their_walls() -> None:
    thin = bodies_of(THIN, 0.045)
    assert thin and not any(one.metal for one in thin)
    assert {one.wall_m for one in thin} == {0.8e-3, 1.6e-3, 2.5e-3}
    assert any(one.metal for one in bodies_of(ANY, 0.045))
    finer = between(THIN, thin[0], 0.045)
    assert min(one.wall_m for one in finer) == 0.8e-3 and max(one.wall_m for one in finer) <= 2.5e-3
    assert {one.permittivity for one in finer} == {2.3}
