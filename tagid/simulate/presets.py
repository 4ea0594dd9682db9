"""Named scenes for the command line, the emulator and the tests.

Each is generated from a seed, so that "helmet-120?seed=1" is the same reflectors, shell and room everywhere.
Shells and handles belong to the object: they move with its reflectors if it is placed off the axis.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tagid.counting import meant
from tagid.errors import DataError, UsageError
from tagid.simulate.objects import Variation, object_scene
from tagid.simulate.scattering import Box, Cylinder, Points
from tagid.simulate.scene import Scene, StaticReturns
from tagid.simulate.specification import BodySpec, ReflectorSpec

if TYPE_CHECKING:
    from tagid.tags.layouts.layout import Layout

CAN_RADIUS_M = 0.033
"""A 330 ml drink can is 66 mm wide."""
BOX_SIDE_M = 0.2
MAX_POINTS = 64
_PLAIN = ("can", "box", "corner", "empty", "untagged")


def room_clutter(rng: np.random.Generator) -> StaticReturns:
    """Antenna leakage at 0.1..0.2 m and echoes of the room from 0.5 to 8 m, of either sign."""
    leakage = rng.uniform(0.1, 0.2)
    ranges = np.concatenate([[leakage], rng.uniform(0.5, 2.0, 4), rng.uniform(2.0, 8.0, 4)])
    sizes = np.concatenate([[4.0], rng.uniform(0.2, 1.5, len(ranges) - 1)])
    return StaticReturns(ranges, sizes * rng.choice([-1.0, 1.0], len(ranges)))


def tag_points(positions: NDArray[np.floating], rng: np.random.Generator) -> Points:
    """A tag's reflectors: amplitudes within 10 % of each other, facing away from the axis.

    A reflector less than 1 cm from the axis has no outer side and is isotropic.
    """
    p = np.asarray(positions, dtype=np.float64)
    facing = np.where(np.linalg.norm(p, axis=1) < 0.01, np.nan, np.arctan2(p[:, 1], p[:, 0]))
    return Points(p, rng.uniform(0.9, 1.0, len(p)), facing, np.deg2rad(180.0), 0.4)


def scene_from_layout(positions: NDArray[np.floating], name: str = "tag", seed: int = 0) -> Scene:
    """A tagged object with a simple round shell, in a room; the seed is that of amplitudes and room.

    The reflectors are (n, 2) in the object's plane, or (n, 3) with their heights, m.
    """
    rng = np.random.default_rng(seed)
    points = tag_points(positions, rng)
    # The wall that carries the reflectors; the centre of a 40 mm octahedron (tip to tip) is 20 mm off it.
    radius = max(0.02, float(np.linalg.norm(points.positions[:, :2], axis=1).max()) - 0.02)
    shell = Cylinder(radius, amplitude=0.5)
    about = {"layout": name, "seed": seed}
    return Scene(name, (points, shell), room=room_clutter(rng), description=about)


def random_points(count: int, rng: np.random.Generator, radius_m: float = 0.2) -> Points:
    """Points of amplitude 0.6..1 in a disc, at least 4 cm apart if there is room."""
    chosen: list[NDArray[np.float64]] = []
    spacing = 0.04
    while len(chosen) < count:
        angle, r = rng.uniform(0, 2 * np.pi), radius_m * np.sqrt(rng.uniform())
        point = np.array([r * np.cos(angle), r * np.sin(angle)])
        if all(np.linalg.norm(point - other) >= spacing for other in chosen):
            chosen.append(point)
        else:
            spacing *= 0.995  # so that the search ends in a full disc
    return Points(np.array(chosen), rng.uniform(0.6, 1.0, count))


def scene_on_body(
    name: str,
    body: BodySpec,
    reflector: ReflectorSpec,
    seed: int = 0,
    strength_db: float = 0.0,
    layouts: Mapping[str, Layout] | None = None,
) -> Scene:
    """A named tag on a physical body in a room.

    The scene is a layout, points-N, or untagged for the body alone. The seed is that of room, direction of
    handle and seam, and strengths, of which `strength_db` is the standard deviation, dB.

    Raises UsageError: the scene is unknown or has no tag, or its reflectors do not fit on the body.
    """
    rng = np.random.default_rng(seed)
    plain = scene_from_name(name, seed, layouts)
    tagged = plain.tag is not None and plain.reference_amplitude is None and name != "corner"
    if not tagged and name != "untagged":
        raise UsageError(
            f"scene {name!r} has no tag to put on a body",
            "Use a layout, points-N or untagged (the body alone).",
        )
    positions = plain.tag.positions if tagged and plain.tag is not None else np.zeros((0, 3))
    layout = name if tagged else ""
    room = room_clutter(rng)
    change = Variation(float(rng.uniform(0, 2 * np.pi)), strength_db=strength_db)
    try:
        return object_scene(
            name, positions, body, reflector, rng=rng, room=room, variation=change, layout=layout, seed=seed
        )
    except DataError as error:
        raise UsageError(f"{name} does not fit on {body}: {error.message}", error.remedy) from None


def preset_names(layouts: Mapping[str, Layout] | None = None) -> list[str]:
    """Every name accepted by `scene_from_name`; N in "points-N" is any number."""
    return [*sorted(_layouts(layouts)), *_PLAIN, "points-N"]


def is_plain(name: str) -> bool:
    """Whether a scene needs no layout: points-N, can, box, corner, empty, untagged."""
    return name in _PLAIN or re.fullmatch(r"points-\d{1,9}", name) is not None


def _layouts(layouts: Mapping[str, Layout] | None) -> Mapping[str, Layout]:
    from tagid.tags.layouts.layout import builtin_layouts

    return builtin_layouts() if layouts is None else layouts


def scene_from_name(name: str, seed: int = 0, layouts: Mapping[str, Layout] | None = None) -> Scene:
    """A named scene: a layout on its object, or points-N, can, box, corner, empty, untagged.

    Args:
        name: see `preset_names`.
        seed: random seed.
        layouts: layouts by name, e.g. of `tagid.enrolling.layout_file`; None for the built-in ones.

    Raises:
        UsageError: the name is unknown.
    """
    rng = np.random.default_rng(seed)
    about = {"seed": seed}
    if match := re.fullmatch(r"points-(\d{1,9})", name):
        count = int(match[1])
        if not 1 <= count <= MAX_POINTS:
            raise UsageError(f"scene {name!r} requests {count} points", f"Use 1 to {MAX_POINTS} points.")
        return Scene(name, (random_points(count, rng),), description=about)
    if name == "can":
        can = Cylinder(CAN_RADIUS_M, 1.0, (0.05, 0.0), 0.12)
        return Scene(name, (can,), room=room_clutter(rng), description=about)
    if name == "box":
        box = Box(BOX_SIDE_M, BOX_SIDE_M, rotation_rad=float(rng.uniform(0, 2 * np.pi)))
        return Scene(name, (box,), room=room_clutter(rng), description=about)
    if name == "corner":
        # A reflector on the axis, ten times a tag's: a calibration target in the room of "empty".
        corner = Points(np.zeros((1, 2)), np.array([10.0]))
        # Its SNR refers to a unit reflector, like that of "empty", so that the room is the same in both.
        return Scene(name, (corner,), room=room_clutter(rng), reference_amplitude=1.0, description=about)
    if name == "empty":
        return Scene(name, room=room_clutter(rng), reference_amplitude=1.0, description=about)
    if name == "untagged":
        # A handle and a scratch: much weaker than a reflector, but they rotate with the object.
        weak = Points(random_points(2, rng, 0.1).positions, rng.uniform(0.03, 0.1, 2))
        parts = (weak, Cylinder(0.09, amplitude=0.5))
        return Scene(name, parts, room=room_clutter(rng), reference_amplitude=1.0, description=about)
    chosen = _layouts(layouts).get(name)
    if chosen is not None:
        positions, heights = chosen.positions, chosen.heights
        if heights is not None and heights.any():
            positions = np.column_stack([positions, heights])
        return scene_from_layout(positions, name, seed)
    raise UsageError(
        f"scene {name[:80]!r} is unknown",
        f"{meant(name, preset_names(layouts))}Use one of {', '.join(preset_names(layouts))}, or give a "
        "designed layout with `file`.",
    )
