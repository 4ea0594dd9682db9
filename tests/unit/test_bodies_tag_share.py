"""What an object's signature says of its tag, and when an object is named by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bodies_synthetic import MUG, Thing, capture, ring

from tagid.capture import Capture
from tagid.pipeline.identify import aspect_spectra, identify
from tagid.tags.bodies.enrolled import EnrolledBody, Searches
from tagid.tags.bodies.hypothesis import Kind, Pose
from tagid.tags.bodies.joint import Named, enrol_signature
from tagid.tags.bodies.posing import match
from tagid.tags.bodies.pulse_tail import explained
from tagid.tags.bodies.signature import Signature, echo
from tagid.tags.bodies.spectra import Spectra, centred
from tagid.tags.bodies.stray import strongest_stray
from tagid.tags.bodies.tag_share import reflector_share
from tagid.tags.layouts.layout import Layout, builtin_layouts

PAIR = Layout("pair", 0.045 * np.array([[np.cos(t), np.sin(t)] for t in np.radians([100, 190])]))
CAN = Thing((), (), wall=6.0)


def enrolled(thing: Thing) -> Signature:
    places = ((0.002 - 0.003j, 0.3), (-0.004 + 0.001j, 2.2), (0.001 + 0.005j, 4.4))
    captures = [
        Named(f"c{i}", aspect_spectra(capture(thing, i, centre=centre, rotation=turn)))
        for i, (centre, turn) in enumerate(places)
    ]
    return enrol_signature(captures, "pair", "object").signature


def ringing(capture: Capture, delay_m: float, share: float) -> Capture:
    """The same with a pulse whose echo of itself comes late, as a share of its amplitude."""
    bins = round(delay_m / capture.range_step_m)
    late = np.zeros_like(capture.samples)
    late[:, bins:] = share * capture.samples[:, :-bins]
    return replace(capture, samples=capture.samples + late)


def test_reflectors_of_a_known_layout_stand_out_of_a_can_s_signature() -> None:
    tagged = enrolled(CAN.plus(ring(100, 190)))
    share = reflector_share(tagged, PAIR)
    # All that turns is the tag's: each of two reflectors returns a half.
    assert 0.15 < share < 0.6
    assert reflector_share(tagged, builtin_layouts()["helmet-120"]) < 0.2 * share


@pytest.mark.parametrize("amplitude", [0.0, 0.4])
def test_a_handle_does_not_pass_for_a_tag(amplitude: float) -> None:
    thing = MUG.plus(ring(100, 190, amplitude=amplitude)) if amplitude else MUG
    assert reflector_share(enrolled(thing), PAIR) < 0.01


def test_with_its_body_enrolled_a_weak_tag_stands_out() -> None:
    tagged = enrolled(MUG.plus(ring(100, 190, amplitude=0.4)))
    mug = replace(enrolled(MUG), name="mug", kind="body")
    body = EnrolledBody(mug, Searches(max(mug.order, tagged.order)))
    share = reflector_share(tagged, PAIR, [body])
    spectra = [
        aspect_spectra(capture(thing, 9, noise=1e-4))
        for thing in (MUG.plus(ring(100, 190, amplitude=0.4)), MUG)
    ]
    true = np.sum(np.abs(spectra[0].data - spectra[1].data) ** 2) / spectra[0].energy / 2
    assert reflector_share(tagged, PAIR) == 0 and 0.2 * true < share < 1.3 * true


def test_an_object_is_not_named_in_noise_that_hides_its_tag() -> None:
    """An untagged mug passes for the tagged one there: the handle explains the echo of both."""
    tagged = enrolled(MUG.plus(ring(100, 190, amplitude=0.4)))
    for noise, named in ((0.2, True), (1.2, False)):
        taken = capture(
            MUG.plus(ring(100, 190, amplitude=0.4)),
            50,
            centre=0.004 - 0.004j,
            rotation=1.0,
            views=36,
            noise=noise,
        )
        reading = identify(taken, [PAIR], None, 1, (tagged,)).reading
        assert reading is not None and (reading.kind is Kind.OBJECT) == named
        for seed in (50, 51, 52):
            bare = capture(MUG, seed, centre=0.004 - 0.004j, rotation=1.0, views=36, noise=noise)
            other = identify(bare, [PAIR], None, 1, (tagged,))
            assert other.status != "identified"


def test_a_pulse_that_rings_on_is_explained(tagged_capture: Capture) -> None:
    """Its tail lies where the range window falls: one gain at each frequency leaves ten times as much."""
    signature = enrolled(MUG.plus(ring(100, 190)))
    spectra = aspect_spectra(ringing(tagged_capture, 0.3, 0.3))
    pose = match(spectra, signature).pose
    known = explained(spectra, centred(echo(spectra, signature, pose)))
    assert known.left < 0.2 * left_of_one_gain(spectra, signature, pose)
    assert np.allclose(known.columns.conj().swapaxes(1, 2) @ known.columns, np.eye(2), atol=1e-9)


def left_of_one_gain(spectra: Spectra, signature: Signature, pose: Pose) -> float:
    own = centred(echo(spectra, signature, pose))
    gain = (own.conj() * spectra.data).sum(axis=1) / (np.abs(own) ** 2).sum(axis=1)
    return float((np.abs(spectra.data - gain[:, None] * own) ** 2).sum())


@pytest.fixture
def tagged_capture() -> Capture:
    return capture(MUG.plus(ring(100, 190)), 5, centre=0.004 - 0.004j, rotation=1.0, views=36, noise=0.01)


def test_a_stray_reflector_has_the_pulse_of_the_recording() -> None:
    signature = enrolled(MUG.plus(ring(100, 190)))
    more = capture(MUG.plus(ring(100, 190, 320)), 5, centre=0.004 - 0.004j, rotation=1.0, views=36, noise=0.5)
    spectra = aspect_spectra(ringing(more, 0.15, 0.7))
    pose = match(spectra, signature).pose
    known = explained(spectra, centred(echo(spectra, signature, pose)))
    flat = replace(known, gain=np.ones_like(known.gain))
    found, other = (strongest_stray(spectra, one, pose.centre, 0.08) for one in (known, flat))
    assert found.nats > 1.3 * other.nats
    there = 0.004 - 0.004j + 0.045 * np.exp(1j * (np.deg2rad(320) + 1.0))
    assert abs(complex(*found.place_m) - there) < 0.015
