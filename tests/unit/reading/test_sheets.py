"""Thin sheets as bodies: slopes of their columns, and solved shells and cartons that nobody enrolled."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from reader_scenes import prepared

from tagid.reading import sheet, sheet_tags
from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import Model
from tagid.reading.compiled import Compiled
from tagid.reading.decision import decide
from tagid.reading.descent import Estimate, _Numpy, refined
from tagid.reading.hypothesis import Hypothesis
from tagid.reading.sheet import HEAD, KINDS, METAL, SHELL, Kind, SheetColumns, SheetModel
from tagid.reading.sheet_search import Seeker
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE, POINTS
from tagid.simulate import Acquisition, Placement, Wobble, simulate_capture
from tagid.simulate.presets import room_clutter
from tagid.simulate.response_file import read_response
from tagid.simulate.response_scene import response_scene
from tagid.tags.layouts.layout import Layout, builtin_layouts

DATA = Path(__file__).parents[2] / "data"
LAYOUTS = builtin_layouts()


@cache
def spectra_of(folder: str, name: str) -> Spectra:
    """Of a thin shell that was solved by the method of moments (tests/data): off the axis, wobbling, the axis
    distance wrong by 8 mm, in a room."""
    placement, wobble = Placement((-0.003, 0.004), 1.0), Wobble(speed=0.005)
    how = {"views": 18, "snr_db": 20.0, "axis_distance_error_m": 0.008}
    acquisition = Acquisition(placement=placement, wobble=wobble, **how)
    shell = read_response(DATA / folder / f"{name}.npz")
    reply = read_response(DATA / "responses/free30_one.npz")
    room = room_clutter(np.random.default_rng(len(name)))
    capture, _ = simulate_capture(response_scene(shell, acquisition, "V", reply, room), acquisition, 1)
    return Spectra.of(prepared(capture))


@cache
def explained(folder: str, name: str) -> tuple[Hypothesis, ...]:
    """Nothing, a round body, and what is made of sheets."""
    spectra = spectra_of(folder, name)
    models = [Model(item, None, item.body, 1) for item in (BARE, POINTS)]
    nothing = [refined(spectra, model, np.zeros(model.parameters)) for model in models]
    results = [Hypothesis(None, item, item.log_z) for item in nothing]

    def enter(layout: Layout | None, estimate: Estimate, odd: int) -> Estimate:
        results.append(Hypothesis(layout, estimate, estimate.log_z))
        return estimate

    sheet_tags.explain(spectra, list(LAYOUTS.values()), KINDS, tuple(results), enter)
    return tuple(results)


TAGGED = replace(
    SheetModel.of(SHELL, (0.07, 0.08), 1),
    tag=Arrangement.of_layout(LAYOUTS["helmet-120"].positions, LAYOUTS["helmet-120"].heights),
    odd=2,
    faces=((1.0, 0.3), None),
)
X = np.array([8e-3, -6e-3, 0.3, -0.05, 0.1, 0.05, 1e-3, 2e-3, 0.7, 5e-4, 0.06, 0.09, 0.03, 0.05])


@pytest.mark.parametrize("compiled", [True, False])
def test_slopes_are_those_of_the_evidence(compiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not compiled:
        monkeypatch.setattr(sheet, "_sheet", None)
    spectra = spectra_of("shells", "shell74_h120").thinned(4)
    likelihood = (Compiled.of if compiled else _Numpy)(spectra, TAGGED)
    if likelihood is None:
        pytest.skip("no compiler was present at installation")
    powers = (10.0, 0.3, 1e-2)
    value, slopes, _ = likelihood.expanded(X, powers, 1e-2)
    steps = 1e-5 * np.eye(len(X))
    ends = [
        [likelihood.values(X + sign * step, [powers], [1e-2])[0, 0] for sign in (1, -1)] for step in steps
    ]
    measured = -np.diff(ends, axis=1)[:, 0] / 2e-5
    assert value == pytest.approx(likelihood.values(X, [powers], [1e-2])[0, 0], rel=1e-12)
    assert slopes == pytest.approx(measured, rel=3e-3, abs=1.0)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.transfer.name)
def test_the_compiled_columns_are_those_of_numpy(kind: Kind, monkeypatch: pytest.MonkeyPatch) -> None:
    """But for the curvature of waves from antennas that are not equally far from the sheet."""
    if sheet._sheet is None:
        pytest.skip("no compiler was present at installation")
    model = replace(TAGGED, kind=kind, transfer=kind.transfer)
    columns = SheetColumns(model, spectra_of("shells", "shell74_h120"), X)
    values, rates = columns.expanded
    np.testing.assert_array_equal(columns.values, values)
    monkeypatch.setattr(sheet, "_sheet", None)
    numpy_values, numpy_rates = SheetColumns(model, columns.spectra, X).expanded
    for first, other in zip((values, *rates), (numpy_values, *numpy_rates), strict=True):
        assert np.linalg.norm(first - other) < 1e-2 * np.linalg.norm(other)


@pytest.mark.parametrize(
    ("folder", "name", "kind"), [("shells", "shell74", "shell"), ("cartons", "carton140", "box")]
)
def test_a_sheet_explains_a_shell_better_than_a_round_body(folder: str, name: str, kind: str) -> None:
    nothing, round_body, *sheets = explained(folder, name)
    best = max((sheet for sheet in sheets if not sheet.tagged), key=lambda item: item.log_z)
    assert best.estimate.model.transfer.name == kind
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


def test_no_reflector_stands_inside_metal_where_none_is_seen() -> None:
    for kind, hidden in ((sheet.CAN, True), (sheet.CUP, False)):
        half = kind.size_m
        model = replace(SheetModel.of(kind, (half, half), 0), tag=Arrangement.rigid(np.array([0.02 + 0j])))
        assert (model.crowding(np.zeros(model.parameters)).max() > 10) == hidden


@pytest.mark.parametrize("half_m", [(0.034, 0.069), (0.045, 0.11), (0.06, 0.06)])
def test_a_box_of_metal_beside_a_reflector_is_looked_for_in_all_sizes(half_m: tuple[float, float]) -> None:
    """Of few views a square box explains chance flashes: its side tells nothing of an oblong one."""
    antenna = np.exp(2j * np.pi * np.arange(12) / 12)
    kappa = spectra_of("shells", "shell74").kappa
    nothing = np.zeros((len(kappa), 12), dtype=complex)
    empty = Spectra(nothing, kappa, antenna, np.zeros(12), 1.0, np.ones(len(kappa)), True)
    x = np.r_[5e-3, -2e-3, 0.4, np.log(np.array(half_m) / METAL.size_m), np.zeros(HEAD - 3)]
    echo = SheetColumns(SheetModel.of(METAL, half_m, 0), empty, x).values[:, 0]
    point, _ = empty.waves(np.array([0.03 + 0.08j]), np.zeros(1))
    (start,) = Seeker(replace(empty, data=echo + 0.3 * point[:, 0])).best(METAL, 1)
    np.testing.assert_allclose(sorted(start.half_m), half_m, rtol=0.08)
