"""What the range window leaves of another pulse's tail.

An echo with the pulse h, from reflectivity s over the range r behind the axis, is seen through the window W
of `Spectra` as W(r) (h * s)(r). Pulses of one radar differ by a few per cent of their energy that arrive 0.2
to 0.4 m late (measured P440 pulses), where W falls. Of what a depth r' returns with the delay tau the window
keeps W(tau + r') = W(tau) + r' W'(tau) + ...: the first term is another pulse, which the free amplitude at
each frequency is anyway; the second is one more amplitude at each frequency, of the echo weighted by its
depth. That is the slope of the echo over the wavenumber kappa, as exp(-j kappa r') has the slope
-j r' exp(-j kappa r'). A longer window would take the tail in instead, and 1.5 dB more noise with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.spectra import Spectra

AMPLITUDES = 2
"""Free at each frequency: of the echo, and of its slope."""
SLOPE = 0.2
"""Standard deviation of the amplitude of an echo's change from one frequency to the next, 0.2 GHz away, over
that of the echo itself: with measured P440 pulses against a nominal one at the enrolment 0.14 to 0.22, at the
ends of the band 0.24 and 0.43 (24 bodies of our simulator)."""


@dataclass(frozen=True, eq=False)
class Explained:
    """What an echo explains of spectra, whatever pulse it was enrolled with.

    Attributes:
        columns: (F, V, AMPLITUDES) orthonormal at each frequency.
        gain: (F,) complex amplitude of the echo.
        rest: (F, V) what is left.
    """

    columns: NDArray[np.complex128]
    gain: NDArray[np.complex128]
    rest: NDArray[np.complex128]

    @property
    def left(self) -> float:
        """Energy of what is left."""
        return float(np.sum(np.abs(self.rest) ** 2))


def slope(echo: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Change of an echo (F, ...) from one frequency to the next."""
    return np.asarray(np.gradient(echo, axis=0))


def explained(spectra: Spectra, echo: NDArray[np.complex128]) -> Explained:
    """The part of spectra that an echo explains.

    Args:
        spectra: the scans, at two frequencies or more.
        echo: (F, V) at the same frequencies and views, without what is constant over the views.
    """
    columns = np.stack([echo, slope(echo)], axis=-1)
    q, r = np.linalg.qr(columns)
    inner = q.conj().swapaxes(1, 2) @ spectra.data[..., None]
    size = np.abs(r).max(axis=(1, 2), keepdims=True)
    amplitudes = np.linalg.solve(r + (1e-12 * size + 1e-300) * np.eye(AMPLITUDES), inner)
    rest = spectra.data - (q @ inner)[..., 0]
    return Explained(q, np.asarray(amplitudes[:, 0, 0], dtype=np.complex128), rest)
