"""Echoes of what turns with the object but lies outside the image.

A fit that knows only the pixels of the image explains such echoes by bright pixels along its edge. They are
therefore fitted on a larger square together with the inside, and their part is subtracted before the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import ImageGrid
from tagid.imaging.lengths import coarsest_pixel_m
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.sparse import SparseSettings, sparse_recovery
from tagid.imaging.types import BasebandScans

_WIDER = 3
"""Side of the larger square over that of the image."""

ASKS = 0.5
"""Backprojection outside over that inside, at its brightest, from which the outside is fitted. Sidelobes of a
full turn fall to J0(2kr) = 0.12 at a quarter of a metre (P440); those of few views and of many points reach
0.4."""

LEAST_SHARE = 0.05
"""Share of the energy that the outside must explain to be subtracted."""

MOST_LEFT = 0.7
"""What the larger square leaves of the scans, over what the image's leaves, at most."""

_MOST_PIXELS = 1024


@dataclass(frozen=True, eq=False)
class Outside:
    """Reflectivities outside the image that explain part of the scans.

    Attributes:
        points: (n, 2) m.
        amplitudes: (n,) complex64.
        share: part of the energy of the scans that they explain.
    """

    points: NDArray[np.float64]
    amplitudes: NDArray[np.complex64]
    share: float

    def removed(self, scans: BasebandScans) -> BasebandScans:
        """Scans (any views, without matched filter) less these echoes."""
        echoes = ForwardOperator(scans, self.points).forward(self.amplitudes)
        return replace(scans, samples=scans.samples - echoes)

    def facts(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {"share": self.share, "points": len(self.points)}


def find_outside(scans: BasebandScans, grid: ImageGrid) -> Outside | None:
    """What lies outside the image and echoes in these scans; None where nothing much does.

    argmin_x 1/2 ||A x - y||^2 + lambda ||x||_1 over a square of three times the side, of which x inside the
    image is left to the method that makes the image. The outside is believed only where the image's square
    alone leaves clearly more of the scans over: few views of many points have sidelobes as bright as points.

    Args:
        scans: baseband scans without matched filter.
        grid: of the image.
    """
    step = min(grid.step, coarsest_pixel_m(scans.wavelength_m) / 2)
    pixels = int(np.clip(np.ceil(_WIDER * grid.extent / step), 2, _MOST_PIXELS))
    wide = ImageGrid(_WIDER * grid.extent, pixels)
    inside = (np.abs(wide.points) <= grid.extent / 2).all(axis=1)
    operator = ForwardOperator(scans, wide)
    back = np.abs(operator.adjoint(scans.samples))
    if not back[~inside].max() > ASKS * back[inside].max():
        return None
    settings = SparseSettings(regularisation=0.05)
    x = sparse_recovery(scans, wide, settings, operator=operator).values.ravel()
    bright = ~inside & (x != 0)
    energy = _energy(scans.samples)
    if not bright.any() or energy == 0:
        return None
    found = Outside(wide.points[bright], x[bright], 0.0)
    share = 1 - _energy(found.removed(scans).samples) / energy
    own = ForwardOperator(scans, grid)
    alone = sparse_recovery(scans, grid, settings, operator=own).values.ravel()
    left = _energy(scans.samples - operator.forward(x)), _energy(scans.samples - own.forward(alone))
    if share < LEAST_SHARE or left[0] > MOST_LEFT * left[1]:
        return None
    return replace(found, share=share)


def _energy(samples: NDArray[np.complex64]) -> float:
    return float(np.vdot(samples, samples).real)
