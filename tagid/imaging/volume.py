"""Reflectivity in three dimensions, from antenna positions at several heights.

A turn at one height cannot tell heights apart; turns at several heights together can, with the resolution
lambda R / (2 H) at the distance R for heights that reach over H.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import VolumeGrid
from tagid.imaging.backprojection import upsample_at_carrier, upsampling
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.memory import require_memory
from tagid.imaging.preprocess import select_views
from tagid.imaging.sparse import sparse_amplitudes
from tagid.imaging.types import BasebandScans
from tagid.types import Progress

_VIEW_VALUES = 1 << 21
"""Upsampled samples of a block of views, 16 MB: they are read once per slab of voxels."""
_SLAB_VOXELS = 1 << 18
"""Voxels of a slab, whose positions and sums take 5 MB."""


@dataclass(frozen=True, eq=False)
class Volume:
    """A complex reflectivity volume.

    Attributes:
        values: (levels, pixels, pixels) complex64, index (z, y, x).
        grid: where the voxels lie, about `centre_m`.
        settings: method and parameters as plain JSON values.
        centre_m: (x, y) of the volume's axis in the object's frame, m; methods work about the origin.
    """

    values: NDArray[np.complex64]
    grid: VolumeGrid
    settings: dict[str, Any] = field(default_factory=dict)
    centre_m: tuple[float, float] = (0.0, 0.0)


def backproject_volume(scans: BasebandScans, grid: VolumeGrid, progress: Progress | None = None) -> Volume:
    """f(p) = 1/views sum_v z_v(d_vp) exp(2j k d_vp) at every voxel, as `backproject` in the plane.

    Views and voxels are taken in blocks, so that beside the result little memory is used. The scans are best
    matched-filtered; `progress` counts pairs of view and voxel. Raises UsageError: no memory for the volume.
    """
    require_memory(
        16 * grid.voxels + 24 * _VIEW_VALUES + 100 * _SLAB_VOXELS,
        f"backprojections to {grid.voxels:,} voxels",
        "Use fewer pixels (`imaging.pixels`) or levels (`levels`).",
    )
    per_level = grid.square.pixels**2
    rise = max(1, _SLAB_VOXELS // per_level)
    slabs = [slice(at, min(at + rise, grid.levels)) for at in range(0, grid.levels, rise)]
    block = max(1, _VIEW_VALUES // (scans.samples.shape[1] * upsampling(scans)))
    values = np.zeros((grid.levels, per_level), dtype=np.complex64)
    views, done = scans.aperture.views, 0
    for first in range(0, views, block):
        some = select_views(scans, slice(first, first + block))
        rows, start, step = upsample_at_carrier(some, slice(None))
        for slab in slabs:
            points = grid.points(slab)
            geometry = RangeGeometry.of(some.aperture, points, (start, step), rows.shape[1])
            values[slab] += geometry.gather(rows).reshape(-1, per_level)
            done += len(rows) * len(points)
            if progress is not None:
                progress(done, views * grid.voxels, "")
    values /= np.float32(views)
    shape = (grid.levels, grid.square.pixels, grid.square.pixels)
    return Volume(values.reshape(shape), grid, {"method": "bp"})


def sparse_volume(scans: BasebandScans, grid: VolumeGrid, progress: Progress | None = None) -> Volume:
    """argmin_x 1/2 ||A x - y||^2 + lambda ||x||_1 over the voxels, as `sparse_recovery` in the plane."""

    def steps(done: int, of: int) -> None:
        if progress is not None:
            progress(done, of, "")

    x, facts = sparse_amplitudes(scans, grid.points(), progress=steps)
    shape = (grid.levels, grid.square.pixels, grid.square.pixels)
    return Volume(x.reshape(shape), grid, {"method": "sparse", **facts})


def part_of(progress: Progress | None, begin: float, end: float, what: str = "") -> Progress:
    """Progress of one of several stages as part of the whole, from 0 to 1; `what` where it has no remark."""

    def report(done: float, total: float, remark: str) -> None:
        if progress is not None:
            progress(begin + (end - begin) * done / max(total, 1), 1.0, remark or what)

    return report


def vertical_resolution_m(scans: BasebandScans) -> float:
    """lambda R / (2 H) with R the median range of the origin and H the span of the heights; inf for one."""
    height = float(np.ptp(scans.aperture.positions[:, 2]))
    reach = float(np.median(scans.aperture.distances(np.zeros((1, 3)))))
    return scans.wavelength_m * reach / (2 * height) if height > 0 else float("inf")
