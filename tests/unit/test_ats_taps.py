"""The field's inner loops: compiled against scipy and numpy, the transpose, and pixels left out."""

from __future__ import annotations

import numpy as np
import pytest

from tagid.geometry import ImageGrid
from tagid.imaging.ats import taps as module
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.problem import interpolation
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.ats.taps import Adam, Taps, first_support, next_support
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tests.unit.imaging_scenes import record, turn

RNG = np.random.default_rng(3)
compiled = pytest.mark.skipif(module._compiled is None, reason="no compiler was present at installation")


@pytest.mark.parametrize("features", [2, 3])
@pytest.mark.parametrize("native", [pytest.param(True, marks=compiled), False])
def test_interpolation_is_that_of_the_field_and_has_its_transpose(features, native, monkeypatch) -> None:
    if not native:
        monkeypatch.setattr(module, "_compiled", None)
    cells = (3, 7)
    tables = [RNG.standard_normal((features, n + 1, n + 1)).astype(np.float32) for n in cells]
    some = np.array([0, 4, 17, 80])
    taps = Taps.of(9, list(cells), some)
    table = np.concatenate([t.reshape(features, -1) for t in tables], axis=1).T.copy()
    rows = np.empty((4, 2 * features), np.float32)
    taps.interpolate(table, rows)
    along = [interpolation(9, n) for n in cells]
    dense = [at @ table @ at.T for at, table in zip(along, tables, strict=True)]
    expected = np.concatenate([part.reshape(features, -1)[:, some] for part in dense])
    np.testing.assert_allclose(rows.T, expected, atol=1e-6)
    slope = RNG.standard_normal(rows.shape).astype(np.float32)
    back = np.full_like(table, 7)
    taps.accumulate(slope, back)
    assert float((rows * slope).sum()) == pytest.approx(float((table * back).sum()), rel=1e-4)


@compiled
def test_the_compiled_update_is_that_of_numpy(monkeypatch) -> None:
    sizes, states = [5, 12, 1], []
    start = RNG.standard_normal((2, 18)).astype(np.float32)
    gradients = RNG.standard_normal((3, 18)).astype(np.float32)
    rates = np.array([0.1, 0.02, 0.3], np.float32)
    for native in (True, False):
        if not native:
            monkeypatch.setattr(module, "_compiled", None)
        adam, parameters = Adam.of(sizes), start[0].copy()
        for gradient in gradients:
            adam.update(parameters, gradient.copy(), rates, 3.0, 0.1)
        states.append((parameters, adam.first.copy(), adam.second.copy()))
    for first, other in zip(*states, strict=True):
        np.testing.assert_allclose(first, other, rtol=1e-5, atol=1e-7)


@compiled
def test_buffers_that_do_not_fit_are_refused() -> None:
    taps = Taps.of(4, [3])
    rows = np.zeros((16, 2), np.float32)
    with pytest.raises(ValueError, match="fit together"):
        taps.interpolate(np.zeros((15, 2), np.float32), rows)  # 16 vertices
    with pytest.raises(ValueError, match="fit together"):
        taps.interpolate(np.zeros((16, 2), np.float32), rows[:3])
    with pytest.raises(ValueError, match="fit together"):
        Adam.of([4]).update(*(np.zeros(3, np.float32) for _ in range(2)), np.ones(1, np.float32), 1.0, 0.1)


def test_a_fit_without_the_compiled_loops_gives_the_same_image(monkeypatch) -> None:
    grid = ImageGrid(0.3, 24)
    scans = preprocess(
        record([[0.05, 0.02]], [1], turn(24), noise=0.02),
        settings=PreprocessSettings("none", False, extent_m=0.3),
    )
    settings = AtsSettings(steps=20, engine="native")
    single = fit(scans, grid, settings).image.values
    monkeypatch.setattr(module, "_compiled", None)
    other = fit(scans, grid, settings).image.values
    assert np.linalg.norm(single - other) < 1e-3 * np.linalg.norm(other)


def test_dark_pixels_are_left_out_and_zero_and_a_late_reflector_joins() -> None:
    strength = np.zeros((9, 9))
    strength[4, 4] = 1
    first = first_support(strength, np.zeros((9, 9)), 0.1)
    assert first.sum() == 9
    assert first[3:6, 3:6].all()
    drawn = np.zeros((9, 9))
    drawn[0, 0], drawn[8, 0] = 1, 0.01
    assert first_support(strength, drawn, 0.1).sum() == 13  # four about what the first image shows
    residual = np.zeros((9, 9))
    residual[0, 8] = 0.2
    later = next_support(strength, residual, 0.1)
    assert later.sum() == 13  # nine about the bright pixel, four in the corner
    assert later[0, 8]
    assert not next_support(strength, residual / 4, 0.1)[0, 8]
    assert next_support(np.ones((9, 9)), residual, 0.1).all()


def test_the_image_is_zero_outside_the_support() -> None:
    scans = preprocess(
        record([[0.05, 0.02]], [1], turn(24), noise=0.02),
        settings=PreprocessSettings("none", False, extent_m=0.3),
    )
    result = fit(scans, ImageGrid(0.3, 40), AtsSettings(steps=60))
    assert result.field is not None
    assert result.field.support is not None
    dark = ~result.field.support
    assert dark.mean() > 0.7
    assert not result.image.values[dark].any()
    assert result.image.values[result.field.support].any()
