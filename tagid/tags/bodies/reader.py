"""Which arrangement of alike reflectors on a body made the echo, and how much better than any other.

On a body of revolution, or an enrolled one, every arrangement of 1 to 4 reflectors that the resolution can
tell is tried, not only the enrolled layouts; the answer is the layout and how far it leads before the best
arrangement that is not the layout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.arrangement import (
    apart_deg,
    can_stand,
    gaps_deg,
    kind_of,
    off_axis,
    resolution_deg,
    turn_to,
    turned_on,
)
from tagid.tags.bodies.body_reading import BodyReading, BodySettings, Placed
from tagid.tags.bodies.flat_face import least_on_faces
from tagid.tags.bodies.hypothesis import BodyModel, Candidate, Pose
from tagid.tags.bodies.layout_search import LayoutSearch, turned_by
from tagid.tags.bodies.middle import with_middles
from tagid.tags.bodies.neighbours import led_before_wall
from tagid.tags.bodies.reflectors_fit import (
    COMMON,
    FACING,
    FEWEST_TERMS,
    OPEN,
    RICH,
    THROUGH,
    Batch,
    Columns,
    Fitter,
    Pattern,
    alone,
    behind,
    joined,
    solve,
)
from tagid.tags.bodies.ring import PairSearch, Ring, peaks
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.bodies.starts import FREE, OTHER, Ringed, Row, Start, halved
from tagid.tags.bodies.symmetric import MOST, symmetric_left
from tagid.tags.layouts.layout import Layout


@dataclass(frozen=True, eq=False)
class _Amplitudes:
    """Fitted responses (F,) of the body and of a reflector seen from outside, the body's energy, `behind`."""

    body: NDArray[np.complex128]
    reflectors: NDArray[np.complex128]
    body_energy: float
    back: float


class BodyReader:
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
        self.noise = self._noise_after(FACING.terms)
        values = spectra.data.size
        floor = max(poses[0].left, 1e-30)
        self.variance = max(spectra.noise, 1e-12 * floor) + settings.priors.model_error * floor / values
        at = poses[0].pose
        own = np.array([*at.centre_m, at.turn_rad]) if body.turns else None
        self.fitter = Fitter(spectra, body, settings.priors, self.variance, own)
        self.coarse_fitter = Fitter(self.coarse, body, settings.priors, self.variance, own)
        self._symmetric_left = cache(partial(symmetric_left, spectra))

    def read(self, rings: Sequence[float], hints: Sequence[complex]) -> BodyReading:
        """Search, fit and compare."""
        searched = [
            found for centre in self._centres(rings, hints) for found in self._searched(rings, centre)
        ]
        starts = sorted((s for _, some in searched for s in some), key=lambda s: s.left)
        rows = self._free_rows(starts) + self._rigid_rows(starts)
        rows += [row for layout in self.layouts for row in self._layout_rows(layout, searched)]
        batch, left = self.coarse_fitter.fitted(joined([row.batch for row in rows]), 3)
        rows, batch = self._kept(rows, batch, left)
        simple = replace(batch, terms=np.minimum(batch.terms, FEWEST_TERMS))
        if self._explained(float(left.min())) < self.settings.hopeless:
            rows, batch = rows + rows, joined([batch, simple])
            left = self.fitter.left(batch)
        else:
            rows, batch, left = self._finished(rows, joined([batch, simple]), batch)
            if self._is_passed(float(left.min())):
                more, wide, rest = self._through(rings)
                rows, batch, left = [*rows, *more], joined([batch, wide]), np.append(left, rest)
        # A pattern that a tag does not need would let other arrangements imitate it.
        per_term = self.spectra.amplitude_cost
        charged = left + per_term * (batch.terms - 1)
        free: list[Placed] = []
        others: list[Placed] = []
        own: dict[str, Placed] = {}
        for i, row in enumerate(rows):
            name = None if row.role in (FREE, OTHER) else row.role
            place = Placed(batch.some(np.array([i])), float(left[i]), float(charged[i]), name)
            if row.role == FREE:
                free.append(place)
            elif row.role == OTHER:
                others.append(place)
            elif row.role not in own or place.charged < own[row.role].charged:
                own[row.role] = place
        ranked = sorted(own.values(), key=lambda p: p.charged)
        ranked[0] = self._polished(ranked[0], free, per_term)
        free += self._freed(ranked[:1], per_term)
        ranked.sort(key=lambda p: p.charged)
        reading = self._compared(ranked, free, others, per_term)
        if reading.lead <= 0:
            return reading
        free += self._freed([*self._loose([*free, *others]), *self._halved(ranked[0])], per_term)
        enough = self.spectra.views >= self.settings.through_views
        reading = self._compared(ranked, free, others, per_term, walled=self.body.turns and enough)
        return self._on_faces(reading) if self.body.turns and reading.lead > 0 else reading

    def _on_faces(self, reading: BodyReading) -> BodyReading:
        """A reading on an enrolled body with the lead that is left against neighbours on flat faces."""
        if reading.nominal_m >= self.settings.wide_m:
            return reading
        best, spectra = reading.layouts[0], self.spectra
        charged = least_on_faces(self.fitter, best) + spectra.amplitude_cost * (FACING.terms - 1)
        charged += spectra.angle_cost
        held = (charged - best.charged) / reading.error
        return replace(reading, lead=min(reading.lead, held + self.settings.face_lead))

    def _loose(self, others: Sequence[Placed]) -> list[Placed]:
        """Arrangements of three reflectors or more to be fitted with free angles: the best, of unlike gaps.

        On the ring's angles, a few degrees apart, the best of many arrangements is often not the nearest one.
        """
        found: list[Placed] = []
        for few in (True, False):
            seen: set[tuple[int, ...]] = set()
            ranked = sorted(others, key=lambda p: p.charged)
            for p in ranked:
                key = kind_of([float(a) for a in p.angles])
                fits = len(p.angles) >= 3 and (p.batch.terms[0] <= FACING.terms) == few
                if fits and key not in seen and len(seen) < self.settings.loose:
                    seen.add(key)
                    found.append(p)
        return found

    def _halved(self, best: Placed) -> list[Placed]:
        """Two neighbours in place of one or both reflectors of a layout, before their fit.

        Patterns of five terms hold them and the layout alike: there a wall of known waves must tell.
        """
        free = int(best.batch.terms[0]) > FACING.terms
        if free or len(best.angles) != 2 or best.radii.mean() >= self.settings.wide_m:
            return []
        pattern = Pattern(int(best.batch.tilt[0]), int(best.batch.terms[0]))
        found = []
        for start in halved(best.centre, float(best.radii.mean()), best.angles):
            row = self._ring_row(start, pattern, free=True)
            row.at[0, 3:COMMON] = best.batch.at[0, 3:COMMON]
            found.append(Placed(row, np.inf, np.inf, None))
        return found

    def _freed(self, several: Sequence[Placed], per_term: float) -> list[Placed]:
        """Arrangements with all angles of their reflectors free, from where they lie."""
        rows = []
        for one in several:
            count = int(one.batch.present[0].sum())
            rows.append(replace(one.batch, moves=self._moves(one.batch.radii.shape[1], count)[None]))
        if not rows:
            return []
        batch, left = self.fitter.fitted(joined(rows), 5)
        charged = left + per_term * (batch.terms - 1)
        return [
            Placed(batch.some(np.array([i])), float(left[i]), float(charged[i]), None)
            for i in range(len(rows))
        ]

    def _moves(self, width: int, count: int) -> NDArray[np.float64]:
        """(P, 6 + width) radius, centre, the body's pose where it has its own, and each of `count` angles."""
        unit = np.eye(COMMON + width)
        # A body of revolution and its reflectors have one centre; an enrolled body has its own.
        pose = unit[[0, 1, 3, 4, 5]] if self.body.turns else unit[[0, 1]] + unit[[3, 4]]
        return np.concatenate([unit[2:3], pose, unit[COMMON : COMMON + count]])

    def _polished(self, best: Placed, free: Sequence[Placed], per_term: float) -> Placed:
        """The best layout, fitted again from where as many reflectors with free angles came to lie."""
        count = int(best.batch.present[0].sum())
        near = [p for p in free if len(p.angles) == count and p.left < best.left]
        if not near:
            return best
        target = min(near, key=lambda p: p.left)
        own = np.sort(best.angles % (2 * np.pi))
        order = np.argsort(best.angles % (2 * np.pi))
        rows = []
        for turn in turn_to(target.angles, own):
            at = best.batch.at.copy()
            at[0, :2], at[0, 3:COMMON] = target.batch.at[0, :2], target.batch.at[0, 3:COMMON]
            offset = float(target.radii.mean()) - float(best.batch.radii[0, :count].mean())
            at[0, 2] = float(np.clip(offset, best.batch.low[0], best.batch.high[0]))
            at[0, COMMON + order] = own + turn
            rows.append(best.batch.moved(at))
        batch, left = self.fitter.fitted(joined(rows), 6)
        i = int(np.argmin(left))
        if left[i] >= best.left:
            return best
        charged = float(left[i] + per_term * (best.batch.terms[0] - 1))
        return Placed(batch.some(np.array([i])), float(left[i]), charged, best.layout)

    def _noise_after(self, terms: int) -> float:
        """Energy that noise leaves after the fit of a body and of a pattern of so many terms."""
        freedom = self.spectra.views - 1 - (1 + terms)
        return self.spectra.noise_energy * max(freedom, 1) / (self.spectra.views - 1)

    def _finished(
        self, rows: Sequence[Row], few: Batch, wide: Batch
    ) -> tuple[list[Row], Batch, NDArray[np.float64]]:
        """Arrangements fitted to the end: with few terms, and with many where there are views for them."""
        batch, left = self.fitter.fitted(few, 4)
        if self.spectra.views < self.settings.through_views or self.body.turns:
            return [*rows, *rows], batch, left
        at = batch.at[: len(rows)].copy()
        mean = (wide.radii * wide.present).sum(axis=1) / wide.present.sum(axis=1)
        small = np.flatnonzero(mean + at[:, 2] < self.settings.wide_m)
        if len(small) == 0:
            return [*rows, *rows], batch, left
        # More terms hold more of the bounces, which leaves the radius nearer to the wall's than few terms do.
        inner = np.clip(self.settings.through_m - mean, wide.low, wide.high)
        at[:, 2] = np.minimum(at[:, 2], inner)
        tilt, terms = 0 * wide.tilt + THROUGH.tilt, 0 * wide.terms + THROUGH.terms
        begun = replace(wide, at=at, tilt=tilt, terms=terms).some(small)
        through, more = self.fitter.fitted(begun, 6)
        return [*rows, *rows, *(rows[int(i)] for i in small)], joined([batch, through]), np.append(left, more)

    def _through(self, rings: Sequence[float]) -> tuple[list[Row], Batch, NDArray[np.float64]]:
        """Arrangements on an enrolled body that the wave passes through, with many terms from the start.

        Five terms hold arrangements that few terms tell from the layout: this is for echoes of which few
        terms explain no arrangement.
        """
        centre = self.poses[0].pose.centre
        wide_m, inner = self.settings.wide_m, self.settings.through_m
        radii = sorted({radius if radius >= wide_m else inner for radius in rings})
        searched = [self._on_ring(self.coarse, r, centre, self.settings.most, 16, THROUGH) for r in radii]
        starts = sorted((s for _, some in searched for s in some), key=lambda s: s.left)
        rows = self._free_rows(starts, (THROUGH,)) + self._rigid_rows(starts, (THROUGH,))
        pose = self._body_at(centre)
        echo = self.body.echo(self.coarse, np.array([pose.centre]), np.array([pose.turn_rad]))
        search = LayoutSearch(self.coarse, echo, centre)
        for layout in self.layouts:
            large = float(off_axis(layout)[0].mean()) >= wide_m
            offsets = self.settings.rings_m if large else (-0.018, -0.009, 0.0)
            values = np.stack([search.explained(layout, o, THROUGH)[:, 0] for o in offsets])
            for i in peaks(values.max(axis=0), 2):
                offset = offsets[int(values[:, i].argmax())]
                batch = self.batch(layout, centre, offset, turned_by(layout, i), THROUGH)
                rows.append(Row(layout.name, (layout.name,), batch))
        batch, left = self.coarse_fitter.fitted(joined([row.batch for row in rows]), 3)
        rows, batch = self._kept(rows, batch, left)
        batch, left = self.fitter.fitted(batch, 6)
        return rows, batch, left

    def _is_passed(self, left: float) -> bool:
        """Whether the wave passes through an enrolled body: few terms leave too much of the tag's echo."""
        few = self.spectra.views < self.settings.through_views
        tag = max(self.poses[0].left - left, 1e-30)
        return self.body.turns and not few and left - self.noise > self.settings.through_left * tag

    def _explained(self, left: float) -> float:
        """Share of what the body leaves of the coarse spectra, above noise, that an arrangement explains."""
        body_left = alone(self.coarse, self.body, self.poses[0].pose).left
        noise = self.noise * len(self.coarse.wavenumbers) / len(self.spectra.wavenumbers)
        return (body_left - max(left, noise)) / max(body_left - noise, 1e-30)

    def _kept(self, rows: Sequence[Row], batch: Batch, left: NDArray[np.float64]) -> tuple[list[Row], Batch]:
        """The best row of each key, and of each role those that may still matter."""
        room = {FREE: 5, OTHER: 8}
        used: dict[str, int] = {}
        seen: set[tuple[object, ...]] = set()
        chosen: list[int] = []
        for i in np.argsort(left):
            row = rows[i]
            if row.key in seen or used.get(row.role, 0) >= room.get(row.role, 1):
                continue
            seen.add(row.key)
            used[row.role] = used.get(row.role, 0) + 1
            chosen.append(int(i))
        # Layouts far behind the best one cannot win, nor come second within any margin that matters.
        layouts = [i for i in chosen if rows[i].role not in room]
        hopeless = set(layouts[self.settings.finished :])
        chosen = [i for i in chosen if i not in hopeless]
        return [rows[i] for i in chosen], batch.some(np.array(chosen))

    def _centres(self, rings: Sequence[float], hints: Sequence[complex]) -> list[complex]:
        """Where the body's centre may be, from its own echo where that is strong, else with reflectors."""
        first = self.poses[0]
        if 1 - first.left / max(self.spectra.energy, 1e-30) > self.settings.strong or self.body.turns:
            return [first.pose.centre]
        reach = self.settings.centre_reach_m
        line = np.arange(-2, 3) * reach / 2
        grid = [complex(x + (j % 2) * reach / 4, y * 0.87) for j, y in enumerate(line) for x in line]
        grid = [z for z in grid if abs(z) <= 1.05 * reach]
        grid += [p.pose.centre for p in self.poses] + list(hints)
        thin = self.spectra.thinned(4)
        small = [r for r in rings if r < self.settings.wide_m]
        large = [r for r in rings if r >= self.settings.wide_m]
        middle = [float(np.mean(some)) for some in (small, large) if some]
        centres = np.array(grid, dtype=np.complex128)
        echoes = self.body.echo(thin, centres, np.zeros(len(centres)))
        starts: list[Start] = []
        for radius in middle:
            count = 36 if radius < self.settings.wide_m else 60
            left, angles = PairSearch(thin, radius, count).left(centres, echoes)
            starts += [
                Start(float(value), centre, radius, (float(pair[0]), float(pair[1])))
                for value, centre, pair in zip(left, grid, angles, strict=True)
            ]
        starts.sort(key=lambda s: s.left)
        rows = [self._ring_row(s, OPEN, free=True) for s in starts[:8]]
        batch, left = self.coarse_fitter.fitted(joined(rows), 4)
        found: list[complex] = []
        for i in np.argsort(left):
            centre = complex(batch.centres[i])
            if all(abs(centre - other) > 2e-3 for other in found):
                found.append(centre)
        return found[: self.settings.centres]

    def _body_at(self, centre: complex) -> Pose:
        pose = self.poses[0].pose
        return pose if self.body.turns else Pose((centre.real, centre.imag))

    def _searched(self, rings: Sequence[float], centre: complex) -> list[tuple[Ring, list[Start]]]:
        """Every ring about a centre, and the best sets of each size on it."""
        return [self._on_ring(self.coarse, radius, centre, self.settings.most, 16) for radius in rings]

    def _on_ring(
        self,
        spectra: Spectra,
        radius: float,
        centre: complex,
        most: int,
        keep: int,
        pattern: Pattern = OPEN,
    ) -> tuple[Ring, list[Start]]:
        """The best sets of each size on one ring; open patterns contain the facing ones' first term."""
        count = int(np.clip(round(2 * np.pi * radius / self.settings.ring_step_m), 48, 90))
        pose = self._body_at(centre)
        echo = self.body.echo(spectra, np.array([pose.centre]), np.array([pose.turn_rad]))[0]
        ring = Ring.of(spectra, echo, centre, radius, pattern, count)
        starts = []
        for sets, values in ring.best(most, keep).values():
            for indices, value in zip(sets, values, strict=True):
                angles = tuple(float(a) for a in ring.angles[indices])
                starts.append(Start(ring.energy - float(value), centre, radius, angles))
        return ring, starts

    def _row(
        self, start: Start, ring: Ringed, limits: tuple[float, float, float], pattern: Pattern, free: bool
    ) -> Batch:
        """One row at a start; limits: least, largest and first radius offset, m."""
        k = len(start.angles)
        pose = self._body_at(start.centre)
        at = np.zeros((1, COMMON + k))
        at[0, :2] = start.centre.real, start.centre.imag
        at[0, 2] = limits[2]
        at[0, 3:6] = *pose.centre_m, pose.turn_rad
        at[0, COMMON:] = start.angles
        moves = self._moves(k, k)
        if not free:
            moves = np.append(moves[:-k], moves[-k:].sum(axis=0, keepdims=True), axis=0)
        one = np.ones(1)
        return Batch(
            at,
            ring.radii[None].copy(),
            ring.heights[None].copy(),
            np.ones((1, k)),
            np.zeros((1, k)),
            one * pattern.tilt,
            one * pattern.terms,
            moves[None],
            one * limits[0],
            one * limits[1],
            one * 0.0,
        )

    def _ring_row(self, start: Start, pattern: Pattern, free: bool) -> Batch:
        k = len(start.angles)
        low, high = (0.02, 0.075) if start.radius_m < self.settings.wide_m else (0.078, 0.2)
        limits = (low - start.radius_m, high - start.radius_m, 0.0)
        return self._row(start, Ringed(np.full(k, start.radius_m), np.zeros(k)), limits, pattern, free)

    def _free_rows(self, starts: Sequence[Start], patterns: Sequence[Pattern] = (FACING, OPEN)) -> list[Row]:
        """The best of each number and ring size with every angle free, by each pattern."""
        seen: dict[tuple[int, bool], int] = {}
        rows: list[Row] = []
        for start in starts:
            key = (len(start.angles), start.radius_m < self.settings.wide_m)
            seen[key] = seen.get(key, 0) + 1
            if seen[key] == 1:
                rows += [
                    Row(FREE, (FREE, *key), self._ring_row(start, pattern, free=True)) for pattern in patterns
                ]
        return rows

    def _rigid_rows(self, starts: Sequence[Start], patterns: Sequence[Pattern] = (FACING, OPEN)) -> list[Row]:
        """The best of each bin of arrangements, turning and growing as a whole, by each pattern."""
        seen: set[tuple[int, ...]] = set()
        rows: list[Row] = []
        for start in starts:
            if len(seen) == self.settings.arrangements:
                break
            key = kind_of(start.angles)
            if key not in seen:
                seen.add(key)
                rows += [
                    Row(OTHER, (OTHER, *key), self._ring_row(start, pattern, free=False))
                    for pattern in patterns
                ]
        return rows

    def _layout_rows(self, layout: Layout, searched: Sequence[tuple[Ring, list[Start]]]) -> list[Row]:
        """The best two starts of a layout, by both patterns."""
        radii, angles, _ = off_axis(layout)
        priors = self.settings.priors
        starts: list[Start] = []
        for ring, some in searched:
            offset = ring.radius_m - float(radii.mean())
            if not priors.radius_low_m <= offset <= priors.radius_high_m:
                continue
            count = len(ring.angles)
            step = 2 * np.pi / count
            value = ring.explained(turned_on(angles, count))
            for i in peaks(value, 2):
                turned = tuple(float(a) for a in angles + i * step)
                starts.append(Start(ring.energy - float(value[i]), some[0].centre, ring.radius_m, turned))
        starts.sort(key=lambda s: s.left)
        rows: list[Row] = []
        for start in starts[:2]:
            offset = start.radius_m - float(radii.mean())
            for pattern in (FACING, OPEN):
                batch = self.batch(layout, start.centre, offset, start.angles, pattern)
                rows.append(Row(layout.name, (layout.name,), batch))
        return rows

    def batch(
        self,
        layout: Layout,
        centre: complex,
        offset_m: float,
        angles: Sequence[float],
        pattern: Pattern,
    ) -> Batch:
        """One row: a layout's reflectors off the axis, turned to angles (K,), rad, about a centre."""
        radii, _, heights = off_axis(layout)
        priors = self.settings.priors
        limits = (priors.radius_low_m, priors.radius_high_m, offset_m)
        start = Start(0.0, centre, float(radii.mean()), tuple(angles))
        return self._row(start, Ringed(radii, heights), limits, pattern, free=False)

    def _compared(
        self,
        ranked: Sequence[Placed],
        free: Sequence[Placed],
        rigid: Sequence[Placed],
        per_term: float,
        *,
        walled: bool = False,
    ) -> BodyReading:
        """The best layout against all that is not it; `walled`: neighbours also by patterns before a wall."""
        settings = self.settings
        if self.body.turns:
            whole = partial(with_middles, self.spectra, self.body, self.layouts, settings.wide_m)
            ranked, free, rigid = whole(ranked), whole(free), whole(rigid)
        best = ranked[0]
        layout = next(one for one in self.layouts if one.name == best.layout)
        radii, angles, _ = off_axis(layout)
        wanted = gaps_deg(angles)
        low = float(radii.mean()) + settings.priors.radius_low_m - settings.other_radius_m / 2
        high = float(radii.mean()) + settings.priors.radius_high_m + settings.other_radius_m / 2

        def away(p: Placed, least_deg: float = 0.0) -> float:
            resolution = max(resolution_deg(float(p.radii.mean())), least_deg)
            return apart_deg(p.angles, wanted, resolution)

        @cache
        def other(p: Placed, least_deg: float = 0.0) -> bool:
            inside = low <= float(p.radii.mean()) <= high
            return away(p, least_deg) > settings.other_deg or not inside

        rivals = [p for p in (*free, *rigid) if other(p) and can_stand(p.angles, float(p.radii.mean()))]
        every = sorted([*rivals, *ranked[1:]], key=lambda p: p.charged)
        # Alike reflectors side by side have a common pattern that is symmetric, too: many terms hold it.
        split = [p for p in every if p.layout is None and not other(p, settings.split_deg)]
        others = [p for p in every if p not in split]
        many = [p for p in split if p.batch.terms[0] > FACING.terms]
        few = [p for p in split if p.batch.terms[0] <= FACING.terms]
        near = sorted(
            (p for p in free if not other(p)), key=lambda p: (len(p.angles) != len(angles), p.charged)
        )
        tag = max(self.poses[0].left - best.left, 1e-30)
        above = max(best.left - self._noise_after(int(best.batch.terms[0])), 0.0)
        next_left = others[0].charged if others else self.poses[0].left
        error = settings.error(self.spectra, above, tag)
        own = near[0] if near else None
        lead = (next_left - best.charged) / error
        if many:
            lead = min(lead, (many[0].charged - best.charged) / error + settings.split_lead)
        rough = error + (settings.simple_error - settings.priors.model_error) * tag
        if few and best.batch.terms[0] > FACING.terms:
            # Where the layout needs five terms, a split arrangement with three is the simpler explanation.
            held = rough + (settings.split_error - settings.simple_error) * tag
            lead = min(lead, (few[0].charged - best.charged) / held)
        elif few:
            least = min(p.charged + self.spectra.angle_cost * (len(p.angles) - 1) for p in few)
            held = (least - best.charged) / error
            imitated = walled and 0 <= held < settings.nested_lead <= lead
            if imitated and led_before_wall(self.fitter, best, few, tag, settings):
                held += settings.nested_lead
            lead = min(lead, held)
        untagged = np.inf
        if lead > 0 and layout.symmetry > 1 and not self.body.turns:
            # As many amplitudes as the body and the layout's pattern have, without those that fit any wall.
            amplitudes = min(1 + int(best.batch.terms[0]), MOST)
            hints = (best.centre, self.poses[0].pose.centre)
            alone = self._symmetric_left(layout.symmetry, amplitudes, hints)
            untagged = (alone + per_term * (amplitudes - 2) - best.charged) / rough
        named = self._amplitudes(best)
        # A wall is there whichever arrangement is before it: that of points without a body is not.
        seen = [named, self._amplitudes(others[0])] if others and others[0].left < best.left else [named]
        return BodyReading(
            body=self.body,
            pose=Pose((float(best.batch.at[0, 3]), float(best.batch.at[0, 4])), float(best.batch.at[0, 5])),
            spectra=self.spectra,
            views=self.spectra.views,
            energy=self.spectra.energy,
            noise=self.noise,
            variance=self.spectra.noise,
            body_left=self.poses[0].left,
            layouts=tuple(ranked),
            others=tuple(every),
            free=own,
            tag=tag,
            unexplained=self._adequate(best, above, tag) / tag,
            lead=min(lead, untagged),
            untagged_lead=untagged,
            error=error,
            rough=rough,
            angle_off_deg=away(own) if own else 180.0,
            radius_off_m=abs(float(own.radii.mean()) - float(best.radii.mean())) if own else 1.0,
            tag_nats=tag / max(self.spectra.noise, 1e-30),
            early_m=self.spectra.early_m(named.reflectors),
            through=int(best.batch.terms[0]) > FACING.terms,
            front_m=min(self.spectra.early_m(one.body) for one in seen),
            body_energy=min(one.body_energy for one in seen),
            back=named.back,
        )

    def _adequate(self, best: Placed, above: float, tag: float) -> float:
        """Energy above noise that the layout leaves, on an enrolled body with the pattern that leaves least.

        Terms are charged where arrangements are compared. Whether the layout is there at all is another
        question: reflectors before a shell, where the wave bounces and passes, fit no pattern of few terms.
        """
        few = self.spectra.views < self.settings.through_views
        if not self.body.turns or few or above <= self.settings.through_left * tag:
            return above
        rich = replace(best.batch, terms=0 * best.batch.terms + RICH.terms, tilt=0 * best.batch.tilt)
        left = float(self.fitter.fitted(rich, 4)[1][0])
        return min(above, max(left - self._noise_after(RICH.terms), 0.0))

    def _amplitudes(self, placed: Placed) -> _Amplitudes:
        """Of body and reflectors at the places found."""
        cols = Columns.of(self.spectra, self.body, placed.batch)
        found = solve(self.spectra.data, cols.values).amplitudes[0]
        own = found[:, 0, None] * cols.values[0, :, 0]
        back = behind(found[:, 1 : 1 + int(placed.batch.terms[0])], float(placed.batch.tilt[0]))
        return _Amplitudes(found[:, 0], found[:, 1:].sum(axis=1), float((np.abs(own) ** 2).sum()), back)
