"""What a body tells beside its tag: how unevenly it turned, the tail of the pulse, and how oval it is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from bodies_synthetic import TAG, Thing, capture
from numpy.typing import NDArray

from tagid.capture import Capture, Pulse
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.pipeline.identify import aspect_spectra, identify
from tagid.simulate import Acquisition, Placement, ReflectorSpec, Wobble, parse_body, simulate_capture
from tagid.simulate.objects import Variation, object_scene
from tagid.tags.bodies.body_reading import BodyReading, BodySettings, seen_again
from tagid.tags.bodies.enrolled import EnrolledBody, Searches
from tagid.tags.bodies.hypothesis import Pose, Seen
from tagid.tags.bodies.joint import Named, enrol_signature
from tagid.tags.bodies.on_body import read_on_body
from tagid.tags.bodies.reflectors_fit import alone
from tagid.tags.bodies.revolution import RoundBody
from tagid.tags.bodies.signature import Signature
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.layouts.layout import builtin_layouts
from tagid.waveform import nominal_pulse

MUG = Thing((0.0, 0.033, 0.066, 0.05 + 0.02j), (6.0, 2.0, 3.0, -1.5j))
PLACES = ((0.002 - 0.003j, 0.3), (-0.004 + 0.001j, 2.2), (0.001 + 0.005j, 4.4))
LAYOUTS = list(builtin_layouts().values())


@pytest.fixture(scope="module")
def mug() -> EnrolledBody:
    captures = [
        Named(f"c{i}", aspect_spectra(capture(MUG, i, centre=centre, rotation=turn)))
        for i, (centre, turn) in enumerate(PLACES)
    ]
    signature = enrol_signature(captures, "mug", "body").signature
    return EnrolledBody(signature, Searches(signature.order))


def unevenly(thing: Thing, errors_rad: float, seed: int = 5) -> tuple[Spectra, Spectra]:
    """A recording as it is stated, and with the angles that the turntable really took."""
    true = aspect_spectra(capture(thing, seed, centre=0.004 - 0.004j, rotation=1.0, views=36))
    bearing = np.angle(true.antenna)
    errors = errors_rad * (np.sin(bearing + 0.4) + 0.5 * np.cos(2 * bearing))
    return replace(true, antenna=true.antenna * np.exp(-1j * errors)), true


def off_rad(found: Spectra, true: Spectra) -> float:
    """Error of the angles but for a turn of the whole, RMS, rad."""
    return float(np.std(np.angle(found.antenna / true.antenna)))


def columns_of(tag: Thing, true: Spectra) -> NDArray[np.complex128]:
    """(F, 1, V) echo of a tag where the recordings of these tests have it."""
    places = 0.004 - 0.004j + np.asarray(tag.points) * np.exp(1j)
    waves = true.waves(np.abs(true.antenna - places[:, None])).sum(axis=1)
    return centred(waves)[:, None]


def test_a_mug_tells_how_unevenly_it_turned_below_its_tag(mug: EnrolledBody) -> None:
    stated, true = unevenly(MUG.plus(TAG), 0.008)
    begun = mug.poses(stated)[0]
    first = mug.seen(stated, begun.pose, None, begun.left / stated.data.size)
    assert first is not None
    beside = mug.seen(stated, first.pose, columns_of(TAG, true), first.left / stated.data.size)
    assert beside is not None
    assert off_rad(stated, true) > 0.006
    assert off_rad(first.spectra, true) < 0.7 * off_rad(stated, true)
    assert off_rad(beside.spectra, true) < 0.4 * off_rad(stated, true)
    assert beside.left < 0.1 * first.left


def test_a_loud_tag_is_not_taken_for_an_uneven_turn(mug: EnrolledBody) -> None:
    """Weighed against the noise, which is far below the tag's echo, it would be."""
    loud = Thing(TAG.points, tuple(4 * a for a in TAG.amplitudes))
    even, _ = unevenly(MUG.plus(loud), 0.0)
    begun = mug.poses(even)[0]
    weighed = mug.seen(even, begun.pose, None, begun.left / even.data.size)
    unweighed = mug.seen(even, begun.pose)
    assert weighed is not None and unweighed is not None
    assert off_rad(weighed.spectra, even) < 0.006
    assert off_rad(unweighed.spectra, even) > 2 * off_rad(weighed.spectra, even)


def test_a_body_of_revolution_tells_nothing(mug: EnrolledBody) -> None:
    stated, _ = unevenly(MUG, 0.0)
    assert RoundBody().seen(stated, Pose()) is None
    assert mug.seen(stated.thinned(2), Pose()) is None, "at other frequencies than those of the signature"


def with_tail(share: float) -> Pulse:
    """The nominal pulse and a part of it that comes 0.3 m late."""
    nominal = nominal_pulse(4.0e9, 1.7e9)
    count = round(2e-9 / nominal.step)
    samples = np.pad(nominal.samples, count)
    samples[2 * count :] += share * nominal.samples
    return Pulse(samples, nominal.step)


def recorded(
    tag: str, turn: float, centre: complex, views: int, pulse: Pulse | None, wobble: float
) -> Capture:
    layout = builtin_layouts()[tag].positions if tag else np.zeros((0, 2))
    scene = object_scene(
        "mug",
        layout,
        parse_body("cup:35mm,wall=4mm,handle"),
        ReflectorSpec("octahedron", 0.02),
        rng=np.random.default_rng(7),
        variation=Variation(0.7, (0.0004, -0.0003), 0.3),
    )
    acquisition = Acquisition(
        views=views,
        snr_db=20.0,
        pulse=pulse,
        placement=Placement((centre.real, centre.imag), turn),
        wobble=Wobble(speed=wobble),
    )
    return simulate_capture(scene, acquisition, int(turn * 100) + views)[0]


@pytest.fixture(scope="module")
def porcelain() -> Signature:
    captures = [
        Named(f"c{i}", aspect_spectra(recorded("", turn, centre, 72, None, 0.0)))
        for i, (centre, turn) in enumerate(PLACES)
    ]
    return enrol_signature(captures, "mug", "body").signature


def test_the_tail_of_another_pulse_is_no_tag(porcelain: Signature) -> None:
    """The window of the spectra ends in the late part, so that no amplitude per frequency explains it."""
    body = EnrolledBody(porcelain, Searches(porcelain.order))
    late = aspect_spectra(recorded("", 1.2, 0.003 + 0.002j, 36, with_tail(0.2), 0.0))
    begun = body.poses(late)[0]
    seen = body.seen(late, begun.pose, None, begun.left / late.data.size)
    assert seen is not None
    left = alone(seen.spectra, body, seen.pose).left
    assert begun.left - late.noise_energy > 5 * max(left - late.noise_energy, 0.0)
    own = aspect_spectra(recorded("", 1.2, 0.003 + 0.002j, 36, None, 0.0))
    same = body.seen(own, begun.pose)
    assert same is not None and same.spectra.data is own.data, "its own pulse has no other tail"


@pytest.mark.parametrize("tag", ["container-90", "container-180"])
def test_a_tag_on_a_mug_is_named_after_an_uneven_turn_and_with_another_pulse(
    porcelain: Signature, tag: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = recorded(tag, 1.2, 0.003 + 0.002j, 36, with_tail(0.2), 0.01)
    found = identify(taken, LAYOUTS, None, 1, (porcelain,)).reading
    assert found is not None and (found.status, found.layout) == ("identified", tag)
    body = EnrolledBody(porcelain, Searches(porcelain.order))
    spectra = aspect_spectra(taken)
    wise = read_on_body(spectra, LAYOUTS, body, BodySettings())
    monkeypatch.setattr(EnrolledBody, "seen", lambda *given: None)
    plain = read_on_body(spectra, LAYOUTS, body, BodySettings())
    assert wise is not None and plain is not None
    assert wise.least - wise.noise < 0.6 * (plain.least - plain.noise)


def on_cup(oval_mm: float, tag: str = "", snr_db: float | None = None) -> Spectra:
    """A cup 5 mm off the axis, alike but for how far out of round it is."""
    layout = builtin_layouts()[tag].positions if tag else np.zeros((0, 2))
    scene = object_scene(
        "cup",
        layout,
        parse_body(f"cup:35mm,wall=4mm,oval={oval_mm}mm"),
        ReflectorSpec("octahedron", 0.02),
        rng=np.random.default_rng(7),
        variation=Variation(0.9),
    )
    acquisition = Acquisition(views=36, snr_db=snr_db, placement=Placement((0.004, -0.003), 1.1))
    scans = simulate_capture(scene, acquisition, 3)[0]
    return Spectra.of(preprocess(scans, settings=PreprocessSettings(matched_filter=False, extent_m=0.5)))


def apart(one: Spectra, other: Spectra) -> float:
    """Energy of the difference of two recordings."""
    return float((np.abs(one.data - other.data) ** 2).sum())


def test_an_oval_cup_is_seen_as_if_it_were_round() -> None:
    body, oval, even = RoundBody(), on_cup(0.3), on_cup(0.0)
    begun = body.poses(oval)[0]
    seen = body.seen(oval, begun.pose, None, begun.left / oval.data.size)
    assert seen is not None
    assert np.hypot(*np.subtract(seen.pose.centre_m, (0.004, -0.003))) < 2e-4
    assert apart(seen.spectra, even) < 0.02 * apart(oval, even)
    begun = body.poses(even)[0]
    assert body.seen(even, begun.pose, None, begun.left / even.data.size) is None


@pytest.mark.parametrize("tag", ["container-90", "container-180"])
def test_a_tag_on_a_round_cup_does_not_make_it_oval(tag: str) -> None:
    """A pair of reflectors opposite each other comes nearer twice a turn, too."""
    even = on_cup(0.0, tag, 20.0)
    found = read_on_body(even, LAYOUTS, RoundBody(), BodySettings())
    assert found is not None and found.layouts[0].layout == tag and found.lead > 1
    assert apart(found.spectra, even) == 0


def test_how_oval_a_cup_is_shows_beside_its_tag() -> None:
    oval, even = on_cup(0.3, "container-90", 20.0), on_cup(0.0, "container-90", 20.0)
    found = read_on_body(oval, LAYOUTS, RoundBody(), BodySettings())
    assert found is not None and found.layouts[0].layout == "container-90"
    assert apart(oval, even) > 0.3 * found.tag
    assert apart(found.spectra, even) < 0.02 * found.tag


@pytest.mark.parametrize(("away_m", "used"), [(0.0005, True), (0.008, False)])
def test_what_a_body_tells_is_not_used_where_free_patterns_take_its_part(away_m: float, used: bool) -> None:
    """Beside them the centre of a cup ran away by 8 mm; alone it then left 17 to 136 times as much."""
    spectra, _ = unevenly(Thing((0.0,), (6.0,)), 0.0)
    body = RoundBody()
    pose = body.poses(spectra)[0].pose
    moved = Pose((pose.centre_m[0] + away_m, pose.centre_m[1]))

    class Telling(RoundBody):
        def seen(self, spectra: Spectra, *given: object) -> Seen:
            return Seen(moved, spectra, 0.0)

    told = SimpleNamespace(
        body=Telling(),
        pose=pose,
        body_left=0.02 * spectra.energy,
        layouts=[SimpleNamespace(left=0.01 * spectra.energy)],
        error=0.001 * spectra.energy,
    )
    beside = np.zeros((len(spectra.data), 1, spectra.views), dtype=np.complex128)
    reading, left = cast("BodyReading", told), 0.01 * spectra.energy
    assert (seen_again(reading, spectra, beside, left, BodySettings()) is not None) == used
    # Nor where it changes little.
    assert seen_again(reading, spectra, beside, 0.00005 * spectra.energy, BodySettings()) is None
