"""Families of layouts by design: the set of necklaces on an object that a radar tells apart best.

As AprilTag families are built for a minimum Hamming distance, these are built for a minimum rotational
distance in metres; where physics leaves no room, fewer layouts come out and the caller is told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import factorial

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.tags.layouts.cliques import farthest_set
from tagid.tags.layouts.codebook import CENTRE_TOLERANCE_M, CONFUSABLE_M, all_distances, best_pairing
from tagid.tags.layouts.layout import MAX_REFLECTORS, MIN_SPACING_M, Layout
from tagid.tags.layouts.necklaces import necklaces, occupied
from tagid.tags.layouts.objects import Row, TaggedObject

REFLECTOR_M = 0.04
"""Width of the paper's reflectors, octahedra of 20 mm radius: two cannot sit nearer."""
GHOST_M = 0.07
"""Nearer than about a wavelength (7.6 cm at 3.95 GHz) two reflectors modulate each other and make a ghost."""
MAX_SLOTS = 48
MAX_COUNT = 500
_MAX_PAIRINGS = 300_000_000


@dataclass(frozen=True)
class DesignRules:
    """What a family is made of.

    Attributes:
        reflectors: on each layout.
        slots: equal steps around the object.
        spacing_m: least distance of two reflectors, in space, m: a reflector's width.
        resolution_m: least distance seen from above, m: nearer ones are one point to the radar.
        mirror_counts: whether a layout and its mirror image may both be used; not where the direction of the
            turn is unknown, for then they read alike.
        centre_tolerance_m: how far off the axis an object may stand; shifts within it tell nothing apart.
        seed: of the search for the best set.
    """

    reflectors: int = 3
    slots: int = 12
    spacing_m: float = REFLECTOR_M
    resolution_m: float = MIN_SPACING_M
    mirror_counts: bool = True
    centre_tolerance_m: float = CENTRE_TOLERANCE_M
    seed: int = 0

    def __post_init__(self) -> None:
        if not 2 <= self.reflectors <= MAX_REFLECTORS:
            raise UsageError(f"{self.reflectors} reflectors a layout", f"Give 2 to {MAX_REFLECTORS}.")
        if not self.reflectors <= self.slots <= MAX_SLOTS:
            raise UsageError(
                f"{self.slots} slots for {self.reflectors} reflectors", f"Give up to {MAX_SLOTS} slots."
            )
        if not 0 <= self.seed < 1 << 63:
            raise UsageError(f"the seed is {self.seed}", "Give a whole number from 0, e.g. --seed 1.")
        for name in ("spacing_m", "resolution_m", "centre_tolerance_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and 0 <= value <= 1):
                raise UsageError(
                    f"{name.removesuffix('_m').replace('_', ' ')} is {value:g} m",
                    "Give 0 to 1, in metres and not in millimetres.",
                )


@dataclass(frozen=True, eq=False)
class Family:
    """A designed set of layouts.

    Attributes:
        layouts: best set found.
        distance_m: least rotational distance (RMS over reflectors) of two of them, m; infinite of one.
        ghost_m: least distance between reflectors of one layout, m; under GHOST_M expect ghosts.
        candidates: necklaces that keep the rules.
        necklaces: necklaces there are.
        rules: as designed.
        proven: whether no set of so many candidates keeps a larger distance; else it is the largest found.
    """

    layouts: tuple[Layout, ...]
    distance_m: float
    ghost_m: float
    candidates: int
    necklaces: int
    rules: DesignRules = field(default_factory=DesignRules)
    proven: bool = False


def design(
    target: TaggedObject,
    rules: DesignRules,
    count: int,
    prefix: str | None = None,
    beside: Sequence[Layout] = (),
) -> Family:
    """The `count` layouts on an object whose least rotational distance is largest.

    Args:
        target: object with its rows; every row is used.
        rules: reflectors, slots and physical limits.
        count: layouts wanted.
        prefix: of the names; None takes the object's and the numbers, as in helmet-r3s12-01.
        beside: layouts already in use; what could be confused with one of them is left out.

    Raises:
        UsageError: fewer than `count` layouts keep the rules; the message says how many do.
    """
    if not 1 <= count <= MAX_COUNT:
        raise UsageError(f"{count} layouts are wanted", f"Ask for 1 to {MAX_COUNT}.")
    points, heights, total = candidates(target, rules)
    free = [i for i, p in enumerate(points) if not _taken(p, beside, rules)]
    taken = len(points) - len(free)
    points, heights = points[free], heights[free]
    if len(points) < count:
        raise UsageError(
            f"{target.name} has room for {len(points)} layouts of {rules.reflectors} reflectors in "
            f"{rules.slots} slots at {rules.spacing_m * 1e3:.0f} mm spacing"
            + (f" beside those enrolled, which take {taken}" if taken else "")
            + f", not for {count}",
            "Ask for fewer, or give more --slots, --reflectors or --rows, or less --spacing.",
        )
    distance = distance_matrix(points, rules)
    far = farthest_set(distance, count, np.random.default_rng(rules.seed))
    chosen = far.chosen
    stem = prefix or f"{target.name}-r{rules.reflectors}s{rules.slots}"
    digits = max(2, len(str(count)))
    notes = f"Designed: {rules.reflectors} of {rules.slots} slots, {len(target.rows)} row(s)."
    layouts = tuple(
        Layout(
            f"{stem}-{i + 1:0{digits}d}",
            points[c],
            target.kind,
            notes=notes,
            label=f"{target.label or target.name} {i + 1}",
            heights=heights[c],
        )
        for i, c in enumerate(chosen)
    )
    off = distance[np.ix_(chosen, chosen)][~np.eye(count, dtype=bool)]
    return Family(
        layouts,
        float(off.min()) if off.size else np.inf,
        min(_nearest(points[c], heights[c]) for c in chosen),
        len(points),
        total,
        rules,
        far.proven,
    )


def candidates(
    target: TaggedObject, rules: DesignRules
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Positions (n, K, 2) and heights (n, K), m, of the necklaces that keep the rules; all necklaces' number.

    Rows of equal radius differ in height alone, which a radar at the object's level does not see: among words
    that look alike from above only the one with the widest spacing in space stays.
    """
    words = necklaces(rules.slots, rules.reflectors, len(target.rows), mirror_counts=rules.mirror_counts)
    kept: dict[tuple[tuple[int, float], ...], tuple[float, NDArray[np.float64], NDArray[np.float64]]] = {}
    for word in words:
        beads = occupied(word)
        rows = [target.rows[colour] for _, colour in beads]
        points, heights = _placed([slot for slot, _ in beads], rows, rules.slots)
        flat = _nearest(points, np.zeros(len(points)))
        space = _nearest(points, heights)
        if flat < rules.resolution_m - 1e-9 or space < rules.spacing_m - 1e-9:
            continue
        seen = _from_above([slot for slot, _ in beads], rows, rules.slots)
        if seen not in kept or space > kept[seen][0] + 1e-9:
            kept[seen] = (space, points, heights)
    if not kept:
        empty = np.zeros((0, rules.reflectors, 2))
        return empty, empty[..., 0], len(words)
    _, points_of, heights_of = zip(*kept.values(), strict=True)
    return np.array(points_of), np.array(heights_of), len(words)


def _taken(points: NDArray[np.float64], beside: Sequence[Layout], rules: DesignRules) -> bool:
    images = (points,) if rules.mirror_counts else (points, points * np.array([1.0, -1.0]))
    return any(
        best_pairing(image, other.positions, rules.centre_tolerance_m).worst_m < CONFUSABLE_M
        for other in beside
        if other.size == len(points)
        for image in images
    )


def _from_above(slots: list[int], rows: list[Row], count: int) -> tuple[tuple[int, float], ...]:
    """Canonical form of what is seen from above: the smallest rotation of (slot, radius)."""
    turned = [
        tuple(sorted(((slot - first) % count, row.radius_m) for slot, row in zip(slots, rows, strict=True)))
        for first in slots
    ]
    return min(turned)


def _placed(slots: list[int], rows: list[Row], count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    angle = 2 * np.pi * np.array(slots) / count
    radius = np.array([row.radius_m for row in rows])
    xy = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.where(np.abs(xy) < 1e-12, 0.0, xy), np.array([row.height_m for row in rows])


def _nearest(points: NDArray[np.float64], heights: NDArray[np.float64]) -> float:
    """Least distance in space of two reflectors, m."""
    space = np.concatenate([points, heights[:, None]], axis=1)
    gap = np.linalg.norm(space[:, None] - space[None], axis=2)
    return float(gap[~np.eye(len(points), dtype=bool)].min())


def distance_matrix(points: NDArray[np.float64], rules: DesignRules) -> NDArray[np.float64]:
    """(n, n) rotational distances (RMS, m) of layouts (n, K, 2): see `codebook.all_distances`.

    Where mirror images read alike, a distance is that to the nearer image.

    Raises UsageError where there are too many to compare.
    """
    n, k = points.shape[:2]
    if n * n * factorial(k) > _MAX_PAIRINGS:
        raise UsageError(
            f"{n} candidate layouts of {k} reflectors are too many to compare all of them",
            "Give fewer --slots, --reflectors or --rows, or more --spacing.",
        )
    straight = all_distances(points, rules.centre_tolerance_m)
    if rules.mirror_counts:
        return straight
    return np.minimum(straight, all_distances(points, rules.centre_tolerance_m, mirrored=True))
