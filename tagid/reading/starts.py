"""Starts of the search: layouts at their best turns, free arrangements on rings, about given centres."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from tagid.reading import search
from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import APART_M, Model
from tagid.reading.descent import Powers
from tagid.reading.hypothesis import Arranged, Candidate, Stand, disc_of, unlike
from tagid.reading.spectra import Spectra
from tagid.tags.layouts.layout import Layout
from tagid.types import Complex, Floats

FREE_RINGS_M = (0.028, 0.036, 0.045, 0.054, 0.063, 0.072, 0.082, 0.09, 0.1, 0.11)
"""Radii of rings on which an arrangement that is not enrolled is looked for."""


@dataclass(frozen=True)
class Wanted:
    """What is looked for in a recording.

    Attributes:
        planes: heights of the reflectors' plane, m.
        most_reflectors: of an arrangement that is not enrolled.
    """

    spectra: Spectra
    layouts: Sequence[Layout]
    planes: Sequence[float]
    most_reflectors: int


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
        for start in search.free(rings[i], apart[i], wanted.most_reflectors, 2):
            tag = Arrangement.ring(radius, np.array(start.angles))
            on_ring = replace(model, tag=tag)
            turns = np.zeros(tag.turns + tag.stretches)
            x = np.concatenate([head, turns, [rise] * on_ring.lifts])
            yield Candidate(start.log, None, on_ring, x, False)
