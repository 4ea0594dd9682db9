"""What the reflector network sees: the image on its own grid as five planes, the same in training and field.

Strength and phase are relative to the brightest pixel; how far that stands out of the noise, and how many
views made it, are planes of their own, because sidelobes and noise look alike without them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.types import BasebandScans, Image

GRID = ImageGrid(0.5, 96)
"""5.2 mm a pixel, a quarter of the point response's main lobe (26 mm from null to null)."""
PLANES = 5
_FULL_SNR_DB = 60.0
_FULL_VIEWS = 360
NORMALISATION = {
    "relative_to": "brightest pixel, phase included",
    "planes": ["real", "imaginary", "magnitude", "snr", "views"],
    "snr": f"dB / {_FULL_SNR_DB:g}, 0 to 1",
    "views": f"log views / log {_FULL_VIEWS}, 0 to 1",
}
"""What `NetworkInput.planes` does, as the model file describes it; another description is rejected."""


@dataclass(frozen=True, eq=False)
class NetworkInput:
    """One image as the network is given it.

    Attributes:
        relative: (96, 96) complex64, the image over its brightest pixel.
        peak: the value of that pixel, in the image's units.
        snr_db: power of that pixel over that of the noise in a backprojection of the scans, dB; 60, the
            largest distinguishable ratio, if the noise is not known.
        views: number of views it was made from.
    """

    relative: NDArray[np.complex64]
    peak: complex
    snr_db: float
    views: int

    @classmethod
    def of(cls, image: Image, scans: BasebandScans) -> NetworkInput:
        """The input for an image on `GRID` and the scans that it was made from.

        Raises UsageError if the image is on another grid.
        """
        if image.grid != GRID:
            raise UsageError(
                f"the image has {image.grid.pixels} pixels on {image.grid.extent} m",
                f"The detector reads {GRID.pixels} pixels on {GRID.extent} m.",
            )
        values = np.nan_to_num(image.values.astype(np.complex64))
        peak = complex(values.flat[int(np.argmax(np.abs(values)))])
        relative = values / np.complex64(peak) if peak else values
        views, snr_db = scans.aperture.views, _FULL_SNR_DB
        if scans.noise_std > 0 and peak:
            snr_db = float(20 * np.log10(abs(peak) * np.sqrt(views) / scans.noise_std))
        return cls(relative, peak, snr_db, views)

    def value_at(self, x_m: float, y_m: float) -> complex:
        """Relative value of the pixel nearest to a position, m; of the edge for one outside."""
        j, i = (round((v / GRID.extent + 0.5) * GRID.pixels - 0.5) for v in (x_m, y_m))
        last = GRID.pixels - 1
        return complex(self.relative[min(max(i, 0), last), min(max(j, 0), last)])

    def planes(self) -> NDArray[np.float32]:
        """(5, 96, 96): real part, imaginary part, magnitude, SNR / 60 dB, log views / log 360."""
        r = self.relative
        snr = np.clip(self.snr_db / _FULL_SNR_DB, 0, 1)
        views = np.clip(np.log(max(self.views, 1)) / np.log(_FULL_VIEWS), 0, 1)
        flat = [np.full(r.shape, value, dtype=np.float32) for value in (snr, views)]
        return np.stack([r.real, r.imag, np.abs(r), *flat]).astype(np.float32)
