"""The log evidence of columns with Gaussian amplitudes: the only least squares of the room.

    y_f = X_f a_f + clutter + noise,   a_f ~ CN(0, S_f),   whitened: CN(0, diag(lambda_f))
    log Z = -y^H C^-1 y - log |C|,     C = diag(lambda) + X S X^H

up to -FM log(pi), which all hypotheses share (C. E. Rasmussen and C. K. I. Williams, *Gaussian Processes for
Machine Learning*, 2006, section 2.7: explicit basis functions with Gaussian weights).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tagid.types import Complex, Floats


@dataclass(frozen=True, eq=False)
class Fit:
    """The evidence of some columns, and what the slopes over their parameters need.

    Attributes:
        log: log Z, nats.
        amplitudes: (F, n) most probable amplitudes.
        adjoint: (F, n, M) B: columns that change by dX change log Z by 2 Re sum conj(B) dX.
        scaled: (F, n, M) columns behind lambda^-1/2.
        inverse: (F, n, n) of X^H X + S^-1.
    """

    log: float
    amplitudes: Complex
    adjoint: Complex
    scaled: Complex
    inverse: Complex

    def curvature(self, slopes: Complex) -> Floats:
        """(P, P) Gauss-Newton Hessian of -log Z over parameters.

        Args:
            slopes: (F, P, M) how the sum of columns times amplitudes changes, behind lambda^-1/2.
        """
        held = slopes @ np.swapaxes(self.scaled.conj(), 1, 2)
        residual = slopes - (held @ np.swapaxes(self.inverse, 1, 2)) @ self.scaled
        return 2 * np.asarray(np.einsum("fpm,fqm->pq", slopes.conj(), residual).real)


def log_evidence(columns: Complex, data: Complex, lam: Floats, power: Floats) -> Floats:
    """log Z (H,) of H variances.

    Args:
        columns: (F, n, M) whitened but for lambda.
        data: (F, M) the same of the data.
        lam: (H or 1, F, M) variance of noise and clutter.
        power: (H, F, n) prior variances S of the amplitudes.
    """
    scaled = columns / np.sqrt(lam)[:, :, None]
    y = data / np.sqrt(lam)
    energy = (np.abs(y) ** 2).sum(axis=(1, 2)) + np.log(lam).sum(axis=(1, 2))
    if columns.shape[1] == 0:
        return np.broadcast_to(-energy, len(power))
    matrix = scaled.conj() @ np.swapaxes(scaled, 2, 3)
    matrix = matrix + np.eye(power.shape[2]) / power[..., None]
    right = (scaled.conj() @ y[..., None])[..., 0]
    factor = np.linalg.cholesky(matrix)
    half = np.linalg.solve(factor, right[..., None])[..., 0]
    diagonal = np.einsum("hfii->hfi", factor).real
    gain = (np.abs(half) ** 2).sum(axis=(1, 2)) - 2 * np.log(diagonal).sum(axis=(1, 2))
    return np.asarray(gain - np.log(power).sum(axis=(1, 2)) - energy)


def fit(columns: Complex, data: Complex, lam: Floats, power: Floats) -> Fit:
    """The evidence of columns, with slopes; arguments as of `log_evidence`, without H."""
    root = np.sqrt(lam)
    scaled = columns / root[:, None]
    y = data / root
    matrix = scaled.conj() @ np.swapaxes(scaled, 1, 2)
    n = columns.shape[1]
    matrix[:, np.arange(n), np.arange(n)] += 1 / power
    right = (scaled.conj() @ y[..., None])[..., 0]
    inverse = np.asarray(np.linalg.inv(matrix), dtype=np.complex128)
    amplitudes = (inverse @ right[..., None])[..., 0]
    residual = y - (amplitudes[:, None] @ scaled)[:, 0]
    adjoint = residual[:, None] * amplitudes.conj()[..., None] - np.swapaxes(inverse, 1, 2) @ scaled
    log = (right.conj() * amplitudes).sum().real + np.linalg.slogdet(inverse)[1].sum()
    log -= (np.abs(y) ** 2).sum() + np.log(lam).sum() + np.log(power).sum()
    return Fit(float(log), amplitudes, adjoint / root[:, None], scaled, inverse)
