"""Tagged objects composed of a body, its parts and reflectors, in one unit of amplitude.

Amplitude 1 is the selected reflector alone in free space at 4 GHz, so that a room scaled to a few reflectors
suits any of them, and a 35 mm can is 26 dB stronger than a 20 mm octahedron, as solved
(shared/fullwave/README.md: -14.1 against -40.5 dBsm).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.simulate.bodies import Carrier, Carton, RoundBody, Shell
from tagid.simulate.multipole import Layer
from tagid.simulate.scatterers import Mounted, Octahedron, Rod, unit_of
from tagid.simulate.scattering import Body
from tagid.simulate.scene import Scene, StaticReturns
from tagid.simulate.specification import BodySpec, ReflectorSpec

METAL = complex(np.inf)
PORCELAIN = 6.0 - 0.1j
"""Relative permittivity of glazed porcelain near 4 GHz; published values lie between 5 and 7."""
WATER = 76.0 - 17.0j
"""Relative permittivity of water at 20 degrees C and 4 GHz by the Debye model of Kaatze (J. Chem. Eng. Data
34, 1989, p. 371: static value 80.2, high-frequency value 5.6, relaxation time 9.36 ps)."""
PLASTIC = 2.8
HANDLE_REACH_M = 0.028
"""Distance from the wall to the middle of a handle's grip; fingers need 25 mm."""
HELMET_SHAPE = (0.078 / 0.101, 0.090 / 0.101)
"""Shorter half axis and height of a helmet relative to its longer half axis."""


@dataclass(frozen=True)
class Variation:
    """Differences between objects of one kind.

    Attributes:
        parts_rad: direction of its handle or seam.
        ring_m: (x, y) of the tag's middle from the body's axis, m: reflectors are never glued on exactly.
        strength_db: standard deviation of the reflectors' strengths, dB.
    """

    parts_rad: float = 0.0
    ring_m: tuple[float, float] = (0.0, 0.0)
    strength_db: float = 0.0


def carrier(spec: BodySpec, unit_m: float, variation: Variation) -> Carrier | None:
    """The body alone, without its parts; None for "none"."""
    centre = (-variation.ring_m[0], -variation.ring_m[1])
    turned = variation.parts_rad
    if spec.kind == "can":
        layers: tuple[Layer, ...] = (Layer(spec.size_m, METAL),)
        height = spec.length("height", 0.1)
        return RoundBody(layers, height, centre, spec.length("oval", 0.0), turned, unit_m)
    if spec.kind == "cup":
        inside = WATER if "filled" in spec.parts else 1.0
        layers = (Layer(spec.size_m - spec.length("wall", 0.004), inside), Layer(spec.size_m, PORCELAIN))
        height = spec.length("height", 0.1)
        return RoundBody(layers, height, centre, spec.length("oval", 0.0), turned, unit_m)
    if spec.kind == "helmet":
        x, up = (share * spec.size_m for share in HELMET_SHAPE)
        wall = spec.length("wall", 0.003)
        return Shell(x, spec.size_m, up, thickness_m=wall, centre_m=centre, unit_m=unit_m)
    if spec.kind == "box":
        height, wall = spec.length("height", 0.1), spec.length("wall", 0.004)
        depth = spec.length("depth", spec.size_m)
        return Carton(spec.size_m, depth, height, wall, rotation_rad=turned, centre_m=centre, unit_m=unit_m)
    return None


def parts(spec: BodySpec, body: Carrier, unit_m: float, variation: Variation) -> tuple[Mounted, ...]:
    """The body's handle and seam, with the effect of the body on their echoes.

    A handle's upright grip scatters; its two horizontal ends do not in vertical polarisation. That of a can
    is a strip 10 mm wide and 60 mm high, as in the full-wave solution (shared/fullwave/README.md); that of a
    cup is a rod of porcelain. A seam is a bead of 1 mm radius along the wall.
    """
    made = []
    out = spec.size_m if spec.kind != "helmet" else spec.size_m * HELMET_SHAPE[0]
    direction = np.array([np.cos(variation.parts_rad), np.sin(variation.parts_rad), 0.0])
    axis = np.array([*body.centre_m, 0.0])

    def mounted(rod: Rod, radius_m: float, place: np.ndarray) -> Mounted:
        position = axis + radius_m * place
        beside = body.around(position[:2])
        return Mounted(rod, position[None], np.ones(1, complex), (beside,), body.centre_m, unit_m)

    if "handle" in spec.parts:
        rod = Rod.metal_strip(0.010, 0.060) if spec.kind == "can" else Rod((Layer(0.006, PORCELAIN),), 0.060)
        made.append(mounted(rod, out + HANDLE_REACH_M, direction))
    if "seam" in spec.parts:
        across = np.array([-direction[1], direction[0], 0.0])
        if spec.kind == "helmet":
            across, out = np.array([1.0, 0.0, 0.0]), out + spec.length("wall", 0.003) / 2
        inside = METAL if spec.kind == "can" else PORCELAIN if spec.kind == "cup" else PLASTIC + 0j
        made.append(mounted(Rod((Layer(0.001, inside),), 0.08), out + 0.0011, across))
    return tuple(made)


def tagged_object(
    positions: NDArray[np.floating],
    body: BodySpec,
    reflector: ReflectorSpec,
    rng: np.random.Generator,
    variation: Variation | None = None,
) -> tuple[Body, ...]:
    """A body with its parts and reflectors, tag first.

    Reflectors (n, 2) or (n, 3) are in the tag's frame, m; none make an untagged object. `rng` draws their
    strengths. Raises DataError: a reflector is inside the body's wall or metal.
    """
    change = variation or Variation()
    scatterer = Octahedron(reflector.size_m)
    unit = unit_of(scatterer)
    base = carrier(body, unit, change)
    p = np.asarray(positions, dtype=np.float64)
    made: list[Body] = []
    if len(p):
        p = np.concatenate([p, np.zeros((len(p), 3 - p.shape[1]))], axis=1)
        strength = 10 ** (change.strength_db * rng.standard_normal(len(p)) / 20)
        beside = tuple(base.around(place) if base else None for place in p)
        axis = base.centre_m if base else (0.0, 0.0)
        made.append(Mounted(scatterer, p, strength.astype(np.complex128), beside, axis, unit))
    if base is not None:
        made += [base, *parts(body, base, unit, change)]
    return tuple(made)


def object_scene(
    name: str,
    positions: NDArray[np.floating],
    body: BodySpec,
    reflector: ReflectorSpec,
    *,
    rng: np.random.Generator,
    room: StaticReturns | None = None,
    variation: Variation | None = None,
    layout: str = "",
    seed: int | None = None,
) -> Scene:
    """A scene of one tagged object (or an untagged one, with no positions) in a room; errors as
    `tagged_object`.

    `layout` and `seed` are noted in the scene's description if given.
    """
    bodies = tagged_object(positions, body, reflector, rng, variation)
    described: dict[str, Any] = {"layout": layout} if layout else {}
    if seed is not None:
        described["seed"] = seed
    described |= {"body": str(body), "reflector": str(reflector)}
    untagged = None if len(positions) else 1.0
    return Scene(name, bodies, room=room, reference_amplitude=untagged, description=described)
