"""Which alike reflectors beside which round wall made the echo, where free patterns cannot tell.

On a can, cup or glass, or an enrolled mug, that the reader of free patterns refuses, every arrangement of 1
to 4 reflectors is fitted beside walls of metal, plastic, ceramic and glass of every size that the layouts
leave room for. An enrolled body keeps the echo and the pose that explain it; the wall fixes the pattern
alone. Two amplitudes per frequency are left for the tag, so that arrangements which patterns of five terms
make alike differ by a tenth of the echo and more.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.arrangement import (
    apart_deg,
    can_stand,
    kind_of,
    layout_gaps_deg,
    off_axis,
    resolution_deg,
    turned_on,
)
from tagid.tags.bodies.body_reading import BodyReading, BodySettings, Placed, seen_again
from tagid.tags.bodies.cylinder_fit import CylinderFitter, Ringed
from tagid.tags.bodies.cylinder_patterns import ANY, Family, Paths, Patterns
from tagid.tags.bodies.hypothesis import Pose
from tagid.tags.bodies.reflectors_fit import POINTS, THROUGH, Batch, Solved
from tagid.tags.bodies.ring import Ring, peaks
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.bodies.symmetric import symmetric_left
from tagid.tags.layouts.layout import Layout

COUNT = 48
"""Angles on a ring: 7.5 degrees, 6 mm on a mug's ring."""
_WALLS, _KEPT, _KEPT_THERE, _FREE, _BEAM, _FINER = 10, 12, 6, 3, 6, 4
"""Walls beside which every number of reflectors is tried; other arrangements fitted that were found there,
of few views also of each polarisation beside metal and beside dielectrics, and with free patterns; sets
kept per number; walls between which finer ones are tried."""
FEW_VIEWS = 24
"""With fewer, walls of either polarisation may look alike: 12 lost tags on cans to the wrong one."""
OUTWARD_M = 8e-3
"""Reflectors may stand so far outside their nominal radius, on feet or foam,"""
ENOUGH = 0.05
"""which is tried where a larger share of the echo is left without."""
FAR_BEHIND = -0.5
"""What a body tells besides is not asked where the best layout leads by less: none of 24 came to lead. Those
that were named led before, or were a tenth of the reading's error behind."""
HOPEFUL, CHANCE_SIGMAS = 0.5, 3.0
"""Share of the echo that the best layout of the search must explain for all arrangements to be fitted, beside
what so many standard deviations of the noise's energy may hide: near the noise little stands out of it."""
ROUND, MOUNTED_M = 0.5, 2e-3
"""The centre of an enrolled body is that of a round one which leaves no more of its echo: mugs with handles
leave up to 0.28. It is known to 0.6 to 1.5 mm, and reflectors stand about it to within a millimetre."""
POSED_NATS = 60.0
"""The pose of an enrolled body is known where its echo explains so many noise variances: of noise alone 9
amplitudes and a pose explain some 40."""
SAME_M = 4e-3
"""Layouts whose mean radii differ by less share one table of patterns."""
_LEAST_OF_MIX = 1e-9
"""Share of a mix of dipoles that sends nothing, relative to that which sends most: keeps it finite."""


def read_on_cylinder(
    spectra: Spectra,
    layouts: Sequence[Layout],
    first: BodyReading,
    settings: BodySettings,
    family: Family = ANY,
) -> BodyReading | None:
    """The best layout beside a round wall, against every other arrangement there.

    What the body tells of the scans, how oval it is, or how unevenly an enrolled one was turned, is asked
    once more beside what its wall tells of the reflectors (`BodyModel.seen`): 0.2 mm of a cup 20 dB over its
    tag are a third of the tag's echo.

    Args:
        spectra: the scans.
        layouts: the enrolled ones; those that stand on a ring under `settings.wide_m` are read.
        first: the reading on a round body with free patterns: its centres are where the search begins.
        settings: search and priors.
        family: materials of the walls.

    Returns:
        The reading; None where no layout can stand beside such a wall, or none explains much of the echo.
    """
    found = _read(spectra, layouts, first, settings, family)
    if found is None:
        return None
    reading = found.reading
    if reading.unexplained <= ENOUGH or reading.lead < FAR_BEHIND:
        return reading
    left = reading.layouts[0].left
    seen = seen_again(reading, spectra, found.echoes(), left, settings)
    if seen is None:
        return reading
    again = _read(seen.spectra, layouts, replace(first, pose=seen.pose), settings, family)
    better = again is not None and again.reading.layouts[0].left < left
    return again.reading if again is not None and better else reading


@dataclass(frozen=True, eq=False)
class _Found:
    """A reading, and what stands beside its body.

    Attributes:
        reading: the reading.
        fitter: in its spectra.
        rows: the layout, and the best other arrangement where there is one.
    """

    reading: BodyReading
    fitter: CylinderFitter
    rows: tuple[Ringed, ...]

    def echoes(self) -> NDArray[np.complex128]:
        """(F, C, V) of the reflectors of all rows: what a body tells beside them suits neither alone."""
        return np.concatenate([self.fitter.echoes(row) for row in self.rows], axis=1)


def _read(
    spectra: Spectra,
    layouts: Sequence[Layout],
    first: BodyReading,
    settings: BodySettings,
    family: Family,
) -> _Found | None:
    """The best layout beside a wall that is round, at each radius where layouts stand and further out."""
    several = []
    for radius, group in _groups(layouts, settings):
        found = _CylinderReader(spectra, radius, 0.0, group, first, settings, family).read()
        if found is None or found.reading.unexplained > ENOUGH:
            outside = _CylinderReader(spectra, radius, OUTWARD_M, group, first, settings, family).read()
            found = _nearer(found, outside)
        if found is not None:
            several.append(found)
    return max(several, key=lambda found: found.reading.lead, default=None)


def _nearer(one: _Found | None, other: _Found | None) -> _Found | None:
    """The reading whose layout leaves less, with the lead that is left against the other's arrangements."""
    if one is None or other is None:
        return one or other
    first, second = sorted((one, other), key=lambda found: found.reading.layouts[0].left)
    return replace(first, reading=_against(first.reading, second.reading))


def _against(reading: BodyReading, elsewhere: BodyReading) -> BodyReading:
    """A reading with the lead that is left against arrangements at another radius."""
    least = elsewhere.others[0].charged if elsewhere.others else np.inf
    return replace(reading, lead=min(reading.lead, (least - reading.layouts[0].left) / reading.error))


def _groups(layouts: Sequence[Layout], settings: BodySettings) -> list[tuple[float, list[Layout]]]:
    """Layouts of nearly one radius, and that radius, m."""
    found: list[tuple[float, list[Layout]]] = []
    several = [(off_axis(layout)[0], layout) for layout in layouts]
    means = [(float(radii.mean()), layout) for radii, layout in several if len(radii) >= 2]
    for mean, layout in sorted(means, key=lambda one: one[0]):
        if mean >= settings.wide_m:
            break
        if found and mean - found[-1][0] < SAME_M:
            found[-1][1].append(layout)
        else:
            found.append((mean, [layout]))
    return found


@dataclass(frozen=True, eq=False)
class _Searched:
    """Layouts on rings beside every wall about one centre.

    Attributes:
        centre: x + jy, m.
        shells: indices of the walls.
        rings: beside each of them.
        starts: the best turns of every layout.
        share: of the echo above noise, beside that of the body, that the best of them explains.
    """

    centre: complex
    shells: tuple[int, ...]
    rings: tuple[Ring, ...]
    starts: tuple[Ringed, ...]
    share: float


def _early_m(spectra: Spectra, solved: Solved) -> float:
    """How early reflectors answer, from the mix of both dipoles that sends most of their echo, m.

    Alone each is ill determined where the wall reverses neither field, and in their sum they may cancel. The
    echo, other than its amplitude, counts frequencies by how well the noise lets them be known.
    """
    gram, dipoles = solved.gram[0, :, 1:, 1:], solved.amplitudes[0, :, 1:]
    energies, axes = np.linalg.eigh(gram.mean(axis=0))
    scales = np.sqrt(np.maximum(energies, _LEAST_OF_MIX * energies[-1]))
    # In these coordinates the energy of the echo is that of the amplitudes.
    mix = np.linalg.svd(dipoles @ axes.conj() * scales, full_matrices=False)[2][0]
    sent = (axes / scales) @ mix
    return spectra.early_m(np.einsum("i,fij,fj->f", sent.conj(), gram, dipoles))


class _CylinderReader:
    """The search at one radius of the reflectors."""

    def __init__(
        self,
        spectra: Spectra,
        radius_m: float,
        outward_m: float,
        layouts: Sequence[Layout],
        first: BodyReading,
        settings: BodySettings,
        family: Family = ANY,
    ) -> None:
        self.spectra, self.radius_m, self.outward_m = spectra, radius_m + outward_m, outward_m
        self.layouts, self.first, self.settings = layouts, first, settings
        patterns = Patterns.of(spectra, self.radius_m, family)
        self.coarse = spectra.thinned(2)
        self.coarse_patterns = patterns.thinned(2)
        self.noise = spectra.noise_energy * max(spectra.views - 3, 1) / (spectra.views - 1)
        variance = spectra.noise + settings.priors.model_error * first.body_left / spectra.data.size
        least = 1e-12 * first.energy
        known = self._known(spectra)
        expected, spread_m = self._expected(known)
        self.fitter = CylinderFitter(
            spectra, patterns, settings.body, expected, spread_m, max(variance, least), known
        )

    def _known(self, spectra: Spectra) -> NDArray[np.complex128] | None:
        """(F, V) echo of an enrolled body in its pose; None for one of revolution."""
        body, pose = self.first.body, self.first.pose
        if not body.turns:
            return None
        echo = body.echo(spectra, np.array([pose.centre]), np.array([pose.turn_rad]))
        return np.asarray(echo[0])

    def _expected(self, known: NDArray[np.complex128] | None) -> tuple[complex, float]:
        """Where wall and reflectors have their centre, x + jy, and its standard deviation, m.

        The origin of an enrolled body is the rotation axis of its first capture. Its wall is round about
        another point, about which its reflectors stand.
        """
        if known is None:
            return 0j, self.settings.priors.centre_m
        first = self.first
        if first.energy - first.body_left < min(first.tag, POSED_NATS * first.variance):
            # The pose of a body that noise and its tag hide may be that of either.
            return 0j, self.settings.priors.centre_m
        round_one = self.settings.body.middle(self.spectra, known, first.pose.centre)
        if round_one.left > ROUND:
            return first.pose.centre, max(first.body.slack_m, MOUNTED_M)
        return round_one.pose.centre, MOUNTED_M

    def read(self) -> _Found | None:
        """Search, fit and compare; None where the search leaves a layout no hope."""
        searched = [self._layouts_about(centre) for centre in self._centres()]
        if max(one.share for one in searched) < HOPEFUL:
            return None
        starts = [start for one in searched for start in (*one.starts, *self._others_about(one))]
        kept = self._kept(starts)
        rows = self.fitter.fitted([*kept, *self._found_freely(kept[0])], 3)
        rows = self.fitter.fitted([self.fitter.beside_other_walls(row) for row in rows], 3)
        rows = self._beside_finer_walls(rows)
        own: dict[str, Ringed] = {}
        for row in rows:
            if row.layout is not None and (row.layout not in own or row.left < own[row.layout].left):
                own[row.layout] = row
        ranked = sorted(own.values(), key=lambda row: row.left)
        free = self.fitter.fitted([replace(ranked[0], layout=None)], 3)
        return self._compared(ranked, [*free, *(row for row in rows if row.layout is None)])

    def _beside_finer_walls(self, rows: list[Ringed]) -> list[Ringed]:
        """Every arrangement beside the best wall between those that explain the echo best."""
        ranked = sorted(rows, key=lambda row: row.left)
        walls = list(dict.fromkeys(row.shell for row in ranked))[:_FINER]
        finer = self.fitter.patterns.finer(self.spectra, walls)
        at = {wall: finer.shells.index(self.fitter.patterns.shells[wall]) for wall in walls}
        self.fitter = replace(self.fitter, patterns=finer)
        begun = [replace(row, shell=at.get(row.shell, at[walls[0]])) for row in rows]
        return self.fitter.fitted([self.fitter.beside_other_walls(row) for row in begun], 3)

    def _centres(self) -> list[complex]:
        """Where body and reflectors may stand, as the body and the free patterns tell."""
        first, fitter = self.first, self.fitter
        centres = [first.pose.centre if fitter.known is None else fitter.expected]
        other = first.layouts[0].centre
        return centres if abs(other - centres[0]) < 3e-3 else [*centres, other]

    def _layouts_about(self, centre: complex) -> _Searched:
        """Layouts beside every wall about a centre."""
        shells = self._coarse_shells()
        rings = self._rings(np.array(shells), centre)
        starts = [
            start
            for shell, ring in zip(shells, rings, strict=True)
            for layout in self.layouts
            for start in self._turned(layout, ring, shell, centre)
        ]
        energy = rings[0].energy
        noise = self.noise * len(self.coarse.wavenumbers) / len(self.spectra.wavenumbers)
        least = min(start.left for start in starts) - CHANCE_SIGMAS * sqrt(noise * self.spectra.noise)
        share = 1 - max(least - noise, 0.0) / max(energy - noise, 1e-30)
        return _Searched(centre, tuple(shells), tuple(rings), tuple(starts), share)

    def _others_about(self, searched: _Searched) -> list[Ringed]:
        """Pairs beside every wall, and beside the best walls every arrangement."""
        pairs = [ring.best(2, _BEAM) for ring in searched.rings]
        least = [ring.energy - float(some[2][1][0]) for ring, some in zip(searched.rings, pairs, strict=True)]
        found: list[Ringed] = []
        for i, shell in enumerate(searched.shells):
            found += self._starts(pairs[i], searched.rings[i], shell, searched.centre)
            least[i] = min([least[i], *(start.left for start in searched.starts if start.shell == shell)])
        for i in np.argsort(least)[:_WALLS]:
            ring = searched.rings[int(i)]
            every = ring.best(self.settings.most, _BEAM)
            found += self._starts(every, ring, searched.shells[int(i)], searched.centre)
        return found

    def _coarse_shells(self) -> list[int]:
        """Every second size of body, and of several permittivities: the others follow in the fit."""
        shells = self.fitter.patterns.shells
        sizes = sorted({one.radius_m for one in shells})[::2]
        walls = sorted({one.permittivity for one in shells if not one.metal})
        walls = walls[1::2] or walls
        return [
            i
            for i, one in enumerate(shells)
            if one.radius_m in sizes and (one.metal or one.permittivity in walls)
        ]

    def _rings(self, shells: NDArray[np.intp], centre: complex) -> list[Ring]:
        """Reflectors all around a centre, beside each of some walls."""
        angles = 2 * np.pi * np.arange(COUNT) / COUNT
        echo = self._known(self.coarse)
        if echo is None:
            echo = self.first.body.echo(self.coarse, np.array([centre]), np.zeros(1))[0]
        one = np.ones((1, COUNT))
        paths = Paths.of(self.coarse, np.array([centre]), self.radius_m * one, angles[None], 0 * one)
        return [
            Ring.from_columns(
                self.coarse.data,
                centred(self.coarse_patterns.columns(paths, np.array([shell]), 1)[0, 0]),
                echo,
                self.radius_m,
                POINTS,
                angles,
            )
            for shell in shells
        ]

    def _turned(self, layout: Layout, ring: Ring, shell: int, centre: complex) -> list[Ringed]:
        """The best turns of a layout on a ring."""
        radii, angles, heights = off_axis(layout)
        value = ring.explained(turned_on(angles, COUNT))
        return [
            Ringed(
                shell,
                centre,
                0.0,
                angles + 2 * np.pi / COUNT * i,
                radii + self.outward_m,
                heights,
                layout.name,
                ring.energy - float(value[i]),
            )
            for i in peaks(value, 2)
        ]

    def _starts(
        self,
        sets: dict[int, tuple[NDArray[np.intp], NDArray[np.float64]]],
        ring: Ring,
        shell: int,
        centre: complex,
    ) -> list[Ringed]:
        """Arrangements found on a ring."""
        return [
            Ringed(
                shell,
                centre,
                0.0,
                ring.angles[indices],
                np.full(len(indices), self.radius_m),
                np.zeros(len(indices)),
                None,
                ring.energy - float(value),
            )
            for some, values in sets.values()
            for indices, value in zip(some, values, strict=True)
        ]

    def _kept(self, starts: list[Ringed]) -> list[Ringed]:
        """The best two starts of every layout, and the best of each of some kinds of other arrangements.

        Of few views also some beside metal and beside dielectrics in both polarisations. The fit moves a
        start to other walls, but not to the other polarisation, and seldom from metal to a dielectric. More
        views tell these apart, and more starts only fit more of the noise.
        """
        few = self.spectra.views < FEW_VIEWS
        kept: list[Ringed] = []
        turns: Counter[str] = Counter()
        named: set[tuple[str, str, bool]] = set()
        kinds: set[tuple[int, ...]] = set()
        there: dict[tuple[str, bool], set[tuple[int, ...]]] = {}
        for start in sorted(starts, key=lambda one: one.left):
            if start.layout is None and not few and len(kinds) == _KEPT:
                continue
            wall = self.fitter.patterns.shells[start.shell]
            of = wall.polarisation, wall.metal
            if start.layout is not None:
                turns[start.layout] += 1
                new = turns[start.layout] <= 2 or (few and (start.layout, *of) not in named)
                named.add((start.layout, *of))
            else:
                kind, seen = kind_of([float(a) for a in start.angles]), there.setdefault(of, set())
                first = kind not in kinds and len(kinds) < _KEPT
                new = first or (few and kind not in seen and len(seen) < _KEPT_THERE)
                if new:
                    kinds.add(kind)
                    seen.add(kind)
            if new:
                kept.append(start)
        return kept

    def _found_freely(self, best: Ringed) -> list[Ringed]:
        """Arrangements that explain the echo with free patterns, where the search on the ring may miss them.

        Args:
            best: of the search; they begin beside the wall of its polarisation that suits them.
        """
        found: dict[tuple[int, ...], Ringed] = {}
        for placed in self.first.others:
            angles = placed.angles
            kind = kind_of([float(a) for a in angles])
            if placed.layout is None and kind not in found and len(found) < _FREE:
                radii, heights = np.full(len(angles), self.radius_m), np.zeros(len(angles))
                start = Ringed(best.shell, placed.centre, 0.0, angles, radii, heights, None)
                found[kind] = self.fitter.beside_other_walls(start)
        return list(found.values())

    def _compared(self, ranked: list[Ringed], free: list[Ringed]) -> _Found:
        """The best layout against all that is not it."""
        settings, spectra, first = self.settings, self.spectra, self.first
        best = ranked[0]
        layout = next(one for one in self.layouts if one.name == best.layout)
        wanted = layout_gaps_deg(layout)
        resolution = resolution_deg(self.radius_m)

        def away(row: Ringed) -> float:
            return apart_deg(row.angles, wanted, resolution)

        rivals = [
            row for row in free if away(row) > settings.other_deg and can_stand(row.angles, self.radius_m)
        ]
        others = [self._placed(row, row.left + spectra.angle_cost * (len(row.angles) - 1)) for row in rivals]
        layouts = [self._placed(row, row.left) for row in ranked]
        every = sorted([*others, *layouts[1:]], key=lambda p: p.charged)
        own = min(
            (row for row in free if away(row) <= settings.other_deg), key=lambda r: r.left, default=None
        )
        tag = max(first.body_left - best.left, 1e-30)
        above = max(best.left - self.noise, 0.0)
        next_left = every[0].charged if every else first.body_left
        error = settings.error(spectra, above, tag)
        lead = (next_left - best.left) / error
        rough = error + (settings.simple_error - settings.priors.model_error) * tag
        untagged = np.inf
        if lead > 0 and layout.symmetry > 1 and not first.body.turns:
            hints = (best.centre, first.pose.centre)
            alone = symmetric_left(spectra, layout.symmetry, 3, hints)
            untagged = (alone - best.left) / rough
        solved = self.fitter.solved([best])
        body, wall = solved.amplitudes[0, :, 0], self.fitter.patterns.shells[best.shell]
        echo = centred(self.fitter.body_echo(np.array([best.centre]))[0])
        reading = BodyReading(
            body=first.body,
            pose=self._pose(best.centre),
            spectra=spectra,
            views=spectra.views,
            energy=spectra.energy,
            noise=self.noise,
            variance=spectra.noise,
            body_left=first.body_left,
            layouts=tuple(layouts),
            others=tuple(every),
            free=self._placed(own, own.left) if own is not None else None,
            tag=tag,
            unexplained=above / tag,
            lead=min(lead, untagged),
            untagged_lead=untagged,
            error=error,
            rough=rough,
            angle_off_deg=away(own) if own is not None else 180.0,
            radius_off_m=0.0,
            tag_nats=tag / max(spectra.noise, 1e-30),
            early_m=_early_m(spectra, solved),
            through=not wall.metal,
            front_m=spectra.early_m(body),
            body_energy=float((np.abs(body[:, None] * echo) ** 2).sum()),
            wall=wall,
        )
        nearest = sorted(rivals, key=lambda row: row.left)[:1]
        return _Found(reading, self.fitter, (best, *nearest))

    def _pose(self, centre: complex) -> Pose:
        """Of the body below reflectors about a centre."""
        return self.first.pose if self.first.body.turns else Pose((centre.real, centre.imag))

    def _placed(self, row: Ringed, charged: float) -> Placed:
        """An arrangement beside a wall as one with a free pattern, as which pictures subtract its body."""
        ring, pose = (row.centre.real, row.centre.imag), self._pose(row.centre)
        at = np.array([[*ring, row.offset_m + self.outward_m, *pose.centre_m, pose.turn_rad, *row.angles]])
        batch = Batch.at_rest(at, row.radii - self.outward_m, row.heights, THROUGH)
        return Placed(batch, row.left, charged, row.layout)
