"""Reading of detected positions: physics-free truth, every kind of answer."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.tags.layouts.layout import Layout, builtin_layouts, rotation_matrix
from tagid.tags.network.detector import Detection
from tests.benchmarks.constellation import read_constellation

LAYOUTS = list(builtin_layouts().values())


def detections(
    layout: Layout, rng: np.random.Generator, *, sigma_m: float = 2e-3, drop: int = 0, p: float = 0.97
) -> tuple[list[Detection], float]:
    """The layout turned, shifted and jittered as detections, and the turn, rad."""
    turn = float(rng.uniform(0, 2 * np.pi))
    points = layout.positions[:, :2] @ rotation_matrix(turn).T + rng.uniform(-6e-3, 6e-3, 2)
    points = points[drop:] + rng.normal(0, sigma_m, (len(points) - drop, 2))
    return [Detection(float(x), float(y), sigma_m, p, 0.0, 1.0) for x, y in points], turn


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_names_each_layout_and_its_turn(layout: Layout) -> None:
    for seed in range(20):
        found, turn = detections(layout, np.random.default_rng(seed))
        reading = read_constellation(found, LAYOUTS)
        assert reading.layout == layout.name
        step = 2 * np.pi / layout.symmetry
        error = (reading.matches[0].rotation_rad - turn + step / 2) % step - step / 2
        assert abs(error) < np.deg2rad(8)


def test_a_weak_false_detection_changes_nothing() -> None:
    layout = builtin_layouts()["helmet-120"]
    found, _ = detections(layout, np.random.default_rng(3))
    found.append(Detection(0.0, 0.02, 2e-3, 0.2, 0.8, 0.1))
    assert read_constellation(found, LAYOUTS).layout == "helmet-120"


def test_two_of_three_reflectors_are_not_named_for_sure_where_they_are_another_layout_too() -> None:
    pair = Layout("pair", builtin_layouts()["helmet-120"].positions[:2])
    found, _ = detections(pair, np.random.default_rng(1))
    reading = read_constellation(found, [pair, builtin_layouts()["helmet-120"]])
    assert reading.matches[0].layout.name == "pair"


def test_unenrolled_tags_are_unknown_and_nothing_is_no_tag() -> None:
    square = Layout("square", np.array([[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0], [0.0, -0.1]]))
    found, _ = detections(square, np.random.default_rng(2))
    assert read_constellation(found, LAYOUTS).status == "unknown"
    assert read_constellation([], LAYOUTS).status == "no_tag"
    doubtful = [Detection(0.05, 0.0, 3e-3, 0.1, 0.5, 1.0)]
    assert read_constellation(doubtful, LAYOUTS).status == "no_tag"


def test_mirror_images_are_told_apart() -> None:
    chiral = np.array([[0.09, 0.0], [0.0, 0.06], [-0.08, -0.05]])
    left, right = Layout("left", chiral), Layout("right", chiral * [1, -1])
    for seed in range(10):
        found, _ = detections(right, np.random.default_rng(seed))
        assert read_constellation(found, [left, right]).layout == "right"
