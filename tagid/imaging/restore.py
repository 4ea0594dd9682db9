"""The restoring beam: an image of points at the resolution that the data have, not at that of the pixels.

Sparse methods put the energy of a reflector into one or a few pixels; which ones is chance below the width of
the point response, so what they show there is no detail of the object.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tagid.imaging.types import Image

_TRUNCATED = 4.0
"""Standard deviations at which the Gaussian is cut off."""
_HALF_HEIGHT = 1.5211
"""Where J0 is a half: the point response of a full turn is close to J0(2 k r) (k of the carrier)."""


def beam_sigma_m(wavenumber: float) -> float:
    """Standard deviation, m, of the Gaussian as wide at half height as J0(2 k r): 7.8 mm for a P440."""
    return float(_HALF_HEIGHT / (2 * wavenumber) / np.sqrt(2 * np.log(2)))


def restore(image: Image, wavenumber: float) -> Image:
    """The image convolved with a Gaussian as wide as the core of the full-turn point response.

    As in CLEAN (Högbom, Astron. Astrophys. Suppl. 15, 1974), with peak 1: pixels whose sum is a point's
    amplitude give a spot of that amplitude. Complex values are convolved, so that pixels of one reflector add
    up in phase. Not for a backprojection, which has the width of the data already.
    """
    width = beam_sigma_m(wavenumber) / image.grid.step
    middle = image.grid.pixels // 2
    unit = np.zeros(image.values.shape)
    unit[middle, middle] = 1
    # The filter's truncation is in what a pixel of 1 becomes.
    kernel_peak = float(blurred(unit, width).max())
    parts = [blurred(part.astype(np.float64), width) for part in (image.values.real, image.values.imag)]
    values = ((parts[0] + 1j * parts[1]) / kernel_peak).astype(np.complex64)
    settings = {**image.settings, "restoring_beam_m": beam_sigma_m(wavenumber)}
    return replace(image, values=values, settings=settings)


def blurred(values: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    """(rows, columns) convolved with a Gaussian of sum 1 and `sigma` pixels, mirrored at the edges."""
    reach = int(_TRUNCATED * sigma + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel /= kernel.sum()
    for axis in (0, 1):
        wide = np.pad(values, [(reach, reach) if side == axis else (0, 0) for side in (0, 1)], "symmetric")
        length = values.shape[axis]
        parts = [wide[i : i + length] if axis == 0 else wide[:, i : i + length] for i in range(len(kernel))]
        values = np.sum([weight * part for weight, part in zip(kernel, parts, strict=True)], axis=0)
    return values
