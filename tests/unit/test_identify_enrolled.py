"""Enrolled bodies and objects from scans to names, refusals, words and pictures."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from bodies_synthetic import MUG, TAG, Thing, capture, enrolled, ring
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.operate.words import hypothesis_words
from tagid.pipeline.answer import Identification
from tagid.pipeline.identify import identify, without_body
from tagid.pipeline.prepared import PreparedCapture
from tagid.pipeline.settings import ImagingSettings
from tagid.reading.reading import Kind, Reading
from tagid.reading.subtract import without_body as subtracted
from tagid.reading.verdict import Code
from tagid.tags.bodies.signature import Signature
from tagid.tags.layouts.layout import builtin_layouts

LAYOUTS = list(builtin_layouts().values())
CENTRE, TURN = 0.004 - 0.004j, 1.0
CAN = Thing((), (), wall=20.0)


def recorded(thing: Thing, noise: float = 0.02, room: float = 3.0) -> Capture:
    return capture(thing, 50, centre=CENTRE, rotation=TURN, views=24, noise=noise, room=room)


def known(names: str) -> list[Signature]:
    """The mug, and the mug with its tag as a whole, as far as they are in `names`."""
    every = {"mug": (MUG, "body"), "mug-7": (MUG.plus(TAG), "object")}
    return [enrolled(every[name][0], name, every[name][1]) for name in names.split()]  # type: ignore[arg-type]


@cache
def answer(thing: Thing, names: str) -> Identification:
    return identify(recorded(thing), LAYOUTS, None, 1, known(names))


def read(thing: Thing, names: str) -> Reading:
    reading = answer(thing, names).reading
    assert reading is not None
    return reading


def nearest_m(reading: Reading, points: tuple[complex, ...]) -> float:
    """How far the farthest of some points is from the reflectors that were found, m."""
    positions = np.array([CENTRE + point * np.exp(1j * TURN) for point in points])
    result = np.array([complex(reflector.x_m, reflector.y_m) for reflector in reading.reflectors])
    return float(np.abs(result[:, None] - positions).min(axis=0).max())


def test_a_tag_is_named_on_an_enrolled_body_alone() -> None:
    reading = read(MUG.plus(TAG), "mug")
    assert (reading.status, reading.layout, reading.kind) == ("identified", "container-90", Kind.BODY)
    assert (reading.hypotheses[0].name, reading.hypotheses[0].layout) == ("mug", "container-90")
    assert reading.hypotheses[0].unexplained < 0.01
    assert len(reading.reflectors) == 2 and all(reflector.matched for reflector in reading.reflectors)
    assert nearest_m(reading, TAG.points) < 3e-3
    assert hypothesis_words(reading) == (
        "container-90 on the enrolled body mug, centre (4, -4) mm, 0.0 % unexplained"
    )
    blind = read(MUG.plus(TAG), "")
    assert blind.layout is None and blind.lead < 0 and blind.kind is not Kind.BODY


def test_an_enrolled_body_alone_has_no_tag() -> None:
    reading = read(MUG, "mug mug-7")
    assert (reading.status, reading.code, reading.kind) == ("no_tag", Code.NO_TAG, Kind.NO_TAG)
    assert reading.reason == "the enrolled body mug without a tag" and reading.reflectors == ()


@pytest.mark.parametrize(
    ("other", "code", "counts"),
    [(ring(100, 190, 320), Code.EXTRA, (0, 1)), (ring(100), Code.MISSING, (1, 0))],
    ids=["one more", "one less"],
)
def test_another_tag_on_the_enrolled_body_is_told(other: Thing, code: Code, counts: tuple[int, int]) -> None:
    reading = read(MUG.plus(other), "mug mug-7")
    assert (reading.status, reading.kind, reading.code) == ("unknown", Kind.BODY, code)
    assert (reading.missing, reading.extra) == counts
    assert len(reading.reflectors) == len(other.points) and nearest_m(reading, other.points) < 3e-3


def test_an_enrolled_object_is_named_as_a_whole_and_not_with_a_reflector_more() -> None:
    result = answer(MUG.plus(TAG), "mug-7")
    assert result.reading is not None
    assert (result.status, result.reading.layout, result.reading.kind) == ("identified", "mug-7", Kind.OBJECT)
    assert result.label == known("mug-7")[0].label and result.reading.reflectors == ()
    other = read(MUG.plus(ring(100, 190, 320)), "mug-7")
    assert (other.status, other.layout, other.nearest) == ("unknown", None, "mug-7")
    assert len(other.reflectors) == 1 and nearest_m(other, ring(320).points) < 3e-3


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
    reading = read(body.plus(TAG), names)
    assert reading.layout in ("container-90", "mug-7")
    shown = without_body(PreparedCapture(both, ImagingSettings()), answer(body.plus(TAG), names)).given
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
    analytic = Capture(
        np.fft.ifft(spectrum, axis=1).astype(np.complex64),
        both.range_start_m,
        both.range_step_m,
        angles_rad=both.angles_rad,
        axis_distance_m=both.axis_distance_m,
    )
    winner = read(CAN.plus(TAG), "").winner
    assert winner is not None
    real, whole = subtracted(both, winner).samples, subtracted(analytic, winner).samples
    assert whole.dtype == np.complex64
    assert energy(moving(whole.real) - moving(real)) < 0.05 * energy(moving(real))


def test_a_tag_beside_no_body_is_left_as_it_is() -> None:
    prepared = PreparedCapture(recorded(TAG), ImagingSettings())
    bare = identify(prepared, LAYOUTS)
    assert bare.reading is not None and bare.reading.kind is Kind.BARE
    assert without_body(prepared, bare) is prepared
