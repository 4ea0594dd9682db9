"""One training scene from the distributions and a seed: an object, how it is recorded, and the truth.

It is drawn with the package's own simulator. Body, handle, rim, seam and contents belong to the object and
are placed off the axis with its reflectors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture, Pulse
from tagid.simulate.acquisition import Acquisition, Placement, Wobble
from tagid.simulate.capture import simulate_capture
from tagid.simulate.noise import Interference, NoiseShape
from tagid.simulate.objects import HANDLE_REACH_M, Variation, tagged_object
from tagid.simulate.presets import room_clutter
from tagid.simulate.pulses import random_pulse
from tagid.simulate.scattering import Body, Box, Cylinder, Points, Returns
from tagid.simulate.scene import Scene
from tagid.simulate.specification import SHAPES, BodySpec, ReflectorSpec
from train.distributions import (
    BodyDistribution,
    Distribution,
    ObjectDistribution,
    PulseDistribution,
    spaced_points,
    uniform,
)


@dataclass(frozen=True, eq=False)
class Ghost:
    """Where something other than a reflector shows: a ring of a radius, m, about a centre (x, y), m."""

    centre_m: NDArray[np.float64]
    radius_m: float = 0.0


@dataclass(frozen=True, eq=False)
class TrainingScene:
    """A recording and what is in it.

    Attributes:
        capture: as a file would hold it.
        reflectors_m: (K, 2) true reflectors at angle zero, m.
        ghosts: what else echoes.
        snr_db: of the recording, per reflector.
    """

    capture: Capture
    reflectors_m: NDArray[np.float64]
    ghosts: tuple[Ghost, ...]
    snr_db: float


def draw_pulse(d: PulseDistribution, rng: np.random.Generator) -> Pulse | None:
    """A pulse of main lobe, ring and late echo, or None for the nominal one."""
    return None if rng.uniform() < d.nominal else random_pulse(rng, d.shapes)


@dataclass
class _Drawing:
    """The object while it is put together."""

    turning: list[Body]
    ghosts: list[Ghost]


def _reflectors(d: ObjectDistribution, radius: float, rng: np.random.Generator) -> Points | None:
    count = int(rng.choice(len(d.counts), p=np.array(d.counts) / sum(d.counts)))
    positions = spaced_points(count, radius, d.spacing_m, bool(rng.uniform() < d.on_circle), rng)
    if not len(positions):
        return None
    amplitudes = np.maximum(1 + uniform(rng, d.spread) * rng.standard_normal(len(positions)), 0.3)
    if rng.uniform() < d.isotropic:
        return Points(positions, amplitudes)
    near = np.linalg.norm(positions, axis=1) < 0.01
    facing = np.where(near, np.nan, np.arctan2(positions[:, 1], positions[:, 0]))
    width, floor = uniform(rng, d.aspect_width_rad), uniform(rng, d.aspect_floor)
    return Points(positions, amplitudes, facing, width, floor)


@dataclass(frozen=True, eq=False)
class _DoubleBounce:
    """The interaction of two close reflectors: from the radar to one, to the other, and back, in both orders.

    The path is |a - p| + |p - q| + |q - a|, so the image shows a ring of radius |p - q| / 2 about their
    midpoint; reported for reflectors about a wavelength apart.

    Attributes:
        positions: (2, 3), m.
        amplitude: sum of both orders.
    """

    positions: NDArray[np.float64]
    amplitude: float

    def returns(self, antennas: NDArray[np.float64]) -> Returns:
        """One point per view, at half the path length in the direction of the midpoint."""
        p, q = self.positions
        path = np.linalg.norm(antennas - p, axis=1) + np.linalg.norm(antennas - q, axis=1)
        distance = (path + np.linalg.norm(p - q)) / 2
        sight = (p + q) / 2 - antennas
        unit = sight / np.linalg.norm(sight, axis=1, keepdims=True)
        points = antennas + unit * distance[:, None]
        return Returns(points[:, None], np.full((len(antennas), 1), self.amplitude, dtype=np.complex128))


def _bounces(drawing: _Drawing, points: Points, amplitude: float) -> None:
    """Interaction images of reflectors closer than 8 cm, as reported for coupled patches."""
    p = points.positions[:, :2]
    pairs = [(i, j) for i in range(len(p)) for j in range(i) if np.linalg.norm(p[i] - p[j]) < 0.08]
    for i, j in pairs:
        both = np.asarray(points.positions[[i, j]], dtype=np.float64)
        drawing.turning.append(_DoubleBounce(both, amplitude))
        drawing.ghosts.append(Ghost((p[i] + p[j]) / 2, float(np.linalg.norm(p[i] - p[j])) / 2))


def _extras(drawing: _Drawing, d: ObjectDistribution, radius: float, rng: np.random.Generator) -> None:
    """Handles, a rim and a box."""
    if rng.uniform() < d.handles:
        count = int(rng.integers(1, 3))
        at = spaced_points(count, radius + 0.015, 0.03, True, rng)
        facing = np.arctan2(at[:, 1], at[:, 0]) + rng.uniform(-0.5, 0.5, len(at))
        size = np.array([uniform(rng, d.handle_amplitude) for _ in at])
        drawing.turning.append(Points(at, size, facing, float(rng.uniform(0.4, 1.2)), 0.05))
        drawing.ghosts += [Ghost(point) for point in at]
    if rng.uniform() < d.rim:
        angles = rng.uniform(0, 2 * np.pi) + np.arange(int(rng.integers(4, 12))) * rng.uniform(0.1, 0.3)
        at = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        sizes = np.full(len(at), uniform(rng, d.rim_amplitude))
        drawing.turning.append(Points(at, sizes, np.asarray(angles, dtype=np.float64), 1.5, 0.1))
        drawing.ghosts += [Ghost(point) for point in at]
    if rng.uniform() < d.box:
        side = 2 * radius + float(rng.uniform(0.05, 0.12))
        face = uniform(rng, d.box_amplitude)
        turn = float(rng.uniform(0, np.pi))
        edges = turn + np.pi / 4 * np.arange(1, 8, 2)
        drawing.turning.append(Box(side, side, face, face / 6, rotation_rad=turn))
        corners = side / np.sqrt(2) * np.stack([np.cos(edges), np.sin(edges)], axis=1)
        drawing.ghosts += [Ghost(corner) for corner in corners]


def _simple(
    drawing: _Drawing, d: ObjectDistribution, radius: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """An object of points, a specular shell and extras; returns its (K, 2) reflectors, m."""
    points = _reflectors(d, radius, rng)
    if points is not None:
        drawing.turning.append(points)
        if rng.uniform() < d.bounce:
            _bounces(drawing, points, uniform(rng, d.bounce_amplitude))
    if rng.uniform() < d.shell:
        offset, turn = uniform(rng, d.shell_offset_m), rng.uniform(0, 2 * np.pi)
        centre = (offset * np.cos(turn), offset * np.sin(turn))
        shell = Cylinder(max(0.02, radius - 0.02), uniform(rng, d.shell_amplitude), centre)
        drawing.turning.append(shell)
        drawing.ghosts.append(Ghost(np.array(centre), shell.radius_m))
    _extras(drawing, d, radius, rng)
    none = np.zeros((0, 2))
    return none if points is None else np.asarray(points.positions[:, :2], dtype=np.float64)


def _body(kind: str, wall_m: float, d: BodyDistribution, rng: np.random.Generator) -> BodySpec:
    """A body whose wall lies so far from its axis, with the parts that chance gives it."""
    if kind == "none":
        return BodySpec()
    # The corners of a box are its farthest points.
    size = np.sqrt(2) * wall_m if kind == "box" else wall_m
    if kind in ("helmet", "box") and size < SHAPES[kind].least_m:
        kind, size = "cup", wall_m
    shape = SHAPES[kind]
    size = float(np.clip(size, shape.least_m, shape.most_m))
    shares = {"handle": d.handle, "seam": d.seam, "filled": d.filled}
    parts = tuple(part for part in shape.parts if rng.uniform() < shares[part])
    lengths = []
    if "oval" in shape.lengths and rng.uniform() < d.oval:
        lengths.append(("oval", float(rng.uniform(0, 0.5e-3))))
    return BodySpec(kind, size, parts, tuple(lengths))


def _physical(
    drawing: _Drawing, d: ObjectDistribution, radius: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """A physical body with octahedra around it; returns its (K, 2) reflectors, m."""
    b = d.bodies
    weights = np.array([weight for _, weight in b.kinds])
    kind = b.kinds[int(rng.choice(len(weights), p=weights / weights.sum()))][0]
    count = int(rng.choice(len(d.counts), p=np.array(d.counts) / sum(d.counts)))
    positions = spaced_points(count, radius, d.spacing_m, True, rng)
    body = _body(kind, radius - uniform(rng, b.standoff_m), b, rng)
    ring, turn = uniform(rng, b.ring_m), rng.uniform(0, 2 * np.pi)
    change = Variation(
        rng.uniform(0, 2 * np.pi), (ring * np.cos(turn), ring * np.sin(turn)), uniform(rng, b.strength_db)
    )
    # Whole millimetres, so that scenes share tables of octahedra.
    reflector = ReflectorSpec("octahedron", round(uniform(rng, b.reflector_m), 3))
    drawing.turning += tagged_object(positions, body, reflector, rng, change)
    centre = -np.array(change.ring_m)
    if body.kind != "none":
        wall = body.size_m / 2 if body.kind == "box" else body.size_m
        drawing.ghosts.append(Ghost(centre, wall))
    if "handle" in body.parts:
        out = np.array([np.cos(change.parts_rad), np.sin(change.parts_rad)])
        drawing.ghosts.append(Ghost(centre + (body.size_m + HANDLE_REACH_M) * out))
    return positions


def draw_scene(seed: int, distribution: Distribution | None = None) -> TrainingScene:
    """The scene of a seed.

    Args:
        seed: random seed of everything in it.
    """
    dist = distribution or Distribution()
    d, r = dist.object, dist.recording
    rng = np.random.default_rng(seed)
    radius = uniform(rng, d.radius_m)
    drawing = _Drawing([], [])
    make = _physical if rng.uniform() < d.physical else _simple
    reflectors = make(drawing, d, radius, rng)
    scene = Scene(
        "training",
        tuple(drawing.turning),
        room=room_clutter(rng) if rng.uniform() < r.room else None,
        reference_amplitude=None if len(reflectors) else 1.0,
    )
    acquisition = _acquisition(dist, rng)
    capture, truth = simulate_capture(scene, acquisition, seed)
    return TrainingScene(
        capture,
        truth.positions_m if len(reflectors) else np.zeros((0, 2)),
        tuple(Ghost(acquisition.placement.apply(g.centre_m[None])[0], g.radius_m) for g in drawing.ghosts),
        float(acquisition.snr_db or 0.0),
    )


def _acquisition(dist: Distribution, rng: np.random.Generator) -> Acquisition:
    r = dist.recording
    weights = np.array([weight for _, weight in r.views])
    views = int(rng.choice([v for v, _ in r.views], p=weights / weights.sum()))
    offset, turn = uniform(rng, r.centre_m), rng.uniform(0, 2 * np.pi)
    spreading = bool(rng.uniform() < r.range_law)
    pulse = draw_pulse(dist.pulse, rng)
    tone = None
    if rng.uniform() < r.interference:
        tone = Interference(uniform(rng, r.interference_db), rng.uniform(3.1e9, 4.8e9), rng.uniform(0.1, 1.0))
    return Acquisition(
        views=views,
        snr_db=uniform(rng, r.snr_db),
        axis_distance_m=uniform(rng, r.axis_distance_m),
        axis_distance_error_m=uniform(rng, r.axis_error_m),
        placement=Placement(
            (offset * np.cos(turn), offset * np.sin(turn)),
            rng.uniform(0, 2 * np.pi),
            uniform(rng, r.elevation_m),
        ),
        noise=NoiseShape(uniform(rng, r.colour), tone),
        wobble=Wobble(uniform(rng, r.wobble), uniform(rng, r.radial_m)),
        pulse=pulse,
        tell_pulse=bool(rng.uniform() < dist.pulse.told),
        beam_width_rad=float(np.pi / 2) if spreading else None,
        range_law=spreading,
    )
