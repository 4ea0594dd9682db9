"""Image files: the output of `tagid reconstruct --out` for other programs.

One NPZ with the complex image, its axes and every setting, so that other programs can check the figures.
"""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tagid.files import write_bytes


class Grid(Protocol):
    """The part of a grid that is needed: its axis, m."""

    @property
    def axis(self) -> NDArray[np.float64]:
        """(pixels,) pixel centres, m."""
        ...


class GriddedImage(Protocol):
    """The part of an image that is needed; `tagid.imaging.types.Image` is one."""

    @property
    def values(self) -> NDArray[np.complex64]:
        """(y, x) reflectivity."""
        ...

    @property
    def grid(self) -> Grid:
        """The grid of the pixels."""
        ...

    @property
    def settings(self) -> dict[str, Any]:
        """Method and parameters."""
        ...

    @property
    def centre_m(self) -> tuple[float, float]:
        """(x, y) of the grid centre, m."""
        ...


def write_image(path: Path, image: GriddedImage) -> None:
    """Write `image` complex64 (y, x), `x_m`, `y_m` and `settings` (JSON), atomically.

    Raises StorageError, DiskFullError.
    """
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        image=image.values.astype(np.complex64),
        x_m=image.grid.axis + image.centre_m[0],
        y_m=image.grid.axis + image.centre_m[1],
        settings=np.array(json.dumps(image.settings, default=str)),
    )
    write_bytes(path, buffer.getvalue())


def is_image(path: Path) -> bool:
    """Whether an NPZ file contains an image or a volume of `tagid reconstruct --out`, and no scans."""
    try:
        with zipfile.ZipFile(path) as file:
            names = set(file.namelist())
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return False
    return not names.isdisjoint(("image.npy", "volume.npy")) and "samples.npy" not in names
