"""From scans to a name or a refusal by all hypotheses: tags in the open, on cans, on a handle, and none;
and enrolled bodies and objects, with words and pictures."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from bodies_synthetic import MUG, TAG, Thing, capture, enrolled, ring
from numpy.typing import NDArray
from tags_synthetic import synthetic_scans

from tagid.capture import Capture
from tagid.errors import DataError, RegistryError
from tagid.geometry import Aperture
from tagid.operate.words import hypothesis_words
from tagid.pipeline.answer import Identification
from tagid.pipeline.identify import identify, identify_together, without_body
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.settings import ImagingSettings, TagPriors
from tagid.reading.reader import ReaderSettings, read
from tagid.reading.reading import Kind, Reading
from tagid.reading.spectra import Spectra
from tagid.reading.subtract import without_body as subtracted
from tagid.reading.verdict import ADVICE, Code
from tagid.simulate import Acquisition, Placement, simulate_capture
from tagid.simulate.presets import room_clutter
from tagid.simulate.response_file import read_response
from tagid.simulate.response_scene import response_scene
from tagid.tags.bodies.signature import Signature
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
    return identify(capture(thing, 50, centre=CENTRE, rotation=TURN, views=views), ALL, settings).reading


def nearest_m(reading: Reading, thing: Thing, centre: complex = CENTRE) -> float:
    """How far the farthest of a thing's points is from the reflectors that were found, m."""
    positions = np.array([centre + point * np.exp(1j * TURN) for point in thing.points])
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


def test_another_tag_is_refused_and_told_how_it_differs() -> None:
    reading = answer(MORE)
    assert (reading.status, reading.layout, reading.code) == ("unknown", None, Code.EXTRA)
    assert (reading.missing, reading.extra) == (0, 1)
    assert "4 reflectors" in reading.reason and reading.advice == ADVICE[Code.EXTRA] != ""
    assert nearest_m(reading, MORE) < 4e-3
    assert not any(reflector.matched for reflector in reading.reflectors) and reading.bound is None


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
    placement = Placement((CENTRE.real, CENTRE.imag), TURN)
    acquisition = Acquisition(views=36, snr_db=26.0, placement=placement, axis_distance_error_m=0.01)
    response, single = (read_response(RESPONSES / f"{item}.npz") for item in (name, "free30_one"))
    scene = response_scene(response, acquisition, "V", single, room_clutter(np.random.default_rng(3)))
    return identify(simulate_capture(scene, acquisition, 1)[0], ALL).reading


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


def test_what_no_calibration_bears_out_is_not_named() -> None:
    reading = answer(TAG, 8)
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


def test_recordings_together_say_more_than_each_alone() -> None:
    """Each in another place and turn."""
    rng = np.random.default_rng(7)
    captures = []
    for seed in range(3):
        centre = complex(*rng.uniform(-0.005, 0.005, 2))
        turned = {"rotation": float(rng.uniform(0, 6)), "views": VIEWS, "noise": 2.3}
        captures.append(capture(HELMET, seed, centre=centre, **turned))
    joint, alone = identify_together(captures, ALL, registry_version=3)
    assert (joint.status, joint.label) == ("identified", LAYOUTS["helmet-120"].label)
    assert joint.reading.layout == "helmet-120"
    # Of one of them a tag elsewhere is as likely.
    assert "unknown" in [single.status for single in alone]
    assert joint.reading.lead > 1.5 * max(single.reading.lead for single in alone)
    assert joint.reading.bound is not None
    assert (joint.capture_uuid, joint.registry_version) == (None, 3)
    with pytest.raises(DataError, match="recordings"):
        identify_together([], ALL)


STAND = 0.004 - 0.004j


def recorded(thing: Thing, noise: float = 0.02, room: float = 3.0) -> Capture:
    return capture(thing, 50, centre=STAND, rotation=TURN, views=VIEWS, noise=noise, room=room)


def known(names: str) -> list[Signature]:
    """The mug, and the mug with its tag as a whole, as far as they are in `names`."""
    every = {"mug": (MUG, "body"), "mug-7": (MUG.plus(TAG), "object")}
    return [enrolled(every[name][0], name, every[name][1]) for name in names.split()]  # type: ignore[arg-type]


@cache
def answer_with(thing: Thing, names: str) -> Identification:
    return identify(recorded(thing), ALL, None, 1, known(names))


def read_with(thing: Thing, names: str) -> Reading:
    return answer_with(thing, names).reading


def test_a_tag_is_named_on_an_enrolled_body_alone() -> None:
    reading = read_with(MUG.plus(TAG), "mug")
    assert (reading.status, reading.layout, reading.kind) == ("identified", "container-90", Kind.BODY)
    assert (reading.hypotheses[0].name, reading.hypotheses[0].layout) == ("mug", "container-90")
    assert reading.hypotheses[0].unexplained < 0.01
    assert len(reading.reflectors) == 2 and all(reflector.matched for reflector in reading.reflectors)
    assert nearest_m(reading, TAG, STAND) < 3e-3
    words = "container-90 on the enrolled body mug, centre (4, -4) mm, 0.0 % unexplained"
    assert hypothesis_words(reading) == words


def test_an_enrolled_body_alone_has_no_tag() -> None:
    reading = read_with(MUG, "mug mug-7")
    assert (reading.status, reading.code, reading.kind) == ("no_tag", Code.NO_TAG, Kind.NO_TAG)
    assert reading.reason == "the enrolled body mug without a tag" and reading.reflectors == ()


def test_another_tag_on_the_enrolled_body_is_told() -> None:
    other = ring(100, 190, 320)
    reading = read_with(MUG.plus(other), "mug mug-7")
    assert (reading.status, reading.kind, reading.code) == ("unknown", Kind.BODY, Code.EXTRA)
    assert (reading.missing, reading.extra) == (0, 1)
    assert len(reading.reflectors) == 3 and nearest_m(reading, other, STAND) < 3e-3


def test_an_enrolled_object_is_named_as_a_whole_and_not_with_a_reflector_more() -> None:
    result = answer_with(MUG.plus(TAG), "mug-7")
    assert (result.status, result.reading.layout, result.reading.kind) == ("identified", "mug-7", Kind.OBJECT)
    assert result.label == known("mug-7")[0].label and result.reading.reflectors == ()
    other = read_with(MUG.plus(ring(100, 190, 320)), "mug-7")
    assert (other.status, other.layout, other.nearest) == ("unknown", None, "mug-7")
    assert len(other.reflectors) == 1 and nearest_m(other, ring(320), STAND) < 3e-3


def moving(samples: NDArray[np.floating]) -> NDArray[np.floating]:
    return np.asarray(samples - samples.mean(axis=0))


def energy(samples: NDArray[np.floating]) -> float:
    return float((samples.astype(np.float64) ** 2).sum())


@pytest.mark.parametrize(
    ("body", "names", "remaining"),
    [(CAN, "", 0.15), (MUG, "mug", 0.15), (MUG, "mug-7", None)],
    ids=["can", "enrolled body", "enrolled object"],
)
def test_the_picture_goes_without_the_body_and_keeps_its_tag(
    body: Thing, names: str, remaining: float | None
) -> None:
    """What is left is the tag's echo, bin by bin: a wrong sign or range would leave twice the body's."""
    both, tag, alone = (recorded(thing, noise=1e-3) for thing in (body.plus(TAG), TAG, body))
    reading = read_with(body.plus(TAG), names)
    assert reading.layout in ("container-90", "mug-7")
    shown = without_body(PreparedCapture(both, ImagingSettings()), answer_with(body.plus(TAG), names)).given
    base, bodys = moving(tag.samples), energy(moving(alone.samples))
    assert energy(moving(both.samples) - base) > 0.9 * bodys > 4 * energy(base)
    if remaining is None:
        # Of an object as a whole the tag is a part.
        assert energy(moving(shown.samples)) < 0.05 * bodys
        return
    assert energy(moving(shown.samples) - base) < remaining * energy(base)
    # Of what is the same in every view the body's part goes, and the room stays.
    static = recorded(body, noise=1e-3, room=0.0).samples.mean(axis=0)
    gone = (both.samples - shown.samples).mean(axis=0)
    assert energy(gone - static) < 0.2 * energy(static)


def test_a_body_is_subtracted_from_complex_scans_as_from_real_ones() -> None:
    both = recorded(CAN.plus(TAG), noise=1e-3)
    spectrum = np.fft.fft(both.samples, axis=1)
    spectrum[:, both.bins // 2 + 1 :] = 0
    spectrum[:, 1 : both.bins // 2 + 1] *= 2
    analytic = replace(both, samples=np.fft.ifft(spectrum, axis=1).astype(np.complex64))
    winner = read_with(CAN.plus(TAG), "").winner
    real, whole = subtracted(both, winner).samples, subtracted(analytic, winner).samples
    assert whole.dtype == np.complex64
    assert energy(moving(whole.real) - moving(real)) < 0.05 * energy(moving(real))


def test_a_tag_beside_no_body_is_left_as_it_is() -> None:
    prepared = PreparedCapture(recorded(TAG), ImagingSettings())
    bare = identify(prepared, ALL)
    assert bare.reading.kind is Kind.BARE
    assert without_body(prepared, bare) is prepared
