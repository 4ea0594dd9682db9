"""Solve the octahedron once for all sizes: `python -m train.octahedron` writes tagid/report/octahedron.json.

The cross-section over the square of the size depends on the size in wavelengths alone, so that one size is
solved over the frequencies that stand for all others.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tagid.constants import SPEED_OF_LIGHT
from tagid.report.reflector_sheet import SIZES_M, TABLE
from tagid.simulate.response import Ring
from train.fullwave import Sweep, shapes, solve_response

SIZE_M, DISTANCE_M = 0.04, 4.0
"""What is solved, far enough for all sizes."""
PIECES = 8
"""Mesh elements per edge: a seventh of the shortest wavelength."""
ASPECTS = 24
BAND_HZ = (3.1e9, 4.9e9)
STEPS = 60


def solved() -> dict[str, object]:
    """The table that `tagid.report.reflector_sheet.cross_section` reads."""
    low, high = (size * f / SIZE_M for size, f in zip(SIZES_M, BAND_HZ, strict=True))
    sweep = Sweep(low, high, STEPS, ASPECTS, (Ring(DISTANCE_M, "V"), Ring(DISTANCE_M, "H")))
    response = solve_response("octahedron", shapes.closed_octahedron(SIZE_M, PIECES), sweep)
    length = np.abs(response.scattering_length_m[:, :, : ASPECTS // 4 + 1]) / SIZE_M
    return {
        "source": "method of moments, electric-field integral equation (train.fullwave)",
        "wavelengths": np.round(sweep.frequency_hz * SIZE_M / SPEED_OF_LIGHT, 5).tolist(),
        "aspect_deg": (np.arange(length.shape[2]) * 360.0 / ASPECTS).tolist(),
        "vertical_db": np.round(20 * np.log10(length[:, 0]), 3).tolist(),
        "horizontal_db": np.round(20 * np.log10(length[:, 1]), 3).tolist(),
    }


if __name__ == "__main__":
    Path(str(TABLE)).write_text(json.dumps(solved(), separators=(",", ":")) + "\n")
