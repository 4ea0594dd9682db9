"""Pictures of a report are made at the axis distance that the reading found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.batch.work import pictured
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import PreparedCapture, prepare
from tagid.pipeline.reconstruct import reconstruct
from tagid.pipeline.settings import ImagingSettings
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_from_name
from tagid.tags.layouts.layout import builtin_layouts

LAYOUTS = tuple(builtin_layouts().values())


@pytest.mark.parametrize("error_m", [-0.015, 0.012])
def test_the_axis_that_the_reading_found_is_the_one_that_a_search_finds(error_m: float) -> None:
    acquisition = Acquisition(views=24, snr_db=20.0, axis_distance_error_m=error_m)
    capture, _ = simulate_capture(scene_from_name("helmet-120", 0), acquisition, 0)
    prepared = PreparedCapture(prepare(capture), ImagingSettings(method="bp"))
    answer = identify(prepared, LAYOUTS)
    assert answer.status == "identified"
    placed = pictured(prepared, answer)
    right = capture.axis_distance_m - error_m if capture.axis_distance_m else 0.0
    assert placed.given.axis_distance_m == pytest.approx(right, abs=0.002)
    searched = reconstruct(prepared).image.values
    result = reconstruct(placed).image.values
    alike = abs(np.vdot(searched, result)) / np.linalg.norm(searched) / np.linalg.norm(result)
    assert alike > 0.98


def test_without_a_name_the_axis_is_searched() -> None:
    capture, _ = simulate_capture(scene_from_name("helmet-120", 0), Acquisition(views=24, snr_db=20.0), 0)
    prepared = PreparedCapture(prepare(capture), ImagingSettings(method="bp"))
    answer = identify(prepared, LAYOUTS)
    assert answer.reading is not None
    reading = replace(answer.reading, status="unknown", layout=None)
    unnamed = replace(answer, status=reading.status, reading=reading)
    assert pictured(prepared, unnamed) is prepared
