"""Errors of the stated angles: the slopes over them, that they are found, and names in spite of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reader_scenes import LAYOUTS, scans_of, spectra_of

from tagid.imaging.types import BasebandScans
from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import Model
from tagid.reading.decision import decide
from tagid.reading.descent import refined
from tagid.reading.reader import contest
from tagid.reading.sheet import SHELL, SheetModel
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE
from tagid.reading.transfers.shade import SHADES
from tagid.reading.uneven import SCALE, errors, fitted, spin, straightened

SPECTRA = spectra_of("helmet-120", views=40, turns=0.85, snr_db=20.0)
HELMET = next(layout for layout in LAYOUTS if layout.name == "helmet-120")
TAG = Arrangement.of_layout(HELMET.positions, HELMET.heights)
MODELS = {
    "layout": Model(SHADES[1], TAG, True, 1, odd=2),
    "free": Model(BARE, Arrangement.points(np.array([0.04, 0.05j, -0.03 - 0.03j])), False, 0, odd=1),
    "heights": Model(SHADES[1], TAG, True, 1, odd=1, levels=2),
    "sheet": replace(SheetModel.of(SHELL, (0.06, 0.08), 1), tag=TAG, odd=1),
}


@pytest.mark.parametrize("name", MODELS)
def test_an_object_that_turns_with_the_antenna_looks_the_same(name: str) -> None:
    model = MODELS[name]
    x = 0.003 * np.cos(1.0 + 3 * np.arange(model.parameters))
    x[-model.spot * model.odd :] = 0.09 * np.sin(2.0 + 2 * np.arange(model.spot * model.odd))
    turn = 1e-4
    ahead = SPECTRA.turned(np.full(SPECTRA.views, turn))
    here, still = model.at(SPECTRA, x).values, model.at(ahead, x).values
    along = model.at(ahead, x + turn * spin(model, x)).values
    # Amplitudes of oval tangents say which way an oval lies.
    whole = [i for i in range(model.columns) if not (model.shapes and i in (1, 2))]
    assert np.abs(still - here)[:, whole].max() > 3e-4
    assert np.abs(along - here)[:, whole].max() < 3e-5


def error_of(spectra: Spectra) -> np.ndarray:
    """(V,) by which the antenna was turned, rad."""
    return np.angle(spectra.antenna / spectra.stated.antenna)


def test_errors_of_the_angles_are_found() -> None:
    rows = errors(SPECTRA)
    truth = np.array([0.6, -0.8, 0.5, 0.9, 1.1])
    spoiled = replace(SPECTRA, antenna=SPECTRA.antenna * np.exp(-1j * (truth @ rows)))
    model = Model(BARE, TAG, False, 1)
    starts = [np.array([0.003, 0.0015, turn, 0.0]) for turn in np.linspace(0, 2 * np.pi / 3, 12)]
    result = max((refined(spoiled, model, x) for x in starts), key=lambda item: item.log_z)
    turned = fitted(spoiled, result)
    assert turned is not None and turned.spectra.stated is spoiled
    # A turn of all of them is one of the object.
    off = error_of(turned.spectra) - truth @ errors(spoiled)
    assert np.std(off) < 0.1 * np.std(truth @ rows)
    assert turned.log_z > result.log_z + 50
    again = refined(turned.spectra, model, result.x)
    assert again.log_z - turned.cost > turned.log_z - 1, "with powers of its own it may be more"
    t = np.linalg.lstsq(errors(spoiled).T, error_of(turned.spectra))[0]
    assert turned.cost > 0.5 * float(t @ t)
    assert straightened(spoiled, [result], result.log_z) is not None
    right = refined(SPECTRA, model, result.x)
    assert straightened(SPECTRA, [right], right.log_z) is None


def test_every_height_has_a_speed_and_a_beginning_of_its_own() -> None:
    """Turns of 10 degrees a view, of which the last step is shorter: there the scale of the angles jumps."""
    views, levels = 36, 3
    angle = np.concatenate([0.7 * level - np.deg2rad(10.05) * np.arange(views) for level in range(levels)])
    height_m = np.repeat([0.0, 0.15, 0.3], views)
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((2, len(SPECTRA.kappa), levels * views))
    empty = replace(
        SPECTRA, antenna=np.exp(1j * angle), height_m=height_m, data=(noise[0] + 1j * noise[1]) / np.sqrt(2)
    )
    rows = errors(empty)
    assert len(rows) == 4 + levels + levels - 1
    for row, start in zip(rows[4 : 4 + levels], range(0, levels * views, views), strict=True):
        turned = row[start : start + views] / SCALE
        np.testing.assert_allclose(np.diff(turned), -np.deg2rad(10.05), atol=1e-6)
        assert not row[:start].any() and not row[start + views :].any()
    truth = np.array([0.0, 0.0, 0.0, 0.0, 0.2, -0.1, 0.3, 0.8, -1.2])
    model = Model(BARE, Arrangement.of_layout(HELMET.positions, None), False, 1, levels=levels)
    x = np.zeros(model.parameters)
    echo = model.at(empty.turned(truth @ rows), x, slopes=False).values[:, 0]
    spectra = replace(empty, data=empty.data + 20 * echo, moving=np.full_like(SPECTRA.moving, 200.0))
    data = spectra.data - (spectra.data @ spectra.rooms.T) @ spectra.rooms
    spectra = replace(spectra, data=data)
    turned = fitted(spectra, refined(spectra, model, x))
    off = error_of(turned.spectra) - truth @ rows
    assert np.std(off) < 0.02 * np.std(truth @ rows)


def scaled(scans: BasebandScans, scale: float) -> BasebandScans:
    angles, distance = scans.aperture.angles, scans.aperture.axis_distance
    return replace(scans, aperture=scans.aperture.turned(scale * angles, distance))


def test_part_of_a_turn_of_another_scale_is_named() -> None:
    scale = 1.02  # the other way than that of the test before
    scans = scaled(scans_of("helmet-120", views=45, turns=0.9, snr_db=20.0), scale)
    base = contest(scans, LAYOUTS)
    base.transfers, base.sheets = (BARE,), ()
    answer = decide(base.run())
    assert answer.name == "helmet-120" and base.spectra.stated is not None
    assert answer.lead > 100
    rows = errors(base.spectra.stated)
    truth = (1 / scale - 1) / SCALE * rows[-1]
    assert np.std(error_of(base.spectra) - truth) < 0.1 * np.std(truth)


def test_a_whole_turn_is_none_where_the_scale_of_its_angles_is_not_known() -> None:
    scale = 1.008
    scans = scaled(scans_of("helmet-120", views=128, turns=1 / scale, snr_db=20.0), scale)
    assert contest(scans, LAYOUTS).spectra.full_turn
    stated = replace(scans, angle_scale_sigma=0.06)
    base = contest(stated, LAYOUTS)
    assert not base.spectra.full_turn and base.spectra.views > 100, "no filter crosses the seam"
    base.transfers, base.sheets = (BARE,), ()
    best = max(base.run(), key=lambda hypothesis: hypothesis.log_z)
    assert best.name == "helmet-120" and base.spectra.stated is not None
    truth = (1 / scale - 1) / 0.06 * errors(base.spectra.stated)[-1]
    assert np.std(error_of(base.spectra) - truth) < 0.25 * np.std(truth)
