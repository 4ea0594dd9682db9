"""Sheets with and without reflectors: what is tried of them beside the hypotheses of points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np

from tagid.reading import search
from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import Priors
from tagid.reading.descent import BODY, OVAL, Found, Powers, best_powers, refined
from tagid.reading.evidence import log_evidence
from tagid.reading.remainder import sets
from tagid.reading.sheet import HEAD, Kind, SheetModel
from tagid.reading.sheet_search import Seeker, beside
from tagid.reading.spectra import MODEL_ERROR, Spectra
from tagid.tags.layouts.layout import Layout
from tagid.types import Floats

GUESTS, FOLLOWED, JOINT = 2, 9, 3
"""Arrangements of other hypotheses beside which sheets are looked for, starts that are followed, and those of
them that are fitted."""
SHEETS, ALONE, ABOUT = 3, 5, 5
"""Sheets of every kind, those that are fitted alone, and those about which reflectors are looked for."""
LOUD = 3
"""Kinds of sheets beside whose loudest scatterer reflectors are looked for."""
FITTED, FITTED_USUAL = (3, 4), (1, 2)
"""Layouts and free arrangements that are fitted about sheets as they were found, and about usual ones."""
ODD_ALONE, ODD_TAGGED, GROWN = 5, 2, 2
"""Odd scatterers beside the best sheet alone, and beside so many best layouts and free arrangements."""
MOST = 4
"""Reflectors anywhere about a sheet."""

Enter = Callable[[Layout | None, Found, int], Found]


class Entry(Protocol):
    """A hypothesis that was tried before."""

    @property
    def layout(self) -> Layout | None: ...

    @property
    def found(self) -> Found: ...

    @property
    def log_z(self) -> float: ...


def explain(
    spectra: Spectra,
    layouts: Sequence[Layout],
    kinds: Sequence[Kind],
    before: Sequence[Entry],
    enter: Enter,
    priors: Priors = Priors(),
) -> None:
    """Enter sheets at their most probable parameters, alone and with reflectors about them.

    Args:
        kinds: of sheets.
        before: hypotheses of points.
        enter: enters a hypothesis beside up to so many odd scatterers, and gives the best of them.
        priors: of centre and mounting.
    """
    best = max(one.log_z for one in before)
    thin = spectra.thinned(2)
    sheets: list[tuple[Layout | None, Found]] = []

    def fitted(layout: Layout | None, model: SheetModel, x: Floats) -> None:
        x = refined(thin, model, x, (1e-2,), 8).x
        found = refined(spectra, model, x, (None,), 4)
        if not any(layout is other and _same(found, one) for other, one in sheets):
            sheets.append((layout, found))

    def fit_best(some: list[_Start], most: tuple[int, int]) -> None:
        some.sort(key=lambda one: -one.log)
        for named, count in zip((True, False), most, strict=True):
            for _, layout, model, x in [one for one in some if (one.layout is not None) == named][:count]:
                fitted(layout, model, x)

    alone = Seeker(spectra)
    likely = [start for kind in kinds for start in alone.best(kind, SHEETS)]
    for start in sorted(likely, key=lambda one: -one.score)[:ALONE]:
        model, x = start.begun(_disc(max(start.half_m)), priors)
        if possible(spectra, model, x) > best:
            fitted(None, model, x)
    sheets.sort(key=lambda one: -one[1].log_z)
    sheets = [(None, enter(None, found, 0 if i else ODD_ALONE)) for i, (_, found) in enumerate(sheets)]
    joint = []
    for layout, guest in _guests(before):
        seeker = Seeker(spectra, guest.beside(spectra)[:, : len(guest.model.transfer.power)])
        for kind in kinds:
            (start,) = seeker.best(kind, 1)
            model, x = start.begun(guest.model.disc, priors)
            if possible(spectra, model, x) > best:
                model, x = _with(model, x, guest)
                joint.append(_Start(best_powers(spectra, model, x)[1], layout, model, x))
    alone_only = len(sheets)
    joint.sort(key=lambda one: -one.log)
    nearer = [
        (refined(thin, model, x, (1e-2,), 3), layout, model) for _, layout, model, x in joint[:FOLLOWED]
    ]
    for found, layout, model in sorted(nearer, key=lambda one: -one[0].log_z)[:JOINT]:
        fitted(layout, model, found.x)
    starts: list[_Start] = []
    for _, found in sorted(sheets, key=lambda one: -one[1].log_z)[:ABOUT]:
        starts += _about(spectra, layouts, _bare(found), found.x, found.centre, found.powers)
    usual: list[_Start] = []
    for model, x in _round(kinds, sheets):
        powers, _ = best_powers(spectra, model, x, 1e-2)
        usual += _about(spectra, layouts, model, x, complex(x[0], x[1]), powers)
    fit_best(starts, FITTED)
    fit_best(usual, FITTED_USUAL)
    # A handle may be louder than the tag: then that is looked for beside it.
    singles: dict[str, _Start] = {}
    for one in sorted((one for one in (*starts, *usual) if one.single), key=lambda one: -one.log):
        singles.setdefault(one.model.transfer.name, one)
    beside_loud: list[_Start] = []
    for _, _, model, x in list(singles.values())[:LOUD]:
        own, x = _as_odd(model, refined(thin, model, x, (1e-2,), 8).x)
        loud = refined(spectra, own, x, (None,), 8)
        beside_loud += _about(spectra, layouts, own, loud.x, loud.centre, loud.powers)
    fit_best(beside_loud, FITTED_USUAL)
    tagged = sorted(sheets[alone_only:], key=lambda one: -one[1].log_z)
    for named in (True, False):
        for i, (layout, found) in enumerate(one for one in tagged if (one[0] is not None) == named):
            enter(layout, found, ODD_TAGGED if i < GROWN else 0)
    if tagged:
        # The sheet that a tag has shown, with anything else about it.
        found = tagged[0][1]
        enter(None, refined(spectra, _bare(found), np.r_[found.x[:HEAD], 0.0, 0.0], (None,), 4), ODD_ALONE)


class _Start(NamedTuple):
    """A sheet with reflectors about it, not fitted, and its log evidence."""

    log: float
    layout: Layout | None
    model: SheetModel
    x: Floats

    @property
    def single(self) -> bool:
        """One reflector, of no layout."""
        return self.layout is None and self.model.tag is not None and self.model.tag.count == 1


def _as_odd(model: SheetModel, x: Floats) -> tuple[SheetModel, Floats]:
    """The same with its only reflector as an odd scatterer."""
    (place,) = model.places(x)
    return replace(model, tag=None).and_odd(), np.r_[x[:HEAD], 0.0, 0.0, place.real, place.imag]


def _bare(found: Found) -> SheetModel:
    """The sheet of a hypothesis, alone."""
    assert isinstance(found.model, SheetModel)
    return replace(found.model, tag=None, odd=0)


def _same(one: Found, other: Found) -> bool:
    """The same sheet with the same reflectors."""
    if one.model.transfer is not other.model.transfer or len(one.places) != len(other.places):
        return False
    alike = abs(one.log_z - other.log_z) < 3
    if len(one.places):
        return alike and bool(np.abs(one.places[:, None] - other.places).min(axis=1).max() < 3e-3)
    return alike and abs(one.x[3:5].sum() - other.x[3:5].sum()) < 0.03


def possible(spectra: Spectra, model: SheetModel, x: Floats) -> float:
    """Largest log evidence of a sheet about here with any reflectors: noise is left, and amplitudes cost."""
    whitener = spectra.whiteners[model.disc]
    columns = whitener.apply(model.at(spectra, x).values)
    lam = np.ones((1, *columns[:, 0].shape))
    power = np.stack([model.power(spectra.moving, BODY[0], 1.0, oval) for oval in OVAL])
    cost = log_evidence(columns, np.zeros_like(columns[:, 0]), lam, power).max()
    noise = np.maximum(1 - MODEL_ERROR**2 * spectra.moving, 0).sum()
    return float(cost - noise * (columns.shape[2] - columns.shape[1] - 1))


def _round(
    kinds: Sequence[Kind], sheets: Sequence[tuple[Layout | None, Found]]
) -> Iterator[tuple[SheetModel, Floats]]:
    """Round sheets of usual sizes where the best one stands: a round echo hardly tells the size."""
    if not sheets:
        return
    best = max((found for _, found in sheets), key=lambda one: one.log_z)
    for kind in kinds:
        for half_m in kind.tagged_m:
            size = float(np.log(half_m / kind.size_m))
            x = np.r_[best.x[:2], 0.0, size, size, 0.0, 0.0, 0.0]
            yield SheetModel.of(kind, (half_m, half_m), _disc(half_m)), x


def _disc(half_m: float) -> int:
    return 0 if half_m < 0.07 else 1


def _guests(before: Sequence[Entry]) -> list[tuple[Layout | None, Found]]:
    """The best layouts, and the best free arrangements of different numbers."""
    out: dict[tuple[Layout | None, int], Found] = {}
    for one in sorted(before, key=lambda one: -one.log_z):
        if one.found.model.tag is not None:
            count = 0 if one.layout is not None else one.found.model.tag.count
            out.setdefault((one.layout, count), one.found)
    kept = [(layout, found) for (layout, _), found in out.items()]
    named = [one for one in kept if one[0] is not None]
    return named[:GUESTS] + [one for one in kept if one[0] is None][:GUESTS]


def _with(model: SheetModel, x: Floats, guest: Found) -> tuple[SheetModel, Floats]:
    """A sheet with the reflectors of another hypothesis."""
    centre, turn, stretch, _ = guest.model.split(guest.x)
    off = centre - complex(x[0], x[1])
    return replace(model, tag=guest.model.tag), np.r_[x[:HEAD], off.real, off.imag, turn, stretch]


def _about(
    spectra: Spectra, layouts: Sequence[Layout], model: SheetModel, x: Floats, middle: complex, powers: Powers
) -> Iterator[_Start]:
    """Reflectors about one sheet, by its tables.

    Args:
        model: of the sheet, and of odd scatterers beside it.
        x: its parameters.
        middle: supposed centre of reflectors, x + jy, m.
    """
    arranged = [Arrangement.of_layout(layout.positions, layout.heights) for layout in layouts]
    odd = x[len(x) - 2 * model.odd :]
    x = np.r_[x[:HEAD], 0.0, 0.0, odd]
    sheet_centre = complex(x[0], x[1])
    centres = [sheet_centre]
    if abs(middle - sheet_centre) > 4e-3:
        centres.append(middle)
    for centre in centres:
        off = centre - sheet_centre
        head = np.r_[x[:HEAD], off.real, off.imag]
        powers = replace(powers, clutter=1e-2, tag=0.3)
        near = beside(spectra, model, x, arranged, centre, powers)
        for layout, a, turns in zip(layouts, arranged, search.turned(near.layouts, 2), strict=True):
            for turn in turns:
                yield _Start(turn.log, layout, replace(model, tag=a), np.r_[head, turn.angles[0], 0.0, odd])
        for log, places in sets(near.spots, near.places, MOST):
            tag = Arrangement.points(places - sheet_centre)
            free = np.r_[x[: HEAD + 2], np.zeros(2 * tag.count), odd]
            yield _Start(log, None, replace(model, tag=tag), free)
