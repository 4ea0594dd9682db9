"""Turns for the benchmark of `tagid scan --until-sure`: nothing enrolled on the table, and tags.

The kinds are those of the reader's own benchmarks (`train.population`, `identification_scenes`,
`reading_bodies_scenes` with its full-wave responses), drawn from seeds that none of those uses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tagid.capture import Capture
from tagid.simulate.acquisition import Acquisition, Placement, Wobble
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import room_clutter, scene_from_layout, scene_from_name
from tagid.simulate.scattering import Box, Points
from tagid.simulate.scene import Scene
from tagid.tags.layouts.codebook import rotational_distance
from tagid.tags.layouts.layout import Layout
from tests.benchmarks import reading_bodies_scenes as bodies
from tests.benchmarks.identification_scenes import SETS, Condition, record
from train.population import draw

CALIBRATE, REPORT = 2_000_000, 3_000_000
"""First numbers of the turns of the shipped calibration, and of those of the table."""
KINDS = (
    *("population",) * 6,
    *("unenrolled", "unenrolled", "box", "noise"),
    *("other tags", "untagged"),
    *("own foreign", "own foreign", "own untagged", "own untagged"),
    *("full-wave foreign", "full-wave foreign", "full-wave untagged", "full-wave untagged"),
)
"""Kinds of null turns, each as often as it is listed."""
STATEMENT = (
    "simulated objects without an enrolled tag, of every kind that the reader is evaluated on: unenrolled "
    "tags, bodies and boxes with and without reflectors, hands, cables, noise, and full-wave responses of "
    "cans, helmet shells and reflectors; 36 or 72 views per turn, 0 to 30 dB; 4 or 16 layouts enrolled; half "
    "of them with a wrong scale of the angle (standard deviation 3 %)"
)
VIEWS = (36, 36, 36, 36, 36, 36, 36, 36, 36, 72)
DESIGNED = 0.05
"""Share of null turns with 16 designed layouts enrolled; more names are compared there."""
SCALE_SIGMA = 0.03
"""Of the angle: the slip of a robot whose wheel base is calibrated, or a stated speed that is not exact."""
SNRS_DB = (0.0, 5.0, 10.0, 20.0, 30.0)
APART_M = 0.012
"""Unenrolled tags nearer than this (RMS) are equivalent to the layout: enrollment calls them confusable."""
_POPULATION_OFFSET = 40_000_000
_SCENE_OFFSET = 10_000_000


class Turn(NamedTuple):
    """A whole turn: as recorded, with angles; the enrolled layouts; the right name, if any; its kind."""

    capture: Capture
    layouts: Sequence[Layout]
    name: str
    kind: str


def null_turn(at: int) -> Turn:
    """The null turn of a number; kind, views, SNR and registry are drawn from it."""
    rng = np.random.default_rng([at, 15])
    kind = KINDS[at % len(KINDS)]
    views, snr_db = int(rng.choice(VIEWS)), float(rng.choice(SNRS_DB))
    enrolled = "helmet-16" if rng.uniform() < DESIGNED else "paper"
    layouts: Sequence[Layout] = SETS[enrolled]
    if kind == "population":
        capture = draw(_POPULATION_OFFSET + at, views=views, snr_db=snr_db).capture
    elif kind in ("unenrolled", "box", "noise"):
        scene = scene_of(kind, rng, _SCENE_OFFSET + at)
        capture, _ = simulate_capture(scene, _acquisition(rng, views, snr_db), _SCENE_OFFSET + at)
    elif kind in ("other tags", "untagged"):
        condition = Condition("untagged" if kind == "untagged" else "unenrolled", "paper", views, snr_db)
        capture = record(condition, at).capture
    else:
        world, group = kind.split(" ")
        if world == "full-wave":
            # An object may carry a layout of the paper's, which its registry then lacks.
            enrolled = "paper"
        known = bodies.BODIES if world == "own" else bodies.FULL_WAVE_BODIES
        body = str(rng.choice([b for b in known if world == "own" or (group, b) in bodies.FULL_WAVE]))
        offset_mm, pulse = int(rng.choice(bodies.OFFSETS_MM)), str(rng.choice(bodies.PULSES))
        cell = bodies.Cell(world, group, enrolled, body, offset_mm, int(snr_db), views, pulse)
        capture, layouts, _ = bodies.draw(cell, at)
    scale = 1 + SCALE_SIGMA * float(np.random.default_rng([at, 16]).standard_normal())
    return Turn(scaled(capture, scale if at // len(KINDS) % 2 else 1.0), layouts, "", kind)


def scaled(capture: Capture, scale: float) -> Capture:
    """The capture as a device would record it whose angles are too large by a factor."""
    assert capture.angles_rad is not None
    return replace(capture, angles_rad=capture.angles_rad * scale)


def unenrolled(rng: np.random.Generator) -> np.ndarray:
    """(K, 2) two to five reflectors 40 mm or more apart, anywhere or on a ring, m; none of the enrolled."""
    while True:
        count, radius = int(rng.integers(2, 6)), rng.uniform(0.045, 0.12)
        points = rng.uniform(-radius, radius, (count, 2))
        if rng.uniform() < 0.5:
            angle = rng.uniform(0, 2 * np.pi, count)
            points = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        gap = np.linalg.norm(points[:, None] - points[None], axis=2) + np.eye(count)
        if gap.min() < 0.04:
            continue
        layout = Layout("unenrolled", points)
        same = [other for other in SETS["paper"] if other.size == count]
        if all(rotational_distance(layout, other).rms_m > APART_M for other in same):
            return points


def scene_of(group: str, rng: np.random.Generator, seed: int) -> Scene:
    """What stands on the table: "noise" alone, a "box", or an "unenrolled" tag."""
    if group == "noise":
        return scene_from_name("empty", seed)
    if group == "box":
        width, depth = rng.uniform(0.06, 0.25, 2)
        box = Box(width, depth, rng.uniform(0.5, 3.0), rng.uniform(0.1, 0.8), rng.uniform(0.03, 0.2))
        return Scene("box", (replace(box, rotation_rad=rng.uniform(0, 6.28)),), room=room_clutter(rng))
    points = unenrolled(rng)
    scene = scene_from_layout(points, str(len(points)), seed)
    if seed % 8 < 4 and scene.points is not None:
        # Half of them are darker or brighter behind than the simulator's usual reflectors.
        other = replace(
            scene.points, aspect_floor=rng.uniform(0, 1), aspect_width_rad=np.deg2rad(rng.uniform(100, 240))
        )
        scene = replace(scene, object=tuple(other if isinstance(b, Points) else b for b in scene.object))
    return scene


def _acquisition(rng: np.random.Generator, views: int, snr_db: float) -> Acquisition:
    radius, turn = 0.01 * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
    return Acquisition(
        views=views,
        snr_db=snr_db,
        placement=Placement((radius * np.cos(turn), radius * np.sin(turn)), rng.uniform(0, 2 * np.pi)),
        wobble=Wobble(speed=0.01),
        axis_distance_error_m=rng.uniform(-0.015, 0.015),
    )


def tagged_turn(at: int, enrolled: str, snr_db: float, scale: float) -> Turn:
    """A tag without a body, layouts in turn, as `identification_scenes` records it at 36 views per turn."""
    recorded = record(Condition("tagged", enrolled, 36, snr_db), at)
    return Turn(scaled(recorded.capture, scale), SETS[enrolled], recorded.name, "tagged")


def tagged_body_turn(number: int, world: str, body: str, snr_db: float) -> Turn:
    """A tag on a body, from our simulator ("own") or full-wave responses ("full-wave")."""
    offset = bodies.OFFSETS_MM[number % len(bodies.OFFSETS_MM)]
    cell = bodies.Cell(world, "tagged", "paper", body, offset, int(snr_db), 36, bodies.PULSES[number % 2])
    return Turn(*bodies.draw(cell, REPORT + number), f"{world} {body}")
