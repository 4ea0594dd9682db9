"""The restoring beam keeps a point's amplitude and place, and is as wide as the full-turn point response."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import j0

from tagid.geometry import ImageGrid
from tagid.imaging.restore import beam_sigma_m, restore
from tagid.imaging.types import Image

K = 2 * np.pi * 3.95e9 / 299_792_458.0


def test_the_beam_is_half_where_the_point_response_is() -> None:
    half = beam_sigma_m(K) * np.sqrt(2 * np.log(2))
    assert j0(2 * K * half) == pytest.approx(0.5, abs=1e-3)


def test_pixels_of_one_point_add_up_to_its_amplitude_and_opposite_ones_cancel() -> None:
    grid = ImageGrid(0.5, 100)
    values = np.zeros((100, 100), dtype=np.complex64)
    values[40, 60], values[40, 61] = 1j, 0.5j
    shown = restore(Image(values, grid, {"method": "omp"}), K)
    peak = np.unravel_index(int(np.abs(shown.values).argmax()), shown.values.shape)
    assert peak == (40, 60)
    assert abs(shown.values[40, 60]) == pytest.approx(1.5, rel=0.1)
    assert np.angle(shown.values[40, 60]) == pytest.approx(np.pi / 2)
    assert shown.settings["restoring_beam_m"] == pytest.approx(beam_sigma_m(K))
    values[40, 61] = -1j
    assert np.abs(restore(Image(values, grid), K).values).max() < 0.5
