"""How far readings tell two layouts apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tagid.reading import alike
from tagid.reading.alike import Apart, Conditions, told_apart
from tagid.reading.decision import SURE
from tagid.reading.transfers.wall import WALLS
from tagid.tags.layouts.layout import Layout, builtin_layouts

PAIR = builtin_layouts()["container-90"]
WIDER = replace(PAIR, name="wider", positions=PAIR.positions * 63 / 45)


def test_two_radii_of_one_angle_are_told_apart_in_the_open_and_not_on_every_container() -> None:
    bare = told_apart(replace(PAIR, kind="helmet"), replace(WIDER, kind="helmet"))
    # The wider ring in the open reads nearly as the narrow one behind plastic, which draws it out.
    assert bare.lead > 12 and bare.body == ""
    on_any = told_apart(PAIR, WIDER)
    assert 0 < on_any.lead < 10 and "plastic" in on_any.body
    assert bare.unresolved() < 0.05 and on_any.unresolved() > 0.3
    turned = Layout("turned", PAIR.positions @ np.array([[0.0, 1.0], [-1.0, 0.0]]), "container")
    assert told_apart(PAIR, turned).unresolved() == pytest.approx(1, abs=0.01)


def test_the_expected_lead_is_that_of_noisy_recordings() -> None:
    other = replace(PAIR, name="other", positions=PAIR.positions * 50 / 45)
    body = WALLS[0]
    spectra = alike._recorded(PAIR, body, Conditions())

    def lead(there: alike.Spectra) -> float:
        base = alike._best(there, PAIR, PAIR, body)
        return base - alike._best(there, other, PAIR, body)

    expected, rng, leads = lead(spectra), np.random.default_rng(0), []
    for _ in range(12):
        noise = rng.standard_normal((2, *spectra.data.shape)) / np.sqrt(2)
        noise -= noise.mean(axis=2, keepdims=True)
        leads.append(lead(replace(spectra, data=spectra.data + noise[0] + 1j * noise[1])))
    assert np.mean(leads) == pytest.approx(expected, abs=0.3 * expected + 1)
    assert np.std(leads) < 1.5 * np.sqrt(2 * expected)


def test_what_is_not_known_of_the_positions_leaves_more_readings_without_a_name() -> None:
    apart = Apart(60.0, "")
    shares = [apart.unresolved(unsure) for unsure in (0.0, 0.1, 0.5)]
    assert shares[0] < shares[1] < shares[2] < 0.5
    rng = np.random.default_rng(0)
    drawn = 60 + np.sqrt(2 * 60) * rng.standard_normal(200_000) + 60 * 2 * 0.5 * rng.standard_normal(200_000)
    assert shares[2] == pytest.approx(np.mean(drawn < SURE), rel=0.03)
