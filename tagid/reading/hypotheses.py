"""What is tried, and in which order: bodies, transfers, arrangements and odd scatterers.

Every hypothesis ends as a `Hypothesis` with its log evidence; `decision` compares them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np

from tagid.reading import search, sheet_tags
from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import APART_M, PLANE_SD_M, RING_M, Model, Priors
from tagid.reading.descent import FAR_M, TAG, Found, Powers, best_powers, refined
from tagid.reading.hypothesis import (
    Arranged,
    Candidate,
    Hypothesis,
    Stand,
    as_layouts,
    bodies_apart,
    disc_of,
    distinct,
    middle_of,
    same_place,
    unlike,
)
from tagid.reading.odd import OddMap
from tagid.reading.remainder import anywhere
from tagid.reading.resized import resized
from tagid.reading.sheet import KINDS, Kind, SheetModel
from tagid.reading.signature import EnrolledBody, SignatureModel
from tagid.reading.signature_search import Poses, altered
from tagid.reading.smooth import smoothed
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE, FACING, POINTS
from tagid.reading.transfers.rod import RODS
from tagid.reading.transfers.shade import SHADES
from tagid.reading.transfers.transfer import Transfer
from tagid.reading.transfers.wall import WALLS
from tagid.reading.uneven import straightened
from tagid.tags.layouts.layout import Layout
from tagid.types import Floats

TRANSFERS: tuple[Transfer, ...] = (BARE, POINTS, *WALLS, *RODS, *SHADES)
SEARCHED = frozenset((BARE, POINTS, *WALLS[:4], RODS[0], SHADES[1]))
"""Behind which arrangements are looked for; what is found is tried behind the others, too."""
MOST_ODD, MOST_ODD_UNTAGGED = 2, 5
"""Odd scatterers beside a tag, and where there is none."""
MOST_REFLECTORS = 5
"""Reflectors of an arrangement that is not enrolled."""
FREE_RINGS_M = (0.028, 0.036, 0.045, 0.054, 0.063, 0.072, 0.082, 0.09, 0.1, 0.11)
"""Radii of rings on which an arrangement that is not enrolled is looked for."""
FIRST, THEN = 16, 8
"""Starts that are refined under much clutter, and those of them that are refined wholly."""
GRID_M = tuple(complex(x, y) for x in 4e-3 * np.arange(-2, 3) for y in 4e-3 * np.arange(-2, 3))
"""Centres that are tried, x + jy."""
SHAPES_M = tuple(r * np.exp(1j * np.pi / 3 * np.arange(6)) for r in (4e-3, 8e-3, 12e-3))
"""Two-fold parts of a body's support function that are tried, m."""
BODIES_M = (*((c, 0j) for c in GRID_M), *((0j, complex(s)) for ring in SHAPES_M for s in ring))
"""Centres and shapes of a body that are tried."""
STRAYS_M = (-9e-3, -4.5e-3, 0.0, 4.5e-3, 9e-3)
"""A wall moves the apparent radius of a ring by about so much, m."""
ELSEWHERE_M = 3e-3
"""Reflectors are looked for again where a loud tag has hidden that the centre is farther off than this, m."""
RESIZED = 3
"""Layouts that are tried at other distances from the centre, and starts of each."""
BESIDE = 3
"""Bodies beside which the best pose of every arrangement is refined."""
LOST = 0.01
"""Share of the tags that have lost a reflector."""
MOST_ALTERED = 3
"""Reflectors less or more than those of an enrolled object."""
RAISED = 1e-4
"""Share of the tags that have an enrolled plan and other heights: a plan is one by chance as rarely."""
RAISED_M = (-0.06, 0.0, 0.06)
"""Heights over the enrolled ones that are tried, m."""
HIDDEN_RAD = tuple(np.deg2rad([90.0, 120.0, 150.0]))
"""Widths of hidden sectors."""
GUESTS, POSES, STANDS = 3, 3, 2
"""Arrangements beside which an enrolled body is looked for, its poses that are refined, and poses of any
enrolled bodies about which reflectors are looked for closely."""
_NEAR_M = tuple(2e-3 * np.exp(1j * np.pi / 3 * np.arange(6)))
"""Steps from a body's centre at which tags are looked for, too."""
_KNOWN_M = 1.5e-3
"""A body's centre is known well enough for the search where its standard deviation is below."""


@dataclass(eq=False)
class Contest:
    """Hypotheses of one recording and what they share."""

    spectra: Spectra
    layouts: Sequence[Layout]
    transfers: Sequence[Transfer] = TRANSFERS
    sheets: Sequence[Kind] = KINDS
    enrolled: Sequence[EnrolledBody] = ()
    priors: Priors = field(default_factory=Priors)
    most_odd: int = MOST_ODD
    most_reflectors: int = MOST_REFLECTORS
    hypotheses: list[Hypothesis] = field(default_factory=list, init=False)
    _centres: list[complex] = field(default_factory=list, init=False)
    _tried: set[Found] = field(default_factory=set, init=False)
    _rough: list[Hypothesis] = field(default_factory=list, init=False)
    _planes: list[float] = field(init=False)

    def __post_init__(self) -> None:
        self._planes = self.spectra.rises(2 * PLANE_SD_M).tolist()

    @cached_property
    def _odd(self) -> OddMap:
        return OddMap(self.spectra)

    def add(
        self, layout: Layout | None, found: Found, middle: bool = False, prior: float = 0.0
    ) -> Hypothesis:
        """Enter a hypothesis."""
        alike = np.log(layout.symmetry) if layout is not None else 0.0
        one = Hypothesis(layout, found, found.log_z + float(alike) + prior, middle, prior)
        self.hypotheses.append(one)
        return one

    def run(self) -> list[Hypothesis]:
        """All hypotheses, the best first, at the stated angles or at those that explain more."""
        self._explore()
        best = max(hypothesis.found.log_z for hypothesis in self.hypotheses)
        # An enrolled body has an uneven turn of its own.
        others = [
            hypothesis.found
            for hypothesis in self.hypotheses
            if not isinstance(hypothesis.found.model, SignatureModel)
        ]
        turned = straightened(self.spectra, others, best)
        if turned is not None:
            other = replace(self, spectra=turned.spectra)
            other._explore()
            if max(hypothesis.found.log_z for hypothesis in other.hypotheses) - turned.cost > best:
                vars(self).update(vars(other))
        self.hypotheses = smoothed(self.spectra, self.hypotheses)
        return self.hypotheses

    def _explore(self) -> None:
        bodies = self._untagged()
        body = max(bodies, key=lambda one: one.log_z).found
        centres = [body.centre, *GRID_M]
        # A loud tag moves the centre that a body alone seems to have.
        near = distinct([body.centre, *self._centres, *(body.centre + step for step in _NEAR_M)], 1e-3)
        powers = [replace(body.found.powers, clutter=max(body.found.powers.clutter, 1e-3)) for body in bodies]
        shapes = [body.found.x[2:4] for body in bodies]
        known = body.centre_sd_m < _KNOWN_M
        self._look(centres, near if known else centres, powers, shapes, GRID_M[::2])
        self._beside_others(shapes)
        best = max(self.hypotheses, key=lambda one: one.log_z).found
        if known and min(abs(best.centre - one) for one in near) > ELSEWHERE_M:
            clear = replace(best.powers, clutter=max(best.powers.clutter, 1e-3))
            self._look([best.centre], [best.centre], [clear] * 2, [np.zeros(2)] * 2)
        self._resized()
        self._beside_enrolled()
        self._as_enrolled()
        self._hidden()
        self._one_less()
        self._beside_odd()
        self._anywhere()
        if self.sheets:
            self._sheets()
        self._about_own_middle()
        self._as_enrolled()
        self._as_free()
        self._raised()
        self._one_more()
        self._by_hand()
        self._unbound()

    @property
    def _searched(self) -> Sequence[Transfer]:
        return [transfer for transfer in self.transfers if transfer in SEARCHED] or self.transfers

    def _look(
        self,
        open_centres: Sequence[complex],
        centres: Sequence[complex],
        powers: Sequence[Powers],
        shapes: Sequence[Floats],
        others: Sequence[complex] = (),
    ) -> None:
        """Reflectors in the open and beside bodies about centres, and beside round ones about others."""
        starts: list[Candidate] = []
        for transfer in self._searched:
            model = Model(transfer, None, transfer.body, 0, levels=self.spectra.levels, priors=self.priors)
            some = centres if transfer.body else open_centres
            starts += self._starts(model, some, powers, shapes, others, wide=2)
            if transfer.body and len(self._planes) > 2:
                # Waves that pass tell the height of the plane well enough for what a body does to them.
                best = max((start for start in starts if start.model.lifts), key=lambda one: one.log)
                self._planes = list(dict.fromkeys([0.0, float(best.x[-1])]))
        self._refine(starts, powers)

    def _resized(self) -> None:
        """The best layouts at other distances from the centre."""
        layouts: dict[Layout | None, Hypothesis] = {}
        for one in self._best(9, enrolled=True):
            layouts.setdefault(one.layout, one)
        for layout in list(layouts.values())[:RESIZED]:
            starts = resized(self.spectra, self._searched, FREE_RINGS_M, layout)
            for start in sorted(starts, key=lambda start: -start.log)[:RESIZED]:
                self.grow(self._placed(None, start.model, start.x), self.most_odd)

    def _refine(self, starts: list[Candidate], powers: Sequence[Powers]) -> None:
        """The best starts of every kind under the clutter that a body leaves; the best of those wholly."""
        for enrolled in (True, False):
            self._refined([start for start in starts if (start.layout is not None) == enrolled], powers)

    def _refined(self, starts: list[Candidate], powers: Sequence[Powers]) -> None:
        ranked = sorted(starts, key=lambda one: -one.log)
        kinds: dict[tuple[str, str, int], Candidate] = {}
        for one in ranked:
            name = "" if one.layout is None else one.layout.name
            count = 0 if one.model.tag is None else one.model.tag.count
            kinds.setdefault((one.model.transfer.name, name, count), one)
        starts = list(dict.fromkeys([*ranked[:FIRST], *kinds.values()]))
        near: list[tuple[float, int, Found]] = []
        for start in starts:
            found = refined(
                self.spectra, start.model, start.x, (min(powers[start.model.disc].clutter, 1e-2),), 4
            )
            near.append((found.log_z, len(near), found))
            self._rough.append(Hypothesis(start.layout, found, found.log_z, start.middle))
        near.sort(key=lambda one: -one[0])
        done: list[tuple[Layout | None, Found]] = []
        for _, i, rough in near:
            if len(done) == THEN:
                break
            layout = starts[i].layout
            if any(layout is other and same_place(rough, there) for other, there in done):
                continue
            found = refined(self.spectra, rough.model, rough.x, (1e-3, None))
            done.append((layout, found))
            self.add(layout, found, starts[i].middle)

    def _beside_others(self, shapes: Sequence[Floats]) -> None:
        """The best pose of every layout, and of free arrangements of every number, beside all bodies."""
        best: dict[tuple[str, int], Hypothesis] = {}
        for one in sorted(self.hypotheses, key=lambda one: -one.log_z):
            if one.found.model.tag is not None:
                name = "" if one.layout is None else one.layout.name
                best.setdefault((name, 0 if name else one.found.model.tag.count), one)
        for one in best.values():
            found, model = one.found, one.found.model
            assert model.tag is not None
            starts = []
            for transfer in (*self.transfers, FACING):
                own, tag, middle = replace(model, transfer=transfer, oval=transfer.body), model.tag, False
                if one.layout is not None:
                    arranged = Arranged.of(one.layout, own.covers_middle)
                    tag, middle = arranged.tag, arranged.middle
                own = replace(own, tag=tag)
                shape = found.x[2:4] if model.shapes else shapes[model.disc]
                x = np.r_[found.x[:2], shape[: own.shapes], found.x[model.head :]]
                outward = np.zeros(len(x))
                outward[own.head + tag.turns :][: tag.stretches] = 1.0
                radii = [x + stray * outward for stray in (STRAYS_M if one.layout is None else (0.0,))]
                values = [best_powers(self.spectra, own, there, found.powers.clutter)[1] for there in radii]
                likeliest = int(np.argmax(values))
                starts.append((values[likeliest], own, radii[likeliest], middle))
            starts.sort(key=lambda one: -one[0])
            for _, own, x, middle in starts[:BESIDE]:
                again = refined(self.spectra, own, x, (1e-3, None))
                tried = [other.found for other in self.hypotheses if other.layout is one.layout]
                if not any(same_place(again, other) and other.model.disc == own.disc for other in tried):
                    self.add(one.layout, again, middle)

    def _as_enrolled(self) -> None:
        """Layouts where points of the best hypotheses stand that are about theirs."""
        for one in self._best(6, enrolled=False):
            if one.found in self._tried:
                continue
            self._tried.add(one.found)
            for layout, model, x, middle in as_layouts(one.found, self.layouts, self.most_odd):
                best = self.add(layout, refined(self.spectra, model, x, (1e-2, None)), middle)
                self.grow(best, self.most_odd - model.odd)

    def _as_free(self) -> None:
        """Free arrangements where the best layouts stand, about the body's own centre."""
        for one in self._best(3, enrolled=True):
            model, found = one.found.model, one.found
            if not model.transfer.body:
                continue
            head = found.x[: model.head].copy()
            if model.about.start:
                head[model.about] = 0.0
            own = replace(model, tag=Arrangement.about(found.places - complex(found.x[0], found.x[1])), odd=0)
            best = refined(self.spectra, own, np.r_[head, np.zeros(own.parameters - model.head)], (None,), 8)
            self.grow(self.add(None, best), self.most_odd)

    def _hidden(self) -> None:
        """The best bare tags, not seen from a sector of directions: behind a post or a hand."""
        for enrolled in (True, False):
            # A tag that is hidden from a third of the views is a poor one before the sector is known.
            bare = [one for one in self._rough if one.found.model.transfer is BARE]
            bare = [one for one in bare if (one.layout is not None) == enrolled]
            for one in sorted(bare, key=lambda one: -one.log_z)[:2]:
                starts = 2 * np.pi * np.arange(12) / 12
                sectors = [replace(one.found.model, hidden=(s, w)) for s in starts for w in HIDDEN_RAD]
                logs = [best_powers(self.spectra, model, one.found.x, 1e-2)[1] for model in sectors]
                model = sectors[int(np.argmax(logs))]
                self.add(one.layout, refined(self.spectra, model, one.found.x, (1e-2, None)), one.middle)

    def _one_less(self) -> None:
        """The best layouts without one of their reflectors, which then is missing or was never there."""
        for one in self._best(3, enrolled=True):
            tag, found = one.found.model.tag, one.found
            if tag is None or tag.count < 2:
                continue
            for k in range(tag.count):
                model = replace(found.model, tag=tag.of(np.delete(np.arange(tag.count), k)))
                prior = float(np.log(LOST / tag.count))
                self.add(None, refined(self.spectra, model, found.x, (None,)), prior=prior)

    def _raised(self) -> None:
        """The best layouts' plans with any heights, where heights are in question."""
        if self.spectra.levels == 1 and not any(
            Arrangement.of_layout(layout.positions, layout.heights).tall for layout in self.layouts
        ):
            return
        for one in self._best(3, enrolled=True):
            model, found = one.found.model, one.found
            if model.tag is None or isinstance(model, SheetModel):
                continue
            tag = model.tag.raised()
            own = replace(model, tag=tag, odd=0)
            first = model.head + model.tag.turns + model.tag.stretches
            heights = model.heights_of(found.x)[0] - tag.height_m
            rises = list(product(RAISED_M, repeat=tag.count))
            starts = [np.append(found.x[:first], heights + rise) for rise in rises]
            logs = [best_powers(self.spectra, own, x, 1e-2)[1] for x in starts]
            for i in np.argsort(logs)[::-1][:2]:
                best = refined(self.spectra, own, starts[i], (1e-2, None))
                self.grow(self.add(None, best, one.middle, float(np.log(RAISED))), self.most_odd)

    def _untagged(self) -> list[Hypothesis]:
        """Nothing, and a round body, with clutter of either disc."""
        levels = self.spectra.levels
        model = Model(POINTS, None, True, 0, levels=levels, priors=self.priors)
        starts = [np.array([c.real, c.imag, s.real, s.imag]) for c, s in BODIES_M]
        values = [best_powers(self.spectra, model, x, 1e-2)[1] for x in starts]
        order = np.argsort(values)[::-1][:2]
        bodies = []
        for disc in (0, 1):
            of_disc = replace(model, disc=disc)
            found = [refined(self.spectra, of_disc, starts[i], (1e-2, None), 12) for i in order]
            self._centres += [one.centre for one in found]
            bodies.append(self.add(None, max(found, key=lambda one: one.log_z)))
        for disc in (0, 1):
            model = Model(BARE, None, False, disc, levels=levels, priors=self.priors)
            self.add(None, refined(self.spectra, model, np.zeros(2), (None,), 1))
        return bodies

    def _starts(
        self,
        model: Model,
        centres: Sequence[complex],
        powers: Sequence[Powers],
        shapes: Sequence[Floats] = (np.zeros(2), np.zeros(2)),
        others: Sequence[complex] = (),
        stand: Stand | None = None,
        wide: int = 0,
    ) -> list[Candidate]:
        """Layouts at their best turns, and free arrangements, by tables of single reflectors.

        Args:
            model: without reflectors.
            others: centres of bodies that are supposed round: a tag that is seen in part looks like an oval
                body about another centre.
            stand: an enrolled body in its pose.
            wide: centres and rings of free arrangements.
        """
        arranged = [Arranged.of(layout, model.covers_middle) for layout in self.layouts]
        candidates: list[Candidate] = []
        for disc in (0, 1):
            model, shape = replace(model, disc=disc), shapes[disc]
            bodies = [(c, shape[: model.shapes]) for c in centres]
            bodies += [(c, np.zeros(2)) for c in others if model.shapes]
            places = [c for c, _ in bodies]
            heads = [np.array([c.real, c.imag, *s]) if stand is None else stand.head(c) for c, s in bodies]
            echoes = [self.spectra.data if stand is None else stand.echo] * len(bodies)
            if stand is None and model.transfer.body:
                echoes = [model.at(self.spectra, x, slopes=False).values[:, 0] for x in heads]
            echo = np.stack(echoes)
            own = list(product([one for one in arranged if disc_of(one.radius_m) == disc], self._planes))
            tagged = [replace(model, tag=one.tag) for one, _ in own]
            about = np.full(len(places), -np.inf)
            enrolled: dict[str, list[Candidate]] = {one.layout.name: [] for one, _ in own}
            groups = [one.group(rise) for one, rise in own]
            tables = search.tables(self.spectra, model, places, groups, powers[disc], echo) if own else []
            for i, (before, table) in enumerate(zip(heads, tables, strict=False)):
                for (one, rise), with_tag, starts in zip(own, tagged, search.turned(table, 2), strict=True):
                    for s in starts:
                        x = np.concatenate([before, [s.angles[0], 0.0], [rise] * with_tag.lifts])
                        some = enrolled[one.layout.name]
                        some.append(Candidate(s.log, one.layout, with_tag, x, one.middle))
                        about[i] = max(about[i], s.log)
            for some in enrolled.values():
                candidates += unlike(some, 2)
            free = list(product([r for r in FREE_RINGS_M if disc_of(r) == disc], self._planes))
            groups = [((r, 0.0, z),) for r, z in free]
            apart = [2 * float(np.arcsin(APART_M / 2 / r)) for r, _ in free]
            for k in np.argsort(-about, kind="stable")[:wide]:
                here = [places[k]], groups, powers[disc], echo[k : k + 1], search.COARSE_RAD
                (all_rings,) = search.tables(self.spectra, model, *here)
                rings = all_rings.each
                pairs = [search.free(t, a, 2, 1)[-1].log for t, a in zip(rings, apart, strict=True)]
                for i in np.argsort(pairs)[::-1][:wide]:
                    for s in search.free(rings[i], apart[i], self.most_reflectors, 2):
                        tag = Arrangement.ring(free[i][0], np.array(s.angles))
                        on_ring = replace(model, tag=tag)
                        lifts = [free[i][1]] * on_ring.lifts
                        x = np.concatenate([heads[k], np.zeros(tag.turns + tag.stretches), lifts])
                        candidates.append(Candidate(s.log, None, on_ring, x, False))
        return candidates

    def _beside_enrolled(self) -> None:
        """Enrolled bodies and objects: alone, beside what the points have shown, and with any reflectors."""
        guests = self._guests()
        stands: list[Stand] = []
        for body in self.enrolled:
            disc = disc_of(body.signature.radius_m)
            alone = SignatureModel.of(body, POINTS, disc, self.spectra.levels, self.priors)
            poses = Poses(self.spectra, body, alone.disc)
            starts = [np.r_[one.head, 0.0, 0.0] for one in poses.best(POSES)]
            if alone.whole:
                rough = [refined(self.spectra, alone, x) for x in starts]
                alone = alone.levelled(self.spectra, max(rough, key=lambda one: one.log_z).x)
                starts = [one.x for one in rough]
            own = [self._placed(None, alone, x) for x in starts]
            best = max(own, key=lambda one: one.log_z)
            self._placed(None, replace(alone, disc=1 - alone.disc), best.found.x)
            if alone.whole:
                self._altered(alone, best.found)
                continue
            for guest in guests:
                (pose,) = poses.best(1, guest.found.beside(self.spectra))
                own.append(self._placed(guest.layout, *alone.with_guest(guest.found, pose.head)))
            stands += [Stand.of(self.spectra, found) for found in bodies_apart(own)]
        if not stands:
            return
        likely = [max((one.log for one in some), default=-np.inf) for some in self._about(stands, ())]
        stands = [stands[i] for i in np.argsort(likely)[::-1][:STANDS]]
        self._refine([one for some in self._about(stands, _NEAR_M) for one in some], [stands[0].powers] * 2)

    def _altered(self, alone: SignatureModel, found: Found) -> None:
        """An enrolled object with reflectors less or more: then it is another one."""
        models = [
            (radius, replace(alone, transfer=transfer, disc=disc_of(radius)))
            for transfer, radius in product(self.transfers, FREE_RINGS_M)
            if transfer.body
        ]
        powers = Powers(1e-2, found.powers.body)
        for model, x in altered(self.spectra, models, found.x, powers, MOST_ALTERED):
            again = refined(self.spectra, model, x, (1e-2, None))
            self.add(None, again, prior=float(np.log(LOST / len(TAG))))

    def _about(self, stands: Sequence[Stand], near: Sequence[complex]) -> list[list[Candidate]]:
        """Reflectors beside enrolled bodies in their poses, about centres near theirs, if any are given."""
        found: list[list[Candidate]] = [[] for _ in stands]
        for transfer in self.transfers:
            for stand, starts in zip(stands, found, strict=True):
                if transfer.body:
                    model = SignatureModel.of(stand.body, transfer, 0, self.spectra.levels, self.priors)
                    centres = distinct([*stand.centres, *(stand.centres[-1] + 2 * one for one in near)], 1e-3)
                    starts += self._starts(
                        model, centres, [stand.powers] * 2, stand=stand, wide=1 if near else 0
                    )
        return found

    def _placed(self, layout: Layout | None, model: Model, x: Floats) -> Hypothesis:
        return self.add(layout, refined(self.spectra, model, x, (1e-2, None)))

    def _guests(self) -> list[Hypothesis]:
        """The best layouts, and the best free arrangement."""
        out: list[Hypothesis] = []
        for one in sorted(self.hypotheses, key=lambda one: -one.log_z):
            if one.tagged and all(one.layout is not other.layout for other in out):
                out.append(one)
        return out[:GUESTS]

    def _best(self, count: int, *, enrolled: bool) -> list[Hypothesis]:
        """The best hypotheses with reflectors, of layouts or of arrangements that are not enrolled."""
        some = [
            hypothesis
            for hypothesis in self.hypotheses
            if hypothesis.found.model.tag and not hypothesis.found.model.whole
        ]
        some = [one for one in some if (one.layout is not None) == enrolled]
        return sorted(some, key=lambda one: -one.log_z)[:count]

    def _untagged_best(self, count: int) -> list[Hypothesis]:
        some = [hypothesis for hypothesis in self.hypotheses if hypothesis.found.model.tag is None]
        return sorted(some, key=lambda one: -one.log_z)[:count]

    def _sheets(self) -> None:
        """Thin sheets, alone, beside what the points have shown, and with all that their tables show."""

        def enter(layout: Layout | None, found: Found, odd: int) -> Found:
            return self.grow(self.add(layout, found), odd).found

        sheet_tags.explain(
            self.spectra, self.layouts, self.sheets, tuple(self.hypotheses), enter, self.priors
        )

    def _beside_odd(self) -> None:
        """The best of every kind beside odd scatterers, added while they pay."""
        kinds: tuple[tuple[list[Hypothesis], int], ...] = (
            (self._untagged_best(6), MOST_ODD_UNTAGGED),
            (self._best(5, enrolled=True), self.most_odd),
            (self._best(9, enrolled=False), self.most_odd),
        )
        for some, most in kinds:
            for one in some:
                self.grow(one, most)

    def _anywhere(self) -> None:
        """Alike reflectors on no ring, in the open or before a body, and beside what is loudest."""
        for rough in anywhere(self.spectra, self.hypotheses, self._planes[-1], self.most_reflectors):
            best = self.add(None, refined(self.spectra, rough.model, rough.x, (None,)))
            self.grow(best, self.most_odd - rough.model.odd)

    def grow(self, one: Hypothesis, most: int) -> Hypothesis:
        """The best of a hypothesis beside up to so many odd scatterers, added while they pay."""
        best = self._grown(one, most)
        if any(best.found.model.faced[one.found.model.odd :]):
            # A face that pays most at first may stand where several points pay more.
            best = max(best, self._grown(one, most, faces=False), key=lambda one: one.log_z)
        return best

    def _grown(self, one: Hypothesis, most: int, *, faces: bool = True) -> Hypothesis:
        for _ in range(most):
            some = [
                refined(
                    self.spectra, one.found.model.and_odd(face), np.append(one.found.x, place), (None,), 8
                )
                for place, face in self._odd.likeliest(one.found, faces=faces)
            ]
            found = max(some, key=lambda found: found.log_z, default=one.found)
            if found.log_z < one.found.log_z + 1:
                break
            other = found.model.identity != one.found.model.identity
            # An odd scatterer is all that tells another object from the enrolled one.
            one = self.add(one.layout, found, one.middle, one.prior + (float(np.log(LOST)) if other else 0.0))
        return one

    def _one_more(self) -> None:
        """Whether an odd scatterer beside a layout is an alike reflector more: then it is another tag."""
        for one in [h for h in self.hypotheses if h.layout is not None and len(h.found.odd)]:
            if one.found.model.tag is None or one.log_z < max(h.log_z for h in self.hypotheses) - 60:
                continue
            for odd in one.found.odd:
                best = refined(self.spectra, *one.found.and_alike(odd), (None,))
                self.grow(self.add(None, best, one.middle), self.most_odd)

    def _about_own_middle(self) -> None:
        """The best layout and an odd scatterer as one tag about their own middle: loud ones move a body's."""
        one = max(self.hypotheses, key=lambda one: one.log_z)
        found = one.found
        if one.layout is None or found.model.tag is None:
            return
        for odd in found.odd:
            points = np.append(found.places, odd)
            centre = middle_of(points)
            radius = float(np.abs(points - centre).mean())
            if abs(centre) > FAR_M or not RING_M[0] < radius < RING_M[1]:
                continue
            tag = Arrangement.ring(radius, np.angle(points - centre))
            starts = []
            for transfer in self.transfers:
                levels, disc = self.spectra.levels, disc_of(radius)
                model = Model(transfer, tag, transfer.body, disc, levels=levels, priors=self.priors)
                x = np.zeros(model.parameters)
                x[:2] = centre.real, centre.imag
                starts.append((best_powers(self.spectra, model, x, 1e-2)[1], model, x))
            for _, model, x in sorted(starts, key=lambda one: -one[0])[:2]:
                self.grow(self._placed(None, model, x), self.most_odd)

    def _by_hand(self) -> None:
        """The best layouts with every reflector a little off its place, as they were glued."""
        for one in self._best(3, enrolled=True):
            best = self.add(one.layout, refined(self.spectra, *one.found.by_hand(), (None,)), one.middle)
            self.grow(best, self.most_odd - one.found.model.odd)

    def _unbound(self) -> None:
        """The best layouts' reflectors as free ones: far from their places they are another tag."""
        for one in self._best(RESIZED, enrolled=True):
            own, start = one.found.unbound()
            best = self.add(None, refined(self.spectra, own, start, (None,)))
            self.grow(best, self.most_odd - own.odd)
