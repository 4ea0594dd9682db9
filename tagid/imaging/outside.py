"""Echoes of what turns with the object but lies outside the image.

A fit that knows only the pixels of the image (of a volume: its voxels) explains such echoes by bright ones
along its edge. They are therefore fitted on a larger square or box together with the inside, and their part
is subtracted before the fit.

The search is bounded at any wavelength: where the envelopes of the scans, whatever their phases, are too weak
for a bright point, no pixel is looked at, the fit takes the brightest pixels only, and fewer views are taken
where it would cost more than half of what the image costs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import ImageGrid, VolumeGrid
from tagid.imaging.facts import OutsideFacts
from tagid.imaging.lengths import coarsest_pixel_m
from tagid.imaging.operator import ForwardOperator, envelope, products
from tagid.imaging.preprocess import select_views
from tagid.imaging.sparse import Progress, SparseSettings, sparse_amplitudes
from tagid.imaging.types import BasebandScans

_WIDER = 3
"""Side of the larger square or box over that of the image or volume."""

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
"""Views that the search takes at least, where not all can be taken."""
_FIT_PAIRS = 2 * 10**6
"""Pairs of view and pixel of the fit."""
_FEWEST_POINTS = 2000
_FIT_PASSES = 200
"""How often the fit visits each pair at most."""
_PRODUCTS_PER_PAIR = 8
"""Multiplications of the operator that take as long as a pair of view and pixel."""
_IMAGE_PASSES = {True: 90, False: 4}
"""How often an image with its held-out residual visits each pair: by a fit, and by backprojection."""
_ENOUGH_VIEWS = 60
"""More views than these of an image are taken only while the search takes at most half of its time."""
_LEAST_WORK = {True: 2.4e9, False: 3e8}
"""Visits of pairs that a search may take whatever the image takes: a few seconds of a core, and less than a
second for an image that can only say what lies outside."""
NOT_SEARCHED = (
    "echoes from outside the image were not searched, which would take longer than the image: what lies "
    "there shows along its edge; use a larger `imaging.extent_m`"
)
_FIT = SparseSettings(regularisation=0.05, iterations=60)


@dataclass(frozen=True, eq=False)
class Outside:
    """Reflectivities outside the image that explain part of the scans.

    Attributes:
        points: (n, 2) in the plane z = 0, or (n, 3), m.
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

    def facts(self, subtracted: bool) -> OutsideFacts:
        """Plain JSON values; whether the image was made without these echoes."""
        return {"share": self.share, "points": len(self.points), "subtracted": subtracted}


def views_searched(scans: BasebandScans, grid: ImageGrid | VolumeGrid, subtracts: bool) -> int:
    """How many views `find_outside` takes, spread over all; 0 where they would be too few.

    The fit then takes at most half as long as the image, or a few seconds.
    """
    points = grid.pixels**2 if isinstance(grid, ImageGrid) else grid.voxels
    box, views = _Box.of(scans, grid), scans.aperture.views

    def pairs_of(corner: NDArray[np.float64]) -> float:
        return products(scans, corner) / _PRODUCTS_PER_PAIR

    image = views * (points + pairs_of(box.corners(1)))
    fit = _FIT_PASSES * (_fit_points(views) + pairs_of(box.corners(_WIDER)))
    cheap = int(_IMAGE_PASSES[subtracts] * image / 2 / fit)
    enough = int(_LEAST_WORK[subtracts] / fit)
    if isinstance(grid, ImageGrid):  # a volume needs views of every height
        enough = min(enough, _ENOUGH_VIEWS)
    most = min(views, max(cheap, enough), _LOOK_PAIRS // max(points, box.cells))
    return most if most >= min(views, _FEWEST_VIEWS) else 0


def find_outside(
    scans: BasebandScans,
    grid: ImageGrid | VolumeGrid,
    progress: Progress | None = None,
    *,
    subtracts: bool = True,
) -> Outside | None:
    """What lies outside the image or volume and echoes in these scans; None where nothing much does.

    argmin_x 1/2 ||A x - y||^2 + lambda ||x||_1 over the brightest pixels of a square (of a volume: voxels of
    a box) of three times the side, of which x inside the image is left to the method that makes the image.
    The outside is believed only where the image's square alone leaves clearly more of the scans over: few
    views of many points have sidelobes as bright as points.

    The scans are without matched filter. An image that is a fit, which the echoes are subtracted from
    (`subtracts`), may take longer.
    """
    energy, views = _energy(scans.samples), views_searched(scans, grid, subtracts)
    if energy == 0 or views == 0:
        return None
    some = scans
    if views < scans.aperture.views:
        some = select_views(scans, np.linspace(0, scans.aperture.views - 1, views).astype(np.intp))
    inside = _Bright.of(some, _points(grid))
    outside = _Bright.of(some, _may_be_bright(some, _Box.of(scans, grid), ASKS * inside.top))
    if not outside.top > ASKS * inside.top:
        return None
    most = _fit_points(scans.aperture.views)
    near, far = inside.brightest(most // 2), outside.brightest(most // 2)
    x, residual = _fit(some, np.concatenate([near, far]), progress)
    bright = x[len(near) :] != 0
    if not bright.any():
        return None
    echoes = Outside(far[bright], x[len(near) :][bright], 0.0)
    share = 1 - _energy(echoes.removed(scans).samples) / energy
    if share < LEAST_SHARE:
        return None
    _, alone = _fit(some, inside.brightest(most), progress)
    return replace(echoes, share=share) if residual <= MOST_LEFT * alone else None


def _points(grid: ImageGrid | VolumeGrid) -> NDArray[np.float64]:
    return grid.points if isinstance(grid, ImageGrid) else grid.points()


def _fit_points(views: int) -> int:
    return max(_FEWEST_POINTS, _FIT_PAIRS // views)


@dataclass(frozen=True, eq=False)
class _Box:
    """The square of an image or the box of a volume, and the cells that a larger one is looked at in.

    Attributes:
        low, high: (2,) or (3,) corners, m.
        sides: (2,) or (3,) pixels per cell along each axis.
        counts: (2,) or (3,) cells of the larger box along each axis.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    sides: NDArray[np.intp]
    counts: NDArray[np.intp]

    @classmethod
    def of(cls, scans: BasebandScans, grid: ImageGrid | VolumeGrid) -> _Box:
        square = grid if isinstance(grid, ImageGrid) else grid.square
        step = min(square.step, coarsest_pixel_m(scans.wavelength_m) / 2)
        low, high, steps = [-square.extent / 2] * 2, [square.extent / 2] * 2, [step] * 2
        if isinstance(grid, VolumeGrid):
            low, high, steps = [*low, grid.bottom], [*high, grid.top], [*steps, grid.rise]
        resolution = scans.wave_speed_m_s / (2 * scans.bandwidth_hz)
        sides = np.maximum(1, (resolution / _CELLS_PER_RESOLUTION / np.array(steps)).astype(np.intp))
        size = np.array(high) - np.array(low)
        counts = np.ceil(_WIDER * size / (sides * np.array(steps))).astype(np.intp)
        return cls(np.array(low), np.array(high), sides, counts)

    @property
    def cells(self) -> int:
        return int(np.prod(self.counts, dtype=np.float64))

    @property
    def middle(self) -> NDArray[np.float64]:
        return (self.low + self.high) / 2

    @property
    def size(self) -> NDArray[np.float64]:
        return self.high - self.low

    def corners(self, wider: float) -> NDArray[np.float64]:
        """(2, n) the two corners of a box of the same middle and so many times the size, m."""
        return np.stack([self.middle - wider / 2 * self.size, self.middle + wider / 2 * self.size])

    def lattice(self) -> NDArray[np.float64]:
        """(cells, n) middles of the cells, x fastest, m."""
        axes = [
            middle + ((np.arange(count) + 0.5) / count - 0.5) * _WIDER * size
            for middle, count, size in zip(self.middle, self.counts, self.size, strict=True)
        ]
        return _product(axes)

    def outside(self, points: NDArray[np.float64], margin: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(points,) whether points lie outside a box that is smaller by a margin (n,), m, in all."""
        return np.asarray((np.abs(points - self.middle) > (self.size - margin) / 2).any(axis=1))


def _product(axes: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """All points with coordinates of some axes, the first fastest."""
    grids = np.meshgrid(*axes[::-1], indexing="ij")
    return np.stack([part.ravel() for part in grids[::-1]], axis=1)


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


def _may_be_bright(scans: BasebandScans, box: _Box, level: float) -> NDArray[np.float64]:
    """Pixels (n, 2) or (n, 3), m, outside the box whose backprojection may exceed a level.

    They are at most so many that all views and they are `_LOOK_PAIRS`. |A^H y| at a point is at most the sum
    of its envelopes over the views, which changes with the range resolution only and is looked at in cells of
    many pixels. The most promising cells come first.
    """
    middles = box.lattice()
    around = envelope(scans, middles).reshape(box.counts[::-1])
    for axis in range(around.ndim):
        ends = [(int(axis == other),) * 2 for other in range(around.ndim)]
        around = np.lib.stride_tricks.sliding_window_view(np.pad(around, ends), 3, axis).max(axis=-1)
    cell = _WIDER * box.size / box.counts
    around = around.ravel()
    wanted = np.flatnonzero(box.outside(middles, cell) & (around > _BETWEEN * level))
    most = max(1, int(_LOOK_PAIRS / (scans.aperture.views * np.prod(box.sides, dtype=np.float64))))
    wanted = wanted[np.argsort(-around[wanted], kind="stable")[:most]]
    offsets = _product(
        [((np.arange(side) + 0.5) / side - 0.5) * step for side, step in zip(box.sides, cell, strict=True)]
    )
    pixels = (middles[wanted][:, None] + offsets).reshape(-1, len(box.low))
    return pixels[box.outside(pixels, np.zeros(len(box.low)))]


def _fit(
    scans: BasebandScans, points: NDArray[np.float64], progress: Progress | None
) -> tuple[NDArray[np.complex64], float]:
    """Amplitudes of some points, and the energy that they leave of the scans."""
    operator = ForwardOperator(scans, points)
    x, _ = sparse_amplitudes(scans, points, _FIT, progress, operator)
    return x, _energy(scans.samples - operator.forward(x))


def _energy(samples: NDArray[np.complex64]) -> float:
    return float(np.vdot(samples, samples).real)
