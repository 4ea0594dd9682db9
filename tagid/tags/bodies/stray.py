"""The strongest single reflector in what a hypothesis leaves of the scans.

Noise spreads over all frequencies and views, a reflector that the hypothesis lacks does not: of F V values it
fills one matched combination. That combination shows it 10 dB below the level at which the energy left, whose
noise is known to a third only, would tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tagid.tags.bodies.pulse_tail import Explained
from tagid.tags.bodies.spectra import Spectra, centred

ARC_M = 12e-3
"""Spacing of the places tried: a third of the width of a point's response, 0.36 times the shortest
wavelength, 62 mm, half of it two-way."""
NEAREST_M = 0.02


@dataclass(frozen=True)
class Stray:
    """What a single reflector explains of a residual.

    Attributes:
        energy: that it explains.
        place_m: (x, y) in the turntable's frame, m.
        variance: of one value of the residual.
    """

    energy: float
    place_m: tuple[float, float]
    variance: float

    @property
    def nats(self) -> float:
        """Energy over the residual's variance: 6 to 12 for noise over some 400 places."""
        return self.energy / max(self.variance, 1e-300)


def strongest_stray(spectra: Spectra, known: Explained, centre: complex, reach_m: float) -> Stray:
    """The reflector that explains most of what an echo leaves.

    A reflector is a point with one amplitude for the whole band, times the gain of the echo, which holds what
    the pulse is against that of the enrolment, and a pattern 1, cos psi over its aspect psi: two amplitudes,
    each made orthogonal to what is explained already.

    Args:
        spectra: the scans.
        known: what is explained of them.
        centre: of the object, x + jy, m.
        reach_m: largest distance of a reflector from it, m.
    """
    freedom = len(known.rest) * (spectra.views - 1 - known.columns.shape[-1])
    variance = known.left / max(freedom, 1)
    shape = known.gain[:, None] / max(float(np.linalg.norm(known.gain)), 1e-300)
    radii = np.arange(NEAREST_M, reach_m + ARC_M / 2, ARC_M)
    best = Stray(0.0, (centre.real, centre.imag), variance)
    for radius in radii:
        count = int(np.ceil(2 * np.pi * radius / ARC_M))
        azimuths = 2 * np.pi * np.arange(count) / count
        places = centre + radius * np.exp(1j * azimuths)
        across = spectra.antenna - places[:, None]
        waves = np.moveaxis(spectra.waves(np.abs(across)), 0, 1) * shape
        facing = np.cos(np.angle(across) - azimuths[:, None])
        columns = centred(np.stack([waves, waves * facing[:, None]], axis=1))
        # (count, 2, F, V): of each frequency, what is explained already is taken out.
        along = np.einsum("fvc,npfv->npfc", known.columns.conj(), columns, optimize=True)
        columns = columns - np.einsum("fvc,npfc->npfv", known.columns, along, optimize=True)
        flat = columns.reshape(count, 2, -1)
        gram = flat.conj() @ flat.swapaxes(1, 2)
        seen = flat.conj() @ known.rest.reshape(-1)
        # A place inside the echo's own span has nothing of its own: it explains nothing, not infinitely much.
        gram += 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-300 * np.eye(2)
        energy = (seen.conj() * np.linalg.solve(gram, seen[..., None])[..., 0]).sum(axis=1).real
        i = int(energy.argmax())
        if energy[i] > best.energy:
            best = Stray(float(energy[i]), (float(places[i].real), float(places[i].imag)), variance)
    return best
