"""The evidence of hypotheses whose reflectors return nearly one amplitude at all frequencies.

The pulse is short, and its delay is that of the axis distance, the same for all hypotheses. The amplitudes of
reflectors, free at every frequency for the search, are a Gaussian process of mean range d and short spread
s, beside a share w that is free:

    E a_f conj(a_g) = sqrt(S_f S_g) ((1 - w) exp(-(s q)^2 / 2 - j d q) + w [f = g]),    q = kappa_f - kappa_g

Bodies, odd scatterers of any size and objects as they were enrolled keep free amplitudes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tagid.reading.descent import Estimate
from tagid.reading.hypothesis import Hypothesis
from tagid.reading.spectra import Spectra
from tagid.types import Complex, Floats

DELAYS_M = tuple(0.015 * i for i in range(-3, 4))
"""Errors d of the axis distance that are tried, m."""
SPREAD_M = 0.0075
"""Standard deviation s of the range within an echo, m: 0.05 ns."""
FREE = (0.1, 0.3, 1.0)
"""Shares w that are free at every frequency, equally likely."""
REACH, MOST = 30.0, 40
"""Hypotheses that are scored: those worse than the best by less, nats, and so many."""


def smoothed(spectra: Spectra, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses with smooth amplitudes of their reflectors, at the delay of the likeliest; best first.

    Those that are not scored have the part of the evidence where all is free.
    """
    ranked = sorted(hypotheses, key=lambda hypothesis: -hypothesis.log_z)
    root = roots(spectra.kappa)
    likely = [first for first in _firsts(ranked) if first.log_z > ranked[0].log_z - REACH][:MOST]
    scored = {first: gains(spectra, first.estimate, root) for first in likely}
    if not scored:
        return ranked
    delay = int(np.max([first.log_z + gain for first, gain in scored.items()], axis=0).argmax())
    free = -np.log(len(FREE))
    out = []
    for hypothesis in ranked:
        tagged = hypothesis.estimate.model.tag is not None
        gain = scored[hypothesis][delay] if hypothesis in scored else free * tagged
        out.append(replace(hypothesis, log_z=hypothesis.log_z + float(gain)))
    return sorted(out, key=lambda hypothesis: -hypothesis.log_z)


def _firsts(ranked: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best with reflectors of every kind."""
    firsts: dict[object, Hypothesis] = {}
    for hypothesis in ranked:
        model = hypothesis.estimate.model
        if model.tag is not None:
            kind = hypothesis.layout, type(model), model.transfer, model.odd, model.tag.count
            firsts.setdefault(kind, hypothesis)
    return list(firsts.values())


def gains(spectra: Spectra, estimate: Estimate, root: Complex) -> Floats:
    """(D,) what a fitted model with reflectors gains for every delay, nats."""
    fitted, model = estimate.whitened(spectra), estimate.model
    tagged = slice(model.body_columns, model.columns - model.odd)
    logs = [log_evidence(*fitted, tagged, root, free) for free in FREE]
    return np.asarray(np.logaddexp.reduce(logs, axis=0) - logs[-1] - np.log(len(FREE)))


def roots(kappa: Floats) -> Complex:
    """(D, F, R) of the covariance over frequency at every delay, which is R R^H."""
    offset = kappa - kappa.mean()
    values, vectors = np.linalg.eigh(np.exp(-0.5 * (SPREAD_M * np.subtract.outer(offset, offset)) ** 2))
    large = values > 1e-5 * values[-1]
    root = vectors[:, large] * np.sqrt(values[large])
    return np.asarray(root * np.exp(-1j * np.outer(DELAYS_M, offset))[..., None])


def log_evidence(
    columns: Complex, data: Complex, lam: Floats, power: Floats, tagged: slice, root: Complex, free: float
) -> Floats:
    """(D,) log Z; columns (F, n, M), data, lam and power as of `evidence.fit`.

    Args:
        tagged: columns whose amplitudes are smooth.
        root: (D, F, R) of their covariance over frequency.
        free: share of them that is free.
    """
    scaled, y = columns / np.sqrt(lam)[:, None], data / np.sqrt(lam)
    loose = power.copy()
    loose[:, tagged] *= free
    gram = scaled.conj() @ np.swapaxes(scaled, 1, 2)
    right = scaled.conj() @ y[..., None]
    inverse = np.linalg.inv(gram + np.eye(power.shape[1]) / loose[:, None])
    # Behind all that is free: of the columns' own Gram matrix and products with the data.
    held = gram @ inverse
    log = (right.conj() * (inverse @ right)).sum().real + np.linalg.slogdet(inverse)[1].sum()
    log -= np.log(loose).sum() + (np.abs(y) ** 2).sum() + np.log(lam).sum()
    size = np.sqrt((1 - free) * power[:, tagged])
    inner = (gram - held @ gram)[:, tagged, tagged] * size[:, :, None] * size[:, None]
    outer = (right - held @ right)[:, tagged, 0] * size
    count = size.shape[1] * root.shape[2]
    joint = np.einsum("dfr,fij,dfs->dirjs", root.conj(), inner, root, optimize=True).reshape(-1, count, count)
    factor = np.linalg.cholesky(joint + np.eye(count))
    half = np.linalg.solve(factor, np.einsum("dfr,fi->dir", root.conj(), outer).reshape(-1, count, 1))
    volume = 2 * np.log(np.einsum("dii->di", factor).real).sum(axis=1)
    return np.asarray(log + (np.abs(half) ** 2).sum(axis=(1, 2)) - volume)
