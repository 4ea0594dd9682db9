"""What is left of an echo after the scene has stood in its way: the paper's transmission, two ways.

It is computed between steps from the current image, so that the step itself stays linear in the scene.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import ImageGrid
from tagid.imaging.bilinear import bilinear

CLEAR_CELLS = 2.0
"""So many cells before a point nothing hides it: it is itself spread over them."""


def transmission(
    power: NDArray[np.floating],
    grid: ImageGrid,
    positions: NDArray[np.float64],
    nepers: float,
    cell_m: float,
) -> NDArray[np.float32]:
    """exp(-integral of nepers |sigma|^2 / max |sigma|^2 over the way in cells) for every view and pixel.

    The power, not the amplitude: a scattered wave takes its power from the one that passes, and sidelobes and
    noise all over the image must not dim it. The integral runs along the straight line from the antenna's
    foot to `CLEAR_CELLS` before the pixel, on a polar grid about the antenna whose step is a pixel.

    Args:
        power: (pixels, pixels) |sigma|^2, index (y, x).
        grid: its grid.
        positions: (views, 3) antenna positions, m.
        nepers: attenuation of the amplitude, two ways, by one cell as bright as the brightest.
        cell_m: length of a cell.

    Returns:
        (views, pixels^2) float32 in 0..1, row-major pixels.
    """
    top = float(power.max(initial=0))
    out = np.ones((len(positions), grid.pixels**2), dtype=np.float32)
    if top == 0 or nepers == 0:
        return out
    density = (power * (nepers / top * grid.step / cell_m)).astype(np.float32)
    clear = max(CLEAR_CELLS * cell_m, 2 * grid.step)
    reach = grid.extent / np.sqrt(2)
    for row, (x, y, _) in zip(out, positions, strict=True):
        distance, bearing = np.hypot(x, y), np.arctan2(-y, -x)
        near = max(distance - reach, grid.step)
        ranges = np.arange(near, distance + reach + grid.step, grid.step)
        half = float(np.arcsin(min(1.0, reach / distance))) if distance > reach else np.pi
        angles = np.linspace(-half, half, max(3, int(np.ceil(2 * half * (distance + reach) / grid.step))))
        px = x + ranges * np.cos(bearing + angles[:, None])
        py = y + ranges * np.sin(bearing + angles[:, None])
        at = [(v / grid.extent + 0.5) * grid.pixels - 0.5 for v in (py, px)]
        crossed = np.cumsum(bilinear(density, *at), axis=1)
        dx, dy = grid.points[:, 0] - x, grid.points[:, 1] - y
        turned = (np.arctan2(dy, dx) - bearing + np.pi) % (2 * np.pi) - np.pi
        place = (np.hypot(dx, dy) - clear - near) / grid.step
        line = (turned + half) / (2 * half) * (len(angles) - 1)
        row[:] = np.exp(-bilinear(crossed, line, place, held=True) * (place > -1))
    return out


_NEAREST = 0.05
"""Points nearer than this part of the middle distance get no more light: 5 cm at 1 m."""


def illumination(
    points: NDArray[np.float64], positions: NDArray[np.float64], spreading: float, beam_width_rad: float
) -> NDArray[np.float32]:
    """(R0 / R)^spreading 2^-(2 theta / width)^2 for every view and point, 1 at the origin.

    Args:
        points: (points, 2) m, in the plane z = 0.
        positions: (views, 3) antenna positions, m; the beam looks at the origin.
        spreading: exponent of the amplitude: 2 for a point reflector (radar equation), 0 for none.
        beam_width_rad: full -3 dB width of the one-way power pattern, whose value is the two-way amplitude,
            rad; 0 for all round.

    Returns:
        (views, points) float32.
    """
    there = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    out = np.empty((len(positions), len(points)), dtype=np.float32)
    for row, antenna in zip(out, positions, strict=True):
        line = there - antenna
        middle = max(float(np.linalg.norm(antenna)), 1e-9)
        distance = np.maximum(np.linalg.norm(line, axis=1), _NEAREST * middle)
        row[:] = (middle / distance) ** spreading
        if beam_width_rad > 0:
            cosine = np.clip(-(line @ antenna) / (distance * middle), -1, 1)
            row *= 2.0 ** -((2 * np.arccos(cosine) / beam_width_rad) ** 2)
    return out
