"""The classical reflector finder: it takes the strongest point and subtracts its response before the next.

The point response of a full turn is J0(2kr), whose first sidelobe is only 7.9 dB down, so local maxima would
include rings. Subtracting templates (CLEAN, Hogbom 1974, with a joint fit after every step) leaves only
reflectors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.enrolling.field import MatchedField, read
from tagid.imaging.types import BasebandScans
from tagid.reading.reading import Reflector
from tagid.reading.views import fold_views
from tagid.signal import median
from tagid.tags.layouts.layout import MIN_SPACING_M

STEP_M = 5e-3
"""Pixel of the search image."""
MOST_REFLECTORS = 8
FLOOR_DB = -12.0
"""Reflectors below this level, relative to the strongest, are not reported."""
DETECTION_NATS = 18.0
"""Smallest |a|^2 ||s||^2 over the noise level of a detected peak: the largest of about 1000 independent cells
of exponential noise exceeds it with a probability of 1000 exp(-18) = 1.5e-5."""
NOISE_MARGIN = 2.0
"""Largest factor by which the residual's level may exceed the stated noise, which is estimated away from the
object, and still count as noise. Anything above is unexplained echoes, which must not raise the detection
threshold."""
_FIRST_STEP_M, _ROUNDS, _REACH_M = 2e-3, 6, 12e-3
"""First step of the refinement of positions, its rounds, and the farthest from the start, per coordinate."""
_BLOCK = 1 << 18


class SearchDisc:
    """|b|^2 on the pixels of a disc about the axis, at `points` (n, 2), m, also after some points have been
    subtracted.

    Pixels are kept as the range profile and the phase in every view: an eighth of their templates' memory.
    """

    def __init__(self, field: MatchedField, radius_m: float) -> None:
        half = int(np.ceil(radius_m / STEP_M))
        axis = np.arange(-half, half + 1) * STEP_M
        x, y = np.meshgrid(axis, axis)
        inside = x**2 + y**2 <= radius_m**2
        self.points = np.stack([x[inside], y[inside]], axis=-1)
        self._field = field
        self._index = np.empty((len(self.points), field.views), dtype=np.int32)
        self._turn = np.empty(self._index.shape, dtype=np.complex64)
        for here in self._parts():
            distances = field.distances(self.points[here])
            self._index[here] = field.ranges.index(distances)
            self._turn[here] = field.ranges.phase(distances)

    def _parts(self) -> list[slice]:
        size = max(1, _BLOCK // self._field.views)
        return [slice(at, at + size) for at in range(0, len(self.points), size)]

    def residual(
        self, positions: NDArray[np.float64], amplitudes: NDArray[np.complex128]
    ) -> NDArray[np.float64]:
        """(n,) |b|^2 of the data minus that of points (K, 2) with complex amplitudes (K,)."""
        # Nothing in it is constant over the views: the pixels' constant parts need not be subtracted.
        data = self._field.data - amplitudes.astype(np.complex64) @ self._field.templates(positions)
        table = self._field.table(data)
        b = np.concatenate(
            [np.vecdot(self._turn[here], read(table, self._index[here])) for here in self._parts()]
        )
        return np.asarray(np.abs(b.astype(np.complex128)) ** 2)


def find_reflectors(scans: BasebandScans, radius_m: float = 0.16) -> tuple[Reflector, ...]:
    """Reflectors in focused scans within a radius of the axis, m, found without knowledge of any layout,
    strongest first. Raises DataError if the scans do not cover the object's range.
    """
    reach = radius_m + 0.02
    field = MatchedField(fold_views(scans, reach), reach)
    disc = SearchDisc(field, radius_m)
    positions, amplitudes = np.zeros((0, 2)), np.zeros(0, dtype=np.complex128)
    floor = 10 ** (FLOOR_DB / 10)
    for _ in range(MOST_REFLECTORS + 1):
        residual = disc.residual(positions, amplitudes)
        level = _level(field, residual)
        peak = int(np.argmax(residual))
        stated = NOISE_MARGIN * field.noise_variance
        noise = min(level, stated) if stated > 0 else level
        strongest = float(np.max(np.abs(amplitudes) ** 2, initial=0.0)) * field.template_energy
        least = max(DETECTION_NATS * noise, floor * strongest)
        if len(positions) == MOST_REFLECTORS or residual[peak] / field.template_energy < least:
            break
        added = np.concatenate([positions, disc.points[peak][None]])
        positions, amplitudes = refine_positions(field, added)
    apart = _separate(positions, amplitudes)
    power = np.maximum(np.abs(amplitudes[apart]) ** 2, 1e-30)
    return tuple(
        Reflector(
            float(x),
            float(y),
            complex(amplitude),
            float(10 * np.log10(peak_power / power[0])),
            float(10 * np.log10(peak_power * field.template_energy / level)),
        )
        for (x, y), amplitude, peak_power in zip(positions[apart], amplitudes[apart], power, strict=True)
        if peak_power >= power[0] * floor
    )


def _level(field: MatchedField, residual: NDArray[np.float64]) -> float:
    """Level of noise and clutter in |b|^2 / ||s||^2; an exponential's median is ln 2 times its mean."""
    level = float(median(residual)) / float(np.log(2)) / field.template_energy
    return float(max(level, field.noise_variance, 1e-12 * field.energy))


def _separate(positions: NDArray[np.float64], amplitudes: NDArray[np.complex128]) -> NDArray[np.intp]:
    """Indices of the points that no stronger one is within MIN_SPACING_M of, strongest first.

    The residual that a reflector's aspect pattern leaves resembles a second point a few millimetres away.
    """
    kept: list[int] = []
    for i in np.argsort(-np.abs(amplitudes)):
        gap = np.linalg.norm(positions[kept] - positions[i], axis=1)
        if not kept or gap.min() >= MIN_SPACING_M:
            kept.append(int(i))
    return np.array(kept, dtype=np.intp)


def refine_positions(
    field: MatchedField, positions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Free least-squares positions (K, 2), m, near the start, and amplitudes (K,).

    Takes a parabolic step in all coordinates jointly if that improves the fit, else in the single best
    coordinate. Positions stay within +- 12 mm of the start.
    """
    k = len(positions)
    start, trial_positions, step = positions, positions.copy(), _FIRST_STEP_M
    unit = np.eye(2 * k).reshape(2 * k, k, 2)
    alone = np.arange(k)[None]
    # A trial moves one point along one axis: the templates of the others are those of the start.
    count = np.arange(4 * k)
    owner = np.tile(np.repeat(np.arange(k), 2), 2)
    which = np.tile(np.arange(k), (len(count) + 1, 1))
    which[1 + count, owner] = k + count

    for _ in range(_ROUNDS):
        trial = trial_positions + np.concatenate([np.zeros((1, k, 2)), unit * step, -unit * step])
        trial = np.clip(trial, start - _REACH_M, start + _REACH_M)
        moved = trial[1 + count, owner]
        value = _least_squares(field, np.concatenate([trial[0], moved]), which)[1]
        plus, minus = value[1 : 2 * k + 1], value[2 * k + 1 :]
        bend = 2 * value[0] - plus - minus
        slope = (plus - minus) / 2
        jump = np.where(bend > 0, slope / np.where(bend > 0, bend, 1), np.sign(slope))
        joint = trial_positions + np.clip(jump, -2, 2).reshape(k, 2) * step
        joint = np.clip(joint, start - _REACH_M, start + _REACH_M)
        best = int(np.argmax(value))
        trial_positions = joint if _least_squares(field, joint, alone)[1][0] >= value[best] else trial[best]
        step *= 0.7
    return trial_positions, _least_squares(field, trial_positions, alone)[0][0]


def _least_squares(
    field: MatchedField, points: NDArray[np.float64], sets: NDArray[np.intp]
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Amplitudes (H, K) = G^-1 b and explained energy (H,) = b^H G^-1 b of sets (H, K) of points (N, 2), m.

    G is loaded by 1e-2 of itself.
    """
    templates = field.templates(points)
    b = field.correlate(templates)[sets]
    gram = field.gram(templates)[sets[:, :, None], sets[:, None]]
    k = sets.shape[1]
    size = np.maximum(np.abs(np.trace(gram, axis1=-2, axis2=-1)) / k, 1e-30)  # one that nobody sees is 0
    load = 1e-2 * size[..., None, None] * np.eye(k)
    amplitudes = np.asarray(np.linalg.solve(gram + load, b[..., None])[..., 0], dtype=np.complex128)
    explained = np.real(np.sum(b.conj() * amplitudes, axis=-1))
    return amplitudes, np.maximum(np.asarray(explained, dtype=np.float64), 0.0)
