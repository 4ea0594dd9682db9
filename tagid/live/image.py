"""Backprojection that grows with the views: each view is added once, and the sum is always the exact image.

The background, the mean over the views, is known only at the end. Backprojection is linear in the scans, so
the part of the background is kept as an operator and applied to the newest mean.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tagid.errors import DataError
from tagid.geometry import ImageGrid
from tagid.imaging.backprojection import upsample_at_carrier
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.types import BasebandScans, Image


class GrowingImage:
    """The backprojection of all views added so far, without their mean, in the plane z = 0.

    With P_v the backprojection of view v and z_v its scan, the image is 1/V sum_v P_v (z_v - m) = 1/V (sum_v
    P_v z_v - (sum_v P_v) m), m the mean of all z_v. Both sums grow by one term per view; the second is a
    matrix (pixels, bins). A constant scan cancels in the image, so the first scan is subtracted from all,
    which keeps static clutter out of the rounding.
    """

    def __init__(self, grid: ImageGrid) -> None:
        self.grid = grid
        self.views = 0
        self._first: BasebandScans | None = None
        self._reference = np.zeros(0, dtype=np.complex64)
        self._unit_rows = np.zeros((0, 0), dtype=np.complex64)
        self._total = np.zeros(grid.pixels**2, dtype=np.complex128)
        self._operator = np.zeros((0, 0), dtype=np.complex128)
        self._scan_sum = np.zeros(0, dtype=np.complex128)

    def add(self, scans: BasebandScans) -> None:
        """Add views of one recording, from `preprocess` with the matched filter and without background
        removal.

        Raises DataError if their ranges differ from those of the first ones.
        """
        first = self._first
        if first is None:
            first = self._begin(scans)
        bins = scans.samples.shape[1]
        if bins != first.samples.shape[1] or scans.range_start_m != first.range_start_m:
            raise DataError(
                f"views of {bins} range bins from {scans.range_start_m:.3f} m do not continue those of "
                f"{first.samples.shape[1]} from {first.range_start_m:.3f} m"
            )
        rows = scans.samples - self._reference
        fine, start, step = upsample_at_carrier(replace(scans, samples=rows), slice(None))
        geometry = RangeGeometry.of(scans.aperture, self.grid.points, (start, step), fine.shape[1])
        self._total += geometry.gather(fine)
        for number, unit in enumerate(self._unit_rows):
            self._operator[:, number] += geometry.gather(np.tile(unit, (len(rows), 1)))
        self._scan_sum += rows.sum(axis=0, dtype=np.complex128)
        self.views += len(rows)

    def image(self) -> Image:
        """The image of the views so far; zero before the second view, because nothing has changed yet."""
        pixels = self.grid.pixels
        first = self._first
        if first is None or self.views < 2:
            return Image(np.zeros((pixels, pixels), dtype=np.complex64), self.grid, {"method": "bp"})
        mean = self._scan_sum / self.views
        values = (self._total - self._operator @ mean) / self.views
        settings = {"method": "bp", "axis_distance_m": first.aperture.axis_distance}
        return Image(values.reshape(pixels, pixels).astype(np.complex64), self.grid, settings)

    def _begin(self, scans: BasebandScans) -> BasebandScans:
        bins = scans.samples.shape[1]
        self._first = scans
        self._reference = scans.samples[0].copy()
        units = replace(scans, samples=np.eye(bins, dtype=np.complex64))
        self._unit_rows = upsample_at_carrier(units, slice(None))[0]
        self._operator = np.zeros((self.grid.pixels**2, bins), dtype=np.complex128)
        self._scan_sum = np.zeros(bins, dtype=np.complex128)
        return scans
