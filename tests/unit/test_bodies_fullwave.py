"""Reading solved waves: a tag on a can is named, the can alone and with a foreign tag is not.

The responses of tests/data/responses were solved by the method of moments; nothing of the reader's model is
in them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.simulate import Acquisition, Placement, Wobble, simulate_capture
from tagid.simulate.presets import room_clutter
from tagid.simulate.response import Response
from tagid.simulate.response_file import read_response
from tagid.simulate.response_scene import response_scene
from tagid.tags.bodies.decide import BodyDecision, decide_on_body
from tagid.tags.bodies.hypothesis import Kind
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching.matcher import read_tag
from tagid.tags.matching.reading import Reading
from tagid.tags.verdicts.verdict import Code

RESPONSES = Path(__file__).parents[1] / "data" / "responses"
LAYOUTS = list(builtin_layouts().values())
OFF_M = 0.006


@cache
def response(name: str) -> Response:
    return read_response(RESPONSES / f"{name}.npz")


def read(name: str, snr_db: float, views: int = 36, seed: int = 1) -> Reading:
    """A recording 6 mm off the axis, wobbling, axis distance wrong by 8 mm, in a room."""
    rng = np.random.default_rng([seed, len(name)])
    turn = rng.uniform(0, 2 * np.pi)
    acquisition = Acquisition(
        views=views,
        snr_db=snr_db,
        placement=Placement((OFF_M * np.cos(turn), OFF_M * np.sin(turn)), rng.uniform(0, 2 * np.pi)),
        wobble=Wobble(speed=0.005),
        axis_distance_error_m=0.008,
    )
    scene = response_scene(response(name), acquisition, "V", response("free30_one"), room_clutter(rng))
    capture, _ = simulate_capture(scene, acquisition, seed)
    settings = PreprocessSettings(matched_filter=False, extent_m=0.5)
    return read_tag(preprocess(capture, settings=settings), LAYOUTS)


@pytest.mark.parametrize("snr_db", [20.0, 10.0])
def test_a_tag_on_a_can_is_named(snr_db: float) -> None:
    reading = read("can30_c180", snr_db)
    assert (reading.status, reading.layout, reading.kind) == ("identified", "container-180", Kind.ROUND)
    assert reading.bound is not None and reading.bound.kept and reading.bound.objects > 999
    assert reading.body is not None
    assert abs(reading.body.pose.centre) == pytest.approx(OFF_M, abs=1e-3)


@pytest.mark.parametrize("snr_db", [20.0, 10.0])
def test_the_can_alone_has_no_tag(snr_db: float) -> None:
    assert read("can30", snr_db).status == "no_tag"


@pytest.mark.parametrize("snr_db", [20.0, 10.0])
def test_a_foreign_tag_on_the_can_is_not_named(snr_db: float) -> None:
    """Two reflectors 130 degrees apart, which a smaller ring would make a pair at 90."""
    reading = read("can30_foreign", snr_db)
    assert reading.layout is None and reading.code is not Code.NONE and reading.advice


def test_a_loud_tag_may_leave_no_more_than_the_model_does() -> None:
    """A helmet shell with its tag, read as a pair on a round body, leaves 12 %; noise may leave as much."""
    body = read("can30_c180", 20.0).body
    assert body is not None and body.unexplained < 0.03 and body.tag > 50 * body.noise
    settings = BodyDecision()
    assert decide_on_body(body, settings).status == "identified"
    shell = replace(body, unexplained=0.12)
    assert decide_on_body(shell, settings).code is Code.BODY
    weak = replace(shell, noise=body.tag / 3, variance=body.tag / 900)
    assert decide_on_body(weak, settings).status == "identified"


@pytest.mark.parametrize("snr_db", [20.0, 10.0])
def test_bare_tags_need_no_body(snr_db: float) -> None:
    reading = read("free30_c90", snr_db)
    assert (reading.status, reading.layout, reading.kind) == ("identified", "container-90", Kind.BARE)
    assert reading.bound is not None and reading.bound.kept and reading.bound.objects > 999
    assert read("free20_foreign", snr_db).layout is None


def test_a_handle_is_refused_with_the_advice_to_enrol_the_body() -> None:
    for name in ("handle34", "handle34_c90"):
        reading = read(name, 20.0)
        assert reading.layout is None
        assert reading.code in (Code.BODY, Code.NO_TAG, Code.UNEXPLAINED, Code.OTHER), name
