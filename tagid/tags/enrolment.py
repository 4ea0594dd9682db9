"""Enrolling a layout: how far it is from every other, and what it is when only the real object is at hand.

Two layouts that can be confused make every later reading of either worthless, so they are refused here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError, LayoutConflictError
from tagid.tags.codebook import (
    CENTRE_TOLERANCE_M,
    CONFUSABLE_M,
    LayoutDistance,
    best_pairing,
    confusable,
    rotational_distance,
)
from tagid.tags.layout import Layout, rotation_matrix
from tagid.tags.reflectors import Reflector

STRONG_DB = -9.0
"""Reflectors of a tag are alike: one this far under the strongest is not taken for a part of the layout."""


class LayoutStore(Protocol):
    """What enrolment needs of a registry."""

    def layouts(self) -> list[Layout]:
        """All enrolled layouts."""
        ...

    def add(self, layout: Layout, source: str, *, replace: bool = False) -> int:
        """Enrol and return the registry's version."""
        ...

    def add_all(self, layouts: Sequence[Layout], source: str) -> int:
        """Enrol several, all or none, and return the registry's version."""
        ...


@dataclass(frozen=True)
class Enrolment:
    """What enrolling found and did.

    Attributes:
        layout: as enrolled.
        distances: distance to every layout enrolled before, by name.
        confusable: names of those that are too near; not empty only where forced.
        version: the registry's version since.
    """

    layout: Layout
    distances: dict[str, LayoutDistance]
    confusable: tuple[str, ...]
    version: int


def enrol(
    store: LayoutStore,
    layout: Layout,
    source: str,
    *,
    force: bool = False,
    tolerance_m: float = CONFUSABLE_M,
) -> Enrolment:
    """Add a layout to the store unless it could be confused with another.

    Args:
        store: the registry.
        layout: new layout.
        source: where it comes from, for the history.
        force: enrol it all the same, and over one of the same name.
        tolerance_m: worst-reflector distance under which two layouts are confusable, m.

    Raises:
        LayoutConflictError: it is too near to an enrolled layout. RegistryError: the name is taken.
    """
    others = [other for other in store.layouts() if not (force and other.name == layout.name)]
    distances = {other.name: rotational_distance(layout, other) for other in others}
    near = {name: d for name, d in distances.items() if d.worst_m < tolerance_m and name != layout.name}
    if near and not force:
        name, distance = min(near.items(), key=lambda item: item[1].worst_m)
        raise LayoutConflictError(
            f"layout {layout.name} could be confused with {name}: its reflectors lie within "
            f"{distance.worst_m * 1e3:.1f} mm of it after a turn of {distance.rotation_deg:.0f} degrees",
            f"Move a reflector until one lies {tolerance_m * 1e3:.0f} mm away, or insist with --force.",
        )
    version = store.add(layout, source, replace=force)
    return Enrolment(layout, distances, tuple(sorted(near)), version)


def merge(
    store: LayoutStore,
    layouts: Sequence[Layout],
    source: str,
    *,
    force: bool = False,
    tolerance_m: float = CONFUSABLE_M,
) -> int:
    """Add several layouts to the store, all or none; those enrolled just so are left as they are.

    Raises:
        LayoutConflictError: a name stands for another layout there, or two layouts could be confused; not
            with `force`, which replaces the former and lets the latter be.
    """
    if not force:
        known = {layout.name: layout for layout in store.layouts()}
        for layout in layouts:
            same = known.get(layout.name)
            if same is not None and same.to_dict() != layout.to_dict():
                raise LayoutConflictError(
                    f"a different layout named {layout.name} is enrolled already",
                    "Rename one of them, or replace the enrolled one with --force.",
                )
        new = [layout for layout in layouts if layout.name not in known]
        fixed = list(known.values())
        for i, layout in enumerate(new):
            for name, distance in confusable(layout, [*fixed, *new[:i]], tolerance_m).items():
                raise LayoutConflictError(
                    f"layout {layout.name} could be confused with {name}: its reflectors lie within "
                    f"{distance.worst_m * 1e3:.1f} mm of it after a turn",
                    "Leave one of them out, or insist with --force; nothing was stored.",
                )
    return store.add_all(layouts, source)


@dataclass(frozen=True, eq=False)
class LayoutEstimate:
    """A layout measured on the real object.

    Attributes:
        layout: mean positions about the object's mean axis, the outermost reflector on +x.
        spread_m: (K,) RMS scatter of each reflector over the captures, m.
        used, discarded: indexes of the captures that showed K reflectors, and of the others.
    """

    layout: Layout
    spread_m: NDArray[np.float64]
    used: tuple[int, ...]
    discarded: tuple[int, ...]


def layout_from_readings(
    found: Sequence[Sequence[Reflector]], name: str, kind: str = "other", label: str = ""
) -> LayoutEstimate:
    """Layout from the reflectors found in several captures of one object, in any turn and place.

    Captures are paired, turned and shifted onto their mean (generalised Procrustes analysis, Gower 1975). The
    origin is the mean place of the turntable's axis on the object: place the object's axis on it as well as
    you can, the errors average out.

    Raises DataError where fewer than two reflectors are seen, or the captures do not agree on how many.
    """
    strong = [[(r.x_m, r.y_m) for r in capture if r.amplitude_db >= STRONG_DB] for capture in found]
    counts = Counter(len(points) for points in strong)
    if not counts:
        raise DataError("no capture to take a layout from", "Give at least one capture of the object.")
    size, votes = max(counts.items(), key=lambda item: (item[1], item[0]))
    if size < 2:
        raise DataError(
            f"{votes} of {len(found)} captures show {size} reflectors, a layout needs two",
            "Check that the object is tagged and in the beam, and record more views.",
        )
    if 2 * votes <= len(found) and len(found) > 1:
        seen = ", ".join(str(len(points)) for points in strong)
        raise DataError(
            f"the captures do not agree on the number of reflectors ({seen})",
            "Record again with more views or less clutter, or give the positions as numbers.",
        )
    used = tuple(i for i, points in enumerate(strong) if len(points) == size)
    sets = [np.array(strong[i]) for i in used]
    mean, axis = sets[0], np.zeros(2)
    for _ in range(3):
        placed = []
        axes = []
        for points in sets:
            # Off the axis in both captures by as much as the reader allows; more is another pairing,
            # since two reflectors can always be exchanged by half a turn and a shift.
            pair = best_pairing(points, mean, 2 * CENTRE_TOLERANCE_M)
            turned = points @ rotation_matrix(pair.rotation_rad).T + pair.shift_m
            ordered = np.empty_like(turned)
            ordered[pair.partner] = turned
            placed.append(ordered)
            axes.append(pair.shift_m)
        mean, axis = np.mean(placed, axis=0), np.mean(axes, axis=0)
    spread = np.sqrt(np.mean(np.sum((np.array(placed) - mean) ** 2, axis=2), axis=0))
    positions = mean - axis
    outermost = int(np.argmax(np.linalg.norm(positions, axis=1)))
    turn = -np.arctan2(positions[outermost, 1], positions[outermost, 0])
    notes = f"Measured on {len(sets)} captures, scatter up to {spread.max() * 1e3:.1f} mm."
    layout = Layout(name, positions @ rotation_matrix(float(turn)).T, kind, notes=notes, label=label)
    discarded = tuple(i for i in range(len(found)) if i not in used)
    return LayoutEstimate(layout, spread, used, discarded)
