"""How far out of round a body is that nobody enrolled, read off its echo.

Cups and cans are oval by some tenths of a millimetre. Their wall then comes nearer and goes farther twice a
turn, which a body of revolution does not explain: 0.3 mm turn the phase of its echo by 0.05 rad, and of a cup
26 dB over a reflector that is a third of the reflector's own energy. The two components of the deviation are
parameters of the body's place, like its centre, with a prior.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.hypothesis import Pose, Seen
from tagid.tags.bodies.posing import CENTRE_SIGMA_M, Linear, descend, noise_of
from tagid.tags.bodies.signature import Standpoint
from tagid.tags.bodies.spectra import Spectra, centred

SIGMA_M = 0.3e-3
"""Standard deviation of each component of the deviation, m."""


def rounded(
    spectra: Spectra, pose: Pose, beside: NDArray[np.complex128] | None = None, variance: float = 0.0
) -> Seen | None:
    """A round body's best centre, and the scans as if it were round; None where nothing shows that it is not.

    Args:
        spectra: the scans.
        pose: start.
        beside: (F, C, V) echoes of reflectors, each with a free amplitude per frequency; None for none.
        variance: of one value of what all this leaves, where that is more than the noise.
    """
    variance = max(variance, noise_of(spectra))
    kappa = spectra.wavenumbers[:, None]

    def model(x: NDArray[np.float64]) -> Linear:
        at = Standpoint(spectra, complex(x[0], x[1]))
        cosine, sine = np.cos(2 * at.azimuth), np.sin(2 * at.azimuth)
        echo = at.carrier * np.exp(-1j * kappa * (x[2] * cosine + x[3] * sine))
        bent = 2 * (x[3] * cosine - x[2] * sine) * at.azimuth_slopes()
        moved = at.carrier_slopes() / at.carrier * echo - 1j * kappa * echo * bent[:, None]
        nearer = np.stack([-1j * kappa * echo * cosine, -1j * kappa * echo * sine])
        return Linear(echo[..., None], np.concatenate([moved, nearer])[..., None]).with_fixed(beside)

    centre = np.array([*pose.centre_m, 0.0, 0.0])
    sigmas = np.array([CENTRE_SIGMA_M, CENTRE_SIGMA_M, SIGMA_M, SIGMA_M])
    even = descend(spectra, model, centre, sigmas=sigmas * (1, 1, 1e-6, 1e-6), variance=variance)
    found = descend(spectra, model, np.array([*even.x[:2], 0.0, 0.0]), sigmas=sigmas, variance=variance)
    left = found.left + variance * float(np.sum((found.x[2:] / SIGMA_M) ** 2))
    # Half the log of the values' number for each component (Schwarz 1978).
    if even.left - left < variance * np.log(2 * spectra.data.size):
        return None
    as_round = Standpoint(spectra, complex(found.x[0], found.x[1])).carrier
    data = spectra.data - found.part(0) + centred(found.amplitudes[:, :1] * as_round)
    return Seen(Pose((float(found.x[0]), float(found.x[1]))), replace(spectra, data=data), left)
