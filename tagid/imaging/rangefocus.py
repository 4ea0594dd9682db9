"""The path delay of scans taken from free antenna positions, found from the sharpness of the image.

A radar on a rail measures every range with the same unknown delay of cables and electronics; a metre of it
defocuses the image and moves all that is in it. The curvature of the echoes over the path tells it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.imaging.backprojection import upsample_at_carrier
from tagid.imaging.preprocess import select_views
from tagid.imaging.types import BasebandScans

Floats = NDArray[np.float64]

MAX_SEARCH_M = 2.0
MIN_CONTRAST = 1.6
"""Focus measure over the median of the search below which nothing is told about the delay. With noise alone,
and with a path too short or too far to see curvature, it stays under 1.3. Two reflectors on a straight rail
of 3.4 m have 9 and more, on one that bends by a few centimetres 2 and more: there the mirror image of each,
on the other side of the path, comes into focus at another delay."""

_VIEWS = 200
_POINTS = 6
_POINT_FLOOR = 0.2
"""Echoes weaker than this part of the strongest are left out of the search."""
_COARSE_M, _FINE_M = 0.02, 0.004
"""Steps in range of the places that an echo may have, for the search and at its end. A delay can in part be
taken for a change of range, so that places too far apart would draw the delay to them."""
_MIRROR_FLOOR = 0.9
"""An echo weaker than this part of the one at its mirror place is its image, not another reflector."""


@dataclass(frozen=True)
class EchoPoint:
    """A strong echo: where it lies once the delay is known, and how strong it is.

    Attributes:
        x_m, y_m: place in the plane z = 0, m.
        amplitude: of the image there.
    """

    x_m: float
    y_m: float
    amplitude: float


@dataclass(frozen=True)
class DelayFocus:
    """What the search for the path delay found.

    Attributes:
        delay_m: one-way metres that the scans' ranges were too long by, and that were taken off.
        contrast: focus measure at the best delay over its median in the search.
        reliable: the best lies inside the search and stands out; only then is it taken.
        points: the strong echoes, strongest first, at the delay taken.
    """

    delay_m: float
    contrast: float
    reliable: bool
    points: tuple[EchoPoint, ...] = ()


def focus_delay(
    scans: BasebandScans, search_m: float = 1.0, towards: tuple[float, float] = (0.0, 0.0)
) -> tuple[BasebandScans, DelayFocus]:
    """The same scans with the path delay taken off their ranges.

    A short piece of the path about its middle tells range and bearing of the strongest echoes whatever the
    delay is. Moved along its bearing by a trial delay, each echo is focused with the whole path; the measure
    is the sum over echoes of the largest |f|^2 near it, f = 1/V sum_v z_v(d_v + delay) exp(2jk d_v). It is
    searched in steps that the path's angles ask for, then twice in finer ones with a parabola at the end.

    Args:
        scans: baseband scans of free antenna positions that hold the object at every delay of the search.
        search_m: half width of the search, one-way m, at most 2.
        towards: a point (x, y) on the side of a straight path that matters, m; the other side mirrors it.

    Returns:
        The scans, their ranges corrected where the result is reliable, and what was found.

    Raises:
        UsageError: search_m is not between 0 and 2 m.
    """
    if not 0 < search_m <= MAX_SEARCH_M:
        raise UsageError(f"the delay search is +-{search_m} m", f"Give up to {MAX_SEARCH_M:g} m.")
    stride = max(1, scans.aperture.views // _VIEWS)
    few = select_views(scans, slice(None, None, stride))
    reference, echoes = _strong_echoes(scans, towards)
    if not len(echoes):
        return scans, DelayFocus(0.0, 1.0, False)
    step = _delay_step(few, reference, echoes)
    delays = np.linspace(-search_m, search_m, 2 * int(np.ceil(search_m / step)) + 1)
    measure, _ = _measure(few, reference, echoes, delays)
    best = int(np.argmax(measure))
    contrast = float(measure[best] / max(float(np.median(measure)), 1e-30))
    if not 0 < best < len(delays) - 1 or contrast < MIN_CONTRAST:
        _, points = _measure(few, reference, echoes, np.zeros(1))
        return scans, DelayFocus(0.0, contrast, False, _strongest_first(points))
    delay, width = float(delays[best]), float(delays[1] - delays[0])
    for around in (width, width / 3):
        near = delay + around * np.linspace(-1, 1, 13)
        power, _ = _measure(few, reference, echoes, near, _FINE_M)
        delay = _vertex(near, power)
        _, points = _measure(few, reference, echoes, np.array([delay]), _FINE_M)
        real = _real(points, few.aperture.positions, echoes)
        points, echoes = tuple(points[i] for i in real), echoes[real]
    corrected = replace(scans, range_start_m=scans.range_start_m - delay)
    return corrected, DelayFocus(delay, contrast, True, _strongest_first(points))


def _strongest_first(points: tuple[EchoPoint, ...]) -> tuple[EchoPoint, ...]:
    return tuple(sorted(points, key=lambda p: -p.amplitude))


def is_straight(positions: Floats) -> bool:
    """True where the antenna positions (views, 3) lie above one line to within 2 mm rms across it.

    Heights do not count: from a path in one upright plane both sides of it look the same.
    """
    centred = positions[:, :2] - positions[:, :2].mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(positions))
    return bool(len(positions) > 2 and spread[0] > 0 and spread[1] < 2e-3)


def _strong_echoes(scans: BasebandScans, towards: tuple[float, float]) -> tuple[Floats, Floats]:
    """Middle of the piece (3,), and the strongest echoes (n, 3) as labelled range, bearing and |f|.

    The piece is so short, sqrt(lambda R) of path, that curvature does not tell there.
    """
    positions = scans.aperture.positions
    middle = len(positions) // 2
    reach = float(np.median(scans.ranges_m))
    limit = np.sqrt(np.pi / scans.wavenumber * 2 * max(reach, 0.1)) / 2
    piece = np.flatnonzero(np.linalg.norm(positions - positions[middle], axis=1) <= limit)
    centre = positions[piece].mean(axis=0)
    length = max(float(np.ptp(positions[piece], axis=0).max()), 1e-3)
    bearings = np.arange(0, 2 * np.pi, np.clip(np.pi / scans.wavenumber / (4 * length), 0.01, 0.1))
    if is_straight(positions):
        across = np.array(towards) - centre[:2]
        along = positions[-1, :2] - positions[0, :2]
        normal = across - along * (across @ along) / float(along @ along)
        if np.linalg.norm(normal) < 1e-3:
            normal = np.array([-along[1], along[0]]) * np.sign(along[0] or 1.0)
        facing = np.cos(bearings) * normal[0] + np.sin(bearings) * normal[1]
        bearings = bearings[facing > 0.1 * np.linalg.norm(normal)]
    fine, start, step = upsample_at_carrier(scans, piece)
    ranges = np.arange(max(scans.ranges_m[0], 0.2), scans.ranges_m[-1], scans.range_step_m / 2)
    x = centre[0] + np.outer(ranges, np.cos(bearings))
    y = centre[1] + np.outer(ranges, np.sin(bearings))
    image = np.zeros(x.shape, dtype=np.complex64)
    for row, antenna in zip(fine, positions[piece], strict=True):
        distance = np.sqrt((x - antenna[0]) ** 2 + (y - antenna[1]) ** 2 + antenna[2] ** 2)
        image += row[np.clip(np.rint((distance - start) / step), 0, len(row) - 1).astype(np.intp)]
    magnitude = np.abs(image) / len(piece)
    return centre, _peaks(magnitude, ranges, bearings)


def _peaks(magnitude: NDArray[np.floating], ranges: Floats, bearings: Floats) -> Floats:
    """The strongest cells (n, 3) of (range, bearing), none within 15 cm and 0.15 rad of a stronger one."""
    left = magnitude.astype(np.float64)
    top = float(left.max(initial=0.0))
    found: list[tuple[float, float, float]] = []
    while len(found) < _POINTS:
        i, j = np.unravel_index(int(np.argmax(left)), left.shape)
        if left[i, j] <= _POINT_FLOOR * top or top == 0:
            break
        found.append((float(ranges[i]), float(bearings[j]), float(left[i, j])))
        turn = np.abs((bearings - bearings[j] + np.pi) % (2 * np.pi) - np.pi)
        left[np.ix_(np.abs(ranges - ranges[i]) < 0.15, turn < 0.15)] = 0
    return np.array(found, dtype=np.float64).reshape(-1, 3)


def _delay_step(scans: BasebandScans, reference: Floats, echoes: Floats) -> float:
    """Step in delay that turns no view's phase by more than a quarter turn against the middle of the path."""
    place = reference[:2] + echoes[:1, 0, None] * np.stack([np.cos(echoes[:1, 1]), np.sin(echoes[:1, 1])], 1)
    sight = np.append(place[0], 0.0) - scans.aperture.positions
    sight /= np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-9)
    ahead = np.append(place[0], 0.0) - reference
    spread = float((1 - sight @ (ahead / np.linalg.norm(ahead))).max())
    return float(np.clip(np.pi / 4 / (scans.wavenumber * max(spread, 1e-6)), 0.004, 0.03))


def _measure(
    scans: BasebandScans, reference: Floats, echoes: Floats, delays: Floats, step_m: float = _COARSE_M
) -> tuple[Floats, tuple[EchoPoint, ...]]:
    """Focus measure (delays,), and the focused echoes at the last delay.

    Places of an echo are tried `step_m` apart along its bearing.
    """
    spread = np.ptp(scans.aperture.positions, axis=0).max()
    # As fine as the whole path resolves, as wide as the short piece leaves open.
    d_bearing = np.clip(np.pi / scans.wavenumber / (4 * max(spread, 0.05)), 2e-3, 0.05)
    d_bearing *= min(1.0, 2 * step_m / _COARSE_M)
    bearing = np.arange(-0.05, 0.05 + d_bearing / 2, d_bearing)
    along = np.arange(-0.06, 0.06 + step_m / 2, step_m)
    fine, start, step = upsample_at_carrier(scans, slice(None))
    radius = echoes[None, :, None, None, 0] - delays[:, None, None, None] + along[None, None, :, None]
    angle = echoes[None, :, None, None, 1] + bearing[None, None, None, :]
    radius = np.maximum(radius, 0.05)
    x = reference[0] + radius * np.cos(angle)
    y = reference[1] + radius * np.sin(angle)
    image = np.zeros(x.shape, dtype=np.complex64)
    carrier = np.exp(-2j * scans.wavenumber * delays).astype(np.complex64)[:, None, None, None]
    for row, antenna in zip(fine, scans.aperture.positions, strict=True):
        distance = np.sqrt((x - antenna[0]) ** 2 + (y - antenna[1]) ** 2 + antenna[2] ** 2)
        label = (distance + delays[:, None, None, None] - start) / step
        image += row[np.clip(np.rint(label), 0, len(row) - 1).astype(np.intp)]
    power = np.abs(image * carrier / len(fine)) ** 2
    flat = power.reshape(len(delays), len(echoes), -1)
    strongest = flat.argmax(axis=2)[-1]
    points = tuple(
        EchoPoint(float(x[-1, i].ravel()[at]), float(y[-1, i].ravel()[at]), float(np.sqrt(flat[-1, i, at])))
        for i, at in enumerate(strongest)
    )
    best = flat.max(axis=2)
    for i, j in _mirrors(scans.aperture.positions, echoes):
        # One of the two is the other's image, and comes into focus at another delay: count what is brighter.
        best[:, i], best[:, j] = np.maximum(best[:, i], best[:, j]), 0
    return best.sum(axis=1), points


def _real(points: tuple[EchoPoint, ...], positions: Floats, echoes: Floats) -> list[int]:
    """Which of the focused echoes are no mirror image of a stronger one."""
    kept = set(range(len(points)))
    for i, j in _mirrors(positions, echoes):
        strong, weak = (i, j) if points[i].amplitude >= points[j].amplitude else (j, i)
        if points[weak].amplitude < _MIRROR_FLOOR * points[strong].amplitude:
            kept.discard(weak)
    return sorted(kept)


def _mirrors(positions: Floats, echoes: Floats) -> list[tuple[int, int]]:
    """Pairs of echoes of one range whose bearings mirror each other about the path near its middle."""
    middle = len(positions) // 2
    near = positions[max(0, middle - len(positions) // 10) : middle + len(positions) // 10 + 1, :2]
    along = near[-1] - near[0]
    path = np.arctan2(along[1], along[0])
    pairs = []
    for i in range(len(echoes)):
        for j in range(i + 1, len(echoes)):
            off = (echoes[i, 1] + echoes[j, 1] - 2 * path + np.pi) % (2 * np.pi) - np.pi
            if abs(off) < 0.2 and abs(echoes[i, 0] - echoes[j, 0]) < 0.15:
                pairs.append((i, j))
    return pairs


def _vertex(at: Floats, values: Floats) -> float:
    """Vertex of the parabola through the best value and three neighbours a side (least squares)."""
    middle = int(np.clip(np.argmax(values), 3, len(at) - 4))
    part = slice(middle - 3, middle + 4)
    bend, slope, _ = np.polyfit(at[part] - at[middle], values[part], 2)
    if bend >= 0:
        return float(at[int(np.argmax(values))])
    return float(np.clip(at[middle] - slope / (2 * bend), at[part][0], at[part][-1]))
