"""Which arrangement of alike reflectors on a body made the echo, and how much better than any other.

On a body of revolution, or an enrolled one, every arrangement of 1 to 4 reflectors that the resolution can
tell is tried, not only the enrolled layouts; the answer is the layout and how far it leads before the best
arrangement that is not the layout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.arrangement import AXIS_M, difference_deg, gaps_deg, merged
from tagid.tags.bodies.hypothesis import BodyModel, Candidate, Pose
from tagid.tags.bodies.reflectors_fit import (
    COMMON,
    FACING,
    OPEN,
    Batch,
    Fitter,
    Pattern,
    Priors,
    joined,
)
from tagid.tags.bodies.revolution import RoundBody
from tagid.tags.bodies.ring import Ring
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.layout import Layout


@dataclass(frozen=True)
class BodySettings:
    """Extent of the search and the priors of tags on bodies.

    Attributes:
        priors: see `Priors`.
        body: the body that nobody enrolled.
        most: largest number of reflectors in another arrangement.
        other_deg: arrangements whose angles differ by more are another arrangement.
        other_radius_m: and so are those whose apparent radius differs by more from the layout's limits.
        strong: a body that explains more than this share of the moving echo gives the centre alone.
        rings_m: radii tried about each nominal one under `wide_m`, relative to it, m.
        wide_m: from here on a body is a shell, and only the nominal radius is tried.
        ring_step_m: spacing of the angles on a ring, m of arc.
        noise_nats: lead in noise variances that counts as much as the model's own error.
    """

    priors: Priors = field(default_factory=Priors)
    body: RoundBody = field(default_factory=RoundBody)
    most: int = 4
    other_deg: float = 12.0
    other_radius_m: float = 0.012
    strong: float = 0.94
    rings_m: tuple[float, ...] = (-0.009, 0.005)
    wide_m: float = 0.076
    ring_step_m: float = 5.5e-3
    noise_nats: float = 25.0


@dataclass(frozen=True, eq=False)
class Placed:
    """One arrangement after its fit.

    Attributes:
        batch: one row.
        left: energy left.
        layout: its name; None for an arrangement that no layout has.
        angles: (K,) of the reflectors present, rad.
        radius_m: mean apparent radius, m.
    """

    batch: Batch
    left: float
    layout: str | None

    @property
    def angles(self) -> NDArray[np.float64]:
        """(K,) directions of the reflectors from their centre, rad."""
        return self.batch.angles[0][self.batch.present[0] > 0]

    @property
    def radii(self) -> NDArray[np.float64]:
        """(K,) apparent distances from their centre, m."""
        return self.batch.radii[0][self.batch.present[0] > 0] + self.batch.at[0, 2]

    @property
    def centre(self) -> complex:
        """Of the ring, x + jy, m."""
        return complex(self.batch.centres[0])

    @property
    def positions(self) -> NDArray[np.float64]:
        """(K, 2) apparent places, m."""
        place = self.centre + self.radii * np.exp(1j * self.angles)
        return np.stack([place.real, place.imag], axis=1)


@dataclass(frozen=True, eq=False)
class BodyReading:
    """What the scans say of a tag on one body.

    Attributes:
        body: the model used.
        pose: of the body in the best layout's fit.
        energy: of the moving echo.
        noise: expected energy of the noise after the fit.
        body_left: energy that the body alone leaves.
        layouts: every layout that can lie on this body, best first.
        others: arrangements that are not the best layout's, best first.
        free: the best layout's arrangement with all angles free; None where none of the free ones is near.
        tag: energy that the best layout's reflectors explain.
        unexplained: share of the tag's echo that they leave, noise subtracted.
        lead: what the best other arrangement leaves more, over what the layout leaves, the model's error and
            the noise: the strength of the evidence.
        angle_off_deg, radius_off_m: between the free arrangement and the layout.
        tag_nats: the tag's energy over the variance of the noise.
    """

    body: BodyModel
    pose: Pose
    energy: float
    noise: float
    body_left: float
    layouts: tuple[Placed, ...]
    others: tuple[Placed, ...]
    free: Placed | None
    tag: float
    unexplained: float
    lead: float
    angle_off_deg: float
    radius_off_m: float
    tag_nats: float


@dataclass(frozen=True)
class _Start:
    """An arrangement found on a ring: energy share left, and where."""

    left: float
    centre: complex
    radius_m: float
    pattern: Pattern
    angles: tuple[float, ...]


def read_on_body(
    spectra: Spectra,
    layouts: Sequence[Layout],
    body: BodyModel,
    settings: BodySettings,
    hints: Sequence[complex] = (),
) -> BodyReading | None:
    """The best layout on a body, against every other arrangement; None where no layout can lie on one.

    Args:
        spectra: the scans.
        layouts: the enrolled ones; those with fewer than two reflectors off the axis cannot be read.
        body: the body below the reflectors.
        settings: search and priors.
        hints: further centres to try, x + jy, m.
    """
    rings = _rings(layouts, settings)
    usable = [layout for layout in layouts if len(_off_axis(layout)[0]) >= 2]
    if not usable:
        return None
    poses = body.poses(spectra)
    reader = _Reader(spectra, usable, body, settings, poses)
    return reader.read(rings, hints)


def _off_axis(
    layout: Layout,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Radii (K,), angles (K,) and heights (K,) of the reflectors that lie off the axis."""
    place = layout.positions[:, 0] + 1j * layout.positions[:, 1]
    off = np.abs(place) > AXIS_M
    heights = np.asarray(layout.heights, dtype=np.float64)[off]
    return np.abs(place[off]), np.angle(place[off]), heights


def _rings(layouts: Sequence[Layout], settings: BodySettings) -> list[float]:
    """Radii at which arrangements are searched, m: those of the layouts, merged within 8 mm."""
    nominal: list[float] = []
    for value in sorted(float(r) for layout in layouts for r in _off_axis(layout)[0]):
        if not nominal or value - nominal[-1] > 8e-3:
            nominal.append(value)
    found: list[float] = []
    for value in nominal:
        offsets = settings.rings_m if value < settings.wide_m else (0.0,)
        found += [value + offset for offset in offsets]
    kept: list[float] = []
    for value in sorted(found):
        if not kept or value - kept[-1] > 8e-3:
            kept.append(value)
    return kept


class _Reader:
    """The search on one body."""

    def __init__(
        self,
        spectra: Spectra,
        layouts: Sequence[Layout],
        body: BodyModel,
        settings: BodySettings,
        poses: Sequence[Candidate],
    ) -> None:
        self.spectra = spectra
        self.layouts = layouts
        self.body = body
        self.settings = settings
        self.poses = poses
        self.coarse = spectra.thinned(2)
        freedom = spectra.views - 1 - (1 + FACING.terms)
        self.noise = spectra.noise_energy * max(freedom, 1) / (spectra.views - 1)
        values = spectra.data.size
        floor = max(poses[0].left, 1e-30)
        self.variance = max(spectra.noise, 1e-12 * floor) + settings.priors.model_error * floor / values
        at = poses[0].pose
        own = np.array([*at.centre_m, at.turn_rad]) if body.turns else None
        self.fitter = Fitter(spectra, body, settings.priors, self.variance, own)

    def read(self, rings: Sequence[float], hints: Sequence[complex]) -> BodyReading:
        """Search, fit and compare."""
        settings = self.settings
        searched = [(r, found) for r in rings for found in self._searched(r, self._centres(hints))]
        starts = sorted((s for _, (_, some) in searched for s in some), key=lambda s: s.left)
        rows = self._free_rows(starts) + self._rigid_rows(starts)
        rows += [row for layout in self.layouts for row in self._layout_rows(layout, searched)]
        names = [name for name, _ in rows]
        batch = joined([row for _, row in rows])
        fitted, left = self.fitter.fitted(batch)
        placed = [
            Placed(fitted.some(np.array([i])), float(left[i]), names[i] or None) for i in range(len(names))
        ]
        free = [p for p, name in zip(placed, names, strict=True) if name == ""]
        rigid = [p for p, name in zip(placed, names, strict=True) if name is None]
        own: dict[str, Placed] = {}
        for p in placed:
            if p.layout and (p.layout not in own or p.left < own[p.layout].left):
                own[p.layout] = p
        ranked = sorted(own.values(), key=lambda p: p.left)
        return self._compared(ranked, free, rigid, settings)

    def _centres(self, hints: Sequence[complex]) -> list[complex]:
        first = self.poses[0]
        if 1 - first.left / max(self.spectra.energy, 1e-30) > self.settings.strong or self.body.turns:
            return [first.pose.centre]
        found: list[complex] = []
        for centre in [*(p.pose.centre for p in self.poses), *hints, 0j]:
            if all(abs(centre - other) > 2e-3 for other in found):
                found.append(centre)
        return found

    def _body_at(self, centre: complex) -> Pose:
        pose = self.poses[0].pose
        return pose if self.body.turns else Pose((centre.real, centre.imag))

    def _searched(self, radius: float, centres: Sequence[complex]) -> list[tuple[Ring, list[_Start]]]:
        """Rings of one radius about every centre, and the best sets of each size on them."""
        count = int(np.clip(round(2 * np.pi * radius / self.settings.ring_step_m), 48, 90))
        found = []
        for centre in centres:
            pose = self._body_at(centre)
            echo = self.body.echo(self.coarse, np.array([pose.centre]), np.array([pose.turn_rad]))[0]
            for pattern in (FACING, OPEN):
                ring = Ring.of(self.coarse, echo, centre, radius, pattern, count)
                starts = []
                for sets, values in ring.best(self.settings.most, 24).values():
                    for indices, value in zip(sets, values, strict=True):
                        angles = tuple(float(a) for a in ring.angles[indices])
                        starts.append(_Start(ring.energy - float(value), centre, radius, pattern, angles))
                found.append((ring, starts))
        return found

    def _row(
        self,
        start: _Start,
        radii: NDArray[np.float64],
        heights: NDArray[np.float64],
        limits: tuple[float, float, float],
        free: bool,
    ) -> Batch:
        """One row at a start; limits: least, largest and expected radius offset, m."""
        k = len(start.angles)
        pose = self._body_at(start.centre)
        at = np.zeros((1, COMMON + k))
        at[0, :2] = start.centre.real, start.centre.imag
        at[0, 2] = limits[2]
        at[0, 3:6] = *pose.centre_m, pose.turn_rad
        at[0, COMMON:] = start.angles
        moves = []
        for axis in range(2):
            move = np.zeros(COMMON + k)
            move[axis] = 1
            if not self.body.turns:
                move[3 + axis] = 1
            moves.append(move)
        moves.append(np.eye(COMMON + k)[2])
        if self.body.turns:
            moves += list(np.eye(COMMON + k)[3:6])
        if free:
            moves += list(np.eye(COMMON + k)[COMMON:])
        else:
            moves.append(np.concatenate([np.zeros(COMMON), np.ones(k)]))
        one = np.ones(1)
        return Batch(
            at,
            radii[None].copy(),
            heights[None].copy(),
            np.ones((1, k)),
            one * start.pattern.tilt,
            one * start.pattern.terms,
            np.array(moves)[None],
            one * limits[0],
            one * limits[1],
            one * 0.0,
        )

    def _ring_row(self, start: _Start, free: bool) -> Batch:
        k = len(start.angles)
        low, high = (0.02, 0.075) if start.radius_m < self.settings.wide_m else (0.078, 0.2)
        limits = (low - start.radius_m, high - start.radius_m, 0.0)
        return self._row(start, np.full(k, start.radius_m), np.zeros(k), limits, free)

    def _free_rows(self, starts: Sequence[_Start]) -> list[tuple[str | None, Batch]]:
        """The best of each number, ring size and pattern, with free angles; marked by an empty name."""
        seen: dict[tuple[int, bool, Pattern], int] = {}
        rows: list[tuple[str | None, Batch]] = []
        for start in starts:
            key = (len(start.angles), start.radius_m < self.settings.wide_m, start.pattern)
            seen[key] = seen.get(key, 0) + 1
            if seen[key] == 1 and len(rows) < 10:
                rows.append(("", self._ring_row(start, free=True)))
        return rows

    def _rigid_rows(self, starts: Sequence[_Start]) -> list[tuple[str | None, Batch]]:
        """The best of each bin of arrangements, turning and growing as a whole."""
        seen: set[tuple[int, ...]] = set()
        rows: list[tuple[str | None, Batch]] = []
        for start in starts:
            if len(rows) >= 12:
                break
            key = _bin(start.angles)
            if key not in seen:
                seen.add(key)
                rows.append((None, self._ring_row(start, free=False)))
        return rows

    def _layout_rows(
        self, layout: Layout, searched: Sequence[tuple[float, tuple[Ring, list[_Start]]]]
    ) -> list[tuple[str | None, Batch]]:
        """The best two starts of a layout for each pattern."""
        radii, angles, heights = _off_axis(layout)
        priors = self.settings.priors
        starts: list[_Start] = []
        for radius, (ring, some) in searched:
            offset = radius - float(radii.mean())
            if not priors.radius_low_m <= offset <= priors.radius_high_m:
                continue
            count = len(ring.angles)
            step = 2 * np.pi / count
            index = np.rint(angles[None] / step + np.arange(count)[:, None]).astype(np.intp) % count
            value = ring.explained(index)
            centre = some[0].centre
            for i in _peaks(value, 2):
                turned = tuple(float(a) for a in angles + i * step)
                starts.append(
                    _Start(
                        ring.energy - float(value[i]),
                        centre,
                        float(radii.mean()) + offset,
                        ring.pattern,
                        turned,
                    )
                )
        starts.sort(key=lambda s: s.left)
        rows: list[tuple[str | None, Batch]] = []
        for pattern in (FACING, OPEN):
            for start in [s for s in starts if s.pattern == pattern][:2]:
                offset = start.radius_m - float(radii.mean())
                limits = (priors.radius_low_m, priors.radius_high_m, offset)
                rows.append((layout.name, self._row(start, radii, heights, limits, free=False)))
        return rows

    def _compared(
        self,
        ranked: list[Placed],
        free: list[Placed],
        rigid: list[Placed],
        settings: BodySettings,
    ) -> BodyReading:
        best = ranked[0]
        layout = next(one for one in self.layouts if one.name == best.layout)
        radii, angles, _ = _off_axis(layout)
        wanted = gaps_deg(angles)
        low = float(radii.mean()) + settings.priors.radius_low_m - settings.other_radius_m / 2
        high = float(radii.mean()) + settings.priors.radius_high_m + settings.other_radius_m / 2

        def other(p: Placed) -> bool:
            gaps = gaps_deg(p.angles)
            away = min(difference_deg(gaps, wanted), difference_deg(merged(gaps), wanted))
            return away > settings.other_deg or not low <= float(p.radii.mean()) <= high

        others = sorted([p for p in free + rigid if other(p)] + ranked[1:], key=lambda p: p.left)
        near = sorted((p for p in free if not other(p)), key=lambda p: p.left)
        tag = max(self.poses[0].left - best.left, 1e-30)
        above = max(best.left - self.noise, 0.0)
        next_left = others[0].left if others else self.poses[0].left
        error = above + settings.priors.model_error * tag + settings.noise_nats * self.spectra.noise
        own = near[0] if near else None
        return BodyReading(
            body=self.body,
            pose=Pose((float(best.batch.at[0, 3]), float(best.batch.at[0, 4])), float(best.batch.at[0, 5])),
            energy=self.spectra.energy,
            noise=self.noise,
            body_left=self.poses[0].left,
            layouts=tuple(ranked),
            others=tuple(others),
            free=own,
            tag=tag,
            unexplained=above / tag,
            lead=(next_left - best.left) / error,
            angle_off_deg=difference_deg(gaps_deg(own.angles), wanted) if own else 180.0,
            radius_off_m=abs(float(own.radii.mean()) - float(best.radii.mean())) if own else 1.0,
            tag_nats=tag / max(self.spectra.noise, 1e-30),
        )


def _bin(angles: Sequence[float]) -> tuple[int, ...]:
    """Key of an arrangement: gaps in steps of 15 degrees, in the rotation that sorts first."""
    gaps = np.round(gaps_deg(angles) / 15).astype(int)
    return min(tuple(int(g) for g in np.roll(gaps, k)) for k in range(len(gaps)))


def _peaks(values: NDArray[np.float64], most: int) -> list[int]:
    """Indices of the largest values that are local maxima on a circle."""
    peak = (values >= np.roll(values, 1)) & (values >= np.roll(values, -1))
    order = [int(i) for i in np.argsort(-values) if peak[i]]
    return order[:most]
