"""Scenes of the identification benchmark: what stands on the table, and how it is recorded.

Seeds begin at 50 000 000, which no training draws; SNR is per reflector (`tagid.simulate.snr`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tagid.capture import Capture
from tagid.errors import TagidError
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.pipeline.identify import identify
from tagid.simulate.acquisition import Acquisition, Placement, Wobble
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_layout, scene_from_name
from tagid.simulate.scattering import Points, Returns
from tagid.simulate.scene import Scene
from tagid.tags.bodies.signature import Signature
from tagid.tags.layouts.codebook import rotational_distance
from tagid.tags.layouts.design import DesignRules, design
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tagid.tags.layouts.objects import object_named

FIRST_SEED = 50_000_000
UNTAGGED = ("can", "box", "untagged", "empty")
UNENROLLED = (
    *("two-far", "three-right-angle", "four-square", "mirror-like", "three-random", "four-random"),
    "linear-outer",
)
_FIXED = {
    "two-far": [[0.07, 0.0], [-0.07, 0.0]],
    "three-right-angle": [[0.08, 0.0], [0.0, 0.08], [-0.08, 0.0]],
    "four-square": [[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0], [0.0, -0.1]],
    "linear-outer": [[0.09, 0.0], [-0.09, 0.0]],
    "mirror-like": [[0.045, 0.0], [0.0, 0.045], [-0.09, -0.02]],
}


_RULES = DesignRules(3, 12)
SETS: dict[str, tuple[Layout, ...]] = {
    "paper": tuple(builtin_layouts().values()),
    "helmet-16": design(object_named("helmet").with_rows(2), _RULES, 16).layouts,
    "mug-8": design(object_named("mug").with_rows(2), _RULES, 8).layouts,
}
"""The paper's four, 16 designed on a helmet and 8 on a mug (3 reflectors, 12 slots, both rows)."""


APART_M = 0.012
"""Nearer than this in RMS, a foreign tag counts as the enrolled one: enrollment calls them confusable."""


def in_space(layout: Layout) -> np.ndarray:
    """(K, 3) reflectors, m."""
    return np.column_stack([layout.positions, layout.heights])


def least_gap_m(points: np.ndarray) -> float:
    """Smallest distance between points, m."""
    return float((np.linalg.norm(points[:, None] - points[None], axis=2) + np.eye(len(points))).min())


def is_foreign(points: np.ndarray, enrolled: Sequence[Layout]) -> bool:
    layout = Layout("foreign", points)
    alike = [other for other in enrolled if other.size == layout.size]
    return all(rotational_distance(layout, other).rms_m > APART_M for other in alike)


class Condition(NamedTuple):
    """What is on the table, of which enrolled set, how it is recorded, and one of TWISTS, if any."""

    group: str
    enrolled: str
    views: int
    snr_db: float
    twist: str = ""


def _unenrolled(kind: str, rng: np.random.Generator) -> np.ndarray:
    """(K, 2) reflectors, m, of a tag that nobody enrolled."""
    if kind in _FIXED:
        return np.array(_FIXED[kind])
    count = 3 if kind == "three-random" else 4
    while True:
        points = rng.uniform(-0.11, 0.11, (count, 2))
        if least_gap_m(points) > 0.04:
            return points


def draw_scene(condition: Condition, number: int) -> tuple[Scene, str]:
    """The scene of that number and the name that would be right."""
    seed = FIRST_SEED + number
    if condition.group == "tagged":
        layouts = SETS[condition.enrolled]
        layout = layouts[number % len(layouts)]
        return scene_from_layout(in_space(layout), layout.name, seed), layout.name
    if condition.group == "untagged":
        name = UNTAGGED[number % len(UNTAGGED)]
        return scene_from_name(name, seed), name
    name = UNENROLLED[number % len(UNENROLLED)]
    return scene_from_layout(_unenrolled(name, np.random.default_rng(seed)), name, seed), name


def _with_points(scene: Scene, points: Points) -> Scene:
    return replace(scene, object=tuple(points if isinstance(b, Points) else b for b in scene.object))


def _missing(scene: Scene, rng: np.random.Generator) -> Scene:
    p = scene.points
    keep = np.arange(len(p.positions)) != rng.integers(len(p.positions))
    facing = None if p.facing_rad is None else p.facing_rad[keep]
    changed = replace(p, positions=p.positions[keep], amplitudes=p.amplitudes[keep], facing_rad=facing)
    return _with_points(scene, changed)


def _extra(scene: Scene, rng: np.random.Generator) -> Scene:
    p = scene.points
    while True:
        place = np.append(rng.uniform(-0.12, 0.12, 2), 0.0)
        if np.linalg.norm(p.positions - place, axis=1).min() > 0.05:
            break
    facing = np.full(len(p.positions), np.nan) if p.facing_rad is None else p.facing_rad
    more = replace(
        p,
        positions=np.concatenate([p.positions, place[None]]),
        amplitudes=np.append(p.amplitudes, 0.95),
        facing_rad=np.append(facing, np.nan),
    )
    return _with_points(scene, more)


def _occluded(scene: Scene, rng: np.random.Generator) -> Scene:
    return _with_points(scene, replace(scene.points, aspect_floor=0.0, aspect_width_rad=np.deg2rad(180.0)))


@dataclass(frozen=True, eq=False, kw_only=True)
class HiddenPoints(Points):
    """Reflectors, each hidden from antennas within `half_rad` of its direction `hidden_rad` (n,)."""

    hidden_rad: np.ndarray
    half_rad: float

    def single(self, index: int) -> Points:
        return replace(super().single(index), hidden_rad=self.hidden_rad[index : index + 1])

    def returns(self, antennas: np.ndarray) -> Returns:
        seen = super().returns(antennas)
        side = np.arctan2(*(antennas[:, None, i] - self.positions[None, :, i] for i in (1, 0)))
        off = np.abs(np.angle(np.exp(1j * (side - self.hidden_rad))))
        return Returns(seen.points, np.where(off < self.half_rad, 0.0, seen.amplitudes))


def _hidden(scene: Scene, directions: np.ndarray, width_deg: float) -> Scene:
    half_rad = np.deg2rad(width_deg / 2)
    return _with_points(scene, HiddenPoints(**vars(scene.points), hidden_rad=directions, half_rad=half_rad))


def _opaque(half_width_deg: float) -> Callable[[Scene, np.random.Generator], Scene]:
    """A hard edge: seen to this angle from the outward side; a reflector on the axis from everywhere."""

    def twist(scene: Scene, rng: np.random.Generator) -> Scene:
        facing = scene.points.facing_rad
        return _hidden(scene, facing + np.pi, 360 - 2 * half_width_deg)

    return twist


def _sector(scene: Scene, rng: np.random.Generator) -> Scene:
    return _hidden(scene, np.full(len(scene.points.positions), rng.uniform(0, 2 * np.pi)), 120.0)


def _sectors(scene: Scene, rng: np.random.Generator) -> Scene:
    return _hidden(scene, rng.uniform(0, 2 * np.pi, len(scene.points.positions)), 90.0)


def _askew(scene: Scene, rng: np.random.Generator) -> Scene:
    p = scene.points
    facing = p.facing_rad + rng.uniform(-1, 1, len(p.positions)) * np.deg2rad(30.0)
    changed = replace(p, facing_rad=facing, aspect_floor=0.0, aspect_width_rad=np.deg2rad(150.0))
    return _with_points(scene, changed)


SCENE_TWISTS: dict[str, Callable[[Scene, np.random.Generator], Scene]] = {
    "one reflector missing": _missing,
    "one reflector extra": _extra,
    "far side occluded": _occluded,
    "opaque, hard edge at 65 deg": _opaque(65.0),
    "opaque, hard edge at 90 deg": _opaque(90.0),
    "opaque, hard edge at 115 deg": _opaque(115.0),
    "120 deg of all hidden": _sector,
    "90 deg of each hidden elsewhere": _sectors,
    "narrow and askew by up to 30 deg": _askew,
}
ACQUISITION_TWISTS: dict[str, Callable[[Acquisition], Acquisition]] = {
    "wobble 3 %": lambda a: replace(a, wobble=Wobble(speed=0.03)),
    "wobble 1 mm radial": lambda a: replace(a, wobble=Wobble(speed=0.01, radial_m=1e-3)),
    "axis distance wrong by 24 mm": lambda a: replace(a, axis_distance_error_m=0.024),
    "turn of 270 deg": lambda a: replace(a, turns=0.75),
    "turn of 180 deg": lambda a: replace(a, turns=0.5),
    "turn of 90 deg": lambda a: replace(a, turns=0.25),
}
TWISTS = (*ACQUISITION_TWISTS, *SCENE_TWISTS)


class Recorded(NamedTuple):
    """Scans to be read, with the truth: the right name and the places of the reflectors, m."""

    capture: Capture
    scans: BasebandScans
    name: str
    positions: np.ndarray


def drawn_acquisition(rng: np.random.Generator, views: int, snr_db: float) -> Acquisition:
    """Up to 10 mm off the axis, turned, axis distance wrong by up to 15 mm, on a turntable that wobbles."""
    radius, turn = 0.01 * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
    return Acquisition(
        views=views,
        snr_db=snr_db,
        placement=Placement((radius * np.cos(turn), radius * np.sin(turn)), rng.uniform(0, 2 * np.pi)),
        wobble=Wobble(speed=0.01),
        axis_distance_error_m=rng.uniform(-0.015, 0.015),
    )


def record(condition: Condition, number: int) -> Recorded:
    """One recording with everything random drawn from its number."""
    return record_scene(*draw_scene(condition, number), condition, number)


def record_scene(scene: Scene, name: str, condition: Condition, number: int) -> Recorded:
    """The recording of a scene under a condition."""
    rng = np.random.default_rng([FIRST_SEED + number, 1])
    acquisition = drawn_acquisition(rng, condition.views, float(condition.snr_db))
    if condition.twist in ACQUISITION_TWISTS:
        acquisition = ACQUISITION_TWISTS[condition.twist](acquisition)
    elif condition.twist in SCENE_TWISTS:
        scene = SCENE_TWISTS[condition.twist](scene, rng)
    capture, truth = simulate_capture(scene, acquisition, FIRST_SEED + number)
    scans = preprocess(capture, PreprocessSettings(matched_filter=False, extent_m=0.3))
    return Recorded(capture, scans, name, truth.positions_m)


def outcome_of(
    capture: Capture, layouts: Sequence[Layout], name: str, signatures: Sequence[Signature] = ()
) -> str:
    """What `tagid identify` makes of a tag of this name: "named", "wrong" or "refused"."""
    try:
        answer = identify(capture, layouts, signatures=signatures)
    except TagidError:
        return "refused"
    if answer.status != "identified" or answer.reading is None:
        return "refused"
    return "named" if answer.reading.layout == name else "wrong"
