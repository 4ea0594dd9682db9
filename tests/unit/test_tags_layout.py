"""Layouts: what is refused, what survives a round trip, and distances against geometry done by hand."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from tagid.errors import FileFormatError, StorageError, UsageError
from tagid.tags.layouts.codebook import CONFUSABLE_M, rotational_distance
from tagid.tags.layouts.layout import Layout, builtin_layouts, layout_from_dict, read_layout

SCALENE = np.array([[0.1, 0.0], [-0.02, 0.06], [-0.05, -0.04]])


def test_the_papers_four_layouts_are_built_in() -> None:
    layouts = builtin_layouts()
    symmetries = {"container-180": 2, "container-90": 1, "helmet-120": 3, "helmet-linear": 2}
    assert {name: layout.symmetry for name, layout in layouts.items()} == symmetries
    for name, radius in (("container-90", 0.045), ("container-180", 0.045), ("helmet-120", 0.11)):
        assert np.allclose(np.linalg.norm(layouts[name].positions, axis=1), radius)
    a, b = layouts["container-90"].positions
    assert abs(a @ b) < 1e-12  # 90 degrees
    steps = np.diff(layouts["helmet-linear"].positions, axis=0)
    assert np.allclose(np.linalg.norm(steps, axis=1), 0.09)
    for layout, other in combinations(layouts.values(), 2):
        assert rotational_distance(layout, other).worst_m >= CONFUSABLE_M


def test_a_layout_takes_back_its_own_dict() -> None:
    seen = np.tile([[1e-6, 2e-7], [2e-7, 3e-6]], (3, 1, 1))
    layout = Layout("a-b.c", SCALENE, "helmet", notes="n", label="L", covariance=seen)
    again = layout_from_dict(json.loads(json.dumps(layout.to_dict())))
    assert again.to_dict() == layout.to_dict()
    assert (again.covariance == seen).all()
    assert again.sigma_m == pytest.approx(np.sqrt(np.linalg.eigvalsh(seen[0])[1]))
    twice = layout.mirrored().mirrored()
    assert twice.to_dict() == layout.to_dict() != layout.mirrored().to_dict()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"name": "Bad Name"}, "name"),
        ({"name": 3}, "name"),
        ({"name": "../x"}, "name"),
        ({"name": "a\x07b"}, "name"),
        ({"kind": "hat"}, "kind"),
        ({"symmetry": 3}, "symmetry"),
        ({"positions_m": [[0.1, 0.0]]}, "positions"),
        ({"positions_m": [[0.1, 0.0], [0.1, float("nan")]]}, "not finite"),
        ({"positions_m": [[110, 0], [0, 110]]}, "axis"),
        ({"positions_m": [[0.1, 0.0], [0.1, float("inf")]]}, "not finite"),
        ({"positions_m": [[0.1, 0.0], [0.101, 0.0]]}, "apart"),
        ({"positions_m": [[0.1, 0.0], ["x", 0.0]]}, "positions_m"),
        ({"positions_m": [[True, 0.0], [0.1, 0.0]]}, "positions_m"),
        ({"positions_m": "no"}, "positions_m"),
        ({"colour": "red"}, "colour"),
        ({"notes": 5}, "notes"),
        ({"label": "red\x1b[31m"}, "label"),
        ({"heights_m": [0.1]}, "heights_m"),
        ({"heights_m": [0.1, 2.0]}, "heights_m"),
        ({"heights_m": "high"}, "heights_m"),
        ({"notes": "x" * 5000}, "notes"),
        ({"covariance_m2": [[1e-6, 0, 1e-6]]}, "covariance_m2"),
        ({"covariance_m2": [[1e-6, 1e-6]] * 3}, "covariance_m2"),
        ({"covariance_m2": [[1e-6, 2e-6, 1e-6]] * 3}, "covariance_m2"),
        ({"covariance_m2": [[1.0, 0, 1.0]] * 3}, "covariance_m2"),
        ({"covariance_m2": [[1e-6, float("nan"), 1e-6]] * 3}, "covariance_m2"),
        ({"covariance_m2": "small"}, "covariance_m2"),
    ],
)
def test_a_wrong_field_is_named(change: dict[str, object], field: str) -> None:
    data = {"name": "ok", "kind": "other", "positions_m": SCALENE.tolist(), **change}
    with pytest.raises(UsageError, match=field):
        layout_from_dict(data)


def test_files_in_toml_and_json_and_their_faults(tmp_path: Path) -> None:
    good = tmp_path / "a.toml"
    good.write_text('name = "a"\npositions_m = [[0.1, 0.0], [0.0, 0.1]]\n')
    assert read_layout(good).size == 2
    as_json = tmp_path / "a.json"
    as_json.write_text(json.dumps(Layout("a", SCALENE).to_dict()))
    assert read_layout(as_json).size == 3
    with pytest.raises(StorageError, match="missing"):
        read_layout(tmp_path / "missing.toml")
    for name, content in {
        "big.toml": b"#" * 70_000,
        "bad.toml": b"name = [",
        "deep.json": b"[" * 60_000,
        "latin.toml": b'name = "\xff"',
        "list.json": b"[1]",
        "nan.json": b'{"name": "a", "positions_m": [[NaN, 0], [0, 1]]}',
        "huge.json": b'{"name": "a", "positions_m": [[1' + b"0" * 400 + b", 0], [0, 1]]}",
    }.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(FileFormatError, match=name):
            read_layout(path)


def test_distance_ignores_turn_order_and_a_shift_within_the_centres_tolerance() -> None:
    a = Layout("a", SCALENE)
    b = Layout("b", a.placed(1.234, np.array([0.005, -0.004]))[[2, 0, 1]])
    distance = rotational_distance(a, b)
    assert distance.worst_m < 1e-6
    assert distance.rotation_deg == pytest.approx(np.rad2deg(1.234), abs=0.01)
    assert rotational_distance(b, a).rotation_deg == pytest.approx(360 - np.rad2deg(1.234), abs=0.01)
    assert rotational_distance(a, Layout("c", SCALENE + np.array([0.05, 0.0]))).worst_m > 0.01


def test_a_part_of_a_layout_is_flagged_as_nested() -> None:
    helmet = builtin_layouts()["helmet-120"]
    pair = Layout("pair", helmet.positions[:2])
    distance = rotational_distance(pair, helmet)
    assert distance.nested and np.isinf(distance.worst_m)
    assert not rotational_distance(builtin_layouts()["container-90"], helmet).nested
