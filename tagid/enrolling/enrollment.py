"""Enrolling layouts: distance to every other layout, evidence that distinguishes them, reasons to reject.

If two enrolled layouts can be confused, no later reading of either is reliable; such layouts are rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tagid.enrolling.registry import Registry
from tagid.errors import LayoutConflictError, RegistryError
from tagid.proportion import percent
from tagid.reading.alike import Apart, Conditions, told_apart
from tagid.tags.bodies.signature import Signature
from tagid.tags.layouts.codebook import (
    CENTRE_TOLERANCE_M,
    LayoutDistance,
    best_pairing,
    in_space,
    rotational_distance,
)
from tagid.tags.layouts.layout import Layout, rotation_matrix

MAX_UNRESOLVED = 1e-2
"""Largest share of the readings without a name because of one neighbour; a layout above it is rejected."""
NEAR_M = 25e-3
"""Layouts farther apart (RMS) are distinguished by more than 100 nats on any body."""
MOST_NEAR = 3
"""Neighbours whose evidence is compared, the nearest ones."""
_TRIES = 20
_T = TypeVar("_T")


@dataclass(frozen=True)
class Basis:
    """What readings tell layouts apart by.

    Attributes:
        direction_known: whether the direction of rotation is known; if not, mirror images are equivalent.
        height_weight: what heights of reflectors count, see `codebook.height_weight`; 0: nothing.
    """

    direction_known: bool = True
    height_weight: float = 0.0


@dataclass(frozen=True)
class Neighbour:
    """An enrolled layout compared with a new one.

    Attributes:
        name: name of the enrolled layout.
        distance: distance between the two.
        apart: how far a reading tells the two apart; None where they are far from alike, or differ in number.
        unresolved: share of the readings without a name because of this neighbour, the uncertainty of both
            layouts' positions included.
        mirrored: whether the comparison is with the new layout's mirror image, which gives the same reading
            if the direction of rotation is unknown.
    """

    name: str
    distance: LayoutDistance
    mirrored: bool = False
    apart: Apart | None = None
    unresolved: float = 0.0

    @property
    def confusable(self) -> bool:
        """Whether the two are too close to be distinguished."""
        return self.unresolved > MAX_UNRESOLVED

    def turned(self, name: str) -> Neighbour:
        """The same comparison from the other layout's side; `name` is the first layout's."""
        turn = self.distance.rotation_deg
        back = turn if self.mirrored else (360 - turn) % 360
        return replace(self, name=name, distance=replace(self.distance, rotation_deg=back))

    def compared(self, layout: Layout, other: Layout, conditions: Conditions) -> Neighbour:
        """The same with the evidence of a reading; unchanged where the two are far from alike."""
        known = layout.covariance is None and other.covariance is None
        if not self.distance.rms_m < (NEAR_M if known else np.inf):
            return self
        oriented = layout.mirrored() if self.mirrored else layout
        apart = told_apart(oriented, other, conditions)
        unsure = _unsure(oriented, other, conditions.height_weight)
        return replace(self, apart=apart, unresolved=apart.unresolved(unsure))

    @property
    def nearness_m(self) -> float:
        """Sorting key of neighbours: largest distance between the reflectors that both have, m."""
        return min(self.distance.worst_m, self.distance.nested_m)


@dataclass(frozen=True)
class Outlook:
    """Consequences of enrolling a layout, computed before anything is stored.

    Attributes:
        layout: new layout.
        neighbours: every other layout; those with as many reflectors first, each group nearest first.
        conditions: of the recordings for which the shares hold.
        version: registry version that the comparison was made against.
    """

    layout: Layout
    neighbours: tuple[Neighbour, ...]
    conditions: Conditions
    version: int = 0

    @property
    def unresolved(self) -> float:
        """Share of the readings of the layout that its neighbours leave without a name, at most."""
        return min(sum(n.unresolved for n in self.neighbours), 1.0)

    @property
    def least(self) -> Neighbour | None:
        """The neighbour that a reading tells apart by least; None where all are far from alike."""
        compared = [n for n in self.neighbours if n.apart is not None]
        return max(compared, key=lambda n: n.unresolved, default=None)

    @property
    def confusable(self) -> tuple[str, ...]:
        """Names of the neighbours that are too close."""
        return tuple(sorted(n.name for n in self.neighbours if n.confusable))

    def conflict(self) -> LayoutConflictError | None:
        """The error that rejects the layout, or None if it may be enrolled."""
        near = [n for n in self.neighbours if n.confusable]
        if not near:
            return None
        worst = max(near, key=lambda n: n.unresolved)
        image = "the mirror image of " if worst.mirrored else ""
        where = "" if worst.apart is None else worst.apart.where
        sigma = self.layout.sigma_m
        known = f", positions known to {sigma * 1e3:.1f} mm" if sigma > 0 else ""
        return LayoutConflictError(
            f"layout {self.layout.name} could be confused with {image}{worst.name}: after a rotation of "
            f"{round(worst.distance.rotation_deg) % 360} degrees their reflectors are within "
            f"{worst.distance.worst_m * 1e3:.1f} mm of each other{known}, and {percent(worst.unresolved)} "
            f"of readings{where} leave no name",
            f"Move a reflector, or {'measure it on more captures, or ' if sigma > 0 else ''}override with "
            "`force`; nothing was stored.",
        )


def outlook(layout: Layout, others: Sequence[Layout], basis: Basis = Basis(), version: int = 0) -> Outlook:
    """Distance between a layout and every other, and how far a reading tells it from the nearest.

    Another one of the same name is ignored; `version` is the registry's, for the result.

    Raises UsageError if a reflector lies outside the largest object of the layout's kind.
    """
    layout.check_room()
    conditions = Conditions(height_weight=basis.height_weight)
    neighbours = _by_nearness(
        [neighbour(layout, other, basis) for other in others if other.name != layout.name]
    )
    enrolled = {other.name: other for other in others}
    near = [
        candidate.compared(layout, enrolled[candidate.name], conditions)
        for candidate in neighbours[:MOST_NEAR]
    ]
    return Outlook(layout, (*near, *neighbours[MOST_NEAR:]), conditions, version)


def _by_nearness(neighbours: Sequence[Neighbour]) -> tuple[Neighbour, ...]:
    """Neighbours with as many reflectors as the layout first, each group nearest first."""
    return tuple(sorted(neighbours, key=lambda n: (not np.isfinite(n.distance.worst_m), n.nearness_m)))


def neighbour(layout: Layout, other: Layout, basis: Basis) -> Neighbour:
    """Distance of two layouts; of the nearer mirror image if the direction is unknown."""
    weight = basis.height_weight
    straight = Neighbour(other.name, rotational_distance(layout, other, height_weight=weight))
    if basis.direction_known:
        return straight
    image = Neighbour(other.name, rotational_distance(layout.mirrored(), other, height_weight=weight), True)
    return image if image.nearness_m < straight.nearness_m - 1e-9 else straight


def _unsure(layout: Layout, other: Layout, height_weight: float) -> float:
    """Standard deviation of the positions along the difference of two layouts, over that difference."""
    if layout.covariance is None and other.covariance is None:
        return 0.0
    pair = best_pairing(in_space(layout, height_weight), in_space(other, height_weight), CENTRE_TOLERANCE_M)
    rotation = rotation_matrix(pair.rotation_rad)
    apart = layout.positions @ rotation.T + pair.shift_m - other.positions[pair.partner]
    length = max(float(np.linalg.norm(apart)), 1e-12)
    along = apart / length
    variance = max(
        _variance_along(layout.covariance, along @ rotation),
        _variance_along(other.covariance, along[np.argsort(pair.partner)]),
    )
    return float(np.sqrt(variance)) / length


def _variance_along(covariance: NDArray[np.float64] | None, along: NDArray[np.float64]) -> float:
    """Variance, m^2, along a unit vector given as (K, 2), of positions with covariances (K, 2, 2)."""
    return 0.0 if covariance is None else float(np.einsum("ki,kij,kj->", along, covariance, along))


def enroll(
    registry: Registry,
    layout: Layout,
    source: str,
    *,
    force: bool = False,
    basis: Basis = Basis(),
    signatures: Sequence[Signature] = (),
) -> tuple[Outlook, int]:
    """Add a layout to the registry unless it could be confused with another.

    With `force` it is enrolled nevertheless, and replaces one of the same name; signatures of the same object
    are stored with it. Returns it compared with its neighbours, and the new registry version.

    Raises:
        LayoutConflictError: it is too close to an enrolled layout.
        RegistryError: the name is taken.
    """

    def compared() -> tuple[Outlook, int] | None:
        version, known = registry.snapshot()
        comparison = outlook(layout, known, basis, version)
        conflict = comparison.conflict()
        if conflict and not force:
            raise conflict
        done = registry.add_all([layout], source, replace=force, since=version, signatures=signatures)
        return None if done is None else (comparison, done)

    return undisturbed(compared)


def family_outlooks(
    layouts: Sequence[Layout],
    known: Sequence[Layout],
    basis: Basis = Basis(),
) -> list[Outlook]:
    """The outlook of several layouts to be enrolled together, compared with each other and those enrolled.

    A new layout replaces an enrolled one of the same name. Raises UsageError as `outlook` does.
    """
    names = {layout.name for layout in layouts}
    fixed = [layout for layout in known if layout.name not in names]
    outlooks = [outlook(layout, [*fixed, *layouts[:i]], basis) for i, layout in enumerate(layouts)]
    # Each layout was compared with the earlier ones only; mirror those comparisons.
    seen: dict[str, list[Neighbour]] = {layout.name: [] for layout in layouts}
    for prospect in outlooks:
        for other in prospect.neighbours:
            if other.name in seen:
                seen[other.name].append(other.turned(prospect.layout.name))
    return [
        replace(prospect, neighbours=_by_nearness([*prospect.neighbours, *seen[prospect.layout.name]]))
        for prospect in outlooks
    ]


def merge(
    registry: Registry,
    layouts: Sequence[Layout],
    source: str,
    *,
    force: bool = False,
    basis: Basis = Basis(),
    checked: int | None = None,
    signatures: Sequence[Signature] = (),
) -> int:
    """Add several layouts of unique names to the registry, all or none; identical entries are left unchanged.

    With `force` they replace layouts of the same names, and may be confusable. `checked` is a registry
    version for which `refusal` found nothing; the other arguments are those of `enroll`.

    Raises LayoutConflictError: a name is taken by a different layout, or two layouts could be confused.
    """

    def compared() -> int | None:
        version, enrolled = registry.snapshot()
        again = not force and version != checked
        if again and (error := refusal(family_outlooks(layouts, enrolled, basis), enrolled)):
            raise error
        return registry.add_all(layouts, source, since=version, signatures=signatures)

    return undisturbed(compared)


def undisturbed(compared: Callable[[], _T | None]) -> _T:
    """Repeat a comparison with the registry and the change that depends on it until nothing comes between.

    It stores with `since`, and gives None where the registry has changed meanwhile. Raises RegistryError if
    other processes keep changing it.
    """
    for _ in range(_TRIES):
        done = compared()
        if done is not None:
            return done
    raise RegistryError("other processes keep changing the registry", "Try again when they have finished.")


def refusal(outlooks: Sequence[Outlook], enrolled: Sequence[Layout]) -> LayoutConflictError | None:
    """Why the layouts compared by `family_outlooks` cannot be added; None if they can."""
    known = {layout.name: layout for layout in enrolled}
    for prospect in outlooks:
        same = known.get(prospect.layout.name)
        if same is not None and same.to_dict() != prospect.layout.to_dict():
            return LayoutConflictError(
                f"a different layout named {same.name} is already enrolled",
                "Rename one of them (a design: `prefix=NAME`), or import with `force`; nothing was stored.",
            )
    conflicts = (prospect.conflict() for prospect in reversed(outlooks) if prospect.layout.name not in known)
    return next((conflict for conflict in conflicts if conflict), None)
