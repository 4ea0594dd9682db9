"""A layout fit in which each reflector's amplitude may vary with the view, beyond the patterns of `aspect`.

Causes are a handle in front of a reflector, a sector hidden by a cable, or a tilted corner reflector. Without
this fit, the residual of such a reflector would be mistaken for additional reflectors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.tags.reading.aspect import outward
from tagid.tags.reading.field import FixedPoints, MatchedField
from tagid.tags.reading.hypotheses import Fit

ORDERS, VIEWS_PER_ORDER = 3, 8
"""Number of harmonics of the view angle in a reflector's amplitude, a resolution of about 60 degrees, and the
views needed for each. With few views fewer are allowed, because three reflectors with free amplitudes could
explain any data."""
UNEVENNESS = 0.3
"""Prior standard deviation of each coefficient relative to the amplitude: a sector of 120 degrees without any
echo gives a first coefficient of 0.28."""


@dataclass(frozen=True, eq=False)
class UnevenFit:
    """The layout with A_k(v) = a_k w_k(v) + sum_m c_km f_m(v), f_m being cosines and sines of the view angle.

    The prior shrinks the c_km towards zero, so an echo close to the noise is fitted with constant amplitude.

    Attributes:
        templates: (P, views * rank), starting with those of the constant part.
        inverse: (P, P) inverse of the Gram matrix plus the inverse of the prior covariance.
        residual: (views * rank,) data minus the fit.
        explained: energy explained by the fit, minus the penalty of the prior.
        cost_nats: evidence lost to the additional freedom: log det(1 + C_prior / C_error).
        sizes: (K,) RMS of A_k over that of w_k. One on the axis faces the antenna always, and is no stronger
            for that: a reflector is as strong beside the strongest as where both face it, weighted by
            (1 + cos psi)^2, if that is more.
        outward: mean cosine of psi (see `Aspect`) weighted by |A_k(v)|^2, minus its mean over the views.
    """

    templates: NDArray[np.complex64]
    inverse: NDArray[np.complex128]
    residual: NDArray[np.complex64]
    explained: float
    cost_nats: float
    sizes: NDArray[np.float64]
    outward: float

    @classmethod
    def of(cls, field: MatchedField, best: Fit, noise: float) -> UnevenFit:
        """The uneven fit at the place of the even fit.

        Args:
            field: matched field of the scans.
            best: the even fit.
            noise: variance of b / ||s|| from noise alone.
        """
        size = best.layout.size
        d = best.distances(field)
        facing = outward(best.positions, best.centre_m)
        even = best.aspect.weight(field.antenna, best.positions, facing)
        angle = np.arctan2(field.antenna[:, 1], field.antenna[:, 0])
        orders = min(ORDERS, max(field.views // VIEWS_PER_ORDER, 1))
        turns = angle * np.arange(1, orders + 1)[:, None]
        waves = np.concatenate([np.cos(turns), np.sin(turns)]).astype(np.float32)
        parts = [field.templates(d, even)]
        parts += [field.templates(d, np.broadcast_to(wave, d.shape)) for wave in waves]
        templates = np.concatenate(parts)
        # Least squares with white noise of this variance per sample, and a prior variance of (UNEVENNESS
        # a)^2.
        usual = max(float(np.mean(np.abs(best.amplitudes) ** 2)), 1e-30)
        load = np.full(len(templates), noise / (UNEVENNESS**2 * usual))
        load[:size] = 1e-2 * field.template_energy * float(np.mean(best.visibility)) + 1e-30
        b, gram = field.correlate(templates), field.gram(templates)
        inverse = np.asarray(np.linalg.inv(gram + np.diag(load)), dtype=np.complex128)
        found = inverse @ b
        even_part = np.linalg.solve(gram[:size, :size] + np.diag(load[:size]), gram[:size, size:])
        own = gram[size:, size:] - gram[size:, :size] @ even_part
        cost = np.linalg.slogdet(np.eye(len(own)) + own / load[size])[1]
        shine = np.outer(found[:size], np.ones(field.views)) * (1.0 if even is None else even)
        shine = shine + found[size:].reshape(len(waves), size).T @ waves
        power = np.abs(shine) ** 2
        side = facing @ np.stack([np.cos(angle), np.sin(angle)])
        usual_power = np.ones_like(power) if even is None else even**2
        every, facing = (
            np.sqrt((power * w).sum(axis=1) / np.maximum((usual_power * w).sum(axis=1), 1e-9))
            for w in (np.ones_like(side), (1 + side) ** 2)
        )
        largest = max(float(every.max()), 1e-30)
        sizes = np.maximum(every, facing * (largest / max(float(facing.max()), 1e-30)))
        return cls(
            templates,
            inverse,
            np.asarray(field.data - found.astype(np.complex64) @ templates, dtype=np.complex64),
            float(np.real(np.vdot(b, found))),
            float(cost),
            np.asarray(sizes, dtype=np.float64),
            float(
                np.mean((power * side).sum(axis=1) / np.maximum(power.sum(axis=1), 1e-30) - side.mean(axis=1))
            ),
        )

    def gains(self, field: MatchedField, others: FixedPoints) -> NDArray[np.float64]:
        """(N,) energy that each of many additional points explains beyond the uneven fit."""
        left = others.beyond(self.templates, self.inverse)
        b = others.correlate(self.residual)
        power = b.real**2 + b.imag**2
        return np.asarray(power / np.maximum(left, 0.05 * field.template_energy), dtype=np.float64)
