"""Enrolling layouts: distance to every other layout, rate of confusion due to noise, and reasons to refuse.

If two enrolled layouts can be confused, no later reading of either can be relied on. Such layouts are refused
here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tagid.errors import LayoutConflictError, RegistryError
from tagid.tags.bodies.signature import Signature
from tagid.tags.layouts.capacity import Localisation, confusion_rate, reference
from tagid.tags.layouts.codebook import (
    CENTRE_TOLERANCE_M,
    CONFUSABLE_M,
    LayoutDistance,
    best_pairing,
    in_space,
)
from tagid.tags.layouts.layout import Layout, rotation_matrix

MAX_CONFUSION = 1e-3
"""Rate of wrong names caused by one neighbour above which a layout is refused: the reader's false-accept
rate."""
_TRIES = 20
_T = TypeVar("_T")


class LayoutStore(Protocol):
    """The part of a registry that enrolment needs."""

    def snapshot(self) -> tuple[int, list[Layout]]:
        """The registry's version and the layouts enrolled at that version."""
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
        """Enrol several, all or none; return the new version, or None if the version is no longer `since`."""
        ...


@dataclass(frozen=True)
class Neighbour:
    """An enrolled layout compared with a new one.

    Attributes:
        name: name of the enrolled layout.
        distance: distance between the two.
        confusion_rate: probability that noise and the uncertainty of the positions make one look nearer to
            the other, the larger of the two directions; NaN if their numbers of reflectors differ.
        mirrored: whether the comparison is with the new layout's mirror image, which gives the same reading
            if the direction of rotation is unknown.
    """

    name: str
    distance: LayoutDistance
    confusion_rate: float
    mirrored: bool = False

    @property
    def confusable(self) -> bool:
        """Whether the two are too close to be told apart."""
        return self.distance.worst_m < CONFUSABLE_M or self.confusion_rate > MAX_CONFUSION

    def turned(self, name: str) -> Neighbour:
        """The same comparison from the other layout's side; `name` is the first layout's."""
        turn = self.distance.rotation_deg
        back = turn if self.mirrored else (360 - turn) % 360
        return replace(self, name=name, distance=replace(self.distance, rotation_deg=back))

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
        place: recording conditions for which the rates hold.
        version: registry version that the comparison was made against.
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
        """Names of the neighbours that are too close."""
        return tuple(sorted(n.name for n in self.neighbours if n.confusable))

    def conflict(self) -> LayoutConflictError | None:
        """The error that refuses the layout, or None if it may be enrolled."""
        near = [n for n in self.neighbours if n.confusable]
        if not near:
            return None
        worst = near[0]
        image = "the mirror image of " if worst.mirrored else ""
        if worst.distance.worst_m < CONFUSABLE_M:
            return LayoutConflictError(
                f"layout {self.layout.name} could be confused with {image}{worst.name}: after a rotation of "
                f"{round(worst.distance.rotation_deg) % 360} degrees their reflectors are within "
                f"{worst.distance.worst_m * 1e3:.1f} mm of each other",
                f"Move a reflector so that at least one is {CONFUSABLE_M * 1e3:.0f} mm away, remove one, or "
                "override with `force`; nothing was stored.",
            )
        return LayoutConflictError(
            f"layout {self.layout.name} would be confused with {image}{worst.name} in "
            f"{worst.confusion_rate:.2g} of readings ({worst.distance.rms_m * 1e3:.1f} mm apart, positions "
            f"known to {self.layout.sigma_m * 1e3:.1f} mm); the limit is {MAX_CONFUSION:g}",
            "Measure it on more captures, move a reflector, or override with `force`; nothing was stored.",
        )


def outlook(
    layout: Layout,
    others: Sequence[Layout],
    *,
    direction_known: bool = True,
    height_weight: float = 0.0,
    place: Localisation | None = None,
    version: int = 0,
) -> Outlook:
    """Distance and rate of confusion between a layout and every other.

    Args:
        layout: new layout.
        others: layouts to compare with; one of the same name is ignored.
        direction_known: whether the direction of rotation is known; if not, mirror images are equivalent.
        height_weight: what heights of reflectors count, see `codebook.height_weight`; 0: nothing.
        place: recording conditions whose localisation error sets the rates; None takes the reference for the
            layout's radius.
        version: registry version to store in the result.

    Raises UsageError if a reflector lies outside the largest object of the layout's kind.
    """
    layout.check_room()
    place = place or reference(layout.radius_m)
    found = [
        neighbour(layout, other, place.sigma_m, direction_known, height_weight)
        for other in others
        if other.name != layout.name
    ]
    return Outlook(layout, _by_nearness(found), place, version)


def _by_nearness(found: Sequence[Neighbour]) -> tuple[Neighbour, ...]:
    """Neighbours with as many reflectors as the layout first, each group nearest first."""
    return tuple(sorted(found, key=lambda n: (not np.isfinite(n.distance.worst_m), n.nearness_m)))


def neighbour(
    layout: Layout, other: Layout, sigma_m: float, direction_known: bool = True, height_weight: float = 0.0
) -> Neighbour:
    """Distance and rate of confusion of two layouts; of the nearer mirror image if the direction is unknown.

    The two differ by a vector d in their 2K coordinates. A reading has an error of sigma per coordinate and
    the enrolled positions have covariance C. One is mistaken for the other if the total error along d exceeds
    half of |d|, with probability Q(|d| / 2 sqrt(sigma^2 + u' C u)), u = d / |d|.
    """
    straight = _neighbour(layout, other, sigma_m, False, height_weight)
    if direction_known:
        return straight
    image = _neighbour(layout.mirrored(), other, sigma_m, True, height_weight)
    return image if image.nearness_m < straight.nearness_m - 1e-9 else straight


def _neighbour(
    layout: Layout, other: Layout, sigma_m: float, mirrored: bool, height_weight: float
) -> Neighbour:
    small, large = (layout, other) if layout.size <= other.size else (other, layout)
    pair = best_pairing(in_space(small, height_weight), in_space(large, height_weight), CENTRE_TOLERANCE_M)
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
    """Result of enrolling a layout.

    Attributes:
        outlook: the layout as enrolled, compared with its neighbours.
        version: registry version after the change.
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
    height_weight: float = 0.0,
    signatures: Sequence[Signature] = (),
) -> Enrolment:
    """Add a layout to the store unless it could be confused with another.

    Args:
        store: the registry.
        layout: new layout.
        source: origin of the layout, for the history.
        force: enrol it despite a conflict, and replace one of the same name.
        direction_known: whether the direction of rotation is known.
        height_weight: as of `outlook`.
        signatures: signatures of the same object, stored with it.

    Raises:
        LayoutConflictError: it is too close to an enrolled layout.
        RegistryError: the name is taken.
    """

    def compared() -> Enrolment | None:
        version, known = store.snapshot()
        found = outlook(
            layout, known, direction_known=direction_known, height_weight=height_weight, version=version
        )
        conflict = found.conflict()
        if conflict and not force:
            raise conflict
        done = store.add_all([layout], source, replace=force, since=version, signatures=signatures)
        return None if done is None else Enrolment(found, done)

    return undisturbed(compared)


def family_outlooks(
    layouts: Sequence[Layout],
    known: Sequence[Layout],
    *,
    direction_known: bool = True,
    height_weight: float = 0.0,
    version: int = 0,
) -> list[Outlook]:
    """The outlook of several layouts to be enrolled together, compared with each other and those enrolled.

    A new layout replaces an enrolled one of the same name. Raises UsageError as `outlook` does.
    """
    names = {layout.name for layout in layouts}
    fixed = [layout for layout in known if layout.name not in names]
    found = [
        outlook(
            one,
            [*fixed, *layouts[:i]],
            direction_known=direction_known,
            height_weight=height_weight,
            version=version,
        )
        for i, one in enumerate(layouts)
    ]
    # Each layout was compared with the earlier ones only; mirror those comparisons.
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
    height_weight: float = 0.0,
    checked: int | None = None,
    signatures: Sequence[Signature] = (),
) -> int:
    """Add several layouts to the store, all or none; identical entries are left unchanged.

    Args:
        store: the registry.
        layouts: with unique names.
        source: origin of the layouts, for the history.
        force: replace layouts of the same names, and accept layouts that could be confused.
        direction_known: whether the direction of rotation is known.
        height_weight: as of `outlook`.
        checked: registry version for which `check_merge` has already passed.
        signatures: stored with the layouts.

    Raises:
        LayoutConflictError: a name is taken by a different layout, or two layouts could be confused.
    """

    def compared() -> int | None:
        version, enrolled = store.snapshot()
        if not force and version != checked:
            found = family_outlooks(
                layouts, enrolled, direction_known=direction_known, height_weight=height_weight
            )
            check_merge(found, enrolled)
        return store.add_all(layouts, source, since=version, signatures=signatures)

    return undisturbed(compared)


def undisturbed(compared: Callable[[], _T | None]) -> _T:
    """Repeat a comparison with the registry and the change that depends on it until nothing comes between.

    Args:
        compared: reads, compares, and stores with `since`; None if the registry has changed meanwhile.

    Raises RegistryError if other processes keep changing the registry.
    """
    for _ in range(_TRIES):
        done = compared()
        if done is not None:
            return done
    raise RegistryError("other processes keep changing the registry", "Try again when they have finished.")


def check_merge(outlooks: Sequence[Outlook], enrolled: Sequence[Layout]) -> None:
    """Raises LayoutConflictError if the layouts compared by `family_outlooks` cannot be added."""
    known = {layout.name: layout for layout in enrolled}
    for one in outlooks:
        same = known.get(one.layout.name)
        if same is not None and same.to_dict() != one.layout.to_dict():
            raise LayoutConflictError(
                f"a different layout named {same.name} is already enrolled",
                "Rename one of them (a design: `prefix=NAME`), or import with `force`; nothing was stored.",
            )
    for one in reversed(outlooks):
        conflict = one.conflict()
        if one.layout.name not in known and conflict:
            raise conflict
