"""Thin sheets as bodies: slopes of their columns, and solved shells and cartons that nobody enrolled."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tagid.reading import sheet_tags
from tagid.reading.columns import Arrangement, Model
from tagid.reading.decision import decide
from tagid.reading.descent import Found, refined, variance
from tagid.reading.evidence import fit
from tagid.reading.hypotheses import Hypothesis
from tagid.reading.sheet import KINDS, SHELL, SheetModel
from tagid.reading.spectra import Floats, Spectra
from tagid.reading.transfers.plain import BARE, POINTS
from tagid.tags.layouts.layout import Layout, builtin_layouts
from tests.unit.solved_shells import recorded_at

LAYOUTS = builtin_layouts()


@cache
def spectra_of(folder: str, name: str) -> Spectra:
    return Spectra.of(recorded_at((-0.003, 0.004), folder, name, views=18))


@cache
def explained(folder: str, name: str) -> tuple[Hypothesis, ...]:
    """Nothing, a round body, and what is made of sheets."""
    spectra = spectra_of(folder, name)
    models = [Model(one, None, one.body, 1) for one in (BARE, POINTS)]
    nothing = [refined(spectra, one, np.zeros(one.parameters)) for one in models]
    found = [Hypothesis(None, one, one.log_z) for one in nothing]

    def enter(layout: Layout | None, one: Found, odd: int) -> Found:
        found.append(Hypothesis(layout, one, one.log_z))
        return one

    sheet_tags.explain(spectra, list(LAYOUTS.values()), KINDS, tuple(found), enter)
    return tuple(found)


def test_slopes_are_those_of_the_evidence() -> None:
    layout = LAYOUTS["helmet-120"]
    spectra = spectra_of("shells", "shell74_h120").thinned(4)
    tag = Arrangement.of_layout(layout.positions, layout.heights)
    model = replace(SheetModel.of(SHELL, (0.07, 0.08), 1), tag=tag, odd=1)
    x = np.array([8e-3, -6e-3, 0.3, -0.05, 0.1, 0.05, 1e-3, 2e-3, 0.7, 5e-4, 0.03, 0.05])
    whitener = spectra.whiteners[1]
    lam, power = variance(spectra, model, 1e-2), model.power(spectra.moving, 10.0, 0.3, 1e-2)

    def at(x: Floats) -> float:
        return fit(whitener.apply(model.at(spectra, x).values), spectra.white[1], lam, power).log

    columns = model.at(spectra, x)
    adjoint = fit(whitener.apply(columns.values), spectra.white[1], lam, power).adjoint
    slopes = 2 * columns.slopes(whitener.adjoint(adjoint).conj()).sum(axis=(1, 2)).real
    steps = 1e-5 * np.eye(len(x))
    measured = np.array([(at(x + step) - at(x - step)) / 2e-5 for step in steps])
    assert slopes == pytest.approx(measured, rel=3e-3, abs=1.0)


@pytest.mark.parametrize(
    ("folder", "name", "kind"), [("shells", "shell74", "shell"), ("cartons", "carton140", "box")]
)
def test_a_sheet_explains_a_shell_better_than_a_round_body(folder: str, name: str, kind: str) -> None:
    nothing, round_body, *sheets = explained(folder, name)
    best = max((one for one in sheets if not one.tagged), key=lambda one: one.log_z)
    assert best.found.model.transfer.name == kind
    assert best.log_z > max(nothing.log_z, round_body.log_z) + 50
    assert decide(explained(folder, name)).status != "identified"


@pytest.mark.parametrize(
    ("folder", "name", "layout"),
    [("shells", "shell74_h120", "helmet-120"), ("cartons", "carton140_c90", "container-90")],
)
def test_a_tag_about_a_sheet_is_named(folder: str, name: str, layout: str) -> None:
    assert decide(explained(folder, name)).name == layout


def test_three_reflectors_in_a_carton_are_no_pair() -> None:
    assert decide(explained("cartons", "carton140_three")).name is None
