"""Echoes of what turns with the object but lies outside the image.

A fit that knows only the pixels of the image explains such echoes by bright pixels along its edge. They are
therefore fitted on a larger square together with the inside, and their part is subtracted before the fit.

The search is bounded at any wavelength: where the envelopes of the scans, whatever their phases, are too weak
for a bright point, no pixel is looked at, and the fit takes the brightest pixels only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import MOST_PIXELS, ImageGrid
from tagid.imaging.lengths import coarsest_pixel_m
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import select_views
from tagid.imaging.sparse import Progress, SparseSettings, sparse_amplitudes
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

_CELLS_PER_RESOLUTION = 4
"""Cells of the first look within the range resolution: the envelope at a cell's middle is at least 0.9 of its
largest in the cell and its neighbours."""
_BETWEEN = 0.9

_LOOK_PAIRS = 10**8
"""Pairs of view and cell of the first look, and of view and pixel of the second: each a second of two
cores."""
_FEWEST_VIEWS = 16
"""Views that the first look visits at least, where the cells are so many that not all views can be."""
_FIT_PAIRS = 2 * 10**6
"""Pairs of view and pixel of the fit, which visits each two hundred times at most."""
_FEWEST_POINTS = 2000
_FIT = SparseSettings(regularisation=0.05, iterations=60)


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

    def facts(self, subtracted: bool) -> dict[str, Any]:
        """Plain JSON values; whether the image was made without these echoes."""
        return {"share": self.share, "points": len(self.points), "subtracted": subtracted}


def find_outside(scans: BasebandScans, grid: ImageGrid, progress: Progress | None = None) -> Outside | None:
    """What lies outside the image and echoes in these scans; None where nothing much does.

    argmin_x 1/2 ||A x - y||^2 + lambda ||x||_1 over the brightest pixels of a square of three times the side,
    of which x inside the image is left to the method that makes the image. The outside is believed only where
    the image's square alone leaves clearly more of the scans over: few views of many points have sidelobes as
    bright as points.

    Args:
        scans: baseband scans without matched filter.
        grid: of the image.
        progress: called after every iteration of the fits.
    """
    energy = _energy(scans.samples)
    if energy == 0:
        return None
    inside = _Bright.of(scans, grid.points)
    outside = _Bright.of(scans, _may_be_bright(scans, grid, ASKS * inside.top))
    if not outside.top > ASKS * inside.top:
        return None
    most = max(_FEWEST_POINTS, _FIT_PAIRS // scans.aperture.views)
    near, far = inside.brightest(most // 2), outside.brightest(most // 2)
    x, residual = _fit(scans, np.concatenate([near, far]), progress)
    bright = x[len(near) :] != 0
    if not bright.any():
        return None
    echoes = Outside(far[bright], x[len(near) :][bright], 0.0)
    share = 1 - _energy(echoes.removed(scans).samples) / energy
    if share < LEAST_SHARE:
        return None
    _, alone = _fit(scans, inside.brightest(most), progress)
    return replace(echoes, share=share) if residual <= MOST_LEFT * alone else None


@dataclass(frozen=True, eq=False)
class _Bright:
    """Points (n, 2), m, and their backprojection |A^H y|, (n,)."""

    points: NDArray[np.float64]
    strength: NDArray[np.float32]

    @classmethod
    def of(cls, scans: BasebandScans, points: NDArray[np.float64]) -> _Bright:
        if not len(points):
            return cls(points, np.zeros(0, dtype=np.float32))
        return cls(points, np.abs(ForwardOperator(scans, points).adjoint(scans.samples)))

    @property
    def top(self) -> float:
        return float(self.strength.max(initial=0.0))

    def brightest(self, most: int) -> NDArray[np.float64]:
        """At most so many points."""
        if len(self.points) <= most:
            return self.points
        return self.points[np.argpartition(-self.strength, most)[:most]]


def _may_be_bright(scans: BasebandScans, grid: ImageGrid, level: float) -> NDArray[np.float64]:
    """Pixels (n, 2), m, outside the image whose backprojection may exceed a level, at most `_LOOK_PAIRS`.

    |A^H y| at a point is at most the sum of its envelopes over the views, which changes with the range
    resolution only and is looked at in cells of many pixels. The most promising cells come first. Where the
    cells are too many for all views, views spread over them are looked at, and nothing where they would be
    few.
    """
    step = min(grid.step, coarsest_pixel_m(scans.wavelength_m) / 2)
    resolution = scans.wave_speed_m_s / (2 * scans.bandwidth_hz)
    side = max(1, int(resolution / _CELLS_PER_RESOLUTION / step))
    per_side = int(np.ceil(_WIDER * grid.extent / (side * step)))
    views = scans.aperture.views
    visited = min(views, _LOOK_PAIRS // per_side**2)
    if per_side > MOST_PIXELS or visited < min(views, _FEWEST_VIEWS):
        return np.zeros((0, 2))
    cells = ImageGrid(_WIDER * grid.extent, per_side)
    some = scans
    if visited < views:
        some = select_views(scans, np.linspace(0, views - 1, visited).astype(np.intp))
    bound = ForwardOperator(some, cells).envelope(some.samples).reshape(cells.pixels, cells.pixels)
    bound *= views / visited
    wide = np.pad(bound, 1)
    rows = np.maximum(np.maximum(wide[:-2], wide[1:-1]), wide[2:])
    around = np.maximum(np.maximum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:]).ravel()
    outside = (np.abs(cells.points) > (grid.extent - cells.step) / 2).any(axis=1)
    wanted = np.flatnonzero(outside & (around > _BETWEEN * level))
    most = max(1, _LOOK_PAIRS // (views * side**2))
    wanted = wanted[np.argsort(-around[wanted], kind="stable")[:most]]
    offset = ((np.arange(side) + 0.5) / side - 0.5) * cells.step
    offsets = np.stack([part.ravel() for part in np.meshgrid(offset, offset)], axis=1)
    pixels = (cells.points[wanted][:, None] + offsets).reshape(-1, 2)
    return np.asarray(pixels[(np.abs(pixels) > grid.extent / 2).any(axis=1)])


def _fit(
    scans: BasebandScans, points: NDArray[np.float64], progress: Progress | None
) -> tuple[NDArray[np.complex64], float]:
    """Amplitudes of some points, and the energy that they leave of the scans."""
    operator = ForwardOperator(scans, points)
    x, _ = sparse_amplitudes(scans, points, _FIT, progress, operator)
    return x, _energy(scans.samples - operator.forward(x))


def _energy(samples: NDArray[np.complex64]) -> float:
    return float(np.vdot(samples, samples).real)
