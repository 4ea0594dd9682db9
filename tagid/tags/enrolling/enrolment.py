"""Enrolling layouts: how far each is from every other, how often noise confuses them, what is refused.

Two layouts that can be confused make every later reading of either worthless, so they are refused here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tagid.errors import LayoutConflictError, RegistryError
from tagid.tags.bodies.signature import Signature
from tagid.tags.layouts.capacity import Localisation, confusion_rate, reference
from tagid.tags.layouts.codebook import CENTRE_TOLERANCE_M, CONFUSABLE_M, LayoutDistance, best_pairing
from tagid.tags.layouts.layout import Layout, rotation_matrix

MAX_CONFUSION = 1e-3
"""Rate of wrong names by one neighbour above which a layout is refused: what the reader promises."""
_TRIES = 20


class LayoutStore(Protocol):
    """What enrolment needs of a registry."""

    def snapshot(self) -> tuple[int, list[Layout]]:
        """The version, and all layouts enrolled at it."""
        ...

    def add_all(
        self,
        layouts: Sequence[Layout],
        source: str,
        *,
        replace: bool = True,
        since: int | None = None,
        signatures: Sequence[Signature] = (),
    ) -> int | None:
        """Enrol several, all or none, and return the registry's version; None where it is not `since`."""
        ...


@dataclass(frozen=True)
class Neighbour:
    """An enrolled layout beside a new one.

    Attributes:
        name: of the enrolled one.
        distance: between the two.
        confusion_rate: how often noise and what is not known of their positions makes one look nearer to the
            other, the worse of the two ways; NaN where their numbers of reflectors differ.
        mirrored: whether the new one's mirror image is meant, which reads alike where the direction of the
            turn is not known.
    """

    name: str
    distance: LayoutDistance
    confusion_rate: float
    mirrored: bool = False

    @property
    def confusable(self) -> bool:
        """Whether it is too near."""
        return self.distance.worst_m < CONFUSABLE_M or self.confusion_rate > MAX_CONFUSION

    def turned(self, name: str) -> Neighbour:
        """The same seen from the other one, `name` being the first."""
        turn = self.distance.rotation_deg
        back = turn if self.mirrored else (360 - turn) % 360
        return replace(self, name=name, distance=replace(self.distance, rotation_deg=back))

    @property
    def nearness_m(self) -> float:
        """What neighbours are sorted by: worst distance of the reflectors that both have, m."""
        return min(self.distance.worst_m, self.distance.nested_m)


@dataclass(frozen=True)
class Outlook:
    """What enrolling a layout would mean, before anything is stored.

    Attributes:
        layout: new layout.
        neighbours: every other layout, the nearest of those of its size first.
        place: recording for which the rates are told.
        version: the registry's version that this was worked out for.
    """

    layout: Layout
    neighbours: tuple[Neighbour, ...]
    place: Localisation
    version: int = 0

    @property
    def confusion_rate(self) -> float:
        """Expected rate of wrong names for the layout: the union bound over its neighbours."""
        rates = [n.confusion_rate for n in self.neighbours if np.isfinite(n.confusion_rate)]
        return float(min(sum(rates), 1.0))

    @property
    def confusable(self) -> tuple[str, ...]:
        """Names of the neighbours that are too near."""
        return tuple(sorted(n.name for n in self.neighbours if n.confusable))

    def conflict(self) -> LayoutConflictError | None:
        """The error that refuses the layout, or None where it may be enrolled."""
        near = [n for n in self.neighbours if n.confusable]
        if not near:
            return None
        worst = near[0]
        image = "the mirror image of " if worst.mirrored else ""
        if worst.distance.worst_m < CONFUSABLE_M:
            return LayoutConflictError(
                f"layout {self.layout.name} could be confused with {image}{worst.name}: its reflectors lie "
                f"within {worst.distance.worst_m * 1e3:.1f} mm of it after a turn of "
                f"{round(worst.distance.rotation_deg) % 360} degrees",
                f"Move a reflector until one lies {CONFUSABLE_M * 1e3:.0f} mm away, leave one out, or "
                "insist with --force; nothing was stored.",
            )
        return LayoutConflictError(
            f"layout {self.layout.name} would be taken for {image}{worst.name}, or the other way, in "
            f"{worst.confusion_rate:.2g} of readings ({worst.distance.rms_m * 1e3:.1f} mm apart, positions "
            f"known to {self.layout.sigma_m * 1e3:.1f} mm); {MAX_CONFUSION:g} is allowed",
            "Measure it on more captures, move a reflector, or insist with --force; nothing was stored.",
        )


def outlook(
    layout: Layout,
    others: Sequence[Layout],
    *,
    direction_known: bool = True,
    place: Localisation | None = None,
    version: int = 0,
) -> Outlook:
    """Distance and confusion of a layout with every other.

    Args:
        layout: new layout.
        others: layouts it would stand beside; one of its own name is left out.
        direction_known: whether the direction of the turn is; else mirror images read alike.
        place: recording whose localisation error makes the rates; None takes the reference of the size.
        version: of the registry, to be kept with the answer.

    Raises UsageError where a reflector lies outside what an object of the kind can be.
    """
    layout.check_room()
    place = place or reference(layout.radius_m)
    found = [
        neighbour(layout, other, place.sigma_m, direction_known)
        for other in others
        if other.name != layout.name
    ]
    return Outlook(layout, _by_nearness(found), place, version)


def _by_nearness(found: Sequence[Neighbour]) -> tuple[Neighbour, ...]:
    """Those of the layout's own size first, each the nearest first."""
    return tuple(sorted(found, key=lambda n: (not np.isfinite(n.distance.worst_m), n.nearness_m)))


def neighbour(layout: Layout, other: Layout, sigma_m: float, direction_known: bool = True) -> Neighbour:
    """Distance and confusion of two layouts; of the nearer image where the direction is not known.

    The two differ by a vector d in the 2K coordinates together. A reading is off by sigma a coordinate, and
    the truth by what its enrolment left open, C: one is taken for the other where both together exceed half
    of d along d, with probability Q(|d| / 2 sqrt(sigma^2 + u' C u)), u = d / |d|.
    """
    straight = _neighbour(layout, other, sigma_m, False)
    if direction_known:
        return straight
    image = _neighbour(layout.mirrored(), other, sigma_m, True)
    return image if image.nearness_m < straight.nearness_m - 1e-9 else straight


def _neighbour(layout: Layout, other: Layout, sigma_m: float, mirrored: bool) -> Neighbour:
    small, large = (layout, other) if layout.size <= other.size else (other, layout)
    pair = best_pairing(small.positions, large.positions, CENTRE_TOLERANCE_M)
    turn = float(np.rad2deg(pair.rotation_rad if small is layout else -pair.rotation_rad) % 360)
    if layout.size != other.size:
        return Neighbour(other.name, LayoutDistance(np.inf, np.inf, turn, pair.worst_m), np.nan, mirrored)
    rotation = rotation_matrix(pair.rotation_rad)
    apart = layout.positions @ rotation.T + pair.shift_m - other.positions[pair.partner]
    length = float(np.linalg.norm(apart))
    along = apart / max(length, 1e-12)
    unsure = max(
        _variance_along(layout.covariance, along @ rotation),
        _variance_along(other.covariance, along[np.argsort(pair.partner)]),
    )
    rate = confusion_rate(pair.rms_m, layout.size, float(np.sqrt(sigma_m**2 + unsure)))
    return Neighbour(other.name, LayoutDistance(pair.rms_m, pair.worst_m, turn), rate, mirrored)


def _variance_along(covariance: NDArray[np.float64] | None, along: NDArray[np.float64]) -> float:
    """Variance, m^2, along a unit vector given as (K, 2), of positions with covariances (K, 2, 2)."""
    return 0.0 if covariance is None else float(np.einsum("ki,kij,kj->", along, covariance, along))


@dataclass(frozen=True)
class Enrolment:
    """What enrolling found and did.

    Attributes:
        outlook: the layout as enrolled, beside its neighbours.
        version: the registry's version since.
    """

    outlook: Outlook
    version: int


def enrol(
    store: LayoutStore,
    layout: Layout,
    source: str,
    *,
    force: bool = False,
    direction_known: bool = True,
    signatures: Sequence[Signature] = (),
) -> Enrolment:
    """Add a layout to the store unless it could be confused with another.

    Args:
        store: the registry.
        layout: new layout.
        source: where it comes from, for the history.
        force: enrol it all the same, and over one of the same name.
        direction_known: whether the direction of the turn is.
        signatures: of the same object, stored with it.

    Raises:
        LayoutConflictError: it is too near to an enrolled layout. RegistryError: the name is taken.
    """
    for _ in range(_TRIES):
        version, known = store.snapshot()
        found = outlook(layout, known, direction_known=direction_known, version=version)
        conflict = found.conflict()
        if conflict and not force:
            raise conflict
        done = store.add_all([layout], source, replace=force, since=version, signatures=signatures)
        if done is not None:
            return Enrolment(found, done)
    raise _busy()


def family_outlooks(
    layouts: Sequence[Layout], known: Sequence[Layout], *, direction_known: bool = True, version: int = 0
) -> list[Outlook]:
    """The outlook of several layouts that would be enrolled together, beside each other and those enrolled.

    Layouts of the same name stand for those enrolled. Raises UsageError as `outlook`.
    """
    names = {layout.name for layout in layouts}
    fixed = [layout for layout in known if layout.name not in names]
    found = [
        outlook(one, [*fixed, *layouts[:i]], direction_known=direction_known, version=version)
        for i, one in enumerate(layouts)
    ]
    # What the later see of the earlier, the earlier see of them.
    seen: dict[str, list[Neighbour]] = {layout.name: [] for layout in layouts}
    for one in found:
        for other in one.neighbours:
            if other.name in seen:
                seen[other.name].append(other.turned(one.layout.name))
    return [replace(one, neighbours=_by_nearness([*one.neighbours, *seen[one.layout.name]])) for one in found]


def merge(
    store: LayoutStore,
    layouts: Sequence[Layout],
    source: str,
    *,
    force: bool = False,
    direction_known: bool = True,
    checked: int | None = None,
    signatures: Sequence[Signature] = (),
) -> int:
    """Add several layouts to the store, all or none; those enrolled just so are left as they are.

    Args:
        store: the registry.
        layouts: of different names.
        source: where they come from, for the history.
        force: replace layouts of the same names, and accept such as could be confused.
        direction_known: whether the direction of the turn is.
        checked: version for which `check_merge` was asked already.
        signatures: stored with them.

    Raises:
        LayoutConflictError: a name stands for another layout there, or two layouts could be confused.
    """
    for _ in range(_TRIES):
        version, enrolled = store.snapshot()
        if not force and version != checked:
            found = family_outlooks(layouts, enrolled, direction_known=direction_known)
            check_merge(found, enrolled)
        done = store.add_all(layouts, source, since=version, signatures=signatures)
        if done is not None:
            return done
    raise _busy()


def check_merge(outlooks: Sequence[Outlook], enrolled: Sequence[Layout]) -> None:
    """Raises LayoutConflictError where layouts, seen by `family_outlooks`, cannot be added."""
    known = {layout.name: layout for layout in enrolled}
    for one in outlooks:
        same = known.get(one.layout.name)
        if same is not None and same.to_dict() != one.layout.to_dict():
            raise LayoutConflictError(
                f"a different layout named {same.name} is enrolled already",
                "Rename one of them (a design: --prefix NAME), or import with --force; nothing was stored.",
            )
    for one in reversed(outlooks):
        conflict = one.conflict()
        if one.layout.name not in known and conflict:
            raise conflict


def _busy() -> RegistryError:
    return RegistryError(
        "the registry is changed by other processes all the time", "Try again when they are done."
    )
