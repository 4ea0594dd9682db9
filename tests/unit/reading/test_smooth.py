"""Amplitudes that are smooth over frequency: their evidence against the dense formula, and what it tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reader_scenes import LAYOUTS, spectra_of

from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import Model
from tagid.reading.descent import refined
from tagid.reading.evidence import fit
from tagid.reading.hypothesis import Hypothesis
from tagid.reading.smooth import DELAYS_M, FREE, SPREAD_M, gains, log_evidence, roots, smoothed
from tagid.reading.transfers.plain import BARE

RNG = np.random.default_rng(3)
F, N, M, OWN = 5, 4, 7, slice(1, 3)
KAPPA = np.linspace(140.0, 190.0, F)
COLUMNS = RNG.normal(size=(F, N, M, 2)) @ [1, 1j]
DATA = RNG.normal(size=(F, M, 2)) @ [1, 1j]
LAM, POWER = RNG.uniform(0.5, 2, (F, M)), RNG.uniform(0.1, 3, (F, N))


def dense(free: float, delay_m: float) -> float:
    offset = np.subtract.outer(KAPPA, KAPPA)
    kernel = np.exp(-0.5 * (SPREAD_M * offset) ** 2 - 1j * delay_m * offset)
    wide = np.zeros((F, M, N, F), dtype=complex)
    wide[np.arange(F), :, :, np.arange(F)] = np.swapaxes(COLUMNS, 1, 2)
    covariance = np.diag(LAM.ravel()).astype(complex)
    for c in range(N):
        share = free if OWN.start <= c < OWN.stop else 1.0
        size = np.sqrt(POWER[:, c])
        prior = np.outer(size, size) * ((1 - share) * kernel + share * np.eye(F))
        column = wide[:, :, c].reshape(F * M, F)
        covariance += column @ prior @ column.conj().T
    y = DATA.ravel()
    return float(-(y.conj() @ np.linalg.solve(covariance, y)).real - np.linalg.slogdet(covariance)[1])


@pytest.mark.parametrize("free", [0.1, 0.3])
def test_the_evidence_is_that_of_all_frequencies_together(free: float) -> None:
    result = log_evidence(COLUMNS, DATA, LAM, POWER, OWN, roots(KAPPA), free)
    np.testing.assert_allclose(result, [dense(free, delay) for delay in DELAYS_M], atol=1e-3)


def test_free_amplitudes_have_the_evidence_of_every_frequency_by_itself() -> None:
    alone = fit(COLUMNS, DATA, LAM, POWER).log
    np.testing.assert_allclose(
        log_evidence(COLUMNS, DATA, LAM, POWER, OWN, roots(KAPPA), 1.0), alone, atol=1e-9
    )
    uncoupled = np.broadcast_to(np.eye(F), (1, F, F)).astype(complex)
    np.testing.assert_allclose(log_evidence(COLUMNS, DATA, LAM, POWER, OWN, uncoupled, 0.3), alone, atol=1e-9)


def test_a_tag_of_one_amplitude_gains_and_one_of_any_does_not() -> None:
    spectra = spectra_of("container-90", views=18, snr_db=5.0)
    model = Model(BARE, Arrangement.of_layout(LAYOUTS[0].positions, LAYOUTS[0].heights), False, 0)
    result = refined(spectra, model, np.zeros(model.parameters), (1e-2, None))
    assert gains(spectra, result, roots(spectra.kappa)).max() > 5
    phases = np.exp(1j * RNG.uniform(0, 2 * np.pi, (len(spectra.kappa), 1)))
    mixed = replace(spectra, data=spectra.data * phases)
    assert gains(mixed, result, roots(spectra.kappa)).max() < 0


def test_the_best_of_a_kind_are_scored_at_the_delay_of_the_likeliest() -> None:
    spectra = spectra_of("container-90", views=18, snr_db=5.0)
    model = Model(BARE, Arrangement.of_layout(LAYOUTS[0].positions, LAYOUTS[0].heights), False, 0)
    tagged = refined(spectra, model, np.zeros(model.parameters), (1e-2, None))
    bare = refined(spectra, replace(model, tag=None), np.zeros(2), (1e-2, None))
    some = [Hypothesis(LAYOUTS[0], tagged, log) for log in (3.0, 2.0)] + [Hypothesis(None, bare, 1.0)]
    first, untagged, second = smoothed(spectra, some)
    assert first.log_z == pytest.approx(3.0 + gains(spectra, tagged, roots(spectra.kappa)).max())
    assert untagged.log_z == 1.0
    assert second.log_z == pytest.approx(2.0 - np.log(len(FREE)))
