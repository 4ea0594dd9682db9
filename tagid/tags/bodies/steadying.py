"""The uneven turn of a turntable, read off an enrolled object.

The given angles of the views are off by a few milliradians: a bent axle, an off-centre belt. A handle 65 mm
from the axis then moves by some tenths of a millimetre, and the residual of a strong echo exceeds
its noise. The errors of the angles are parameters of the object's place, like its turn, with a prior.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.posing import CENTRE_SIGMA_M, Linear, Match, at_pose, descend
from tagid.tags.bodies.signature import Pose, Signature, Standpoint, turned
from tagid.tags.bodies.spectra import Spectra

HARMONICS = 4
"""Of a turn, in the error of the angles."""
SIGMA_RAD = 0.01
"""Standard deviation of the first harmonic's coefficients, rad; the k-th has 1/k of it, as where the speed
is uneven by as much at every harmonic."""


def steadied(spectra: Spectra, signature: Signature, pose: Pose) -> tuple[Match, Spectra]:
    """The best match near a start, and the spectra seen from where they were taken."""
    shapes = _harmonics(spectra.antenna)

    def model(x: NDArray[np.float64]) -> Linear:
        seen = _turned_by(spectra, x[3:] @ shapes)
        at = Standpoint(seen, complex(x[0], x[1]))
        parts = at_pose(at, turned(seen, signature, float(x[2])))
        # A larger angle takes the antenna along its circle, as if the centre moved the other way.
        along = 1j * seen.antenna
        by_x, by_y = parts.slopes[0, ..., 0], parts.slopes[1, ..., 0]
        later = -(by_x * along.real + by_y * along.imag) * shapes[:, None, :]
        return Linear(parts.columns, np.concatenate([parts.slopes, later[..., None]]))

    sigmas = SIGMA_RAD / np.repeat(np.arange(1, HARMONICS + 1), 2)
    start = np.concatenate([[*pose.centre_m, pose.turn_rad], np.zeros(2 * HARMONICS)])
    sigmas = np.array([CENTRE_SIGMA_M, CENTRE_SIGMA_M, np.inf, *sigmas])
    end, residual = descend(spectra, model, start, sigmas=sigmas)
    x, y, turn = (float(value) for value in end[:3])
    return Match(Pose((x, y), turn % (2 * np.pi)), residual), _turned_by(spectra, end[3:] @ shapes)


def _harmonics(antenna: NDArray[np.complex128]) -> NDArray[np.float64]:
    """(2 HARMONICS, V) cosines and sines of the bearing of the views."""
    orders = np.arange(1, HARMONICS + 1)
    waves = np.exp(1j * orders[:, None] * np.angle(antenna))
    return np.stack([waves.real, waves.imag], axis=1).reshape(2 * HARMONICS, -1)


def _turned_by(spectra: Spectra, errors: NDArray[np.float64]) -> Spectra:
    return replace(spectra, antenna=spectra.antenna * np.exp(1j * errors))
