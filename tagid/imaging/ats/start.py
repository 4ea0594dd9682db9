"""The image that a fit begins with: the sparse solution, as the eye sees it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import ImageGrid
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.restore import beam_sigma_m, blurred
from tagid.imaging.sparse import SparseSettings, sparse_amplitudes
from tagid.imaging.types import BasebandScans

_PAIRS = 2 * 10**6
"""Pairs of view and vertex of the sparse solution: all for a P440 and 360 views of 0.5 m."""


LARGE_PAIRS = 30 * 10**6
"""Pairs of view and pixel from which an image is large: 360 views of 0.5 m at 24 GHz, but not of 2 m of a
P440."""

_ITERATIONS_OF_LARGE = 40
"""Iterations of the sparse solution of a large image. Its echoes keep FISTA busy to its last iteration, which
is two thirds of a fit, and the fit then leaves about as much of unseen views as after 150: of two outlines
and a box at 24 GHz 22.1, 53.4 and 83.8 %, after 150 iterations 22.5, 52.5 and 86.2 %."""


class FirstImages:
    """First images by the views that a fit does not see, each computed once.

    Fits of the same scans on the same grid share them: priors that are compared on the same views begin
    alike, and the sparse solution is up to half of a fit.
    """

    def __init__(self) -> None:
        self._made: dict[tuple[bytes, int], NDArray[np.complex128]] = {}

    def of(
        self, scans: BasebandScans, unseen: NDArray[np.integer], grid: ImageGrid, cells: int, step: float
    ) -> NDArray[np.complex128]:
        """As `first_image`; `scans` are those without the views `unseen`."""
        key = np.asarray(unseen, dtype=np.int64).tobytes(), cells
        if key not in self._made:
            self._made[key] = first_image(scans, grid, cells, step)
        return self._made[key]


def first_image(scans: BasebandScans, grid: ImageGrid, cells: int, step: float) -> NDArray[np.complex128]:
    """(cells + 1, cells + 1) sparse solution with the restoring beam at the vertices of the finest level, in
    the units of the scans.

    From backprojection, whose sidelobes of a dozen views are half as bright as its points, the steps do not
    get rid of them: 8.8 % of unseen views are left of twelve views of reflectors, 2.7 % from here. From bare
    pixels the points stay where their pixels are: 1.0 mm off at 36 views, 0.6 mm from here. Where the sparse
    solution is blank it is backprojection. The brightest vertices of a large image take part.

    Args:
        scans: those that are fitted.
        grid: the image.
        cells: of the finest level, a side.
        step: factor by which backprojection explains the scans best.
    """
    axis = np.linspace(-grid.extent / 2, grid.extent / 2, cells + 1)
    vertices = np.stack([part.ravel() for part in np.meshgrid(axis, axis)], axis=1)
    operator = ForwardOperator(scans, vertices)
    back = operator.adjoint(np.ascontiguousarray(scans.samples, dtype=np.complex64))
    most = max(1, _PAIRS // scans.aperture.views)
    chosen = np.zeros(len(vertices), dtype=bool)
    chosen[np.argsort(-np.abs(back), kind="stable")[:most]] = True
    large = len(vertices) * scans.aperture.views > LARGE_PAIRS
    settings = SparseSettings(iterations=_ITERATIONS_OF_LARGE) if large else SparseSettings()
    sparse, _ = sparse_amplitudes(scans, vertices[chosen], settings, operator=operator.among(chosen))
    if not sparse.any():
        return np.asarray(back * step, np.complex128).reshape(cells + 1, cells + 1)
    bare = np.zeros(len(vertices), dtype=np.complex128)
    bare[chosen] = sparse
    width = beam_sigma_m(scans.wavenumber) / (grid.extent / cells)
    parts = [blurred(part.reshape(cells + 1, cells + 1), width) for part in (bare.real, bare.imag)]
    # A vertex is spread over the pixels of a cell.
    share = (cells / grid.pixels) ** 2
    return np.asarray((parts[0] + 1j * parts[1]) * share, dtype=np.complex128)
