"""Families of layouts by design: the necklaces on an object that a radar distinguishes best.

As AprilTag families maximise a minimum Hamming distance, these maximise a minimum rotational distance in
metres. If physics leaves too little room, `design` reports how many layouts fit.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import factorial

import numpy as np
from numpy.typing import NDArray

from tagid.counting import counted
from tagid.errors import UsageError
from tagid.tags.layouts.cliques import farthest_set
from tagid.tags.layouts.codebook import (
    CENTRE_TOLERANCE_M,
    CONFUSABLE_M,
    all_distances,
    best_pairing,
    height_weight,
    in_space,
)
from tagid.tags.layouts.layout import MAX_REFLECTORS, MIN_SPACING_M, Layout
from tagid.tags.layouts.necklaces import necklaces, occupied
from tagid.tags.layouts.objects import Row, TaggedObject

REFLECTOR_M = 0.04
"""Size (tip to tip) of the paper's reflectors, octahedra of 20 mm radius: their centres cannot be closer."""
GHOST_M = 0.07
"""Reflectors closer than about a wavelength (7.6 cm at 3.95 GHz) modulate each other and cause a ghost."""
MAX_SLOTS = 48
MAX_COUNT = 500
_MAX_PAIRINGS = 300_000_000


@dataclass(frozen=True)
class DesignRules:
    """Design rules of a family.

    Attributes:
        reflectors: reflectors per layout.
        slots: equal angular steps around the object.
        spacing_m: minimum distance of two reflectors in space, m: a reflector's width.
        mirror_counts: whether a layout and its mirror image may both be used; False if the direction of
            rotation is unknown, because they then read the same.
        seed: random seed of the search for the best set.
        antenna_heights_m: heights of the antenna above the object's plane at which every object is recorded;
            with several, layouts may differ in the heights of their reflectors alone.
        axis_distance_m: horizontal distance from the antenna to the axis, m.
    """

    reflectors: int = 3
    slots: int = 12
    spacing_m: float = REFLECTOR_M
    mirror_counts: bool = True
    seed: int = 0
    antenna_heights_m: tuple[float, ...] = (0.0,)
    axis_distance_m: float = 1.0

    @property
    def height_weight(self) -> float:
        """See `codebook.height_weight`."""
        return height_weight(self.antenna_heights_m, self.axis_distance_m)

    def __post_init__(self) -> None:
        if not 2 <= self.reflectors <= MAX_REFLECTORS:
            raise UsageError(f"{self.reflectors} reflectors per layout", f"Give 2 to {MAX_REFLECTORS}.")
        if not self.reflectors <= self.slots <= MAX_SLOTS:
            raise UsageError(
                f"{self.slots} slots for {self.reflectors} reflectors", f"Give up to {MAX_SLOTS} slots."
            )
        if not 0 <= self.seed < 1 << 63:
            raise UsageError(f"the seed is {self.seed}", "Give a whole number from 0, e.g. `seed=1`.")
        if not self.antenna_heights_m or not np.isfinite(self.antenna_heights_m).all():
            raise UsageError("the antenna heights are not finite numbers", "Give metres, e.g. 0,0.15,0.3.")
        if not (np.isfinite(self.axis_distance_m) and self.axis_distance_m > 0):
            raise UsageError(f"the axis distance is {self.axis_distance_m} m", "Give a positive distance.")
        if not (np.isfinite(self.spacing_m) and 0 <= self.spacing_m <= 1):
            raise UsageError(f"spacing is {self.spacing_m:g} m", "Give 0 to 1, in metres, not millimetres.")


@dataclass(frozen=True, eq=False)
class Family:
    """A designed set of layouts.

    Attributes:
        layouts: the best set found.
        distance_m: minimum rotational distance (RMS over reflectors) of two layouts, m; infinite for one.
        ghost_m: minimum distance between reflectors of one layout, m; expect ghosts below GHOST_M.
        candidates: number of necklaces that meet the rules.
        necklaces: number of all necklaces.
        rules: the design rules.
        proven: whether no other set of this size has a larger distance; else it is the largest found.
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
    """The `count` layouts on an object, in all its rows, with the largest minimum rotational distance.

    `prefix` begins the names; None gives the object, the rules and three characters that tell this set from
    others, as in helmet-r3s12-4fd-01. Candidates that could be confused with layouts in use, `beside`, are
    excluded.

    Raises UsageError: fewer than `count` layouts meet the rules; the message says how many do.
    """
    if not 1 <= count <= MAX_COUNT:
        raise UsageError(f"cannot design {count} layouts", f"Ask for 1 to {MAX_COUNT}.")
    points, heights, total = candidates(target, rules)
    space = weighted(points, heights, rules)
    free = _free(space, beside, rules)
    taken = len(points) - len(free)
    points, heights, space = points[free], heights[free], space[free]
    if len(points) < count:
        raise UsageError(
            f"{target.name} has room for {len(points)} layouts of {rules.reflectors} reflectors in "
            f"{rules.slots} slots at {rules.spacing_m * 1e3:.0f} mm spacing"
            + (f" besides the enrolled ones, which exclude {taken}" if taken else "")
            + f", not for {count}",
            f"Ask for {len(points)} or fewer."
            if len(points)
            else "Use fewer reflectors, a smaller spacing or a larger object.",
        )
    distance = distance_matrix(space, rules)
    far = farthest_set(distance, count, np.random.default_rng(rules.seed))
    chosen = far.chosen
    set_name = _fingerprint(points[chosen], heights[chosen])
    stem = prefix or f"{target.name}-r{rules.reflectors}s{rules.slots}-{set_name}"
    digits = max(2, len(str(count)))
    notes = f"Designed: {rules.reflectors} of {rules.slots} slots, {counted(len(target.rows), 'row')}."
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


def _fingerprint(points: NDArray[np.float64], heights: NDArray[np.float64]) -> str:
    """Three characters that differ between sets of layouts, so that two designs do not share names."""
    tenths = np.rint(np.concatenate([points.ravel(), heights.ravel()]) * 1e4).astype("<i4")
    return hashlib.sha256(tenths.tobytes()).hexdigest()[:3]


def candidates(
    target: TaggedObject, rules: DesignRules
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Positions (n, K, 2) and heights (n, K), m, of the necklaces that meet the rules, and the number of all.

    Rows of equal radius differ only in height, which a radar at one height cannot resolve: of words that are
    equal in plan view, only the one with the widest spacing in space is kept. With several antenna heights,
    words count as equal only if their heights are, too, up to a common shift.
    """
    words = necklaces(rules.slots, rules.reflectors, len(target.rows), mirror_counts=rules.mirror_counts)
    kept: dict[
        tuple[tuple[int, float, float], ...], tuple[float, NDArray[np.float64], NDArray[np.float64]]
    ] = {}
    for word in words:
        beads = occupied(word)
        rows = [target.rows[colour] for _, colour in beads]
        points, heights = _placed([slot for slot, _ in beads], rows, rules.slots)
        flat = _nearest(points, np.zeros(len(points)))
        space = _nearest(points, heights)
        if flat < MIN_SPACING_M - 1e-9 or space < rules.spacing_m - 1e-9:
            continue
        seen = _seen([slot for slot, _ in beads], rows, rules)
        if seen not in kept or space > kept[seen][0] + 1e-9:
            kept[seen] = (space, points, heights)
    if not kept:
        empty = np.zeros((0, rules.reflectors, 2))
        return empty, empty[..., 0], len(words)
    _, points_of, heights_of = zip(*kept.values(), strict=True)
    return np.array(points_of), np.array(heights_of), len(words)


def weighted(
    points: NDArray[np.float64], heights: NDArray[np.float64], rules: DesignRules
) -> NDArray[np.float64]:
    """Positions (n, K, 2), with weighted heights as a third coordinate if these distinguish layouts, m."""
    if rules.height_weight <= 0:
        return points
    return np.concatenate([points, rules.height_weight * heights[..., None]], axis=-1)


def capacity(target: TaggedObject, rules: DesignRules, beside: Sequence[Layout] = ()) -> int:
    """Number of layouts that meet the rules and are unlike those in use; at most `MAX_COUNT`."""
    points, heights, _ = candidates(target, rules)
    return min(len(_free(weighted(points, heights, rules), beside, rules)), MAX_COUNT)


def _free(space: NDArray[np.float64], beside: Sequence[Layout], rules: DesignRules) -> list[int]:
    """Indexes of the candidates (n, K, 2 or 3), m, that cannot be confused with a layout in use."""
    return [i for i, points in enumerate(space) if not _taken(points, beside, rules)]


def _taken(points: NDArray[np.float64], beside: Sequence[Layout], rules: DesignRules) -> bool:
    flip = np.array([1.0, -1.0, 1.0][: points.shape[1]])
    images = (points,) if rules.mirror_counts else (points, points * flip)
    weight = rules.height_weight
    return any(
        best_pairing(image, in_space(other, weight), CENTRE_TOLERANCE_M).worst_m < CONFUSABLE_M
        for other in beside
        if other.size == len(points)
        for image in images
    )


def _seen(slots: list[int], rows: list[Row], rules: DesignRules) -> tuple[tuple[int, float, float], ...]:
    """Canonical form of what the radar resolves: the smallest rotation of (slot, radius, height).

    Heights are relative to the lowest reflector, and 0 where they are not resolved.
    """
    lowest = min(row.height_m for row in rows)
    shown = [round(row.height_m - lowest, 6) if rules.height_weight > 0 else 0.0 for row in rows]
    beads = [(slot, row.radius_m, height) for slot, row, height in zip(slots, rows, shown, strict=True)]
    turned = [
        tuple(sorted(((slot - first) % rules.slots, radius, height) for slot, radius, height in beads))
        for first in slots
    ]
    return min(turned)


def _placed(slots: list[int], rows: list[Row], count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    angle = 2 * np.pi * np.array(slots) / count
    radius = np.array([row.radius_m for row in rows])
    xy = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.where(np.abs(xy) < 1e-12, 0.0, xy), np.array([row.height_m for row in rows])


def _nearest(points: NDArray[np.float64], heights: NDArray[np.float64]) -> float:
    """Minimum distance of two reflectors in space, m."""
    space = np.concatenate([points, heights[:, None]], axis=1)
    gap = np.linalg.norm(space[:, None] - space[None], axis=2)
    return float(gap[~np.eye(len(points), dtype=bool)].min())


def distance_matrix(points: NDArray[np.float64], rules: DesignRules) -> NDArray[np.float64]:
    """(n, n) rotational distances (RMS, m) of layouts (n, K, 2 or 3): see `codebook.all_distances`.

    If mirror images read the same, the distance is the smaller one of both images.

    Raises UsageError if there are too many to compare.
    """
    n, k = points.shape[:2]
    if n * n * factorial(k) > _MAX_PAIRINGS:
        raise UsageError(
            f"{n} candidate layouts of {k} reflectors are too many to compare",
            "Reduce `slots`, `reflectors` or `rows`, or increase `spacing`.",
        )
    straight = all_distances(points)
    if rules.mirror_counts:
        return straight
    return np.minimum(straight, all_distances(points, mirrored=True))
