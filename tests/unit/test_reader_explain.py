"""What a reading says of a hypothesis: shares, levels and phases of reflectors, range offset, and codes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tags_synthetic import synthetic_scans

from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import Model
from tagid.reading.decision import Needed, _difference, decide, settled
from tagid.reading.descent import Estimate, Powers, refined
from tagid.reading.explain import MOST, Explained, explanations, kind_of, ranked, residuals
from tagid.reading.hypothesis import Arranged, Hypothesis, Joint
from tagid.reading.reading import Kind
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.plain import BARE, POINTS
from tagid.reading.transfers.transfer import Transfer
from tagid.reading.transfers.wall import WALLS
from tagid.reading.verdict import Code
from tagid.tags.layouts.layout import Layout, builtin_layouts

LAYOUTS = builtin_layouts()
PAIR = LAYOUTS["container-90"]
CENTRE, TURN = 0.002 - 0.003j, 0.5
STRAY = -0.06 - 0.02j


def spectra_of(distance_error: float) -> Spectra:
    """The pair, and half as strong a scatterer a quarter of a wave late, at a wrong axis distance."""
    pair = PAIR.placed(TURN, np.array([CENTRE.real, CENTRE.imag]))
    scans = synthetic_scans(
        np.concatenate([pair, [[STRAY.real, STRAY.imag]]]),
        amplitudes=np.array([1.0, 1.0, 0.5j]),
        axis_distance=1.0,
        noise=0.03,
        distance_error=distance_error,
        seed=4,
    )
    return Spectra.of(scans)


def explained(spectra: Spectra, odd: int) -> Explained:
    """The pair with its most probable amplitudes, with and without the odd scatterer."""
    model = Model(BARE, Arrangement.of_layout(PAIR.positions, PAIR.heights), False, 0)
    x = np.array([CENTRE.real, CENTRE.imag, TURN, 0.0])
    if odd:
        model, x = model.and_odd(), np.append(x, [STRAY.real, STRAY.imag])
    result = refined(spectra, model, x, (1e-2, None))
    return Explained.of(spectra, Hypothesis(PAIR, result, result.log_z))


@pytest.mark.parametrize("error_m", [0.01, -0.01])
def test_the_range_offset_is_that_of_a_wrong_axis_distance(error_m: float) -> None:
    """Stated too far, the object shows nearer than its axis."""
    spectra = spectra_of(error_m)
    assert explained(spectra, 1).offset_m(spectra) == pytest.approx(-error_m, abs=1e-3)


def test_reflectors_have_their_places_levels_and_phases() -> None:
    spectra = spectra_of(0.01)
    *tag, stray = explained(spectra, 1).reflectors(spectra)
    positions = PAIR.placed(TURN, np.array([CENTRE.real, CENTRE.imag]))
    assert np.array([(item.x_m, item.y_m) for item in tag]) == pytest.approx(positions, abs=1e-3)
    assert complex(stray.x_m, stray.y_m) == pytest.approx(STRAY, abs=1e-3)
    assert [item.matched for item in (*tag, stray)] == [True, True, False]
    assert [item.amplitude_db for item in (*tag, stray)] == pytest.approx([0, 0, -6], abs=0.5)
    assert np.diff([item.snr_db for item in (tag[0], stray)]) == pytest.approx(-6, abs=0.5)
    assert [item.z_m for item in (*tag, stray)] == [None] * 3
    assert tag[1].amplitude / tag[0].amplitude == pytest.approx(1.0, abs=0.1)
    assert stray.amplitude / tag[0].amplitude == pytest.approx(0.5j, abs=0.1)


def test_what_a_hypothesis_leaves_is_the_share_of_what_it_lacks() -> None:
    spectra = spectra_of(0.0)
    assert explained(spectra, 1).unexplained < 0.01
    assert explained(spectra, 0).unexplained == pytest.approx(0.25 / 2.25, abs=0.03)


def hypothesis(
    positions: NDArray[np.complex128],
    log_z: float = 0.0,
    layout: Layout | None = None,
    transfer: Transfer = BARE,
) -> Hypothesis:
    """Reflectors at places, x + jy, m, about the axis, or those of a layout; none: a body or nothing."""
    tag, middle = None if not len(positions) else Arrangement.rigid(np.asarray(positions)), False
    if layout is not None:
        arranged = Arranged.of(layout, transfer.body and not transfer.clear)
        tag, middle = arranged.tag, arranged.middle
    model = Model(transfer, tag, transfer.body, 0)
    estimate = Estimate(model, np.zeros(model.parameters), Powers(0.0), log_z, log_z, 1e-3)
    return Hypothesis(layout, estimate, log_z, middle)


def flat(layout: Layout) -> NDArray[np.complex128]:
    return np.asarray(layout.positions[:, 0] + 1j * layout.positions[:, 1])


def ring(*degrees: float, radius: float = 0.045) -> NDArray[np.complex128]:
    return np.asarray(radius * np.exp(1j * np.deg2rad(degrees)))


HELMET = LAYOUTS["helmet-120"]
NOTHING = np.zeros(0, dtype=np.complex128)
DIFFERENCES = {
    "one more": (HELMET, np.append(flat(HELMET), 0.09j), Code.EXTRA),
    "one less": (HELMET, flat(HELMET)[:2], Code.MISSING),
    "one moved": (HELMET, flat(HELMET) + np.array([0.02, 0, 0]), Code.DISPLACED),
    "opened by 10 degrees": (PAIR, ring(0, 100), Code.DISPLACED),
    "farther out": (PAIR, ring(20, 110, radius=0.075), Code.RADIUS),
    "another": (PAIR, ring(0, 150, radius=0.075), Code.OTHER),
    "more and elsewhere": (PAIR, ring(0, 50, 200, radius=0.08), Code.OTHER),
}


@pytest.mark.parametrize("name", DIFFERENCES)
def test_a_refused_arrangement_is_told_from_the_nearest_layout(name: str) -> None:
    layout, positions, code = DIFFERENCES[name]
    assert _difference(hypothesis(positions), hypothesis(NOTHING, layout=layout)) is code


def test_a_middle_reflector_counts_where_no_body_covers_it() -> None:
    linear = LAYOUTS["helmet-linear"]
    outer = flat(linear)[np.abs(flat(linear)) > 0.01]
    opaque = hypothesis(NOTHING, layout=linear, transfer=WALLS[0])
    assert opaque.middle and len(opaque.estimate.positions) == len(outer) == linear.size - 1
    assert _difference(hypothesis(outer), opaque) is Code.MISSING
    assert _difference(hypothesis(outer, transfer=WALLS[0]), opaque) is not Code.MISSING


def test_the_decision_is_by_leads() -> None:
    bare, round_body = hypothesis(NOTHING), hypothesis(NOTHING, 5.0, transfer=POINTS)
    named, other = hypothesis(NOTHING, 60.0, PAIR), hypothesis(ring(0, 150), 40.0)
    every = [bare, round_body, named, other]
    result = decide(every, Needed(15.0, 15.0))
    assert (result.status, result.name, result.lead, result.bare) == ("identified", PAIR.name, 20.0, 20.0)
    weak = decide(every, Needed(25.0, 25.0))
    assert (weak.status, weak.name, weak.code, weak.winner) == ("unknown", None, Code.WEAK, named)
    assert decide(every, Needed(np.inf, np.inf)).code is Code.UNCALIBRATED
    stranger = decide([*every, hypothesis(ring(0, 100), 70.0)], Needed(15.0, 15.0))
    assert (stranger.status, stranger.lead, stranger.code) == ("unknown", -10.0, Code.DISPLACED)
    assert stranger.reason.startswith("2 reflectors 100 degrees apart, 45 mm")
    rival = decide([*every, hypothesis(NOTHING, 58.0, HELMET)], Needed(15.0, 15.0))
    assert (rival.status, rival.code, rival.lead) == ("ambiguous", Code.AMBIGUOUS, 2.0)
    assert rival.reason == f"{PAIR.name}, or {HELMET.name}"


def test_a_lead_without_a_body_names_from_its_own_limit_on() -> None:
    """The body explains a little more, and is what shows."""
    body, alone = hypothesis(NOTHING, 62.0, PAIR, POINTS), hypothesis(NOTHING, 60.0, PAIR)
    every = [hypothesis(NOTHING), body, alone, hypothesis(ring(0, 150), 50.0)]
    assert decide(every, Needed(30.0, 10.0)).name == PAIR.name
    refused = decide(every, Needed(30.0, 11.0))
    assert (refused.name, refused.lead, refused.bare) == (None, 12.0, 10.0)
    assert decide([every[0], body, every[3]], Needed(30.0, 10.0)).bare == -np.inf


def test_without_reflectors_there_is_no_tag_and_without_an_echo_nothing() -> None:
    silent, body = hypothesis(NOTHING, 0.0), hypothesis(NOTHING, 7.0, transfer=POINTS)
    named = hypothesis(NOTHING, 8.0, PAIR)
    assert decide([silent, body, named]).code is Code.NO_TAG
    # Nor is anything there that is hardly likelier than nothing.
    for some in ([silent, replace(named, log_z=3.0)], [silent, replace(body, log_z=5.0), named]):
        assert decide(some).code is Code.NO_ECHO
    mixed = settled(Joint(60.0, named), Joint(61.0, body, mixed=True), Joint(0.0, silent))
    assert (mixed.status, mixed.code) == ("unknown", Code.DISAGREE)


def test_the_winner_and_the_best_of_every_kind_are_reported() -> None:
    spectra = spectra_of(0.0)
    real = explained(spectra, 1).hypothesis
    others = [
        hypothesis(NOTHING, real.log_z - 500, transfer=POINTS),
        hypothesis(NOTHING, real.log_z - 400),
        hypothesis(ring(0, 150), real.log_z - 30),
        hypothesis(ring(0, 140), real.log_z - 40),
        hypothesis(NOTHING, real.log_z - 50, HELMET, POINTS),
    ]
    rows = explanations([Explained.of(spectra, item) for item in ranked([real, *others], real)])
    kinds = [(Kind.BARE, PAIR.name), (Kind.BARE, None), (Kind.ROUND, HELMET.name), (Kind.NO_TAG, None)]
    assert [(row.kind, row.layout) for row in rows] == kinds
    assert [row.log_evidence for row in rows] == pytest.approx([0, -30, -50, -400])
    assert rows[0].radius_m == pytest.approx(0.045, abs=2e-3) and rows[3].radius_m is None
    assert rows[0].unexplained < 0.01 < rows[1].unexplained <= 1 and len(rows) <= MOST
    assert kind_of(others[0]) is Kind.NO_TAG and ranked(others, others[0])[0] is others[0]


def test_what_is_left_of_a_recording_is_noise_where_the_hypothesis_is_right() -> None:
    spectra = spectra_of(0.0)
    real = explained(spectra, 1)
    wrong = Explained.of(spectra, hypothesis(ring(0, 140), real.hypothesis.log_z - 40))
    remaining = residuals(spectra, [real, wrong])
    assert remaining.by_hypothesis.shape == (2, len(remaining.range_m), spectra.views)
    assert (np.diff(remaining.angle_rad) > 0).all()
    shown = (remaining.recorded, *remaining.by_hypothesis)
    energies = [float((base.astype(float) ** 2).sum()) for base in shown]
    assert energies[1] < 0.02 * energies[0] < energies[2]
    residual = real.residual(spectra)
    assert np.abs(residual @ spectra.rooms.T).max() < 1e-9 * np.abs(spectra.data).max()
