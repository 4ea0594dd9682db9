"""How well a few points explain scans: the measure by which geometry is judged.

A handful of points is what an image is made of where the geometry is right; under a wrong one each point is
seen as a ring, and the same number of points explains less. What each sector of the turn has left over is
kept apart, so that the sectors can be asked whether they agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot, sqrt

import numpy as np
from numpy.typing import NDArray

from tagid.geometry import Aperture, ImageGrid
from tagid.imaging.backprojection import upsample_at_carrier
from tagid.imaging.kernel import RangeGeometry
from tagid.imaging.types import BasebandScans
from tagid.signal import vertex

GROUPS = 12
"""Sectors of the turn, or pieces of the path: wide enough that neighbours share few sidelobes, many enough
for a standard deviation."""

BAND_PARTS = 3
"""Parts of the band that are asked for a distance of their own: the fewest with a standard deviation worth
the name, each as wide as possible, since the error of a slope grows as its width shrinks. What two halves
say is compared beside it (`BandDelays`)."""
ENOUGH_VIEWS = 90
"""Views that tell an axis or angles as well as more do."""
_PADDED = 4
"""Frequencies for every range bin, so that neighbouring phases differ by less than half a turn."""

_PIXEL_WAVELENGTHS = 1 / 12
"""Pixels of the search for points; a parabola finds the place between them."""
_MAX_PIXELS = 150
_STAGES = (0.55, 0.5, 0.45)
"""Each stage adds the local maxima above this part of the brightest: under the first sidelobe of a full turn
(J0: 0.40) they would be the sidelobes of the stronger ones."""
_PER_STAGE = 5
_SPOT_WAVELENGTHS = 0.6
"""Points nearer than this are one spot: a body that small is no second place."""
_RIDGE = 1e-3


@dataclass(frozen=True, eq=False)
class Explained:
    """What a few points leave over.

    Attributes:
        left: (groups,) energy that they leave of each sector, over the energy of all scans.
        points: (n, 2) m; amplitudes: (n,) complex.
        second: energy of the second spot over that of the first; 0 if there is one spot.
    """

    left: NDArray[np.float64]
    points: NDArray[np.float64]
    amplitudes: NDArray[np.complex128]
    second: float


@dataclass(frozen=True, eq=False)
class BandDelays:
    """How much farther than the points the echo comes from in parts of the band.

    Attributes:
        thirds: (BAND_PARTS,) m.
        apart_m: that of the upper half of the band minus that of the lower one, m.
        apart_error_m: its standard error over the sectors of the turn, m; nan for fewer than three sectors.
    """

    thirds: NDArray[np.float64]
    apart_m: float
    apart_error_m: float

    @property
    def error_m(self) -> float:
        """Standard error, m, of a distance that is found from the whole band.

        The first part is that of the mean of the thirds. The second is the standard deviation of the halves,
        the share of the noise subtracted: |a - b| / sqrt 2. A mean over the band does not reduce it, since an
        echo that is late in one half is most often late in the other, too. Thirds miss it, halves do not: the
        error of a slope decreases with the width to the power of 1.5.
        """
        mean = float(self.thirds.std(ddof=1)) / sqrt(len(self.thirds))
        beyond = float(np.maximum(self.apart_m**2 - self.apart_error_m**2, 0.0)) / 2
        return sqrt(mean**2 + beyond)


class PointSearch:
    """The search for points in a square that explain scans, under one aperture after another."""

    def __init__(self, scans: BasebandScans, grid: ImageGrid) -> None:
        pixels = int(
            np.clip(np.ceil(grid.extent / (_PIXEL_WAVELENGTHS * scans.wavelength_m)), 8, _MAX_PIXELS)
        )
        self._scans = scans
        self._square = ImageGrid(grid.extent, pixels)
        self._pixels = self._square.points
        self._data = np.asarray(scans.samples, dtype=np.complex64)
        self._energy = float(np.vdot(self._data, self._data).real)
        offsets = scans.ranges_m[None, :] - scans.ranges_m[:, None]
        self._match = scans.response(offsets).conj().T.astype(np.complex64)
        # What is correlated first is the same under every aperture.
        self._first = self._rows(self._data)

    def _rows(self, samples: NDArray[np.complex64]) -> tuple[NDArray[np.complex64], float, float]:
        """(views, fine bins) correlated with the response and upsampled, their first range and step, m."""
        return upsample_at_carrier(replace(self._scans, samples=samples @ self._match), slice(None))

    def explain(self, aperture: Aperture) -> Explained:
        """Points in the square that explain the scans best if they were taken from this aperture.

        They are found in stages: peaks of the backprojection of what is left, then least squares of all
        points together.
        """
        scans, data, square = self._scans.with_aperture(aperture), self._data, self._square
        lam, groups = scans.wavelength_m, sector_of(scans)
        if self._energy == 0:
            return Explained(np.zeros(groups.max() + 1), np.zeros((0, 2)), np.zeros(0, complex), 0.0)
        rows, start_m, step_m = self._first
        geometry = RangeGeometry.of(aperture, self._pixels, (start_m, step_m), rows.shape[1])
        points, columns = np.zeros((0, 2)), np.zeros((0, data.size), dtype=np.complex64)
        rest, amplitudes = data, np.zeros(0, dtype=np.complex128)
        for stage, floor in enumerate(_STAGES):
            rows = self._rows(rest)[0] if stage else rows
            image = np.abs(geometry.gather(rows)).reshape(square.pixels, square.pixels)
            spots = peaks(image, square, floor, lam / 4, _PER_STAGE)
            if not len(spots):
                break
            points = np.vstack([points, spots])
            columns = np.vstack([columns, echoes(scans, spots)])
            amplitudes = _least_squares(columns, data.ravel())
            rest = (data.ravel() - amplitudes.astype(np.complex64) @ columns).reshape(data.shape)
        power = (np.abs(rest) ** 2).sum(axis=1, dtype=np.float64) / self._energy
        residual = np.asarray(np.bincount(groups, power, minlength=int(groups.max()) + 1), dtype=np.float64)
        return Explained(residual, points, amplitudes, _second_spot(points, amplitudes, columns, lam))


def band_delays(scans: BasebandScans, explained: Explained) -> BandDelays:
    """How much farther than the points that were fitted to scans the echo comes from in each part of the
    band.

    The phase of sum_v M(v, f)* D(v, f), with M the points' and D the measured spectrum, is -2 pi f d for an
    echo that is farther by d, f in cycles per metre of range; its slope over a part is a weighted least
    squares fit. A reflector gives the same d everywhere. What resonates, and the waves that creep about a
    body, arrive later in one part than in another.
    """
    if not len(explained.points):
        return BandDelays(np.zeros(BAND_PARTS), 0.0, 0.0)
    frequency, sectors = _cross_spectra(scans, explained)
    cross = sectors.sum(axis=0)
    without = [_halves_apart(frequency, cross - sector) for sector in sectors]
    return BandDelays(
        _delays(frequency, cross, BAND_PARTS), _halves_apart(frequency, cross), jackknife_error(without)
    )


def _cross_spectra(
    scans: BasebandScans, explained: Explained
) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """(n,) frequencies of the band, cycles per metre of range, and (groups, n) the sum over the views of each
    sector of M* D at them."""
    seen = (explained.amplitudes.astype(np.complex64) @ echoes(scans, explained.points)).reshape(
        scans.samples.shape
    )
    bins = _PADDED * scans.samples.shape[1]
    spectra = [np.fft.fft(samples, bins, axis=1) for samples in (seen, scans.samples)]
    cross = np.fft.fftshift(spectra[0].conj() * spectra[1], axes=1)
    frequency = np.fft.fftshift(np.fft.fftfreq(bins, scans.range_step_m))
    to_hz = scans.wave_speed_m_s / 2
    middle = ((scans.center_hz or scans.carrier_hz) - scans.carrier_hz) / to_hz
    inside = np.abs(frequency - middle) <= scans.bandwidth_hz / to_hz / 2
    groups = sector_of(scans)
    sums = [cross[groups == group][:, inside].sum(axis=0) for group in range(int(groups.max()) + 1)]
    return frequency[inside], np.array(sums, dtype=np.complex128)


def _delays(frequency: NDArray[np.float64], cross: NDArray[np.complex128], parts: int) -> NDArray[np.float64]:
    """(parts,) delay, m, of parts of the band as wide as each other."""
    split = (
        np.array_split(values, parts) for values in (frequency, np.unwrap(np.angle(cross)), np.abs(cross))
    )
    return np.array([-_slope(*part) / (2 * np.pi) for part in zip(*split, strict=True)])


def _halves_apart(frequency: NDArray[np.float64], cross: NDArray[np.complex128]) -> float:
    lower, upper = _delays(frequency, cross, 2).tolist()
    return float(upper - lower)


def jackknife_error(without: Sequence[float]) -> float:
    """Standard error of an estimate from its values with each group left out; nan for fewer than three."""
    groups = len(without)
    if groups < 3:
        return float("nan")
    return float(np.sqrt((groups - 1) * np.var(without)))


def t_value(gain: NDArray[np.float64]) -> NDArray[np.float64]:
    """t of gains (..., groups) of at least two sectors: their mean over its standard error."""
    error = gain.std(axis=-1, ddof=1) / np.sqrt(gain.shape[-1])
    return np.asarray(gain.mean(axis=-1) / np.maximum(error, 1e-12))


def needed_evidence(groups: int) -> float:
    """Least t value over so many sectors that an estimate needs: 2.75 for 12, more for fewer."""
    return 2 + 9 / max(groups, 1)


def echoes(scans: BasebandScans, points: NDArray[np.float64]) -> NDArray[np.complex64]:
    """(n, views * bins) scans of unit points (n, 2), m."""
    distance = scans.aperture.distances(points).T
    response = scans.response(scans.ranges_m[None, None] - distance[..., None])
    carrier = np.exp(-2j * scans.wavenumber * distance)
    return np.asarray(response * carrier[..., None], dtype=np.complex64).reshape(len(points), -1)


def sector_of(scans: BasebandScans) -> NDArray[np.intp]:
    """(views,) number of the sector of every view: up to `GROUPS` of about as many views, at least two
    each."""
    views = scans.aperture.views
    count = int(np.clip(views // 2, 1, GROUPS))
    angles = scans.aperture.angles
    order = np.arange(views) if angles is None else np.argsort(np.mod(angles, 2 * np.pi), kind="stable")
    out = np.empty(views, dtype=np.intp)
    out[order] = np.arange(views) * count // views
    return out


def peaks(
    image: NDArray[np.floating], grid: ImageGrid, floor: float, apart_m: float, most: int
) -> NDArray[np.float64]:
    """(n, 2) local maxima, m, of at least `floor` of the highest, none within `apart_m` of a higher one."""
    top = float(image.max(initial=0.0))
    if top == 0:
        return np.zeros((0, 2))
    n = image.shape[0]
    # The largest of each pixel and its neighbours, first along the columns, then along the rows.
    beside = image.copy()
    np.maximum(beside[1:], image[:-1], out=beside[1:])
    np.maximum(beside[:-1], image[1:], out=beside[:-1])
    around = beside.copy()
    np.maximum(around[:, 1:], beside[:, :-1], out=around[:, 1:])
    np.maximum(around[:, :-1], beside[:, 1:], out=around[:, :-1])
    row, column = np.nonzero((image >= floor * top) & (image >= around))
    order = np.argsort(-image[row, column], kind="stable")
    kept: list[tuple[float, float]] = []
    for i, j in zip(row[order].tolist(), column[order].tolist(), strict=True):
        x = ((_between(image[i, :], j) + 0.5) / n - 0.5) * grid.extent
        y = ((_between(image[:, j], i) + 0.5) / n - 0.5) * grid.extent
        if all(hypot(x - a, y - b) >= apart_m for a, b in kept):
            kept.append((x, y))
        if len(kept) == most:
            break
    return np.array(kept).reshape(-1, 2)


def _between(line: NDArray[np.floating], at: int) -> float:
    """Vertex of the parabola through a maximum and its neighbours."""
    if not 0 < at < len(line) - 1:
        return float(at)
    return at + min(max(vertex(*line[at - 1 : at + 2].tolist()), -0.5), 0.5)


def _slope(x: NDArray[np.float64], y: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    """Weighted least squares; 0 where x does not vary."""
    total = float(weight.sum())
    if total == 0:
        return 0.0
    apart = x - float((weight * x).sum()) / total
    spread = float((weight * apart**2).sum())
    return float((weight * apart * y).sum()) / spread if spread > 0 else 0.0


def _least_squares(columns: NDArray[np.complex64], data: NDArray[np.complex64]) -> NDArray[np.complex128]:
    """Amplitudes with a small ridge, since points of one spot are nearly collinear."""
    normal = (columns.conj() @ columns.T).astype(np.complex128)
    normal += _RIDGE * np.diag(normal.diagonal().real)
    return np.asarray(np.linalg.solve(normal, (columns.conj() @ data).astype(np.complex128)))


def _second_spot(
    points: NDArray[np.float64],
    amplitudes: NDArray[np.complex128],
    columns: NDArray[np.complex64],
    lam: float,
) -> float:
    """Energy of the second spot over that of the first, points within `_SPOT_WAVELENGTHS` being one spot."""
    remaining = set(range(len(points)))
    strength, positions = np.abs(amplitudes).tolist(), points.tolist()
    energies = []
    while remaining:
        first = max(remaining, key=strength.__getitem__)
        x, y = positions[first]
        near = [
            i for i in remaining if hypot(positions[i][0] - x, positions[i][1] - y) < _SPOT_WAVELENGTHS * lam
        ]
        echo = amplitudes[near].astype(np.complex64) @ columns[near]
        energies.append(float(np.vdot(echo, echo).real))
        remaining -= set(near)
    energies.sort(reverse=True)
    return energies[1] / energies[0] if len(energies) > 1 and energies[0] > 0 else 0.0
