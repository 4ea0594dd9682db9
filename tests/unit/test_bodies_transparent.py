"""Tags on enrolled bodies that hardly change the wave, read as points once the body's echo is taken out."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from bodies_synthetic import TAG, Thing, capture, ring

from tagid.capture import Capture
from tagid.constants import SPEED_OF_LIGHT
from tagid.imaging.types import BasebandScans
from tagid.pipeline.identify import aspect_spectra, identify
from tagid.pipeline.prepared import PreparedCapture
from tagid.tags.bodies.body_reading import BodyReading, BodySettings
from tagid.tags.bodies.enrolled import EnrolledBody, Searches
from tagid.tags.bodies.hypothesis import Kind
from tagid.tags.bodies.joint import Named, enrol_signature
from tagid.tags.bodies.on_body import read_on_body
from tagid.tags.bodies.points import PlacedPoints, PointReading
from tagid.tags.bodies.reflectors_fit import Priors
from tagid.tags.bodies.signature import Signature, between
from tagid.tags.bodies.spectra import Spectra
from tagid.tags.bodies.transparent import TransparentDecision, without_transparent
from tagid.tags.layouts.layout import builtin_layouts
from tagid.tags.matching.reading import Reading

CRATE = Thing(
    (0.05 + 0.05j, -0.05 + 0.05j, -0.05 - 0.05j, 0.05 - 0.05j, 0.05, 0.05j, -0.05, -0.05j),
    (0.6, 0.5, 0.7, 0.6, 1.3, -1.0j, 1.1, 0.9j),
)
"""Edges and faces of a plastic crate, about as loud as a reflector."""
LAYOUTS = list(builtin_layouts().values())
PLACES = ((0.002 - 0.003j, 0.3), (-0.004 + 0.001j, 2.2), (0.001 + 0.005j, 4.4))


def enrolled(thing: Thing, name: str) -> Signature:
    captures = [
        Named(f"{name}{i}", aspect_spectra(capture(thing, i, centre=centre, rotation=turn, views=72)))
        for i, (centre, turn) in enumerate(PLACES)
    ]
    return enrol_signature(captures, name, "body").signature


@pytest.fixture(scope="module")
def crate() -> Signature:
    return enrolled(CRATE, "crate")


def read(thing: Thing, signature: Signature, seed: int) -> Reading:
    """A recording of 18 views in so much noise that free patterns on the body cannot name a tag."""
    taken = capture(thing, seed, centre=0.004 - 0.004j, rotation=1.0, views=18, noise=0.8)
    reading = identify(taken, LAYOUTS, None, 1, (signature,)).reading
    assert reading is not None
    return reading


@pytest.mark.parametrize("degrees", [(100, 190), (100, 280)])
def test_points_name_a_tag_on_a_crate(
    crate: Signature, degrees: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Free patterns do not; the name is said to be that of a tag on the body."""
    wanted = {90: "container-90", 180: "container-180"}[degrees[1] - degrees[0]]
    found = read(CRATE.plus(ring(*degrees)), crate, 50)
    assert (found.status, found.layout, found.kind) == ("identified", wanted, Kind.BODY)
    assert found.body is not None and found.body.body.name == "crate"
    assert found.bound is not None and found.bound.objects > 0
    # The points beside the body won, not the layout on it that was refused.
    won = found.explained_by
    assert won is not None and (won.kind, won.name, won.layout) == (Kind.BODY, "crate", wanted)
    assert won.beyond_body is not None and won.left < won.beyond_body < 0.1
    centre = complex(*found.centre_m)
    one, other = (complex(r.x_m, r.y_m) - centre for r in found.reflectors[:2])
    apart = abs(np.rad2deg(np.angle(other / one)))
    assert apart == pytest.approx(degrees[1] - degrees[0], abs=12)
    monkeypatch.setattr(TransparentDecision, "bears_out", lambda *_: False)
    refused = read(CRATE.plus(ring(*degrees)), crate, 50)
    assert (refused.status, refused.layout) == ("unknown", None)


@pytest.mark.parametrize("degrees", [(10, 150), (200,), (30, 100), (100, 190, 300)])
@pytest.mark.parametrize("seed", [50, 51, 52])
def test_other_tags_on_a_crate_are_not_named(crate: Signature, degrees: tuple[int, ...], seed: int) -> None:
    assert read(CRATE.plus(ring(*degrees)), crate, seed).status != "identified"


def test_points_need_the_layout_that_is_nearest_on_the_body() -> None:
    def borne_out(lead: float, on_body: str, points: str, unexplained: float, behind: float) -> bool:
        found = PointReading(
            (PlacedPoints(np.zeros(2), np.zeros(2), 1.0, points),),
            PlacedPoints(np.zeros(2), np.zeros(2), 1.0),
            (),
            100.0,
            1.0,
            unexplained,
            unexplained,
            lead,
            0.0,
            1.0,
        )
        return TransparentDecision().bears_out(found, reading_of(on_body, behind))

    assert borne_out(1.0, "container-90", "container-90", 0.02, -0.05)
    assert not borne_out(1.0, "container-180", "container-90", 0.02, -0.05)
    assert not borne_out(1.0, "container-90", "container-90", 0.02, -0.2)
    assert not borne_out(-0.1, "container-90", "container-90", 0.02, -0.05)
    assert not borne_out(1.0, "container-90", "container-90", 0.2, -0.05)


def reading_of(layout: str, lead: float) -> BodyReading:
    """As much of a reading on a body as the decision asks for."""
    placed = SimpleNamespace(layout=layout)
    return cast("BodyReading", SimpleNamespace(layouts=(placed,), lead=lead))


def test_taking_out_a_body_leaves_the_tag(crate: Signature) -> None:
    """What is left is the tag's echo over the whole band, not at the frequencies of the signature alone."""
    where = {"centre": 0.004 - 0.004j, "rotation": 1.0, "views": 36, "noise": 0.02, "room": 0.0}
    alone, both = (scans_of(capture(one, 7, **where)) for one in (TAG, CRATE.plus(TAG)))  # type: ignore[arg-type]
    spectra = Spectra.of(both, wavenumbers=crate.wavenumbers)
    body = EnrolledBody(crate, Searches(crate.order))
    reading = read_on_body(spectra, LAYOUTS, body, BodySettings())
    assert reading is not None
    left = without_transparent(both, spectra, reading, Priors())
    tag = moving(alone.samples)
    before, after = (float((np.abs(moving(one.samples) - tag) ** 2).sum()) for one in (both, left))
    assert after < 0.04 * before
    assert after < 0.12 * float((np.abs(tag) ** 2).sum())


def scans_of(taken: Capture) -> BasebandScans:
    prepared = PreparedCapture(taken)
    return prepared.scans(prepared.settings.preprocessing(matched_filter=False))


def moving(samples: np.ndarray) -> np.ndarray:
    return np.asarray(samples - samples.mean(axis=0))


def test_harmonics_between_the_frequencies_of_a_signature() -> None:
    """A wall 0.1 m before the centre: its phase follows the frequency."""
    known = 4 * np.pi / SPEED_OF_LIGHT * 1e9 * np.arange(3.2, 4.9, 0.2)
    finer = np.linspace(known[0], known[-1], 57)
    harmonics = np.exp(1j * 0.1 * known)[:, None] * np.array([1.0, 2.0, -1j])
    wanted = np.exp(1j * 0.1 * finer)[:, None] * np.array([1.0, 2.0, -1j])
    found = between(harmonics, known, finer)
    assert np.abs(found - wanted).max() < 0.025 * np.abs(wanted).max()
    np.testing.assert_allclose(between(harmonics, known, known), harmonics, atol=1e-12)
    beyond = between(harmonics, known, np.array([known[0] - 5, known[-1] + 5]))
    np.testing.assert_allclose(beyond, harmonics[[0, -1]], atol=1e-12)
