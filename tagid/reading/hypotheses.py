"""What is tried, and in which order: bodies, transfers, arrangements and odd scatterers.

Every hypothesis ends as a `Hypothesis` with its log evidence; `decision` compares them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np

from tagid.reading import sheet_tags
from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import PLANE_SD_M, Model, Priors
from tagid.reading.descent import TAG, Estimate, Powers, best_powers, refined
from tagid.reading.hypothesis import (
    MOST_ODD,
    Arranged,
    Candidate,
    Hypothesis,
    Stand,
    as_layouts,
    bodies_apart,
    disc_of,
    distinct,
    rivals,
    same_place,
)
from tagid.reading.odd import OddMap
from tagid.reading.remainder import anywhere
from tagid.reading.sheet import KINDS, Kind, SheetModel
from tagid.reading.signature import EnrolledBody, SignatureModel
from tagid.reading.signature_search import Poses, altered
from tagid.reading.smooth import smoothed
from tagid.reading.spectra import Spectra
from tagid.reading.starts import (
    FREE_RINGS_M,
    GRID_M,
    RoundBodies,
    Wanted,
    nothing,
    resized,
    round_bodies,
    starts_about,
    with_clutter,
)
from tagid.reading.transfers.plain import BARE, FACING, POINTS
from tagid.reading.transfers.rod import RODS
from tagid.reading.transfers.shade import SHADES
from tagid.reading.transfers.transfer import Transfer
from tagid.reading.transfers.wall import WALLS
from tagid.reading.uneven import Turned, straightened
from tagid.tags.layouts.layout import Layout
from tagid.types import Floats

TRANSFERS: tuple[Transfer, ...] = (BARE, POINTS, *WALLS, *RODS, *SHADES)
SEARCHED = frozenset((BARE, POINTS, *WALLS[:4], RODS[0], SHADES[1]))
"""Behind which arrangements are looked for; what is found is tried behind the others, too."""
MOST_ODD_UNTAGGED = 5
"""Odd scatterers that one search adds where there is no tag."""
STRAIGHTENED = 3
"""Times at most that the angles of a part of a turn are found: first by hypotheses that wrong ones bent."""
LIMIT_ODD, LIMIT_ODD_UNTAGGED = 4, 7
"""Odd scatterers beside a tag, and where there is none, at most."""
EVENED = 8
"""Kinds of rivals that get as many odd scatterers as what they compete with."""
FIRST, THEN = 16, 8
"""Starts that are refined under much clutter, and those of them that are refined wholly."""
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
MORE, RINGED = 0.1, 2
"""Share of those that are not enrolled which are an enrolled one and a reflector more on its ring, and the
layouts of which that is tried."""
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
    """Hypotheses of one recording and what they share.

    Attributes:
        place: about which they are, x + jy, m from the axis.
    """

    spectra: Spectra
    layouts: Sequence[Layout]
    transfers: Sequence[Transfer] = TRANSFERS
    sheets: Sequence[Kind] = KINDS
    enrolled: Sequence[EnrolledBody] = ()
    priors: Priors = field(default_factory=Priors)
    place: complex = 0j
    hypotheses: list[Hypothesis] = field(default_factory=list, init=False)
    _centres: list[complex] = field(default_factory=list, init=False)
    _tried: set[Estimate] = field(default_factory=set, init=False)
    _rough: list[Hypothesis] = field(default_factory=list, init=False)
    _planes: list[float] = field(init=False)
    _seen: float = field(default=-np.inf, init=False)
    _shapes: Sequence[Floats] = field(default=(), init=False)

    def __post_init__(self) -> None:
        self._planes = self.spectra.rises(2 * PLANE_SD_M).tolist()

    @property
    def wanted(self) -> Wanted:
        """What is looked for."""
        return Wanted(self.spectra, self.layouts, self._planes)

    @cached_property
    def _odd(self) -> OddMap:
        return OddMap(self.spectra)

    def behind(self, transfer: Transfer) -> Model:
        """A model without reflectors."""
        return Model(transfer, None, transfer.body, 0, levels=self.spectra.levels, priors=self.priors)

    def add(
        self, layout: Layout | None, estimate: Estimate, middle: bool = False, prior: float = 0.0
    ) -> Hypothesis:
        """Enter a hypothesis."""
        alike = np.log(layout.symmetry) if layout is not None else 0.0
        hypothesis = Hypothesis(layout, estimate, estimate.log_z + float(alike) + prior, middle, prior)
        self.hypotheses.append(hypothesis)
        return hypothesis

    def run(self) -> list[Hypothesis]:
        """All hypotheses, the best first, at the stated angles or those that a look or all show."""
        stated, errors, cost = self.spectra, None, 0.0
        self.look()
        for explored in (False, *[True] * (STRAIGHTENED - 1)):
            # An enrolled body has an uneven turn of its own.
            others = [h.estimate for h in self.hypotheses if not isinstance(h.estimate.model, SignatureModel)]
            best = self._highest - cost
            # About another place the angles are those that were found about the axis.
            turned = None if self.place else straightened(stated, others, best, errors)
            other = None if turned is None else self._turned(turned, explored, best)
            if turned is not None and other is not None:
                vars(self).clear()
                vars(self).update(vars(other))
                errors, cost = turned.errors, turned.cost
            elif explored:
                break
            if not explored:
                self._then()
        self.hypotheses = smoothed(self.spectra, self.hypotheses)
        return self.hypotheses

    def about(self, place: complex) -> Contest:
        """The same about another place, x + jy, m from the present one, with nothing tried."""
        return replace(self, spectra=self.spectra.about(place), place=self.place + place)

    def look(self) -> float:
        """Log evidence of the likeliest hypothesis of the first look, nats."""
        if not self.hypotheses:
            self._first()
            self._seen = self._highest
        return self._seen

    @property
    def _ranked(self) -> list[Hypothesis]:
        """All so far, the best first."""
        return sorted(self.hypotheses, key=lambda hypothesis: -hypothesis.log_z)

    @property
    def _highest(self) -> float:
        return max(hypothesis.estimate.log_z for hypothesis in self.hypotheses)

    def _turned(self, turned: Turned, explored: bool, best: float) -> Contest | None:
        """What competes at other angles, tried as far as at those before; None where it explains no more."""
        other = replace(self, spectra=turned.spectra)
        other.look()
        if explored:
            other._then()
        return other if other._highest - turned.cost > best else None

    def _first(self) -> None:
        """Bodies, and reflectors in the open and beside them."""
        bodies = self._untagged()
        body = bodies.best
        centres = [body.centre, *GRID_M]
        # A loud tag moves the centre that a body alone seems to have.
        near = distinct([body.centre, *self._centres, *(body.centre + step for step in _NEAR_M)])
        powers, self._shapes = bodies.powers, bodies.shapes
        known = body.centre_sd_m < _KNOWN_M
        self._look(centres, near if known else centres, powers, self._shapes, GRID_M[::2])
        self._beside_others()
        best = max(self.hypotheses, key=lambda hypothesis: hypothesis.log_z).estimate
        if known and min(abs(best.centre - centre) for centre in near) > ELSEWHERE_M:
            self._look([best.centre], [best.centre], [with_clutter(best.powers)] * 2, [np.zeros(2)] * 2)
        if not self.spectra.full_turn and not self.place:  # angles are told by what explains most
            self._anywhere()
            self._facing()

    def _then(self) -> None:
        """All that follows from what the first look has shown."""
        self._resized()
        self._beside_enrolled()
        self._as_enrolled()
        self._hidden()
        self._one_less()
        self._beside_odd()
        self._anywhere()
        self._facing()
        if self.sheets:
            self._sheets()
        self._as_enrolled()
        self._as_free()
        self._raised()
        self._one_more()
        self._beside_others()
        self._by_hand()
        self._unbound()
        self._one_more_on_ring()
        self._evened()

    @property
    def searched(self) -> Sequence[Transfer]:
        """Behind which arrangements are looked for."""
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
        for transfer in self.searched:
            model = self.behind(transfer)
            some = centres if transfer.body else open_centres
            starts += starts_about(self.wanted, model, some, powers, shapes, others, wide=2)
            if transfer.body and len(self._planes) > 2:
                # Waves that pass tell the height of the plane well enough for what a body does to them.
                best = max((start for start in starts if start.model.lifts), key=lambda start: start.log)
                self._planes = list(dict.fromkeys([0.0, float(best.x[-1])]))
        self._refine(starts, powers)

    def _resized(self) -> None:
        """The best layouts at other distances from the centre."""
        layouts: dict[Layout | None, Hypothesis] = {}
        for hypothesis in self._best(9, enrolled=True):
            layouts.setdefault(hypothesis.layout, hypothesis)
        for layout in list(layouts.values())[:RESIZED]:
            starts = resized(self.spectra, self.searched, layout)
            for start in sorted(starts, key=lambda start: -start.log)[:RESIZED]:
                self.grow(self._placed(None, start.model, start.x), MOST_ODD)

    def _refine(self, starts: list[Candidate], powers: Sequence[Powers]) -> None:
        """The best starts of every kind under the clutter that a body leaves; the best of those wholly."""
        for enrolled in (True, False):
            self._refined([start for start in starts if (start.layout is not None) == enrolled], powers)

    def _refined(self, starts: list[Candidate], powers: Sequence[Powers]) -> None:
        ranked = sorted(starts, key=lambda start: -start.log)
        kinds: dict[tuple[str, str, int], Candidate] = {}
        for start in ranked:
            name = "" if start.layout is None else start.layout.name
            count = 0 if start.model.tag is None else start.model.tag.count
            kinds.setdefault((start.model.transfer.name, name, count), start)
        starts = list(dict.fromkeys([*ranked[:FIRST], *kinds.values()]))
        near: list[tuple[float, int, Estimate]] = []
        for start in starts:
            estimate = refined(
                self.spectra, start.model, start.x, (min(powers[start.model.disc].clutter, 1e-2),), 4
            )
            near.append((estimate.log_z, len(near), estimate))
            self._rough.append(Hypothesis(start.layout, estimate, estimate.log_z, start.middle))
        near.sort(key=lambda entry: -entry[0])
        done: list[tuple[Layout | None, Estimate]] = []
        for _, i, rough in near:
            if len(done) == THEN:
                break
            layout = starts[i].layout
            if any(layout is other and same_place(rough, there) for other, there in done):
                continue
            estimate = refined(self.spectra, rough.model, rough.x, (1e-3, None))
            done.append((layout, estimate))
            self.add(layout, estimate, starts[i].middle)

    def _beside_others(self) -> None:
        """The best pose of every layout and of free arrangements of every number, beside all but sheets."""
        best: dict[tuple[str, int], Hypothesis] = {}
        for hypothesis in self._ranked:
            if type(hypothesis.estimate.model) is Model and hypothesis.estimate.model.tag is not None:
                name = "" if hypothesis.layout is None else hypothesis.layout.name
                best.setdefault((name, 0 if name else hypothesis.estimate.model.tag.count), hypothesis)
        for hypothesis in best.values():
            estimate, model = hypothesis.estimate, hypothesis.estimate.model
            assert model.tag is not None
            starts = []
            for transfer in self.transfers:
                walled, tag, middle = replace(model, transfer=transfer, oval=transfer.body), model.tag, False
                if hypothesis.layout is not None:
                    arranged = Arranged.of(hypothesis.layout, walled.covers_middle)
                    tag, middle = arranged.tag, arranged.middle
                walled = replace(walled, tag=tag)
                shape = estimate.x[2:4] if model.shapes else self._shapes[model.disc]
                x = np.r_[estimate.x[:2], shape[: walled.shapes], estimate.x[model.head :]]
                outward = np.zeros(len(x))
                outward[walled.head + tag.turns :][: tag.stretches] = 1.0
                radii = [x + stray * outward for stray in STRAYS_M]
                values = [
                    best_powers(self.spectra, walled, there, estimate.powers.clutter)[1] for there in radii
                ]
                likeliest = int(np.argmax(values))
                starts.append((values[likeliest], walled, radii[likeliest], middle))
            starts.sort(key=lambda start: -start[0])
            for _, walled, x, middle in starts[:BESIDE]:
                again = refined(self.spectra, walled, x, (1e-3, None))
                tried = [other.estimate for other in self.hypotheses if other.layout is hypothesis.layout]
                if not any(same_place(again, other) and other.model.disc == walled.disc for other in tried):
                    self.add(hypothesis.layout, again, middle)

    def _as_enrolled(self) -> None:
        """Layouts where points of the best hypotheses stand that are about theirs."""
        for hypothesis in self._best(6, enrolled=False):
            if hypothesis.estimate in self._tried:
                continue
            self._tried.add(hypothesis.estimate)
            for layout, model, x, middle in as_layouts(hypothesis.estimate, self.layouts):
                self.grow(self._placed(layout, model, x, middle=middle), MOST_ODD - model.odd)

    def _as_free(self) -> None:
        """Free arrangements where the best layouts stand, about the body's own centre."""
        for hypothesis in self._best(3, enrolled=True):
            model, estimate = hypothesis.estimate.model, hypothesis.estimate
            if not model.transfer.body:
                continue
            head = estimate.x[: model.head].copy()
            if model.about.start:
                head[model.about] = 0.0
            tag = Arrangement.about(estimate.positions - complex(estimate.x[0], estimate.x[1]))
            freed = replace(model, tag=tag, odd=0)
            x = np.r_[head, np.zeros(freed.parameters - model.head)]
            self.grow(self._placed(None, freed, x, (None,), 8), MOST_ODD)

    def _facing(self) -> None:
        """The best bare tags, of reflectors that return less from behind."""
        for enrolled in (True, False):
            every = self._best(len(self.hypotheses), enrolled=enrolled)
            for h in [h for h in every if h.estimate.model.transfer is BARE][:3]:
                model, x = replace(h.estimate.model, transfer=FACING), h.estimate.x
                self._placed(h.layout, model, x, (1e-3, None), middle=h.middle, prior=h.prior)

    def _hidden(self) -> None:
        """The best bare tags, not seen from a sector of directions: behind a post or a hand."""
        for enrolled in (True, False):
            # A tag that is hidden from a third of the views is a poor one before the sector is known.
            bare = [hypothesis for hypothesis in self._rough if hypothesis.estimate.model.transfer is BARE]
            bare = [hypothesis for hypothesis in bare if (hypothesis.layout is not None) == enrolled]
            for hypothesis in sorted(bare, key=lambda hypothesis: -hypothesis.log_z)[:2]:
                model, x = hypothesis.estimate.model, hypothesis.estimate.x
                every = product(2 * np.pi * np.arange(12) / 12, HIDDEN_RAD)
                sectors = [replace(model, hidden=sector) for sector in every]
                logs = [best_powers(self.spectra, sector, x, 1e-2)[1] for sector in sectors]
                self._placed(hypothesis.layout, sectors[int(np.argmax(logs))], x, middle=hypothesis.middle)

    def _one_less(self) -> None:
        """The best layouts without one of their reflectors, which then is missing or was never there."""
        for hypothesis in self._best(3, enrolled=True):
            tag, estimate = hypothesis.estimate.model.tag, hypothesis.estimate
            if tag is None or tag.count < 2:
                continue
            for k in range(tag.count):
                model = replace(estimate.model, tag=tag.of(np.delete(np.arange(tag.count), k)))
                prior = float(np.log(LOST / tag.count))
                self._placed(None, model, estimate.x, (None,), prior=prior)

    def _raised(self) -> None:
        """The best layouts' plans with any heights, where heights are in question."""
        if self.spectra.levels == 1 and not any(
            Arrangement.of_layout(layout.positions, layout.heights).tall for layout in self.layouts
        ):
            return
        for hypothesis in self._best(3, enrolled=True):
            model, estimate = hypothesis.estimate.model, hypothesis.estimate
            if model.tag is None or isinstance(model, SheetModel):
                continue
            tag = model.tag.raised()
            raised = replace(model, tag=tag, odd=0)
            first = model.head + model.tag.turns + model.tag.stretches
            heights = model.heights_of(estimate.x)[0] - tag.height_m
            rises = list(product(RAISED_M, repeat=tag.count))
            starts = [np.append(estimate.x[:first], heights + rise) for rise in rises]
            logs = [best_powers(self.spectra, raised, x, 1e-2)[1] for x in starts]
            for i in np.argsort(logs)[::-1][:2]:
                prior = float(np.log(RAISED))
                best = self._placed(None, raised, starts[i], middle=hypothesis.middle, prior=prior)
                self.grow(best, MOST_ODD)

    def _untagged(self) -> RoundBodies:
        """Nothing, and a round body, with clutter of either disc."""
        bodies = round_bodies(self.spectra, self.priors)
        self._centres += [estimate.centre for some in bodies.estimates for estimate in some]
        for estimate in (*bodies.of_disc, *nothing(self.spectra, self.priors)):
            self.add(None, estimate)
        return bodies

    def _beside_enrolled(self) -> None:
        """Enrolled bodies and objects: alone, beside what the points have shown, and with any reflectors."""
        guests = self._guests()
        stands: list[Stand] = []
        for body in self.enrolled:
            disc = disc_of(body.signature.radius_m)
            alone = SignatureModel.of(body, POINTS, disc, self.spectra.levels, self.priors)
            poses = Poses(self.spectra, body, alone.disc)
            starts = [np.r_[pose, 0.0, 0.0] for pose in poses.best(POSES)]
            if alone.whole:
                rough = [refined(self.spectra, alone, x) for x in starts]
                alone = alone.levelled(self.spectra, max(rough, key=lambda estimate: estimate.log_z).x)
                starts = [estimate.x for estimate in rough]
            placed = [self._placed(None, alone, x) for x in starts]
            best = max(placed, key=lambda hypothesis: hypothesis.log_z)
            self._placed(None, replace(alone, disc=1 - alone.disc), best.estimate.x)
            if alone.whole:
                self._altered(alone, best.estimate)
                continue
            for guest in guests:
                (pose,) = poses.best(1, guest.estimate.beside(self.spectra))
                placed.append(self._placed(guest.layout, *alone.with_guest(guest.estimate, pose)))
            stands += [Stand.of(self.spectra, estimate) for estimate in bodies_apart(placed)]
        if not stands:
            return
        likely = [max((start.log for start in some), default=-np.inf) for some in self._about(stands, ())]
        stands = [stands[i] for i in np.argsort(likely)[::-1][:STANDS]]
        self._refine(
            [start for some in self._about(stands, _NEAR_M) for start in some], [stands[0].powers] * 2
        )

    def _altered(self, alone: SignatureModel, estimate: Estimate) -> None:
        """An enrolled object with reflectors less or more: then it is another one."""
        models = [
            (radius, replace(alone, transfer=transfer, disc=disc_of(radius)))
            for transfer, radius in product(self.transfers, FREE_RINGS_M)
            if transfer.body
        ]
        powers = Powers(1e-2, estimate.powers.body)
        for model, x in altered(self.spectra, models, estimate.x, powers, MOST_ALTERED):
            self._placed(None, model, x, prior=float(np.log(LOST / len(TAG))))

    def _about(self, stands: Sequence[Stand], near: Sequence[complex]) -> list[list[Candidate]]:
        """Reflectors beside enrolled bodies in their poses, about centres near theirs, if any are given."""
        by_stand: list[list[Candidate]] = [[] for _ in stands]
        for transfer in self.transfers:
            for stand, starts in zip(stands, by_stand, strict=True):
                if transfer.body:
                    model = SignatureModel.of(stand.body, transfer, 0, self.spectra.levels, self.priors)
                    centres = distinct([*stand.centres, *(stand.centres[-1] + 2 * step for step in near)])
                    starts += starts_about(
                        self.wanted, model, centres, [stand.powers] * 2, stand=stand, wide=1 if near else 0
                    )
        return by_stand

    def _placed(
        self,
        layout: Layout | None,
        model: Model,
        x: Floats,
        stages: tuple[float | None, ...] = (1e-2, None),
        rounds: int = 6,
        *,
        middle: bool = False,
        prior: float = 0.0,
    ) -> Hypothesis:
        """Enter a model at its most probable parameters near x (P,); stages and rounds as of `refined`."""
        return self.add(layout, refined(self.spectra, model, x, stages, rounds), middle, prior)

    def _guests(self) -> list[Hypothesis]:
        """The best layouts, and the best free arrangement."""
        out: list[Hypothesis] = []
        for h in self._ranked:
            if h.estimate.model.tagged and all(h.layout is not other.layout for other in out):
                out.append(h)
        return out[:GUESTS]

    def _best(self, count: int, *, enrolled: bool) -> list[Hypothesis]:
        """The best hypotheses with reflectors, of layouts or of arrangements that are not enrolled."""
        some = [h for h in self._ranked if h.estimate.model.tag and not h.estimate.model.whole]
        return [hypothesis for hypothesis in some if (hypothesis.layout is not None) == enrolled][:count]

    def _sheets(self) -> None:
        """Thin sheets, alone, beside what the points have shown, and with all that their tables show."""

        def enter(layout: Layout | None, estimate: Estimate, odd: int) -> Estimate:
            return self.grow(self.add(layout, estimate), odd).estimate

        sheet_tags.explain(
            self.spectra, self.layouts, self.sheets, tuple(self.hypotheses), enter, self.priors
        )

    def _beside_odd(self) -> None:
        """The best of every kind beside odd scatterers, added while they pay."""
        untagged = [hypothesis for hypothesis in self._ranked if hypothesis.estimate.model.tag is None]
        tagged = self._best(5, enrolled=True) + self._best(9, enrolled=False)
        for hypothesis in untagged[:6]:
            self.grow(hypothesis, MOST_ODD_UNTAGGED)
        for hypothesis in tagged:
            self.grow(hypothesis, MOST_ODD)

    def _anywhere(self) -> None:
        """Alike reflectors on no ring, in the open or before a body, and beside what is loudest."""
        for rough in anywhere(self.spectra, self.hypotheses, self._planes[-1]):
            self.grow(self._placed(None, rough.model, rough.x, (None,)), MOST_ODD - rough.model.odd)

    def grow(self, hypothesis: Hypothesis, most: int) -> Hypothesis:
        """The best of a hypothesis beside up to so many odd scatterers, added while they pay."""
        best = self._grown(hypothesis, most)
        if any(best.estimate.model.faced[hypothesis.estimate.model.odd :]):
            # A face that pays most at first may stand where several points pay more.
            points = self._grown(hypothesis, most, faces=False)
            best = points if points.log_z > best.log_z else best
        return best

    def _grown(self, hypothesis: Hypothesis, most: int, *, faces: bool = True) -> Hypothesis:
        limit = LIMIT_ODD_UNTAGGED if hypothesis.estimate.model.tag is None else LIMIT_ODD
        for _ in range(min(most, limit - hypothesis.estimate.model.odd)):
            before = hypothesis.estimate
            some = [
                refined(self.spectra, before.model.and_odd(face), np.append(before.x, place), (None,), 8)
                for place, face in self._odd.likeliest(before, faces=faces)
            ]
            estimate = max(some, key=lambda estimate: estimate.log_z, default=before)
            if estimate.log_z < before.log_z + 1:
                break
            # An odd scatterer is all that tells another object from the enrolled one.
            lost = float(np.log(LOST)) if estimate.model.identity != before.model.identity else 0.0
            hypothesis = self.add(hypothesis.layout, estimate, hypothesis.middle, hypothesis.prior + lost)
        return hypothesis

    def _one_more(self) -> None:
        """Whether an odd scatterer beside a layout is an alike reflector more: then it is another tag."""
        some = [h for h in self._best(len(self.hypotheses), enrolled=True) if h.estimate.model.odd]
        for hypothesis in some[:3]:
            for odd in hypothesis.estimate.odd:
                alike = hypothesis.estimate.and_alike(odd)
                self.grow(self._placed(None, *alike, (None,), middle=hypothesis.middle), MOST_ODD)

    def _one_more_on_ring(self) -> None:
        """The same of a reflector anywhere on the best layouts' rings, of whom nothing has shown yet."""
        for hypothesis in self._best(RINGED, enrolled=True):
            more, clutter = hypothesis.estimate.more_on_ring(), hypothesis.estimate.powers.clutter
            logs = [best_powers(self.spectra, model, x, clutter)[1] for model, x in more]
            alike = more[int(np.argmax(logs))]
            best = self._placed(None, *alike, (None,), middle=hypothesis.middle, prior=float(np.log(MORE)))
            self.grow(best, MOST_ODD - best.estimate.model.odd)

    def _by_hand(self) -> None:
        """The best layouts with every reflector a little off its place, as they were glued."""
        for hypothesis in self._best(3, enrolled=True):
            glued = hypothesis.estimate.by_hand()
            best = self._placed(hypothesis.layout, *glued, (None,), middle=hypothesis.middle)
            self.grow(best, MOST_ODD - hypothesis.estimate.model.odd)

    def _unbound(self) -> None:
        """The best layouts' reflectors as free ones: far from their places they are another tag."""
        for hypothesis in self._best(RESIZED, enrolled=True):
            freed, start = hypothesis.estimate.unbound()
            self.grow(self._placed(None, freed, start, (None,)), MOST_ODD - freed.odd)

    def _evened(self) -> None:
        """The best rivals of every kind, beside as many odd scatterers as the best with a name has."""
        named = [hypothesis for hypothesis in self.hypotheses if hypothesis.name is not None]
        odd = max(named, key=lambda hypothesis: hypothesis.log_z).estimate.model.odd if named else 0
        for hypothesis in rivals(self.hypotheses)[:EVENED]:
            self.grow(hypothesis, odd - hypothesis.estimate.model.odd)
