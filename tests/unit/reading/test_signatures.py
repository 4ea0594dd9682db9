"""Enrolled bodies and objects: slopes of their columns, tags beside them, and what is not named by them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from reader_scenes import prepared

from tagid.imaging.types import BasebandScans
from tagid.reading.arrangement import Arrangement
from tagid.reading.decision import Decision, decide
from tagid.reading.descent import BODY, CLUTTER, OVAL, _likelihood, _Numpy
from tagid.reading.descent import TAG as POWERS
from tagid.reading.reader import contest
from tagid.reading.signature import EnrolledBody, SignatureModel, enrolled_in
from tagid.reading.signature_search import Poses
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE, POINTS
from tagid.reading.transfers.shade import SHADES
from tagid.tags.bodies.signature import Signature
from tagid.tags.layouts.layout import builtin_layouts
from tests.unit.bodies_synthetic import MUG, TAG, Thing, capture, enrolled, ring

LAYOUTS = builtin_layouts()


def scans_of(thing: Thing, noise: float = 0.05) -> BasebandScans:
    taken = capture(thing, 50, centre=0.004 - 0.004j, rotation=1.0, views=36, noise=noise)
    return prepared(taken)


def read(thing: Thing, *signatures: Signature) -> Decision:
    """The decision among hypotheses without sheets and walls, which none of these objects has."""
    every = contest(scans_of(thing), list(LAYOUTS.values()), signatures)
    every.transfers, every.sheets = (BARE, POINTS), ()
    return decide(every.run())


def mug() -> Signature:
    return enrolled(MUG, "mug", "body")


def mug_7() -> Signature:
    return enrolled(MUG.plus(TAG), "mug-7", "object")


def spectra_of(scans: BasebandScans) -> Spectra:
    return Spectra.of(scans, kappa=mug().wavenumbers)


def beside_a_tag() -> tuple[SignatureModel, np.ndarray]:
    """A model with all kinds of columns, and parameters of it."""
    layout = LAYOUTS["helmet-120"]
    tag = Arrangement.of_layout(layout.positions, layout.heights)
    model = replace(SignatureModel.of(EnrolledBody.of(mug()), SHADES[1], 1), tag=tag, odd=1)
    return model, np.array(
        [3e-3, -2e-3, 0.5, 0.02, -0.01, 5e-3, 1e-2, 0.05, -0.08, 1e-3, 2e-3, 0.7, 5e-4, 0.03, 0.05]
    )


def test_compiled_values_are_those_of_numpy() -> None:
    (model, x), spectra = beside_a_tag(), spectra_of(scans_of(MUG))
    some = list(product(BODY, POWERS, OVAL[1:2]))
    first, other = (way(spectra, model).values(x, some, CLUTTER) for way in (_likelihood, _Numpy))
    np.testing.assert_allclose(first, other, rtol=1e-9)


def test_slopes_are_those_of_the_evidence() -> None:
    model, x = beside_a_tag()
    likelihood = _Numpy(spectra_of(scans_of(MUG)), replace(model, level=np.ones(9)))
    powers = (10.0, 0.3, 1e-3)
    _, slopes, _ = likelihood.expanded(x, powers, 1e-2)
    ends = [
        [likelihood.values(x + sign * step, [powers], [1e-2])[0, 0] for sign in (1, -1)]
        for step in 1e-6 * np.eye(len(x))
    ]
    measured = -np.diff(ends, axis=1)[:, 0] / 2e-6
    assert slopes == pytest.approx(measured, rel=1e-4, abs=1e-4 * np.abs(slopes).max())


def test_a_body_is_found_where_it_stands_alone_and_beside_a_tag() -> None:
    body = EnrolledBody.of(mug())
    (alone,) = Poses(spectra_of(scans_of(MUG)), body, 0).best(1)
    spectra = spectra_of(scans_of(MUG.plus(ring(100, 190, amplitude=3.0))))
    positions = 0.004 - 0.004j + 0.045 * np.exp(1j * (1.0 + np.deg2rad([100, 190])))
    tag = spectra.waves(positions, np.zeros(2))[0].sum(axis=1, keepdims=True)
    (beside,) = Poses(spectra, body, 0).best(1, tag)
    for pose in (alone, beside):
        # The enrolment's first capture had the centre at 2, -3 mm, and was turned by 0.3.
        assert pose[2] == pytest.approx(1.0 - 0.3, abs=0.06)


def test_an_object_that_lacks_a_reflector_is_not_the_enrolled_one() -> None:
    answer = read(MUG.plus(ring(100)), mug_7())
    assert answer.name is None and "the enrolled object mug-7" in answer.reason


def test_two_objects_that_look_alike_are_ambiguous() -> None:
    answer = read(MUG.plus(TAG), mug_7(), replace(mug_7(), name="mug-8"))
    assert answer.status == "ambiguous"
    assert "mug-7" in answer.reason and "mug-8" in answer.reason


def test_signatures_of_another_band_take_no_part() -> None:
    base = mug()
    other = replace(base, name="other", wavenumbers=base.wavenumbers * 1.1)
    assert [item.signature.name for item in enrolled_in(scans_of(MUG), [other, base])] == ["mug"]
