"""From scans to a name or a refusal by all hypotheses: tags in the open, on cans, on a handle, and none."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from bodies_synthetic import TAG, Thing, capture, ring
from tags_synthetic import synthetic_scans

from tagid.errors import DataError, RegistryError
from tagid.geometry import Aperture
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.settings import ImagingSettings, TagPriors
from tagid.reading.reader import ReaderSettings, read
from tagid.reading.reading import Kind, Reading
from tagid.reading.spectra import Spectra
from tagid.reading.verdict import ADVICE, Code
from tagid.simulate import Acquisition, Placement, simulate_capture
from tagid.simulate.presets import room_clutter
from tagid.simulate.response_file import read_response
from tagid.simulate.response_scene import response_scene
from tagid.tags.layouts.layout import Layout, builtin_layouts

RESPONSES = Path(__file__).parents[1] / "data" / "responses"
LAYOUTS = builtin_layouts()
ALL = list(LAYOUTS.values())
VIEWS = 24
CENTRE, TURN = 0.003 - 0.004j, 1.0
HELMET = Thing(tuple(complex(x, y) for x, y in LAYOUTS["helmet-120"].positions), (1.0, 1.0, 1.0))
CAN = Thing((), (), wall=20.0)


@cache
def answer(thing: Thing, views: int = VIEWS, settings: ImagingSettings | None = None) -> Reading:
    """The reading of a thing off the axis and turned, in a room."""
    result = identify(capture(thing, 50, centre=CENTRE, rotation=TURN, views=views), ALL, settings).reading
    assert result is not None
    return result


def nearest_m(reading: Reading, thing: Thing) -> float:
    """How far the farthest of a thing's points is from the reflectors that were found, m."""
    positions = np.array([CENTRE + point * np.exp(1j * TURN) for point in thing.points])
    result = np.array([complex(reflector.x_m, reflector.y_m) for reflector in reading.reflectors])
    return float(np.abs(result[:, None] - positions).min(axis=0).max())


SCALENE = np.array([[0.1, 0.0], [-0.02, 0.06], [-0.05, -0.04]])
RIGHT, LEFT = Layout("right", SCALENE), Layout("left", SCALENE * np.array([1.0, -1.0]))


@cache
def mirrored(layouts: tuple[Layout, ...], direction_known: bool) -> Reading:
    """The reading of the right-handed layout, by these."""
    points = RIGHT.placed(2.0, np.array([0.003, 0.003]))
    scans = synthetic_scans(points, noise=0.3, seed=1, views=VIEWS, axis_distance=1.0, distance_error=0.007)
    return read(scans, layouts, ReaderSettings(direction_known=direction_known))


def test_turn_centre_and_range_are_those_of_the_object() -> None:
    reading = mirrored((RIGHT, LEFT), True)
    assert (reading.status, reading.layout) == ("identified", "right")
    assert reading.rotation_deg == pytest.approx(np.rad2deg(2.0), abs=1.0)
    assert reading.centre_m == pytest.approx((0.003, 0.003), abs=1e-3)
    # The axis is 7 mm nearer than stated.
    assert reading.offset_m == pytest.approx(-0.007, abs=1e-3)
    assert reading.bound is not None and reading.bound.kept and reading.lead > reading.needed


def test_a_mirror_image_is_another_layout_unless_the_direction_of_the_turn_is_unknown() -> None:
    other = mirrored((LEFT,), True)
    assert other.layout is None and other.nearest == "left" and other.lead < 0
    either = mirrored((LEFT,), False)
    assert (either.layout, either.lead) == ("left", pytest.approx(mirrored((RIGHT, LEFT), True).lead))
    both = mirrored((RIGHT, LEFT), False)
    assert (both.status, both.code) == ("ambiguous", Code.AMBIGUOUS)
    assert "right" in both.reason and "left" in both.reason


def test_a_tag_on_nothing_is_named_where_it_stands() -> None:
    reading = answer(HELMET)
    assert (reading.status, reading.layout, reading.kind) == ("identified", "helmet-120", Kind.BARE)
    assert nearest_m(reading, HELMET) < 1e-3
    assert all(reflector.matched for reflector in reading.reflectors) and len(reading.reflectors) == 3
    assert (reading.missing, reading.extra, reading.advice) == (0, 0, "")


MORE = Thing((*HELMET.points, complex(0.09 * np.exp(2.6j))), (1.0,) * 4)
OTHER = Thing((0.09 + 0.03j, -0.05 + 0.03j, 0.02 - 0.05j, -0.03 - 0.11j), (1.0,) * 4)


@pytest.mark.parametrize(
    ("thing", "code", "counts"),
    [
        (Thing(HELMET.points[:2], (1.0, 1.0)), Code.MISSING, (1, 0)),
        (MORE, Code.EXTRA, (0, 1)),
        (ring(0, 110), Code.DISPLACED, (0, 0)),
        (OTHER, Code.OTHER, None),
    ],
    ids=["one less", "one more", "another angle", "another tag"],
)
def test_another_tag_is_refused_and_told_how_it_differs(
    thing: Thing, code: Code, counts: tuple[int, int] | None
) -> None:
    reading = answer(thing)
    assert (reading.status, reading.layout, reading.code) == ("unknown", None, code)
    assert counts in (None, (reading.missing, reading.extra))
    assert f"{len(thing.points)} reflectors" in reading.reason and reading.advice == ADVICE[code] != ""
    assert nearest_m(reading, thing) < 4e-3
    assert not any(reflector.matched for reflector in reading.reflectors) and reading.bound is None


def test_a_tag_on_a_can_is_named_where_it_stands() -> None:
    reading = answer(CAN.plus(TAG))
    assert (reading.status, reading.layout, reading.kind) == ("identified", "container-90", Kind.ROUND)
    # The pair of the layout stands at 0 and 90 degrees, that of the thing at 100 and 190 before its turn.
    assert reading.rotation_deg == pytest.approx(100 + np.rad2deg(TURN), abs=1.5)
    assert complex(*reading.centre_m) == pytest.approx(CENTRE, abs=1e-3)
    assert nearest_m(reading, TAG) < 3e-3


def test_another_tag_on_a_can_is_refused_where_it_stands() -> None:
    odd = ring(0, 71, 207)
    reading = answer(CAN.plus(odd))
    assert (reading.status, reading.layout, reading.kind) == ("unknown", None, Kind.ROUND)
    assert len(reading.reflectors) == 3 and nearest_m(reading, odd) < 3e-3
    won = reading.explained_by
    assert won is not None and won.layout is None and won.unexplained < 0.02
    assert complex(*won.centre_m) == pytest.approx(CENTRE, abs=2e-3)
    assert won.radius_m == pytest.approx(0.045, abs=3e-3)


@cache
def solved(name: str) -> Reading:
    """The reading of a body that was solved by the method of moments, the axis distance wrong by 10 mm."""
    acquisition = Acquisition(
        views=36,
        snr_db=26.0,
        placement=Placement((CENTRE.real, CENTRE.imag), TURN),
        axis_distance_error_m=0.01,
    )
    response, single = (read_response(RESPONSES / f"{item}.npz") for item in (name, "free30_one"))
    scene = response_scene(response, acquisition, "V", single, room_clutter(np.random.default_rng(3)))
    result = identify(simulate_capture(scene, acquisition, 1)[0], ALL).reading
    assert result is not None
    return result


def test_a_tag_on_a_solved_can_is_named() -> None:
    reading = solved("can30_c180")
    assert (reading.status, reading.layout, reading.kind) == ("identified", "container-180", Kind.ROUND)
    assert reading.rotation_deg == pytest.approx(np.rad2deg(TURN), abs=2.0)
    assert complex(*reading.centre_m) == pytest.approx(CENTRE, abs=1e-3)
    assert reading.bound is not None and reading.bound.kept


def test_a_solved_can_alone_and_with_another_tag_is_not_named() -> None:
    """Two reflectors 130 degrees apart, which a smaller ring would make a pair at 90."""
    alone, foreign = solved("can30"), solved("can30_foreign")
    assert alone.layout is None and alone.lead < 0 and len(alone.reflectors) <= 1
    assert foreign.layout is None and "2 reflectors 130 degrees apart" in foreign.reason


def test_noise_holds_no_tag() -> None:
    reading = answer(Thing((), ()))
    assert (reading.status, reading.layout, reading.kind) == ("no_tag", None, Kind.NO_TAG)
    assert reading.code in (Code.NO_TAG, Code.NO_ECHO) and reading.advice
    assert (reading.reflectors, reading.score) == ((), 0.0)


@pytest.mark.parametrize(
    ("views", "settings"), [(8, None), (VIEWS, ImagingSettings(false_accept=1e-6))], ids=["views", "setting"]
)
def test_what_no_calibration_bears_out_is_not_named(views: int, settings: ImagingSettings | None) -> None:
    reading = answer(TAG, views, settings)
    assert (reading.status, reading.layout, reading.code) == ("unknown", None, Code.UNCALIBRATED)
    assert reading.nearest == "container-90" and reading.lead > 20 and reading.needed == np.inf
    odd = [r.amplitude_db for r in reading.reflectors if not r.matched]
    assert len(reading.reflectors) - len(odd) == 2 and nearest_m(reading, TAG) < 2e-3
    assert max(odd, default=-np.inf) < -30, "a scatterer that the noise hides may stand beside them"


def test_an_answer_says_where_its_bound_does_not_hold() -> None:
    reported = answer(TAG, settings=ImagingSettings(priors=TagPriors(centre_sigma_m=0.02)))
    assert reported.layout == "container-90" and "calibrated with the default priors" in reported.note


def test_free_positions_are_read_like_a_turntable() -> None:
    """The model needs the antenna's places alone."""
    prepared = PreparedCapture(capture(CAN.plus(TAG), 50, centre=CENTRE, rotation=TURN, views=VIEWS))
    scans = prepared.scans(prepared.settings.preprocessing(matched_filter=False))
    free = scans.with_aperture(Aperture(scans.aperture.positions))
    first, other = (Spectra.of(item, 0.13) for item in (free, scans))
    assert np.allclose(first.data, other.data) and np.allclose(first.antenna, other.antenna)


def test_bad_input_is_told() -> None:
    scans = synthetic_scans(SCALENE, views=VIEWS)
    with pytest.raises(RegistryError, match="no layout"):
        read(scans, [])
    with pytest.raises(DataError, match="cover"):
        read(scans.with_aperture(scans.aperture.with_axis_distance(5.0)), ALL)
