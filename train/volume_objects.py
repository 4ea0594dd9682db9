"""A population of objects solved by cells (`train.volume`), for figures alone: nothing is chosen on it.

Containers with real walls, fillings and levels, cups and cans with handles, helmets with a brim, cartons;
with an enrolled tag, a foreign one as in `train.population`, or none. In two dimensions an object is the same
at all heights, except that above the level of a filling its body is empty. A reflector is a thin wire, 15 dB
below a metal can of 35 mm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tagid.constants import SPEED_OF_LIGHT
from tagid.simulate.acquisition import Acquisition, Placement, Wobble
from tagid.simulate.capture import simulate_capture
from tagid.simulate.noise import NoiseShape
from tagid.simulate.presets import room_clutter
from tagid.simulate.pulses import random_pulse
from tagid.simulate.response import Response, Ring
from tagid.simulate.response_scene import response_scene
from tagid.tags.layouts.layout import builtin_layouts
from tagid.types import Complex
from train.population import SNRS_DB, VIEWS, Specimen, foreign, has_enrolled_spacing
from train.volume import METAL, NOTHING, Cells, box, echo, ellipse, metal, wall

DEVELOPMENT, SEALED = range(10_000), range(10_000, 20_000)
"""Seeds: those of development may be drawn at any time, sealed ones for the figures of a release alone."""

FILLINGS = {
    "powder": ((2.0, 3.0), (0.005, 0.03)),
    "oil": ((2.4, 2.7), (0.03, 0.07)),
    "rice": ((2.5, 3.2), (0.06, 0.12)),
    "water": ((73.0, 77.0), (0.18, 0.23)),
}
"""Permittivity and loss tangent of what a plastic bottle may hold."""
BODIES = (
    *("bare", "empty bottle", *FILLINGS, "ceramic cup", "ceramic cup with a handle"),
    *("can", "can with a handle", "helmet", "carton"),
)
TAGS = ("enrolled", "foreign", "enrolled", "none", "enrolled")
"""What the objects of one round of bodies carry."""
WIRE_M = 5e-5
"""Radius of a reflector's wire."""
FREQUENCY_HZ = np.linspace(2.8e9, 5.2e9, 21)
_HEIGHT_M = 0.1
_NEAR = 0.985, 1.015
"""Distances at which an object is solved, in axis distances: its place is off the axis."""
_WATER_CELL_M = 1.5e-3


@dataclass(frozen=True, eq=False)
class Target:
    """Cells of an object.

    Attributes:
        kind: one of `BODIES`.
        truth: name of the enrolled layout that it carries, or None.
        tag, body, odd: its reflectors, its body, and what else it has.
        empty: the body without its filling; nothing for a body without.
    """

    kind: str
    truth: str | None
    tag: Cells
    body: Cells
    odd: Cells
    empty: Cells


def target(seed: int) -> Target:
    """The object of a seed: `BODIES` in turn, `TAGS` round after round."""
    rng, kind = np.random.default_rng([seed, 11]), BODIES[seed % len(BODIES)]
    truth, positions = _tag(rng, kind, TAGS[seed // len(BODIES) % len(TAGS)])
    body, empty, radius = _body(rng, kind, positions)
    sigma = rng.uniform(0.5e-3, 1.5e-3)
    placed = positions + sigma * (
        rng.standard_normal(len(positions)) + 1j * rng.standard_normal(len(positions))
    )
    # A wire of half the radius returns 1 dB less.
    tag = Cells.of(placed, WIRE_M * np.exp(0.7 * rng.standard_normal(len(positions))), METAL)
    odd = NOTHING
    if rng.uniform() < 0.2 or (kind == "bare" and not len(positions)):
        at = _beside(rng, radius + rng.uniform(0.02, 0.05), np.append(positions, body.centre_m), 0.019)
        odd = Cells.of(np.array([at]), WIRE_M * np.exp(rng.uniform(-2.0, 2.0)), METAL)
    return Target(kind, truth, tag, body, odd, empty)


def draw(seed: int) -> Specimen:
    """A recording of the object of a seed; its SNR refers to one reflector alone."""
    made, rng = target(seed), np.random.default_rng([seed, 12])
    distance = float(rng.uniform(0.8, 1.2))
    response = solved(f"volume-{seed}", made.body + made.odd + made.tag, distance, made.tag.centre_m)
    if len(made.empty.centre_m) and rng.uniform() < 0.5:
        above = rng.uniform(0.0, 0.6)
        filling = solved("filled", made.body, distance).without(solved("empty", made.empty, distance))
        lengths = response.scattering_length_m - np.complex64(above) * filling.scattering_length_m
        response = replace(response, scattering_length_m=lengths)
    views, snr_db = int(rng.choice(VIEWS)), float(rng.choice(SNRS_DB))
    centre = 6e-3 * rng.standard_normal(2)
    acquisition = Acquisition(
        views=views,
        direction=int(rng.choice((1, -1))),
        axis_distance_m=distance,
        axis_distance_error_m=float(rng.normal(0.0, 8e-3)),
        pulse=random_pulse(rng) if rng.uniform() < 0.5 else None,
        snr_db=snr_db,
        noise=NoiseShape(float(rng.uniform() * (rng.uniform() < 0.5))),
        placement=Placement((float(centre[0]), float(centre[1])), float(rng.uniform(0, 2 * np.pi))),
        wobble=Wobble(speed=float(rng.uniform(0.0, 0.01))),
    )
    at = np.array([0.045 + 0j])
    single = solved("one reflector", Cells.of(at, WIRE_M, METAL), distance, at)
    scene = response_scene(response, acquisition, "V", single, room_clutter(rng))
    capture, _ = simulate_capture(scene, acquisition, int(rng.integers(2**31)))
    odd = "odd" if len(made.odd.centre_m) else ""
    return Specimen(capture, made.truth, made.kind, odd, made.tag.centre_m, views, snr_db)


def solved(name: str, cells: Cells, distance_m: float, reflectors_m: Complex | None = None) -> Response:
    """The response of cells to an antenna about so far from z = 0, as a slice of 0.1 m height.

    Its aspects serve for an object of 0.3 m radius.
    """
    aspects = 144
    direction = np.exp(2j * np.pi * np.arange(aspects) / aspects)
    rings = tuple(Ring(distance_m * near, "V") for near in _NEAR)
    antennas = np.concatenate([ring.distance_m * direction for ring in rings])
    lengths = 1j * _HEIGHT_M / np.pi * echo(cells, FREQUENCY_HZ, antennas)
    at = np.zeros(0, complex) if reflectors_m is None else reflectors_m
    shaped = lengths.reshape(len(FREQUENCY_HZ), len(rings), aspects).astype(np.complex64)
    return Response(name, FREQUENCY_HZ, rings, shaped, np.column_stack([at.real, at.imag]))


def _tag(rng: np.random.Generator, kind: str, what: str) -> tuple[str | None, Complex]:
    """Name of an enrolled layout and its places; or None and those of a foreign tag, or of none."""
    if what == "enrolled":
        fits = {"bare": "", "carton": "", "helmet": "helmet"}.get(kind, "container")
        name = str(rng.choice([name for name in builtin_layouts() if name.startswith(fits)]))
        at = builtin_layouts()[name].positions
        return name, np.asarray(at[:, 0] + 1j * at[:, 1])
    positions = np.zeros(0, complex)
    while what == "foreign" and (not 2 <= len(positions) <= 4 or has_enrolled_spacing(positions)):
        positions = foreign(rng, {"bare": "none", "carton": "none", "helmet": "shell"}.get(kind, "can"))
    return None, positions


def _cell(permittivity: complex) -> float:
    """A fifteenth of the shortest wavelength inside, m; a quarter of it in water, which is opaque."""
    inside = float(SPEED_OF_LIGHT / FREQUENCY_HZ[-1] / np.sqrt(abs(permittivity)) / 15)
    return max(inside, _WATER_CELL_M)


def _body(rng: np.random.Generator, kind: str, positions: Complex) -> tuple[Cells, Cells, float]:
    """A body with its reflectors outside, or inside of a carton; it empty, if it is full; its radius, m."""
    outside = positions[np.abs(positions) > 0.01]
    reach = np.abs(outside)
    gap = rng.uniform(0.008, 0.022)
    radius = float(reach.min() - gap if len(reach) else rng.uniform(0.025, 0.045))
    oval = 1 + rng.uniform(-0.01, 0.01)
    if kind == "bare":
        return NOTHING, NOTHING, 0.0
    if kind == "carton":
        least = max(0.06, reach.max(initial=0.0) + 0.012)
        half = rng.uniform(least, 0.15, 2) if rng.uniform() < 0.5 else np.full(2, rng.uniform(least, 0.15))
        board = wall(box(*half), rng.uniform(3e-3, 4e-3), rng.uniform(1.4, 2.0), 4e-3)
        inner = _body(rng, "empty bottle", positions)[0] if rng.uniform() < 0.5 else NOTHING
        return board + inner, NOTHING, float(np.hypot(*half))
    if kind == "helmet":
        half_x = min(radius, 0.082) if len(reach) else rng.uniform(0.07, 0.082)
        half_y = half_x * rng.uniform(1.0, 1.25)
        way = outside / reach
        # Rounder until reflectors stand 8 mm off the shell.
        while (reach - 1 / abs(way.real / half_x + 1j * way.imag / half_y)).min(initial=1.0) < 7.9e-3:
            half_y = (half_x + half_y) / 2
        shell = wall(ellipse(half_x, half_y), 3e-3, rng.uniform(2.5, 3.0), 3e-3)
        along = -1j * (half_y + 3e-3 * np.arange(1, 14))
        brim = Cells.of(along.astype(np.complex128), 3e-3 / np.sqrt(np.pi), 2.7)
        clear = np.abs(positions[:, None] - brim.centre_m).min(initial=1.0) > 0.012
        return shell + brim if clear else shell, NOTHING, half_y
    if kind.startswith("can"):
        can = metal(ellipse(radius, radius * oval))
        return can + _fitting(rng, kind, radius, positions, METAL), NOTHING, radius
    ceramic = kind.startswith("ceramic")
    thickness = 4e-3 if ceramic else rng.uniform(2e-3, 3e-3)
    material = complex(rng.uniform(5.0, 6.5) if ceramic else rng.uniform(2.3, 2.8))
    middle = radius - thickness / 2
    shell = wall(ellipse(middle, middle * oval), thickness, material, _cell(material))
    shell += _fitting(rng, kind, radius, positions, material)
    if kind not in FILLINGS:
        return shell, NOTHING, radius
    permittivity, loss = (rng.uniform(*limits) for limits in FILLINGS[kind])
    filling = complex(permittivity, -permittivity * loss)
    return shell + _rod(radius - thickness, filling), shell, radius


def _rod(radius_m: float, permittivity: complex) -> Cells:
    return wall(ellipse(radius_m / 2, radius_m / 2), radius_m, permittivity, _cell(permittivity))


def _beside(rng: np.random.Generator, radius_m: float, positions: Complex, gap_m: float = 0.02) -> complex:
    """A place at a radius, clear of others."""
    while True:
        at = complex(radius_m * np.exp(2j * np.pi * rng.uniform()))
        if all(np.abs(positions - at) > gap_m):
            return at


def _fitting(
    rng: np.random.Generator, kind: str, radius: float, positions: Complex, material: complex
) -> Cells:
    """The grip of a handle, or the metal seam of some cans, at the height of the tag."""
    if kind.endswith("handle"):
        at, thick = _beside(rng, radius + rng.uniform(0.018, 0.03), positions), rng.uniform(4e-3, 7e-3)
        return (metal(ellipse(thick, thick)) if material == METAL else _rod(thick, material)).moved(at)
    if material == METAL and rng.uniform() < 0.4:
        at = _beside(rng, radius + rng.uniform(1.5e-3, 2.5e-3), positions, 8e-3)
        return Cells.of(np.array([at]), rng.uniform(4e-4, 8e-4), METAL)
    return NOTHING
