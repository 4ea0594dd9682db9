"""Objects that stand anywhere on the table."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.pipeline.prepared import load_capture
from tagid.reading.columns import Model
from tagid.reading.descent import refined
from tagid.reading.hypotheses import Contest
from tagid.reading.hypothesis import Arranged, Hypothesis
from tagid.reading.place import likeliest
from tagid.reading.reader import read
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE
from tagid.simulate import Placement, parse_body, parse_reflector
from tagid.simulate.acquisition import Acquisition
from tagid.simulate.capture import simulate_capture
from tagid.simulate.presets import scene_on_body
from tagid.tags.layouts.layout import builtin_layouts

LAYOUTS = list(builtin_layouts().values())
PLACE = 0.048 - 0.036j


@cache
def recorded(layout: str, body: str, views: int = 36) -> BasebandScans:
    scene = scene_on_body(layout, parse_body(body), parse_reflector("octahedron:20mm"))
    there = Placement((PLACE.real, PLACE.imag), 0.4)
    capture, _ = simulate_capture(scene, Acquisition(views=views, snr_db=20.0, placement=there), seed=3)
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    return preprocess(load_capture(capture), settings=settings)


@pytest.mark.parametrize(("layout", "body"), [("container-90", "can:35mm"), ("container-180", "none")])
def test_a_tag_off_the_axis_is_named_and_placed(layout: str, body: str) -> None:
    reading = read(recorded(layout, body), LAYOUTS)
    assert reading.layout == layout and reading.status == "identified"
    assert abs(complex(*reading.centre_m) - PLACE) < 3e-3
    assert abs(complex(*reading.hypotheses[0].centre_m) - PLACE) < 5e-3
    away = [abs(complex(point.x_m, point.y_m) - PLACE) for point in reading.reflectors if point.matched]
    assert away == pytest.approx([0.045, 0.045], abs=6e-3)
    # For a picture without the body, the hypothesis is in the frame of the recording.
    assert reading.winner is not None and abs(reading.winner.estimate.centre - PLACE) < 5e-3


def test_clutter_and_a_round_body_tell_where_an_object_stands() -> None:
    assert abs(likeliest(Spectra.of(recorded("container-90", "can:35mm"))) - PLACE) < 3e-3


def test_hypotheses_are_as_likely_in_the_frame_of_another_place() -> None:
    spectra = Spectra.of(recorded("container-90", "can:35mm"))
    contest = Contest(spectra, LAYOUTS)
    model = Model(BARE, Arranged.of(LAYOUTS[0], False).tag, False, 0, odd=1)
    x = np.array([0.004, 0.003, 0.5, 0.0, 0.05, -0.02])
    estimate = refined(spectra, model, x, (1e-2,), 2)
    moved = Hypothesis(None, estimate, estimate.log_z).moved(-PLACE, 1.0)
    there = contest.about(PLACE)
    assert there.place == PLACE and not there.hypotheses
    assert moved.log_z == estimate.log_z + 1 and moved.prior == 1
    assert np.allclose(moved.estimate.positions, estimate.positions - PLACE)
    assert np.allclose(moved.estimate.odd, estimate.odd - PLACE)
    here, elsewhere = (e.whitened(s) for s, e in ((spectra, estimate), (there.spectra, moved.estimate)))
    assert all(np.allclose(a, b) for a, b in zip(here, elsewhere, strict=True))
