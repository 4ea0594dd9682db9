"""Coupled pixels: a Gaussian prior whose variance neighbours share, for scenes that no few points explain.

Within a resolution cell the scans do not say where an echo comes from, so the prior must not either: the
variance of a pixel is the power of an earlier estimate, spread over its surroundings. Reweighting by the
estimate itself is FOCUSS, which ends in few pixels (Gorodnitsky and Rao, IEEE Trans. Signal Process. 45,
1997); that neighbours share their variance is the assumption of pattern-coupled sparse Bayesian learning
(Fang, Shen, Li and Li, ibid. 63, 2015).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import ImageGrid
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.restore import beam_sigma_m, blurred
from tagid.imaging.sparse import column_norm, sparse_recovery
from tagid.imaging.types import BasebandScans, Image
from tagid.types import Floats, Samples

ROUNDS = 2
"""Estimates, each with the variance that the one before gives."""
SPREADS = (1.0, 3.0, 9.0)
"""Standard deviations of a pixel's surroundings, over the restoring beam's, each weighed by its inverse."""
_MODEL_ERROR = 0.01
"""Variance of what no scene of points explains, over the mean power of the scans."""
_FAINT = 1e-3
"""Pixels with less than this share of the greatest prior standard deviation are zero."""
_ITERATIONS, _GAIN = 60, 1e-4
"""Conjugate gradients end after so many iterations, or after one that gains less than this share of all:
mostly after 10 to 25, after twice as many where bright points stand on a faint body."""


def coupled_recovery(scans: BasebandScans, grid: ImageGrid) -> Image:
    """The posterior mean of sigma in y = A sigma + noise under the prior CN(0, diag(v)).

    At first v is the power of the sparse solution, then that of the posterior mean before, both spread by
    Gaussians of `SPREADS`; its scale makes the energy of the scans that the prior expects that of the
    scans y, which are best without matched filter.
    """
    operator = ForwardOperator(scans, grid)
    values = sparse_recovery(scans, grid, operator=operator).values
    for _ in range(ROUNDS if values.any() else 0):
        variance = _spread(np.abs(values.astype(np.complex128)) ** 2, grid, beam_sigma_m(scans.wavenumber))
        values = _posterior_mean(scans, operator, variance.ravel()).reshape(values.shape)
    return Image(values, grid, {"method": "ats", "axis_distance_m": scans.aperture.axis_distance})


def _spread(power: Floats, grid: ImageGrid, beam_m: float) -> Floats:
    """Power (pixels, pixels), spread over the surroundings of every pixel, of any scale."""
    width = max(beam_m / grid.step, 1.0)
    return np.asarray(np.sum([blurred(power, spread * width) / spread for spread in SPREADS], axis=0))


def _posterior_mean(scans: BasebandScans, operator: ForwardOperator, variance: Floats) -> Samples:
    """(points,) under a prior variance (points,) of any scale."""
    shape = variance / variance.max()
    some = shape > _FAINT**2
    energy = float(np.vdot(scans.samples, scans.samples).real)
    scale = energy / (column_norm(scans) ** 2 * float(shape[some].sum()))
    noise = scans.noise_std**2 + _MODEL_ERROR * energy / scans.samples.size
    root = np.sqrt(shape[some]).astype(np.float32)
    values = np.zeros(operator.points, dtype=np.complex64)
    values[some] = root * damped(operator.among(some), scans.samples, root, noise / scale)
    return values


def damped(operator: ForwardOperator, samples: Samples, root: NDArray[np.float32], damping: float) -> Samples:
    """argmin_z ||A diag(root) z - y||^2 + damping ||z||^2 of scans y (views, bins), (points,), from zero.

    Conjugate gradients of the normal equations (CGLS; Hestenes and Stiefel, J. Res. NBS 49, 1952).
    """
    z = np.zeros(operator.points, dtype=np.complex64)
    rest = np.asarray(samples, dtype=np.complex64).copy()
    slope = root * operator.adjoint(rest)
    direction, power, gained = slope.copy(), float(np.vdot(slope, slope).real), 0.0
    for _ in range(_ITERATIONS):
        seen = operator.forward(root * direction)
        curvature = np.vdot(seen, seen).real + damping * np.vdot(direction, direction).real
        if curvature <= 0:
            break
        length = np.float32(power / curvature)
        z = z + length * direction
        rest -= length * seen
        slope = root * operator.adjoint(rest) - np.float32(damping) * z
        before, power = power, float(np.vdot(slope, slope).real)
        direction = slope + np.float32(power / before) * direction
        gain = before**2 / float(curvature)
        gained += gain
        if gain < _GAIN * gained:
            break
    return z
