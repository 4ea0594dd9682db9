"""Starts of the search: nothing or a round body, and the clutter that it leaves; then layouts at their best
turns and free arrangements on rings, about given centres.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from tagid.reading import search
from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import APART_M, Model, Priors
from tagid.reading.descent import Estimate, Powers, best_powers, refined
from tagid.reading.hypothesis import MOST_REFLECTORS, Arranged, Candidate, Hypothesis, Stand, disc_of, unlike
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE, POINTS
from tagid.reading.transfers.transfer import Transfer
from tagid.tags.layouts.layout import Layout
from tagid.types import Complex, Floats

GRID_M = tuple(complex(x, y) for x in 4e-3 * np.arange(-2, 3) for y in 4e-3 * np.arange(-2, 3))
"""Centres that are tried, x + jy."""
SHAPES_M = tuple(r * np.exp(1j * np.pi / 3 * np.arange(6)) for r in (4e-3, 8e-3, 12e-3))
"""Two-fold parts of a body's support function that are tried, m."""
BODIES_M = (*((c, 0j) for c in GRID_M), *((0j, complex(s)) for ring in SHAPES_M for s in ring))
"""Centres and shapes of a body that are tried."""
LEAST_CLUTTER = 1e-3
"""Least power of the clutter under which reflectors are looked for: a body alone takes some of theirs."""
FREE_RINGS_M = (0.028, 0.036, 0.045, 0.054, 0.063, 0.072, 0.082, 0.09, 0.1, 0.11)
"""Radii of rings on which an arrangement that is not enrolled is looked for."""


@dataclass(frozen=True)
class Wanted:
    """What is looked for in a recording.

    Attributes:
        planes: heights of the reflectors' plane, m.
    """

    spectra: Spectra
    layouts: Sequence[Layout]
    planes: Sequence[float]


@dataclass(frozen=True)
class _Bodies:
    """Bodies of one model about N centres.

    Attributes:
        model: without reflectors.
        centres: x + jy, m.
        heads: parameters of every body.
        echo: (N, F, V) of the bodies.
        powers: of clutter and reflectors.
    """

    model: Model
    centres: Sequence[complex]
    heads: Sequence[Floats]
    echo: Complex
    powers: Powers


def starts_about(
    wanted: Wanted,
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
        centres: x + jy, m.
        powers, shapes: of either disc of the clutter.
        others: centres of bodies that are supposed round: a tag that is seen in part looks like an oval body
            about another centre.
        stand: an enrolled body in its pose.
        wide: centres and rings of free arrangements.
    """
    spectra, candidates = wanted.spectra, []
    for disc in (0, 1):
        of_disc, shape = replace(model, disc=disc), shapes[disc]
        poses = [(centre, shape[: model.shapes]) for centre in centres]
        poses += [(centre, np.zeros(2)) for centre in others if model.shapes]
        heads = [np.array([c.real, c.imag, *s]) if stand is None else stand.head(c) for c, s in poses]
        echoes = [spectra.data if stand is None else stand.echo] * len(poses)
        if stand is None and model.transfer.body:
            echoes = [of_disc.at(spectra, x, slopes=False).values[:, 0] for x in heads]
        bodies = _Bodies(of_disc, [centre for centre, _ in poses], heads, np.stack(echoes), powers[disc])
        likely = np.full(len(poses), -np.inf)
        enrolled: dict[str, list[Candidate]] = {}
        for i, start in _layouts(wanted, bodies):
            assert start.layout is not None
            enrolled.setdefault(start.layout.name, []).append(start)
            likely[i] = max(likely[i], start.log)
        for some in enrolled.values():
            candidates += unlike(some, 2)
        for i in np.argsort(-likely, kind="stable")[:wide]:
            candidates += _free(wanted, bodies, int(i), wide)
    return candidates


def _layouts(wanted: Wanted, bodies: _Bodies) -> Iterator[tuple[int, Candidate]]:
    """The best turns of every layout of a disc beside every body, and the body's number."""
    model = bodies.model
    arranged = [Arranged.of(layout, model.covers_middle) for layout in wanted.layouts]
    raised = list(product([a for a in arranged if disc_of(a.radius_m) == model.disc], wanted.planes))
    if not raised:
        return
    tagged = [replace(model, tag=arrangement.tag) for arrangement, _ in raised]
    groups = [arrangement.group(rise) for arrangement, rise in raised]
    tables = search.tables(wanted.spectra, model, bodies.centres, groups, bodies.powers, bodies.echo)
    for i, (head, table) in enumerate(zip(bodies.heads, tables, strict=True)):
        turned = search.turned(table, 2)
        for (arrangement, rise), with_tag, turns in zip(raised, tagged, turned, strict=True):
            for turn in turns:
                x = np.concatenate([head, [turn.angles[0], 0.0], [rise] * with_tag.lifts])
                yield i, Candidate(turn.log, arrangement.layout, with_tag, x, arrangement.middle)


def _free(wanted: Wanted, bodies: _Bodies, number: int, wide: int) -> Iterator[Candidate]:
    """Free arrangements beside one body, on the rings where pairs explain most."""
    model, head = bodies.model, bodies.heads[number]
    raised = list(product([r for r in FREE_RINGS_M if disc_of(r) == model.disc], wanted.planes))
    groups = [((radius, 0.0, rise),) for radius, rise in raised]
    apart = [2 * float(np.arcsin(APART_M / 2 / radius)) for radius, _ in raised]
    here = [bodies.centres[number]], groups, bodies.powers, bodies.echo[number : number + 1]
    (table,) = search.tables(wanted.spectra, model, *here, search.COARSE_RAD)
    rings = table.by_group
    pairs = [search.free(ring, gap, 2, 1)[-1].log for ring, gap in zip(rings, apart, strict=True)]
    for i in np.argsort(pairs)[::-1][:wide]:
        radius, rise = raised[i]
        for start in search.free(rings[i], apart[i], MOST_REFLECTORS, 2):
            tag = Arrangement.ring(radius, np.array(start.angles))
            on_ring = replace(model, tag=tag)
            turns = np.zeros(tag.turns + tag.stretches)
            x = np.concatenate([head, turns, [rise] * on_ring.lifts])
            yield Candidate(start.log, None, on_ring, x, False)


def resized(spectra: Spectra, transfers: Sequence[Transfer], hypothesis: Hypothesis) -> Iterator[Candidate]:
    """A layout's angles on rings of other radii, at their best turns about the centre where it stands.

    At another distance from the centre they are another tag.

    Args:
        hypothesis: of a layout.
    """
    assert hypothesis.layout is not None
    estimate, of_layout = hypothesis.estimate, hypothesis.estimate.model
    powers = Powers(max(estimate.powers.clutter, 1e-3), estimate.powers.body)
    rise = float(of_layout.heights_of(estimate.x)[0].min())
    for transfer, disc in product(transfers, (0, 1)):
        model = Model(transfer, None, transfer.body, disc, levels=of_layout.levels, priors=of_layout.priors)
        shape = estimate.x[2:4] if of_layout.shapes else np.zeros(2)
        head = np.r_[estimate.centre.real, estimate.centre.imag, shape[: model.shapes]]
        arranged = Arranged.of(hypothesis.layout, model.covers_middle)
        radii = [radius for radius in FREE_RINGS_M if disc_of(radius) == disc]
        rings = [replace(arranged, tag=arranged.tag.resized(radius)) for radius in radii]
        echo = model.at(spectra, head, slopes=False).values[:, 0] if transfer.body else spectra.data
        groups = [ring.group(rise) for ring in rings]
        (table,) = search.tables(spectra, model, [estimate.centre], groups, powers, echo[None])
        for ring, starts in zip(rings, search.turned(table, 1), strict=True):
            tagged = replace(model, tag=ring.tag)
            for start in starts:
                x = np.r_[head, start.angles[0], 0.0, [rise] * tagged.lifts]
                yield Candidate(start.log, None, tagged, x, False)


@dataclass(frozen=True, eq=False)
class RoundBodies:
    """A round body in the clutter of either disc.

    Attributes:
        estimates: of the likeliest starts, for each disc.
    """

    estimates: Sequence[Sequence[Estimate]]

    @cached_property
    def of_disc(self) -> list[Estimate]:
        """The best of each disc."""
        return [max(some, key=lambda estimate: estimate.log_z) for some in self.estimates]

    @property
    def best(self) -> Estimate:
        return max(self.of_disc, key=lambda estimate: estimate.log_z)

    @property
    def powers(self) -> list[Powers]:
        """Under which reflectors are looked for, for each disc."""
        return [with_clutter(estimate.powers) for estimate in self.of_disc]

    @property
    def shapes(self) -> list[Floats]:
        """(2,) two-fold parts of the support function, m, for each disc."""
        return [estimate.x[2:4] for estimate in self.of_disc]


def with_clutter(powers: Powers) -> Powers:
    """Powers with `LEAST_CLUTTER` at least."""
    return replace(powers, clutter=max(powers.clutter, LEAST_CLUTTER))


def round_bodies(spectra: Spectra, priors: Priors) -> RoundBodies:
    """A round body in the clutter of either disc."""
    model = Model(POINTS, None, True, 0, levels=spectra.levels, priors=priors)
    starts = [np.array([c.real, c.imag, s.real, s.imag]) for c, s in BODIES_M]
    values = [best_powers(spectra, model, x, 1e-2)[1] for x in starts]
    order = np.argsort(values)[::-1][:2]
    models = [replace(model, disc=disc) for disc in (0, 1)]
    return RoundBodies([[refined(spectra, m, starts[i], (1e-2, None), 12) for i in order] for m in models])


def nothing(spectra: Spectra, priors: Priors) -> list[Estimate]:
    """No body, in the clutter of either disc."""
    models = [Model(BARE, None, False, disc, levels=spectra.levels, priors=priors) for disc in (0, 1)]
    return [refined(spectra, model, np.zeros(2), (None,), 1) for model in models]
