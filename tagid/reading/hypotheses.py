"""What is tried, and in which order: bodies, transfers, arrangements and odd scatterers.

Every hypothesis ends as a `Hypothesis` with its log evidence; `decision` compares them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tagid.reading import search
from tagid.reading.columns import CLOSEST_M, ODD_POWER, REACH_M, Arrangement, Columns, Model
from tagid.reading.descent import CLUTTER, Found, Powers, best_powers, refined, variance
from tagid.reading.spectra import CLUTTER_RADII_M, Complex, Floats, Spectra
from tagid.reading.transfers.plain import BARE, FACING, FILLED, OPEN, POINTS, THIN
from tagid.reading.transfers.transfer import Transfer
from tagid.tags.layouts.layout import Layout

TRANSFERS: tuple[Transfer, ...] = (BARE, POINTS, FACING, OPEN, THIN, FILLED)
MOST_ODD, MOST_ODD_UNTAGGED = 2, 5
"""Odd scatterers beside a tag, and where there is none."""
MOST_REFLECTORS = 4
"""Reflectors of an arrangement that is not enrolled."""
FREE_RINGS_M = (0.03, 0.045, 0.063, 0.085, 0.11)
"""Radii of rings on which an arrangement that is not enrolled is looked for."""
_GRID_M = 4e-3
_MIDDLE_M = 5e-3
"""A reflector nearer to the axis is the middle one: beside a body it looks like that."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One explanation of a recording.

    Attributes:
        layout: the enrolled one; None for none or an arrangement that is not enrolled.
        found: the model at its most probable parameters.
        log_z: log evidence, nats.
        middle: the layout has a reflector in the middle, which looks like the body.
    """

    layout: Layout | None
    found: Found
    log_z: float
    middle: bool = False

    @property
    def tagged(self) -> bool:
        """It has reflectors."""
        return self.found.model.tag is not None


@dataclass(eq=False)
class Contest:
    """Hypotheses of one recording and what they share."""

    spectra: Spectra
    layouts: Sequence[Layout]
    transfers: Sequence[Transfer] = TRANSFERS
    hypotheses: list[Hypothesis] = field(default_factory=list)
    _maps: dict[int, Complex] = field(default_factory=dict)

    def add(self, layout: Layout | None, found: Found, middle: bool = False) -> Hypothesis:
        """Enter a hypothesis."""
        alike = np.log(layout.symmetry) if layout is not None else 0.0
        one = Hypothesis(layout, found, found.log_z + float(alike), middle)
        self.hypotheses.append(one)
        return one

    def run(self) -> list[Hypothesis]:
        """All hypotheses, the best first."""
        bodies = self._untagged()
        centre = bodies[0].found.centre
        clutter = [max(one.found.powers.clutter, 1e-3) for one in bodies[:2]]
        for transfer in self.transfers:
            self._tagged(transfer, centre, clutter)
        self._beside_odd()
        self._one_more()
        return sorted(self.hypotheses, key=lambda one: -one.log_z)

    def _untagged(self) -> list[Hypothesis]:
        """Nothing, and a round body, with clutter of either disc."""
        grid = _GRID_M * np.arange(-2, 3)
        model = Model(POINTS, None, True, 0)
        starts = [np.array([x, y]) for x in grid for y in grid]
        values = [best_powers(self.spectra, model, x, 1e-2)[1] for x in starts]
        order = np.argsort(values)[::-1][:2]
        bodies = []
        for disc in (0, 1):
            of_disc = replace(model, disc=disc)
            found = [refined(self.spectra, of_disc, starts[i], (1e-2, None), 12) for i in order]
            bodies.append(self.add(None, max(found, key=lambda one: one.log_z)))
        for disc in (0, 1):
            self.add(None, refined(self.spectra, Model(BARE, None, False, disc), np.zeros(2), (None,), 1))
        return bodies

    def _tagged(self, transfer: Transfer, centre: complex, clutter: Sequence[float]) -> None:
        spectra = self.spectra
        grid = _GRID_M * np.arange(-2, 3)
        centres = [centre] if transfer.body else [centre, *(complex(x, y) for x in grid for y in grid)]
        offsets = (0.0,) if transfer.radius_sd_m < 5e-3 else (-0.009, 0.0, 0.011)
        arranged = [Arrangement.of_layout(one.positions, one.heights) for one in self.layouts]
        for disc in (0, 1):
            own = [i for i, one in enumerate(arranged) if disc_of(float(one.radius_m.max())) == disc]
            free_m = [r for r in FREE_RINGS_M if disc_of(r) == disc]
            model = Model(transfer, None, transfer.body, disc)
            powers = Powers(clutter[disc])
            best: dict[int, list[tuple[float, complex, float, float]]] = {i: [] for i in own}
            free: list[tuple[float, complex, float, tuple[float, ...]]] = []
            for c in centres:
                rings = sorted(
                    {(round(float(r + o), 4), float(z)) for i in own for r, z in _rings(arranged[i]) for o in offsets}
                    | {(r, 0.0) for r in free_m}
                )
                table = search.tables(spectra, model, c, rings, powers)
                for i in own:
                    a = arranged[i]
                    keep = (a.radius_m > _MIDDLE_M) | (not transfer.body)
                    for o in offsets:
                        ring = np.array(
                            [rings.index((round(float(r + o * (r > _MIDDLE_M)), 4), float(z))) if (round(float(r + o * (r > _MIDDLE_M)), 4), float(z)) in rings else 0
                             for r, z in zip(a.radius_m[keep], a.height_m[keep], strict=True)]
                        )
                        for s in search.turned(table, ring, a.angle[keep], 2):
                            best[i].append((s.log, c, s.angles[0], o))
                for r in free_m:
                    for s in search.free(table, rings.index((r, 0.0)), MOST_REFLECTORS, 2):
                        free.append((s.log, c, r, s.angles))
            order = sorted(own, key=lambda i: -max(b[0] for b in best[i]))[:2]
            for i in order:
                a = arranged[i]
                middle = bool((a.radius_m <= _MIDDLE_M).any())
                if middle and transfer.body:
                    a = _without_middle(a)
                for _, c, turn, o in sorted(best[i], key=lambda b: -b[0])[:2]:
                    x = np.array([c.real, c.imag, turn, o])
                    found = refined(spectra, replace(model, tag=a), x, (1e-2, 1e-3, None))
                    self.add(self.layouts[i], found, middle)
            free.sort(key=lambda one: -one[0])
            seen: list[tuple[int, Floats]] = []
            for _, c, r, angles in free:
                gaps = _gaps(np.array(angles))
                if any(len(gaps) == len(g) and _alike(gaps, g) for _, g in seen):
                    continue
                seen.append((len(angles), gaps))
                x = np.r_[c.real, c.imag, np.zeros(len(angles)), 0.0]
                tag = Arrangement.ring(r, np.array(angles))
                self.add(None, refined(spectra, replace(model, tag=tag), x, (1e-2, 1e-3, None)))
                if len(seen) == 4:
                    break

    def _beside_odd(self) -> None:
        """The best of every kind beside odd scatterers, added while they pay."""
        kinds: tuple[tuple[list[Hypothesis], int], ...] = (
            ([h for h in self.hypotheses if not h.tagged], MOST_ODD_UNTAGGED),
            (sorted((h for h in self.hypotheses if h.layout is not None), key=lambda h: -h.log_z)[:5], MOST_ODD),
            (sorted((h for h in self.hypotheses if h.tagged and h.layout is None), key=lambda h: -h.log_z)[:9], MOST_ODD),
        )
        for some, most in kinds:
            for one in some:
                self._grow(one, most)

    def _grow(self, one: Hypothesis, most: int) -> Hypothesis:
        for _ in range(most):
            place = self._likely_spot(one.found)
            if place is None:
                break
            model = one.found.model.with_odd(one.found.model.odd + 1)
            x = np.r_[one.found.x, place.real, place.imag]
            found = refined(self.spectra, model, x, (None,), 8)
            if found.log_z < one.found.log_z + 1:
                break
            one = self.add(one.layout, found, one.middle)
        return one

    def _likely_spot(self, found: Found) -> complex | None:
        """Where an odd scatterer adds most evidence, x + jy, m; None where it does not pay for its place."""
        spectra, model = self.spectra, found.model
        places = _disc()
        if model.disc not in self._maps:
            waves, _ = spectra.waves(places, np.zeros(len(places)))
            self._maps[model.disc] = spectra.whiteners[model.disc].apply(waves)
        lam = variance(spectra, model, found.powers.clutter)
        whitener = spectra.whiteners[model.disc]
        columns = whitener.apply(Columns.of(model, spectra, found.x, slopes=False).values) / np.sqrt(lam)[:, None]
        y = spectra.white[model.disc] / np.sqrt(lam)
        power = model.power(spectra.moving, found.powers.tag, found.powers.oval)
        matrix = columns.conj() @ np.swapaxes(columns, 1, 2) + np.eye(columns.shape[1]) / power[:, None, :]
        inverse = np.linalg.inv(matrix)
        left = y - ((inverse @ (columns.conj() @ y[..., None]))[..., 0][:, None] @ columns)[:, 0]
        spots = self._maps[model.disc]
        # Columns and data are held against the same whitened spots: conj(w) y / lambda.
        number = (spots.conj() @ (left / np.sqrt(lam))[..., None])[..., 0]
        cross = spots.conj() @ np.swapaxes(columns / np.sqrt(lam)[:, None], 1, 2)
        size = (np.abs(spots) ** 2 @ (1 / lam)[..., None])[..., 0]
        size -= np.einsum("fqn,fnm,fqm->fq", cross, inverse, cross.conj(), optimize=True).real
        prior = (ODD_POWER * spectra.moving)[:, None]
        gain = (np.abs(number) ** 2 / (1 / prior + size) - np.log1p(prior * size)).sum(axis=0)
        used = np.concatenate([found.places, found.odd])
        if len(used):
            gain[(np.abs(places[:, None] - used) < CLOSEST_M).any(axis=1)] = -np.inf
        best = int(gain.argmax())
        return complex(places[best]) if gain[best] > 5 else None

    def _one_more(self) -> None:
        """Whether an odd scatterer beside a layout is an alike reflector more: then it is another tag."""
        for one in [h for h in self.hypotheses if h.layout is not None and len(h.found.odd)]:
            tag, found = one.found.model.tag, one.found
            if tag is None or one.log_z < max(h.log_z for h in self.hypotheses) - 60:
                continue
            for odd in found.odd:
                places = np.append(found.places, odd) - found.centre
                radius = float(np.abs(places[:-1]).max())
                if not 0.5 * radius < abs(places[-1]) < 1.7 * radius:
                    continue
                more = Arrangement(
                    np.abs(places), np.angle(places), np.append(tag.height_m, 0.0), np.arange(len(places)),
                    np.zeros(len(places), dtype=np.intp), True,
                )
                model = Model(found.model.transfer, more, found.model.oval, found.model.disc)
                x = np.r_[found.x[:2], np.zeros(len(places) + 1)]
                self._grow(self.add(None, refined(self.spectra, model, x, (None,)), one.middle), MOST_ODD)


def disc_of(radius_m: float) -> int:
    """Number of the clutter's disc for reflectors at a distance from the axis, m."""
    return 0 if radius_m < 0.08 else 1


def _rings(arrangement: Arrangement) -> list[tuple[float, float]]:
    return list(zip(arrangement.radius_m, arrangement.height_m, strict=True))


def _without_middle(a: Arrangement) -> Arrangement:
    keep = a.radius_m > _MIDDLE_M
    return Arrangement(a.radius_m[keep], a.angle[keep], a.height_m[keep], a.turn[keep], a.stretch[keep], a.free)


def _gaps(angles: Floats) -> Floats:
    a = np.sort(angles % (2 * np.pi))
    return np.diff(np.append(a, a[0] + 2 * np.pi))


def _alike(a: Floats, b: Floats) -> bool:
    return any(np.abs(np.roll(a, k) - b).max() < np.deg2rad(20) for k in range(len(a)))


def _disc() -> Complex:
    out = []
    for q in np.arange(0.0, REACH_M + 1e-3, 0.007):
        n = max(1, int(2 * np.pi * q / 0.008))
        out.append(q * np.exp(2j * np.pi * np.arange(n) / n))
    return np.concatenate(out)
