"""Sheets with and without reflectors: what is tried of them beside the hypotheses of points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tagid.reading import search
from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import Priors
from tagid.reading.descent import BODY, OVAL, Estimate, Powers, best_powers, refined
from tagid.reading.evidence import log_evidence
from tagid.reading.hypothesis import Hypothesis
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

Enter = Callable[[Layout | None, Estimate, int], Estimate]


def explain(
    spectra: Spectra,
    layouts: Sequence[Layout],
    kinds: Sequence[Kind],
    before: Sequence[Hypothesis],
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
    best = max(hypothesis.log_z for hypothesis in before)
    thin = spectra.thinned(2)
    sheets: list[tuple[Layout | None, Estimate]] = []

    def fitted(layout: Layout | None, model: SheetModel, x: Floats) -> None:
        x = refined(thin, model, x, (1e-2,), 8).x
        estimate = refined(spectra, model, x, (None,), 4)
        if not any(layout is other and _same(estimate, other_estimate) for other, other_estimate in sheets):
            sheets.append((layout, estimate))

    def fit_best(some: list[_Start], most: tuple[int, int]) -> None:
        some.sort(key=lambda start: -start.log)
        for named, count in zip((True, False), most, strict=True):
            best_starts = [start for start in some if (start.layout is not None) == named]
            for _, layout, model, x in best_starts[:count]:
                fitted(layout, model, x)

    alone = Seeker(spectra)
    likely = [start for kind in kinds for start in alone.best(kind, SHEETS)]
    for start in sorted(likely, key=lambda start: -start.score)[:ALONE]:
        model, x = start.begun(_disc(max(start.half_m)), priors)
        if possible(spectra, model, x) > best:
            fitted(None, model, x)
    sheets.sort(key=lambda entry: -entry[1].log_z)
    sheets = [(None, enter(None, estimate, 0 if i else ODD_ALONE)) for i, (_, estimate) in enumerate(sheets)]
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
    joint.sort(key=lambda start: -start.log)
    nearer = [
        (refined(thin, model, x, (1e-2,), 3), layout, model) for _, layout, model, x in joint[:FOLLOWED]
    ]
    for estimate, layout, model in sorted(nearer, key=lambda entry: -entry[0].log_z)[:JOINT]:
        fitted(layout, model, estimate.x)
    starts: list[_Start] = []
    for _, estimate in sorted(sheets, key=lambda entry: -entry[1].log_z)[:ABOUT]:
        starts += _about(spectra, layouts, _bare(estimate), estimate.x, estimate.centre, estimate.powers)
    usual: list[_Start] = []
    for model, x in _round(kinds, sheets):
        powers, _ = best_powers(spectra, model, x, 1e-2)
        usual += _about(spectra, layouts, model, x, complex(x[0], x[1]), powers)
    fit_best(starts, FITTED)
    fit_best(usual, FITTED_USUAL)
    # A handle may be louder than the tag: then that is looked for beside it.
    singles: dict[str, _Start] = {}
    for single in sorted(
        (candidate for candidate in (*starts, *usual) if candidate.single),
        key=lambda candidate: -candidate.log,
    ):
        singles.setdefault(single.model.transfer.name, single)
    beside_loud: list[_Start] = []
    for _, _, model, x in list(singles.values())[:LOUD]:
        loud_model, x = _as_odd(model, refined(thin, model, x, (1e-2,), 8).x)
        loud = refined(spectra, loud_model, x, (None,), 8)
        beside_loud += _about(spectra, layouts, loud_model, loud.x, loud.centre, loud.powers)
    fit_best(beside_loud, FITTED_USUAL)
    tagged = sorted(sheets[alone_only:], key=lambda entry: -entry[1].log_z)
    for named in (True, False):
        for i, (layout, estimate) in enumerate(entry for entry in tagged if (entry[0] is not None) == named):
            enter(layout, estimate, ODD_TAGGED if i < GROWN else 0)
    if tagged:
        # The sheet that a tag has shown, with anything else about it.
        estimate = tagged[0][1]
        enter(
            None, refined(spectra, _bare(estimate), np.r_[estimate.x[:HEAD], 0.0, 0.0], (None,), 4), ODD_ALONE
        )


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
    (place,) = model.positions(x)
    return replace(model, tag=None).and_odd(), np.r_[x[:HEAD], 0.0, 0.0, place.real, place.imag]


def _bare(estimate: Estimate) -> SheetModel:
    """The sheet of a hypothesis, alone."""
    assert isinstance(estimate.model, SheetModel)
    return replace(estimate.model, tag=None, odd=0)


def _same(estimate: Estimate, other: Estimate) -> bool:
    """The same sheet with the same reflectors."""
    if estimate.model.transfer is not other.model.transfer or len(estimate.positions) != len(other.positions):
        return False
    alike = abs(estimate.log_z - other.log_z) < 3
    if len(estimate.positions):
        return alike and bool(np.abs(estimate.positions[:, None] - other.positions).min(axis=1).max() < 3e-3)
    return alike and abs(estimate.x[3:5].sum() - other.x[3:5].sum()) < 0.03


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
    kinds: Sequence[Kind], sheets: Sequence[tuple[Layout | None, Estimate]]
) -> Iterator[tuple[SheetModel, Floats]]:
    """Round sheets of usual sizes where the best one stands: a round echo hardly tells the size."""
    if not sheets:
        return
    best = max((estimate for _, estimate in sheets), key=lambda entry: entry.log_z)
    for kind in kinds:
        for half_m in kind.tagged_m:
            size = float(np.log(half_m / kind.size_m))
            x = np.r_[best.x[:2], 0.0, size, size, 0.0, 0.0, 0.0]
            yield SheetModel.of(kind, (half_m, half_m), _disc(half_m)), x


def _disc(half_m: float) -> int:
    return 0 if half_m < 0.07 else 1


def _guests(before: Sequence[Hypothesis]) -> list[tuple[Layout | None, Estimate]]:
    """The best layouts, and the best free arrangements of different numbers."""
    out: dict[tuple[Layout | None, int], Estimate] = {}
    for entry in sorted(before, key=lambda entry: -entry.log_z):
        if entry.estimate.model.tag is not None:
            count = 0 if entry.layout is not None else entry.estimate.model.tag.count
            out.setdefault((entry.layout, count), entry.estimate)
    kept = [(layout, estimate) for (layout, _), estimate in out.items()]
    named = [entry for entry in kept if entry[0] is not None]
    return named[:GUESTS] + [entry for entry in kept if entry[0] is None][:GUESTS]


def _with(model: SheetModel, x: Floats, guest: Estimate) -> tuple[SheetModel, Floats]:
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
        whole, spots, nodes = beside(spectra, model, x, arranged, centre, powers)
        for layout, a, turns in zip(layouts, arranged, search.turned(whole, 2), strict=True):
            for turn in turns:
                yield _Start(turn.log, layout, replace(model, tag=a), np.r_[head, turn.angles[0], 0.0, odd])
        for log, positions in sets(spots, nodes, MOST):
            tag = Arrangement.points(positions - sheet_centre)
            free = np.r_[x[: HEAD + 2], np.zeros(2 * tag.count), odd]
            yield _Start(log, None, replace(model, tag=tag), free)
