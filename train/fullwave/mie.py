"""The exact scattering of a conducting sphere, the reference for the solver."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import spherical_jn, spherical_yn


def sphere_backscatter(radius_m: float, k: NDArray[np.floating]) -> NDArray[np.complex128]:
    """Scattering length b (m) of a conducting sphere towards the radar, phase reference at its centre.

    b = (j / 2k) sum_n (-1)^n (2n + 1) (a_n - b_n), a_n = [x j_n(x)]' / [x h_n(x)]', b_n = j_n(x) / h_n(x),
    with h = j - jy for exp(+j omega t) and x = k radius (Mie series; Balanis, Advanced Engineering
    Electromagnetics, 2nd edition, section 11.8). Radar cross-section 4 pi |b|^2.

    Args:
        radius_m: m.
        k: wavenumbers of any shape, 1/m.
    """
    x = np.asarray(k, dtype=np.float64) * radius_m
    total = np.zeros(x.shape, dtype=np.complex128)
    # Terms beyond x + 4 x^(1/3) are below double precision (Wiscombe, Appl. Opt. 19, 1505, 1980).
    for n in range(1, int(x.max() + 4 * x.max() ** (1 / 3) + 6)):
        j, y = spherical_jn(n, x), spherical_yn(n, x)
        dj, dy = j + x * spherical_jn(n, x, True), y + x * spherical_yn(n, x, True)
        total += (-1) ** n * (2 * n + 1) * (dj / (dj - 1j * dy) - j / (j - 1j * y))
    return 0.5j * total / np.asarray(k)
