"""A volume as pictures: maximum projections along each axis, and a rotating animation."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tagid.errors import DataError
from tagid.files import write_bytes
from tagid.imaging.bilinear import bilinear
from tagid.report.axes import Axes, colour_bar
from tagid.report.canvas import Canvas
from tagid.report.colours import colourise, to_decibels
from tagid.report.picture import fit_text

_SIDE, _GAP, _LEFT, _TOP = 380, 120, 110, 100
_FRAMES, _FRAME_MS, _FRAME_SIDE = 48, 80, 320


def draw_projections(
    values: NDArray[np.inexact],
    axis_m: NDArray[np.floating],
    heights_m: NDArray[np.floating],
    path: Path,
    title: str = "",
    dynamic_range_db: float = 25.0,
    centre_m: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Write a PNG of the maximum projections from above, from the front and from the side.

    Args:
        values: (z, y, x) reflectivity.
        axis_m: (pixels,) centres along x and y, m.
        heights_m: (levels,) centres along z, m.
        path: the PNG; written atomically.
        title: one line above.
        dynamic_range_db: voxels further below the brightest one have the darkest colour.
        centre_m: (x, y) that the axis is about, m.

    Raises:
        DataError: not a finite volume. StorageError, DiskFullError.
    """
    magnitude = _magnitude(values)
    (along_x, along_y), up = (_limits(axis_m + middle) for middle in centre_m), _limits(heights_m)
    views = (
        (magnitude.max(axis=0), along_x, along_y, "x (m)", "y (m)", "from above"),
        (magnitude.max(axis=1), along_x, up, "x (m)", "z (m)", "along y"),
        (magnitude.max(axis=2), along_y, up, "y (m)", "z (m)", "along x"),
    )
    top = float(magnitude.max())
    canvas = Canvas(_LEFT + 3 * (_SIDE + _GAP) + 40, _TOP + _SIDE + 100)
    for number, (plane, x, y, x_label, y_label, name) in enumerate(views):
        left = _LEFT + number * (_SIDE + _GAP)
        scale = _SIDE / max(x[1] - x[0], y[1] - y[0])
        box = (left, _TOP, left + (x[1] - x[0]) * scale, _TOP + (y[1] - y[0]) * scale)
        axes = Axes(canvas, box, x, y)
        decibels = to_decibels(plane, dynamic_range_db, top)
        canvas.raster(box, colourise(decibels[::-1], dynamic_range_db), smooth=True)
        axes.frame(x_label, y_label, name)
    right = _LEFT + 3 * (_SIDE + _GAP) - _GAP + 20
    colour_bar(canvas, (right, _TOP, right + 26, _TOP + _SIDE), dynamic_range_db)
    canvas.text((_LEFT, 30), fit_text(canvas, title, 1400, 28), 28)
    canvas.save(Path(path))


def write_turning(
    values: NDArray[np.inexact],
    axis_m: NDArray[np.floating],
    heights_m: NDArray[np.floating],
    path: Path,
    dynamic_range_db: float = 25.0,
) -> None:
    """Write a WebP of one rotation about z, with the maximum projection along the line of sight per frame.

    Args and errors as `draw_projections`.
    """
    magnitude = _magnitude(values).astype(np.float32)
    shrink = min(1.0, 96 / magnitude.shape[2])
    sides = [round(side * shrink) for side in magnitude.shape[1:]]
    lines = [np.linspace(0, side - 1, count) for side, count in zip(magnitude.shape[1:], sides, strict=True)]
    rows, columns = np.meshgrid(*lines, indexing="ij")
    small = bilinear(magnitude, rows, columns) if shrink < 1 else magnitude
    y, x = (index - (side - 1) / 2 for index, side in zip(np.indices(sides), sides, strict=True))
    top = float(small.max())
    across, up = _limits(axis_m), _limits(heights_m)
    size = (_FRAME_SIDE, max(1, round(_FRAME_SIDE * (up[1] - up[0]) / (across[1] - across[0]))))
    frames = []
    for angle in np.arange(_FRAMES) * 360 / _FRAMES:
        cos, sin = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
        turned = bilinear(
            small, cos * y + sin * x + (sides[0] - 1) / 2, cos * x - sin * y + (sides[1] - 1) / 2
        )
        plane = np.maximum(turned.max(axis=1), 0)
        decibels = to_decibels(plane, dynamic_range_db, top)
        picture = Image.fromarray(colourise(decibels[::-1], dynamic_range_db))
        frames.append(picture.resize(size, Image.Resampling.BILINEAR))
    buffer = io.BytesIO()
    frames[0].save(
        buffer, "WEBP", save_all=True, append_images=frames[1:], duration=_FRAME_MS, loop=0, quality=80
    )
    write_bytes(path, buffer.getvalue())


def _magnitude(values: NDArray[np.inexact]) -> NDArray[np.float64]:
    if values.ndim != 3 or values.size == 0 or not np.isfinite(values).all():
        raise DataError(f"the volume has shape {values.shape}, expected (z, y, x), finite")
    return np.asarray(np.abs(values), dtype=np.float64)


def _limits(centres: NDArray[np.floating]) -> tuple[float, float]:
    half = float(centres[1] - centres[0]) / 2 if len(centres) > 1 else 0.005
    return float(centres[0]) - half, float(centres[-1]) + half
