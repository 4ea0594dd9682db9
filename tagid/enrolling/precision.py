"""Precision of the reflector positions measured in one recording: their covariance.

Captures of one object differ in views, noise and position; an unweighted mean would waste the good ones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.tags.reading.field import MatchedField

_STEP_M = 2e-4
_LOAD = 1e-9


def position_covariances(field: MatchedField, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of least-squares positions with free complex amplitudes: the inverse Fisher information.

    Let S be the templates, a the amplitudes, and J the derivatives of S a with respect to the coordinates,
    made orthogonal to S because the amplitudes are fitted too. The covariance is (2 / v Re(J^H J))^-1 (Kay
    1993, section 15.7), v being the variance of a complex sample. v is the noise variance or the variance of
    the residual, whichever is larger, so unexplained echoes of the object count as noise. Correlations
    between reflectors are omitted from the result.

    Args:
        field: matched field of the scans.
        positions: (K, 2) m, at the least-squares solution.

    Returns:
        (K, 2, 2), m^2.
    """
    k = len(positions)
    own = field.templates(positions).astype(np.complex128)
    amplitudes, *_ = np.linalg.lstsq(own.T, field.data.astype(np.complex128), rcond=None)
    left = field.data - amplitudes @ own
    variance = max(float(np.mean(np.abs(left) ** 2)), field.noise_variance, 1e-30)
    slopes = []
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = _STEP_M
        ahead, behind = field.templates(positions + step), field.templates(positions - step)
        slopes.append((ahead - behind).astype(np.complex128) / (2 * _STEP_M) * amplitudes[:, None])
    jacobian = np.stack(slopes, axis=1).reshape(2 * k, -1)
    basis, _ = np.linalg.qr(own.T)
    jacobian = jacobian - (jacobian @ basis.conj()) @ basis.T
    information = 2 / variance * np.real(jacobian.conj() @ jacobian.T)
    information += _LOAD * np.trace(information) / (2 * k) * np.eye(2 * k) + 1e-6 * np.eye(2 * k)
    whole = np.linalg.inv(information)
    return np.array([whole[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(k)])
