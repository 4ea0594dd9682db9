"""Which alike reflectors beside a thin shell made the echo, where free patterns cannot tell.

A pattern that holds what a helmet's shell does to its reflectors has seven free terms, which takes 30 views
and an enrolled body. But the shell's own wave fixes it: the field at a reflector is that beside a thin sheet,
elliptic or, of a carton, rectangular (`tagid.fields.thin_shell`), and few amplitudes per frequency are left,
one for all reflectors, and for the shell one of each power of the cosine of incidence,

    Y = B + sum_p A_p(f) echo_p(shell) + g(f) sum_k E(r_k)^2.

What is searched is the shape and the place of the shell, and where the reflectors are. It need not be
enrolled.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf

import numpy as np
from numpy.typing import NDArray

from tagid.fields.thin_shell import POINTS as CONTOUR
from tagid.fields.thin_shell import ShellField
from tagid.tags.bodies.arrangement import (
    apart_deg,
    farthest,
    gaps_deg,
    kind_of,
    off_axis,
    resolution_deg,
)
from tagid.tags.bodies.body_reading import BodyReading, BodySettings, Placed
from tagid.tags.bodies.points import Place, columns
from tagid.tags.bodies.reflectors_fit import POINTS, THROUGH, Batch
from tagid.tags.bodies.ring import Ring, peaks
from tagid.tags.bodies.shell_model import (
    SEARCHED,
    ShellBody,
    ShellFit,
    basis_of,
    beyond,
    likely_boxes,
    likely_shells,
    refined_beside,
)
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.layouts.layout import Layout

OBLIQUITIES = 3
"""Amplitudes of a shell per frequency, see `ShellView.echoes`."""
COUNT = 72
"""Angles on a ring: 5 degrees, 10 mm on a helmet's."""
_TRIED, _BEGUN, _REFINED = 8, 4, 3
"""Shells of the search beside which layouts are tried, those beside which the best one is fitted, and those
that are fitted with it."""
_BOXES = 4
"""Boxes of unlike size, of the first kind."""
_LAYOUTS, _KEPT, _BEAM = 8, 12, 8
"""Turns of layouts and other arrangements that are fitted, and sets kept per number of reflectors."""
RING_M = 3e-3
"""Standard deviation of a reflector's distance from the ring's centre about its nominal one,"""
OFF_M = 3e-3
"""and of that centre about the shell's, per coordinate."""
LOOSE_M = 10e-3
"""That of a tag in a carton about the carton's."""
MOST_RING_M = 0.16
"""Largest ring of reflectors: what can be enrolled is no larger, and the contour's points are of helmets."""
SMALLER = 0.8
"""Shells inside a ring are also those inside one this part of it, and larger."""
FEWEST_VIEWS = 18
"""With 12, one of 60 foreign tags of our simulator passed for one on a shell."""
PROMISING = 0.5
"""Share of what the shell leaves, beyond noise, that a layout must explain for both to be fitted: tags on
solved shells have 0.76 and more at 36 views, at 18 half of them, too; 19 of 20 other objects have less."""
ENOUGH = 0.9
"""Where a layout explains so much after that, no other start is fitted."""
HOPEFUL = 0.4
"""And that it must explain after that, for other arrangements to be fitted."""
CLEAR_M = 0.5e-3
"""Reflectors on a ring clear the shell's wall by so much."""
MODEL_ERROR = 0.02
"""Share of the tag's echo that counts as the model's error: layouts leave 2 to 6 % of solved ones."""
_STEP_M, _STEP_RAD = 3e-4, 3e-3


def read_on_shell(
    spectra: Spectra, layouts: Sequence[Layout], settings: BodySettings, hint: Place | None = None
) -> ShellReading | None:
    """The best layout beside a shell, against every other arrangement there.

    Args:
        spectra: the scans.
        layouts: the enrolled ones; those with reflectors from `settings.wide_m` to MOST_RING_M out are read.
        settings: search and priors.
        hint: where a layout seems to be without a body. Its echo hides that of the shell where it is louder,
            so that shells are sought without it as well.

    Returns:
        The reading; None where no layout can stand around a shell, or none explains much of the echo.
    """
    wide = [layout for layout in layouts if settings.wide_m <= _ring_m(layout) <= MOST_RING_M]
    if not wide or spectra.views < FEWEST_VIEWS:
        return None
    rings = _rings_m(wide)

    def likely(seen: Spectra, count: int) -> list[ShellFit]:
        return [fit for ring in rings for fit in likely_shells(seen, ring, count)]

    return _best_beside(likely, _Sought(spectra, wide, settings), hint)


def read_in_box(
    spectra: Spectra, layouts: Sequence[Layout], settings: BodySettings, hint: Place | None = None
) -> ShellReading | None:
    """The same beside four thin walls: a tag in a carton, or on a plastic crate.

    Args:
        spectra, layouts, settings, hint: as of `read_on_shell`. All layouts are read, in the middle of the
            box and where the hint is: what is in a carton need not stand in its middle.
    """
    own = [layout for layout in layouts if 0 < _ring_m(layout) <= MOST_RING_M]
    if not own or spectra.views < FEWEST_VIEWS:
        return None
    centre = None if hint is None else complex(*hint.centre_m)
    return _best_beside(likely_boxes, _Sought(spectra, own, settings, _BOXES, LOOSE_M, centre), hint)


@dataclass(frozen=True, eq=False)
class _Sought:
    """What is sought beside shells.

    Attributes:
        spectra: the scans.
        layouts: that may stand there.
        settings: search and priors.
        tried: shells that are tried, and half as many without the echo of a hint.
        off_m: standard deviation of the reflectors' centre about the shell's, m, per coordinate.
        centre: where layouts are sought besides the middle of the shell, x + jy, m.
    """

    spectra: Spectra
    layouts: Sequence[Layout]
    settings: BodySettings
    tried: int = _TRIED
    off_m: float = OFF_M
    centre: complex | None = None

    @property
    def loose(self) -> bool:
        """Whether the reflectors need not stand around the middle of the shell."""
        return self.off_m > OFF_M


def _best_beside(
    likely: Callable[[Spectra, int], list[ShellFit]], sought: _Sought, hint: Place | None
) -> ShellReading | None:
    """The reading beside the one of some shells that explains most together with a layout."""
    shells = likely(sought.spectra, sought.tried)
    if hint is not None:
        shells += likely(_without(sought.spectra, hint), sought.tried // 2)
    thin = replace(sought, spectra=sought.spectra.thinned(2))
    starts = [_ShellReader(thin, fit, 1, SEARCHED) for fit in shells]
    starts.sort(key=lambda reader: reader.start.left)
    # The reflectors may stand some millimetres further out than the layout has them.
    begun = [(reader, reader.fitted(reader.start, 2)) for reader in starts[:_BEGUN]]
    begun.sort(key=lambda pair: pair[1].left)
    if begun[0][0].explained(begun[0][1]) < PROMISING:
        return None
    found: list[_Beside] = []
    for reader, row in begun[:_REFINED]:
        one = _refined(_Beside(row, reader), sought)
        if one.reader.clears(one.row):
            found.append(one)
            if one.explained >= ENOUGH:
                break
    return min(found, key=lambda one: one.row.left).reader.read() if found else None


def _refined(one: _Beside, sought: _Sought) -> _Beside:
    """Beside its reflectors a shell is seen more exactly, and they beside it."""
    # One amplitude tells more of the shell's shape, several hold more of its echo.
    fit = refined_beside(one.reader.spectra, one.reader.fit, one.reader.wave_of(one.row), 1)
    reader = _ShellReader(sought, fit, OBLIQUITIES)
    row = reader.fitted(one.row)
    fit = refined_beside(sought.spectra, fit, reader.wave_of(row), OBLIQUITIES, 2)
    reader = _ShellReader(sought, fit, OBLIQUITIES)
    return _Beside(reader.fitted(reader.start, 2), reader)


def _without(spectra: Spectra, hint: Place) -> Spectra:
    """Spectra without the echo of a layout, as points without a body."""
    own = hint.layout.positions[:, 0] + 1j * hint.layout.positions[:, 1]
    places = complex(*hint.centre_m) + own * np.exp(1j * hint.turn_rad)
    heights = np.asarray(hint.layout.heights, dtype=np.float64)
    wave = np.swapaxes(columns(spectra, places, heights), 1, 2)
    return replace(spectra, data=beyond(spectra.data, np.linalg.qr(wave)[0]))


def _ring_m(layout: Layout) -> float:
    return float(off_axis(layout)[0].max(initial=0.0))


def _rings_m(layouts: Sequence[Layout]) -> list[float]:
    """Rings inside which shells are sought, the largest first: each holds those of rings not much smaller."""
    found: list[float] = []
    for ring in sorted({round(_ring_m(layout), 3) for layout in layouts}, reverse=True):
        if not found or ring < SMALLER * found[-1]:
            found.append(ring)
    return found


@dataclass(frozen=True, eq=False)
class ShellReading:
    """What the scans say of a tag beside a shell.

    Attributes:
        reading: the same as on any other body.
        middle_nats: energy by which a reflector alike in the middle would show, over the reading's error.
        middle_lead: what the best layout leaves less than the same with a reflector more in the middle, or
            without the one that it has there, over that error.
        has_middle: the best layout has one.
        outside_m: (K,) how far outside the shell the best layout's reflectors stand, m; negative inside.
    """

    reading: BodyReading
    middle_nats: float
    middle_lead: float
    has_middle: bool
    outside_m: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Ringed:
    """Alike reflectors around one centre.

    Attributes:
        at: (3 + K,) centre x and y about the shell's, what is added to the radii, m, and the angles, rad.
        radii: (K,) nominal, m; 0 for one in the middle.
        heights: (K,) above the object's plane, m.
        layout: its name, which turns as a whole; None for reflectors whose angles are free.
        left: energy left.
    """

    at: NDArray[np.float64]
    radii: NDArray[np.float64]
    heights: NDArray[np.float64]
    layout: str | None
    left: float = inf

    @property
    def places(self) -> NDArray[np.complex128]:
        """(K,) about the shell's centre, in the turntable's directions, m."""
        out = (self.radii + self.at[2] * (self.radii > 0)) * np.exp(1j * self.at[3:])
        return np.asarray(complex(self.at[0], self.at[1]) + out)

    @property
    def on_ring(self) -> NDArray[np.float64]:
        """Angles of the reflectors off the middle, rad."""
        return np.asarray(self.at[3:][self.radii > 0])


def _away_deg(row: _Ringed, best: _Ringed) -> float:
    """How far the angles of an arrangement are from those of a layout."""
    return apart_deg(row.on_ring, gaps_deg(best.on_ring), resolution_deg(float(best.radii.max())))


@dataclass(frozen=True, eq=False)
class _Beside:
    """A layout beside a shell, and the reader of that shell."""

    row: _Ringed
    reader: _ShellReader

    @property
    def explained(self) -> float:
        """Share that it explains of what the shell leaves."""
        return self.reader.explained(self.row)


class _ShellReader:
    """The search beside one shell in one place."""

    def __init__(self, sought: _Sought, fit: ShellFit, obliquities: int, contour: int = CONTOUR) -> None:
        self.sought, self.fit = sought, fit
        spectra = self.spectra = sought.spectra
        field = ShellField.of(spectra.wavenumbers / 2, fit.shell, contour)
        self.across = spectra.antenna - fit.pose.centre
        self._rings: dict[tuple[float, float, complex], NDArray[np.complex128]] = {}
        self.seen = field.seen_from(self.across * np.exp(-1j * fit.pose.turn_rad))
        self.basis = basis_of(self.seen, obliquities)
        self.beyond = self._beyond_body(spectra.data)
        self.body_left = float((np.abs(self.beyond) ** 2).sum())
        free = max(spectra.views - 2 - obliquities, 1)
        self.noise = spectra.noise_energy * free / (spectra.views - 1)
        self.variance = max(
            spectra.noise + MODEL_ERROR * self.body_left / spectra.data.size, 1e-12 * spectra.energy
        )

    def explained(self, row: _Ringed) -> float:
        """Share of what the shell leaves, beyond noise, that an arrangement explains; 1 of noise alone."""
        signal = self.body_left - self.noise
        return (self.body_left - max(row.left, self.noise)) / signal if signal > 0 else 1.0

    def _beyond_body(self, waves: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Waves (F, ..., V) without what is constant over the views and without what the shell may return."""
        return beyond(centred(waves), self.basis)

    def each(self, places: NDArray[np.complex128], heights: NDArray[np.float64]) -> NDArray[np.complex128]:
        """(F, K, V) echo of reflectors at places about the shell's centre, m."""
        plane = np.abs(self.across - places[:, None])
        distance = np.hypot(plane, self.spectra.height_m - heights[:, None])
        direct = self.spectra.waves(distance) * (self.spectra.distance_m / distance) ** 2
        return direct * self.seen.relative(places * np.exp(-1j * self.fit.pose.turn_rad))

    def wave_of(self, row: _Ringed) -> NDArray[np.complex128]:
        """(F, V) echo of an arrangement, without the room."""
        return centred(self.each(row.places, row.heights).sum(axis=1))

    def _rest(self, at: NDArray[np.float64], row: _Ringed) -> NDArray[np.complex128]:
        """(F, V) what body and arrangement leave of the data."""
        moved = replace(row, at=at)
        wave = self._beyond_body(self.each(moved.places, row.heights).sum(axis=1))
        along = (wave.conj() * self.beyond).sum(axis=1, keepdims=True)
        size = np.maximum((np.abs(wave) ** 2).sum(axis=1, keepdims=True), 1e-30)
        return np.asarray(self.beyond - wave * along / size)

    def fitted(self, row: _Ringed, rounds: int = 4) -> _Ringed:
        """Levenberg-Marquardt on where an arrangement is."""
        k = len(row.radii)
        moves = np.zeros((3 + (1 if row.layout else k), 3 + k))
        moves[:3, :3] = np.eye(3)
        moves[3:, 3:] = 1.0 if row.layout else np.eye(k)
        steps = np.full(len(moves), _STEP_RAD)
        steps[:3] = _STEP_M
        weight = np.zeros(3 + k)
        weight[:3] = self.sought.off_m**-2, self.sought.off_m**-2, RING_M**-2
        weight *= self.variance / 2
        at = row.at
        rest = self._rest(at, row)
        cost, damping = float((np.abs(rest) ** 2).sum() + weight @ at**2), 1e-2
        for _ in range(rounds):
            slopes = np.stack(
                [(self._rest(at + d * m, row) - rest).ravel() / d for d, m in zip(steps, moves, strict=True)]
            )
            normal = np.real(slopes.conj() @ slopes.T) + (moves * weight) @ moves.T
            gradient = np.real(slopes.conj() @ rest.ravel()) + (moves * weight) @ at
            gain = 0.0
            for _ in range(3):
                size = np.diag(normal)
                damped = normal + np.diag(damping * size + 1e-12 * size.sum() + 1e-300)
                trial = at - np.linalg.solve(damped, gradient) @ moves
                there = self._rest(trial, row)
                value = float((np.abs(there) ** 2).sum() + weight @ trial**2)
                if value < cost:
                    gain = cost - value
                    at, rest, cost, damping = trial, there, value, damping / 5
                    break
                damping *= 8
            if gain < 1e-3 * cost:
                break
        return replace(row, at=at, left=float((np.abs(rest) ** 2).sum()))

    def _around(self, radius_m: float, height_m: float, centre: complex) -> NDArray[np.complex128]:
        """(F, 2 COUNT, V) echo of a reflector all around a ring; the first alone in the middle. Kept."""
        key = (round(radius_m, 4), round(height_m, 4), centre)
        if key not in self._rings:
            places = centre + radius_m * np.exp(1j * np.pi * np.arange(2 * COUNT) / COUNT)
            count = len(places) if radius_m > 0 else 1
            self._rings[key] = self.each(places[:count], np.full(count, height_m))
        return self._rings[key]

    def _turns(self, layout: Layout, centre: complex) -> list[_Ringed]:
        """The best turns of a layout about a place x + jy, m, off the shell's centre."""
        place = layout.positions[:, 0] + 1j * layout.positions[:, 1]
        radii, angles = np.abs(place), np.angle(place)
        radii = np.where(radii > 0.01, radii, 0.0)
        heights = np.asarray(layout.heights, dtype=np.float64)
        frequencies, views = self.spectra.data.shape
        total = np.zeros((frequencies, COUNT, views), dtype=np.complex128)
        for radius, angle, height in zip(radii, angles, heights, strict=True):
            ring = self._around(float(radius), float(height), centre)
            steps = np.rint(angle * COUNT / np.pi).astype(np.intp) + 2 * np.arange(COUNT)
            total += ring[:, steps % ring.shape[1]]
        waves = self._beyond_body(total)
        along = np.abs((waves.conj() * self.beyond[:, None]).sum(axis=-1)) ** 2
        value = (along / np.maximum((np.abs(waves) ** 2).sum(axis=-1), 1e-30)).sum(axis=0)
        found = []
        for i in peaks(value, 2):
            at = np.concatenate([[centre.real, centre.imag, 0.0], angles + 2 * np.pi * i / COUNT])
            found.append(_Ringed(at, radii, heights, layout.name, self.body_left - float(value[i])))
        return found

    def clears(self, row: _Ringed) -> bool:
        """Whether no reflector on the ring stands in the shell's wall."""
        return bool((np.abs(self._outside_m(row)) > CLEAR_M).all())

    def _outside_m(self, row: _Ringed) -> NDArray[np.float64]:
        own = row.places[row.radii > 0] * np.exp(-1j * self.fit.pose.turn_rad)
        return self.fit.shell.outside_m(own)

    def _others(self, centre: complex) -> list[_Ringed]:
        """The best of each of some kinds of arrangements on the layouts' rings about such a place."""
        thin = slice(None, None, 2)
        angles = 2 * np.pi * np.arange(COUNT) / COUNT
        starts: list[_Ringed] = []
        for radius in sorted({round(_ring_m(layout), 3) for layout in self.sought.layouts}):
            places = centre + radius * np.exp(1j * angles)
            each = self._beyond_body(self.each(places, np.zeros(COUNT)))
            ring = Ring.from_columns(self.beyond[thin], each[thin], None, radius, POINTS, angles)
            scale = self.body_left / max(ring.energy, 1e-30)
            for sets, values in ring.best(self.sought.settings.most, _BEAM).values():
                for indices, value in zip(sets, values, strict=True):
                    k = len(indices)
                    at = np.concatenate([[centre.real, centre.imag, 0.0], angles[indices]])
                    left = (ring.energy - float(value)) * scale
                    starts.append(_Ringed(at, np.full(k, radius), np.zeros(k), None, left))
        kept: list[_Ringed] = []
        seen: set[tuple[object, ...]] = set()
        for start in sorted(starts, key=lambda one: one.left):
            kind = (kind_of([float(a) for a in start.on_ring]), float(start.radii[0]))
            if kind not in seen and len(kept) < _KEPT:
                seen.add(kind)
                kept.append(start)
        return kept

    @cached_property
    def turns(self) -> list[_Ringed]:
        """The best turns of every layout."""
        centres = [0j]
        if self.sought.centre is not None:
            centres.append(self.sought.centre - self.fit.pose.centre)
        return [row for layout in self.sought.layouts for at in centres for row in self._turns(layout, at)]

    @property
    def start(self) -> _Ringed:
        """The one that leaves least."""
        return min(self.turns, key=lambda row: row.left)

    def read(self) -> ShellReading | None:
        """Search, fit and compare."""
        turns = sorted(self.turns, key=lambda row: row.left)
        rows = [self.fitted(row) for row in turns[:_LAYOUTS]]
        rows = [row for row in rows if self.clears(row)]
        own: dict[str, _Ringed] = {}
        for row in sorted(rows, key=lambda one: one.left, reverse=True):
            own[row.layout or ""] = row
        ranked = sorted(own.values(), key=lambda row: row.left)
        if not ranked or self.explained(ranked[0]) < HOPEFUL:
            return None
        best = ranked[0]
        centre = complex(best.at[0], best.at[1]) if self.sought.loose else 0j
        others = [self.fitted(row) for row in self._others(centre)]
        free = self.fitted(replace(best, layout=None))
        # With one amplitude per frequency the shell's shape is seen better, and what stands in its middle.
        fit = refined_beside(self.spectra, self.fit, self.wave_of(best), 1)
        plain = _ShellReader(self.sought, fit, 1)
        return plain.middle_of(best, self._compared(ranked, others, free, fit))

    def _error(self, left: float) -> float:
        """Energy that a lead of 1 is, where an arrangement leaves so much."""
        tag = max(self.body_left - left, 1e-30)
        above = max(left - self.noise, 0.0)
        return above + MODEL_ERROR * tag + self.sought.settings.noise_nats * self.spectra.noise

    def middle_of(self, best: _Ringed, reading: BodyReading) -> ShellReading:
        """A reading with what stands in the middle of its best layout.

        Several amplitudes of the shell hold much of a wave from there: this asks for one.
        """
        own, other = self.fitted(best), self.fitted(self._toggled(best))
        error = self._error(own.left)
        wave = self._beyond_body(self.wave_of(own))
        size = np.maximum((np.abs(wave) ** 2).sum(axis=1), 1e-30)
        amplitude = (wave.conj() * self.beyond).sum(axis=1) / size
        # What a reflector alike adds beyond the arrangement, whose amplitude follows.
        fewer, more = sorted((own, self._toggled(own)), key=lambda row: len(row.radii))
        extra = self._beyond_body(self.wave_of(more) - self.wave_of(fewer))
        extra = extra - wave * ((wave.conj() * extra).sum(axis=1) / size)[:, None]
        shows = float((np.abs(amplitude[:, None] * extra) ** 2).sum())
        has = bool((best.radii == 0).any())
        lead = (other.left - own.left) / error
        return ShellReading(reading, shows / error, lead, has, self._outside_m(own))

    def _toggled(self, row: _Ringed) -> _Ringed:
        """An arrangement with a reflector in the middle, or without the one that it has there."""
        keep = row.radii > 0
        if keep.all():
            return replace(
                row,
                at=np.append(row.at, 0.0),
                radii=np.append(row.radii, 0.0),
                heights=np.append(row.heights, row.heights.mean()),
            )
        at = np.concatenate([row.at[:3], row.at[3:][keep]])
        return replace(row, at=at, radii=row.radii[keep], heights=row.heights[keep])

    def _is_other(self, row: _Ringed, best: _Ringed) -> bool:
        """Whether an arrangement is another than a layout.

        Reflectors too near for two stay in: beside walls they stand for what is no reflector.
        """
        settings, radius = self.sought.settings, float(best.radii.max())
        elsewhere = abs(float(row.radii.max() + row.at[2]) - radius) > settings.other_radius_m
        if _away_deg(row, best) <= settings.other_deg and not elsewhere:
            return False
        # A pair a little less than opposite is the opposite one about another centre.
        same = radius * float(np.deg2rad(settings.other_deg)) / 2
        return farthest(row.places, best.places) > same

    def _compared(
        self, ranked: list[_Ringed], found: list[_Ringed], free: _Ringed, shown: ShellFit
    ) -> BodyReading:
        """The best layout against all that is not it.

        Args:
            ranked: layouts, best first.
            found: other arrangements.
            free: the best layout's reflectors, each free.
            shown: the shell that the reading shows.
        """
        spectra, best = self.spectra, ranked[0]
        different = [row for row in found if self._is_other(row, best) and self.clears(row)]
        costs = [self._placed(row, spectra.angle_cost * (len(row.on_ring) - 1)) for row in different]
        every = sorted([*costs, *(self._placed(row, 0.0) for row in ranked[1:])], key=lambda p: p.charged)
        tag = max(self.body_left - best.left, 1e-30)
        above = max(best.left - self.noise, 0.0)
        error = self._error(best.left)
        lead = (every[0].charged - best.left) / error if every else inf
        wave = self._beyond_body(self.wave_of(best))
        amplitude = (wave.conj() * self.beyond).sum(axis=1) / (np.abs(wave) ** 2).sum(axis=1)
        rest = spectra.data - amplitude[:, None] * self.wave_of(best)
        body = rest - beyond(rest, self.basis)
        layouts = tuple(self._placed(row, 0.0) for row in ranked)
        return BodyReading(
            body=ShellBody(shown, spectra.wavenumbers, round(spectra.distance_m, 2)),
            pose=shown.pose,
            spectra=spectra,
            views=spectra.views,
            energy=spectra.energy,
            noise=self.noise,
            variance=spectra.noise,
            body_left=self.body_left,
            layouts=layouts,
            others=tuple(every),
            free=self._placed(free, 0.0) if len(free.on_ring) == len(best.on_ring) else None,
            tag=tag,
            unexplained=above / tag,
            lead=lead,
            untagged_lead=inf,
            error=error,
            rough=error,
            angle_off_deg=_away_deg(free, best),
            radius_off_m=abs(float(free.at[2] - best.at[2])),
            tag_nats=tag / max(spectra.noise, 1e-30),
            early_m=spectra.early_m(amplitude),
            through=True,
            front_m=0.0,
            body_energy=float((np.abs(body) ** 2).sum()),
        )

    def _placed(self, row: _Ringed, charge: float) -> Placed:
        """An arrangement beside the shell as one with a free pattern, as which pictures subtract its body."""
        off = row.radii > 0
        centre = self.fit.pose.centre + complex(row.at[0], row.at[1])
        pose = self.fit.pose
        at = np.array([[centre.real, centre.imag, row.at[2], *pose.centre_m, pose.turn_rad, *row.on_ring]])
        batch = Batch.at_rest(at, row.radii[off], row.heights[off], THROUGH)
        return Placed(batch, row.left, row.left + charge, row.layout)
