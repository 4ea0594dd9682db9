"""The uneven turn of a turntable, read off an enrolled object.

The stated angles of the views are off by a few milliradians: a bent axle, an off-centre belt. A handle 65 mm
from the axis then moves by some tenths of a millimetre, and what a signature leaves of a loud object is more
than its noise. The errors of the angles are parameters of the object's place, like its turn, with a prior.

Beside a tag that is not enrolled with its body, what the body's echo leaves is mostly the tag: its energy is
what the errors are weighed against, or a few milliradians more than there are would explain a part of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.hypothesis import Pose, Seen
from tagid.tags.bodies.posing import CENTRE_SIGMA_M, Linear, at_pose, descend, noise_of
from tagid.tags.bodies.pulse_tail import SLOPE, slope
from tagid.tags.bodies.signature import Signature, Standpoint, turned
from tagid.tags.bodies.spectra import Spectra, centred

HARMONICS = 4
"""Of a turn, in the error of the angles."""
SIGMA_RAD = 0.01
"""Standard deviation of the first harmonic's coefficients, rad; the k-th has 1/k of it, as where the speed
is uneven by as much at every harmonic."""


@dataclass(frozen=True, eq=False)
class Steadied(Seen):
    """An object where its turn may have been uneven.

    Attributes:
        charged: what the prior of the angles charges.
    """

    charged: float


def steadied(
    spectra: Spectra,
    signature: Signature,
    pose: Pose,
    *,
    beside: NDArray[np.complex128] | None = None,
    variance: float = 0.0,
    tail: bool = False,
) -> Steadied:
    """The best pose near a start, together with the errors of the angles.

    Args:
        spectra, signature: at the same frequencies.
        pose: start.
        beside: (F, C, V) echoes of what else stands there, each with a free amplitude per frequency.
        variance: of one value of what all this leaves, where that is more than the noise.
        tail: the pulse may have another tail than that of the enrolment, see `pulse_tail`.
    """
    variance = max(variance, noise_of(spectra))
    shapes = _harmonics(spectra.antenna)

    def model(x: NDArray[np.float64]) -> Linear:
        seen = _turned_by(spectra, x[3:] @ shapes)
        at = Standpoint(seen, complex(x[0], x[1]))
        parts = at_pose(at, turned(seen, signature, float(x[2])))
        # A larger angle takes the antenna along its circle, as if the centre moved the other way.
        along = 1j * seen.antenna
        by_x, by_y = parts.slopes[0, ..., 0], parts.slopes[1, ..., 0]
        later = -(by_x * along.real + by_y * along.imag) * shapes[:, None, :]
        columns, slopes = [parts.columns], [np.concatenate([parts.slopes, later[..., None]])]
        if tail:
            columns.append(slope(columns[0]))
            slopes.append(np.swapaxes(slope(np.swapaxes(slopes[0], 0, 1)), 0, 1))
        own = Linear(np.concatenate(columns, axis=-1), np.concatenate(slopes, axis=-1))
        return own.with_fixed(beside)

    sigmas = SIGMA_RAD / np.repeat(np.arange(1, HARMONICS + 1), 2)
    start = np.concatenate([[*pose.centre_m, pose.turn_rad], np.zeros(2 * HARMONICS)])
    loads = _loads(spectra.data, model(start).columns, variance) if tail else None
    found = descend(
        spectra,
        model,
        start,
        sigmas=np.array([CENTRE_SIGMA_M, CENTRE_SIGMA_M, np.inf, *sigmas]),
        variance=variance,
        loads=loads,
    )
    x, y, turn = (float(value) for value in found.x[:3])
    charged = variance * float(np.sum((found.x[3:] / sigmas) ** 2))
    seen = _turned_by(spectra, found.x[3:] @ shapes)
    if loads is not None:
        seen = replace(seen, data=spectra.data - found.part(1))
    return Steadied(Pose((x, y), turn % (2 * np.pi)), seen, found.left + charged, charged)


def _loads(
    data: NDArray[np.complex128], columns: NDArray[np.complex128], variance: float
) -> NDArray[np.float64]:
    """(F, N) loads of columns (F, V, N), the echo first and its slope second, which alone is held."""
    echo = centred(columns[..., 0])
    size = np.maximum((np.abs(echo) ** 2).sum(axis=1), 1e-300)
    level = np.abs((echo.conj() * data).sum(axis=1)) / size
    loads = np.zeros((len(columns), columns.shape[-1]))
    # Where there is no echo there is no tail.
    loads[:, 1] = np.minimum(variance / np.maximum((SLOPE * level) ** 2, 1e-300), 1e12 * size)
    return loads


def _harmonics(antenna: NDArray[np.complex128]) -> NDArray[np.float64]:
    """(2 HARMONICS, V) cosines and sines of the bearing of the views."""
    orders = np.arange(1, HARMONICS + 1)
    waves = np.exp(1j * orders[:, None] * np.angle(antenna))
    return np.stack([waves.real, waves.imag], axis=1).reshape(2 * HARMONICS, -1)


def _turned_by(spectra: Spectra, errors: NDArray[np.float64]) -> Spectra:
    return replace(spectra, antenna=spectra.antenna * np.exp(1j * errors))
