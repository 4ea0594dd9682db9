"""Designed families: necklace counts from the table, distances that behave as distances, rules that hold."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tagid.errors import UsageError
from tagid.tags.layouts.cliques import SearchTooLongError, _Search, exact_clique, farthest_set, least_of
from tagid.tags.layouts.codebook import all_distances, best_pairing, best_places, rotational_distance
from tagid.tags.layouts.design import DesignRules, candidates, design, distance_matrix
from tagid.tags.layouts.layout import Layout, rotation_matrix
from tagid.tags.layouts.necklaces import necklaces
from tagid.tags.layouts.objects import Row, TaggedObject, object_named

HELMET = object_named("helmet")
NAMES = st.integers(0, 10**6)


def random_layout(seed: int, count: int = 3) -> Layout:
    rng = np.random.default_rng(seed)
    while True:
        points = rng.uniform(-0.11, 0.11, (count, 2))
        gap = np.linalg.norm(points[:, None] - points[None], axis=2) + np.eye(count)
        if gap.min() > 0.03:
            return Layout("random", points)


@pytest.mark.parametrize(
    ("slots", "weight", "colours"), [(6, 3, 2), (7, 2, 3), (8, 4, 1), (12, 3, 1), (5, 5, 2)]
)
def test_necklaces_against_brute_force(slots: int, weight: int, colours: int) -> None:
    def least(word: tuple[int, ...]) -> tuple[int, ...]:
        return min(word[i:] + word[:i] for i in range(slots))

    words = [w for w in product(range(colours + 1), repeat=slots) if sum(c > 0 for c in w) == weight]
    assert len(necklaces(slots, weight, colours)) == len({least(w) for w in words})
    both = {min(least(w), least(w[::-1])) for w in words}
    assert len(necklaces(slots, weight, colours, mirror_counts=False)) == len(both)


@settings(deadline=None, max_examples=30)
@given(NAMES, st.floats(-10, 10), st.integers(2, 5))
def test_a_turned_layout_is_the_same(seed: int, turn: float, count: int) -> None:
    a = random_layout(seed, count)
    b = Layout("turned", a.positions @ rotation_matrix(turn).T)
    c = random_layout(seed + 1, count)
    assert rotational_distance(a, b).worst_m < 1e-7
    assert rotational_distance(a, c).rms_m == pytest.approx(rotational_distance(b, c).rms_m, abs=1e-7)


@settings(deadline=None, max_examples=30)
@given(NAMES, st.sampled_from([0.0, np.inf]))
def test_rotational_distance_is_a_metric(seed: int, tolerance: float) -> None:
    a, b, c = (random_layout(seed + i) for i in range(3))
    ab, ba = (rotational_distance(*pair, tolerance).rms_m for pair in ((a, b), (b, a)))
    bc, ac = (rotational_distance(*pair, tolerance).rms_m for pair in ((b, c), (a, c)))
    assert ab == pytest.approx(ba, abs=1e-9) and ab > 0
    assert ac <= ab + bc + 1e-9
    assert rotational_distance(a, b, 0.014).rms_m <= rotational_distance(a, b, 0.0).rms_m + 1e-9


@settings(deadline=None, max_examples=20)
@given(NAMES)
def test_exact_pairing_finds_the_turn_and_the_shift(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = random_layout(seed, 4).positions
    turn, shift, order = rng.uniform(-3, 3), rng.uniform(-0.005, 0.005, 2), rng.permutation(4)
    result = best_pairing(a, (a @ rotation_matrix(turn).T + shift)[order], 0.01)
    assert result.worst_m < 1e-7 and np.allclose(result.shift_m, shift, atol=1e-7)
    assert np.angle(np.exp(1j * (result.rotation_rad - turn))) == pytest.approx(0, abs=1e-7)
    assert (order[result.partner] == np.arange(4)).all()


def test_more_points_than_can_be_tried_are_paired_too() -> None:
    a = random_layout(3, 8).positions
    turned = a @ rotation_matrix(2.0).T + np.array([0.003, -0.002])
    result = best_pairing(a, turned[::-1], 0.01)
    assert result.worst_m < 1e-6


def test_a_family_keeps_its_rules_and_says_its_distance() -> None:
    family = design(HELMET.with_rows(2), DesignRules(3, 12, seed=1), 8)
    layouts = family.layouts
    apart = [rotational_distance(a, b).rms_m for i, a in enumerate(layouts) for b in layouts[:i]]
    assert family.distance_m == pytest.approx(min(apart), abs=1e-6)
    assert len({layout.name for layout in layouts}) == 8
    for layout in layouts:
        space = np.concatenate([layout.positions, np.asarray(layout.heights)[:, None]], axis=1)
        gap = np.linalg.norm(space[:, None] - space[None], axis=2) + np.eye(3)
        assert gap.min() >= 0.04 - 1e-9
    again = design(HELMET.with_rows(2), DesignRules(3, 12, seed=1), 8)
    assert [a.to_dict() for a in again.layouts] == [a.to_dict() for a in layouts]


@pytest.mark.parametrize(("name", "rows", "slots", "count"), [("helmet", 1, 8, 4), ("mug", 2, 12, 5)])
def test_a_designed_set_is_the_best_of_all_sets(name: str, rows: int, slots: int, count: int) -> None:
    rules, target = DesignRules(3, slots), object_named(name).with_rows(rows)
    points, _, _ = candidates(target, rules)
    distance = distance_matrix(points, rules)
    best = max(
        min(distance[i, j] for i, j in combinations(chosen, 2))
        for chosen in combinations(range(len(points)), count)
    )
    family = design(target, rules, count)
    assert family.distance_m == pytest.approx(best, abs=1e-9)
    assert family.proven


@settings(deadline=None, max_examples=25)
@given(NAMES, st.integers(3, 5))
def test_the_farthest_set_against_all_sets(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    half = np.triu(rng.integers(1, 12, (11, 11)) / 1000, 1)
    distance = half + half.T
    best = max(least_of(distance, list(chosen)) for chosen in combinations(range(11), count))
    result = farthest_set(distance, count, np.random.default_rng(0))
    assert result.proven and least_of(distance, result.chosen) == best
    level = distance >= best + 1e-9
    assert exact_clique(level, count) is None
    assert len(set(exact_clique(distance >= best - 1e-9, count) or ())) == count


def test_a_search_without_branches_left_says_so() -> None:
    with pytest.raises(SearchTooLongError):
        exact_clique(np.ones((9, 9), dtype=bool), 5, _Search(2))
    points, _, _ = candidates(HELMET.with_rows(2), DesignRules(3, 12))
    distance = distance_matrix(points, DesignRules(3, 12))
    assert not farthest_set(distance, 16, np.random.default_rng(0), 10).proven


@settings(deadline=None, max_examples=20)
@given(NAMES, st.integers(2, 4), st.sampled_from([0.0, 0.004, 0.014, 0.05]))
def test_all_distances_at_once_are_those_of_every_two(seed: int, count: int, tolerance: float) -> None:
    layouts = [random_layout(seed + i, count) for i in range(4)]
    matrix = all_distances(np.array([layout.positions for layout in layouts]), tolerance)
    assert (matrix == matrix.T).all() and (np.diag(matrix) == 0).all()
    for i, j in combinations(range(4), 2):
        assert matrix[i, j] == pytest.approx(
            rotational_distance(layouts[i], layouts[j], tolerance).rms_m, abs=1e-8
        )


@settings(deadline=None, max_examples=25)
@given(NAMES, st.sampled_from([0.0, 0.003, 0.014]))
def test_a_limited_shift_leaves_the_least_distance_of_all_turns(seed: int, tolerance: float) -> None:
    p, q = random_layout(seed).positions, random_layout(seed + 1).positions + np.array([0.04, 0.01])
    rms, _, shift = best_places(p, q, tolerance)
    turns = np.linspace(0, 2 * np.pi, 5001)
    free = q.mean(axis=0) - (rotation_matrix(turns) @ p.mean(axis=0))
    held = free * np.minimum(1, tolerance / np.linalg.norm(free, axis=1))[:, None]
    tried = np.einsum("tij,kj->tki", rotation_matrix(turns), p) + held[:, None] - q
    least = np.sqrt(np.mean(np.sum(tried**2, axis=2), axis=1)).min()
    assert np.linalg.norm(shift) <= tolerance + 1e-12
    assert least - 2e-6 <= rms <= least + 1e-9


def test_mirror_images_are_left_out_where_the_direction_is_unknown() -> None:
    single = design(HELMET.with_rows(1), DesignRules(3, 12, mirror_counts=False), 12)
    assert single.candidates == 12 and single.necklaces == 12
    flip = np.array([1.0, -1.0])
    apart = [
        rotational_distance(Layout("m", a.positions * sides), b).rms_m
        for a, b in combinations(single.layouts, 2)
        for sides in (flip, 1.0)
    ]
    assert single.distance_m == pytest.approx(min(apart), abs=1e-8)
    half = design(HELMET.with_rows(1), DesignRules(3, 12, mirror_counts=False), 6)
    assert half.distance_m > single.distance_m
    mirrored = replace(half.layouts[3], positions=half.layouts[3].positions * flip)
    again = design(HELMET.with_rows(1), DesignRules(3, 12, mirror_counts=False), 11, None, [mirrored])
    assert again.candidates == 11


def test_what_there_is_no_room_for_is_told() -> None:
    with pytest.raises(UsageError, match="room for 19"):
        design(HELMET.with_rows(1), DesignRules(3, 12), 20)
    with pytest.raises(UsageError, match="rows"):
        HELMET.with_rows(9)
    with pytest.raises(UsageError, match="radius of 110 m"):
        TaggedObject("own", "other", (Row(110.0),))
    with pytest.raises(UsageError, match="unknown object"):
        object_named("../etc")
    with pytest.raises(UsageError, match="too many"):
        necklaces(48, 12)
