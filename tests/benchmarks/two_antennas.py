"""What ignoring the second antenna costs: places of points backprojected with and without it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tagid.geometry import Aperture
from tagid.imaging.backprojection import upsample_at_carrier
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tests.benchmarks.run import Run
from tests.benchmarks.tables import Table
from tests.unit.imaging_scenes import record

STEP_M = 2.5e-4
SECTORS_DEG = {"full turn": (0, 360), "half turn": (-90, 90), "quarter turn": (-45, 45)}
NOTE = """{count} points drawn within 0.13 m of the axis, each alone and without noise; a P440's band, 1
degree per view, axis distance 1 m to the middle between the antennas. Localisation error of the backprojected
peak in mm, rms (largest), on a grid of 0.25 mm.

The range of the axis is sqrt(1 + (d/2)^2) - 1 m too long for one antenna; "axis moved" takes that much more
axis distance, as a search for it would find."""


def errors_mm(views: Aperture, assumed: Aperture, points: np.ndarray) -> np.ndarray:
    """(points,) distance of the backprojected peak of each point alone from its place, mm."""
    axis = np.arange(-0.012, 0.012 + STEP_M / 2, STEP_M)
    around = np.stack([part.ravel() for part in np.meshgrid(axis, axis)], axis=1)
    errors = []
    for point in points:
        settings = PreprocessSettings("none", True, extent_m=0.4)
        rows, start, step = upsample_at_carrier(
            preprocess(record([point], [1], views), settings=settings), slice(None)
        )
        place = RangeGeometry.of(assumed, around + point, (start, step), rows.shape[1])
        errors.append(1e3 * np.hypot(*around[np.argmax(np.abs(place.gather(rows)))]))
    return np.array(errors)


def antennas(run: Run) -> Iterator[Table]:
    """A row for every distance of the antennas and part of a turn."""
    count = run.number(40, 4)
    run.seeds = "0"
    points = np.random.default_rng(0).uniform(-0.09, 0.09, (count, 2)) * np.sqrt(2)
    rows = []
    for apart in (0.1, 0.2, 0.4):
        reach = float(np.hypot(1, apart / 2))
        for name, (first, last) in SECTORS_DEG.items():
            angles = np.deg2rad(np.arange(first, last))
            views = Aperture.turntable(angles, 1.0, 0.0, apart)
            errors = [
                errors_mm(views, assumed, points)
                for assumed in (views, Aperture.turntable(angles, 1.0), Aperture.turntable(angles, reach))
            ]
            cells = [f"{np.sqrt((e**2).mean()):.2f} ({e.max():.2f})" for e in errors]
            rows.append((f"{apart:g} m apart", name, f"{1e3 * (reach - 1):.1f}", *cells))
    columns = (
        "antennas | views | range error of the axis (mm) | both antennas | one, in the middle | "
        "one, axis moved"
    )
    yield Table(columns, rows, NOTE.format(count=count))
