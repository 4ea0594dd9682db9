"""The classical reflector finder: it takes the strongest point and subtracts its response before the next.

The point response of a full turn is J0(2kr), whose first sidelobe is only 7.9 dB down, so local maxima would
include rings. Subtracting templates (CLEAN, Hogbom 1974, with a joint fit after every step) leaves only
reflectors.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.imaging.types import BasebandScans
from tagid.signal import median
from tagid.tags.layouts.layout import MIN_SPACING_M
from tagid.tags.reading.aspect import NO_SIDE_M, TRANSPARENT, Appearance, outward
from tagid.tags.reading.compiled import MOST_POINTS, Explained, PointSteps
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.squares import explained_by
from tagid.tags.reading.views import fold_views

DETECTION_NATS = 18.0
"""Smallest |a|^2 ||s||^2 over the noise level of a detected peak: the largest of about 1000 independent cells
of exponential noise exceeds it with a probability of 1000 exp(-18) = 1.5e-5."""

_FIRST_STEP_M, _ROUNDS = 2e-3, 6
"""First step of the refinement of free positions, and its rounds."""

NOISE_MARGIN = 2.0
"""Largest factor by which the residual's level may exceed the stated noise, which is estimated away from the
object, and still count as noise. Anything above is unexplained echoes, which must not raise the detection
threshold."""


@dataclass(frozen=True)
class Reflector:
    """A point found in the scans.

    Attributes:
        x_m, y_m: position in the object's plane, m.
        amplitude: complex, in units of the scans.
        amplitude_db: relative to the strongest reflector found, dB.
        snr_db: energy over the level of noise and clutter, dB.
        matched: whether it belongs to the layout that was read.
        z_m: height above the object's plane, m; None where one antenna height does not show it.
    """

    x_m: float
    y_m: float
    amplitude: complex
    amplitude_db: float
    snr_db: float
    matched: bool = False
    z_m: float | None = None


@dataclass(frozen=True)
class FinderSettings:
    """Extent and sensitivity of the finder.

    Attributes:
        radius_m: radius of the disc around the axis that is searched, m.
        step_m: pixel of the search image, m.
        maximum: largest number of reflectors.
        floor_db: reflectors below this level, relative to the strongest, are not reported, dB.
        detection_nats: smallest energy of a peak over the noise level.
    """

    radius_m: float = 0.16
    step_m: float = 5e-3
    maximum: int = 8
    floor_db: float = -12.0
    detection_nats: float = DETECTION_NATS


@dataclass(eq=False)
class Cleaned:
    """Points after one was added.

    Attributes:
        positions: (K, 2 or 3) m.
        amplitudes: (K,).
        energy: that they explain.
        left: (pixels,) |b|^2 of what they leave; None until `SearchDisc.left_by` is asked for it.
    """

    positions: NDArray[np.float64]
    amplitudes: NDArray[np.complex128]
    energy: float
    left: NDArray[np.float64] | None = None


class SearchDisc:
    """|b|^2 on the pixels of a disc, also after some points have been subtracted.

    Args:
        field: matched field of the scans.
        radius_m, step_m: radius and pixel of the disc, m.
        look: how a point looks.
        heights_m: (levels,) heights of the discs where the antenna stood at several; None: the plane z = 0.

    Attributes:
        points: (n, 2) pixels, or (n, 3) with their heights, m.
        fixed: templates of the pixels.
        power: (n,) |b|^2 of the pixels.
        alone: what is found beginning with no points, as far as anyone has looked, see `Cleaned`.
    """

    def __init__(
        self,
        field: MatchedField,
        radius_m: float,
        step_m: float,
        look: Appearance,
        heights_m: NDArray[np.float64] | None = None,
    ) -> None:
        self.field = field
        self.radius_m = radius_m
        self.step_m = step_m
        self.look = look
        self.heights_m = heights_m
        self.points = _pixels(radius_m, step_m)
        if heights_m is not None:
            plane, levels = self.points, len(heights_m)
            heights = np.repeat(heights_m, len(plane))
            self.points = np.column_stack([np.tile(plane, (levels, 1)), heights])
        self.fixed = look.fixed(field, self.points)
        self.power = self.left(*no_points(self))
        self.alone: list[Cleaned] = []

    def fitted(self, positions: NDArray[np.float64]) -> tuple[NDArray[np.complex128], float]:
        """Least-squares amplitudes (K,) of points (K, 2 or 3), and the energy that they explain."""
        look, alone = self.look, np.arange(len(positions))[None]
        facing = outward(positions, look.centre_m)
        found = explained_by(self.field, look.aspect, positions, facing, look.offset_m, alone)
        return found.amplitudes[0], float(found.explained[0])

    def left(self, positions: NDArray[np.float64], amplitudes: NDArray[np.complex128]) -> NDArray[np.float64]:
        """(pixels,) |b|^2 of the data minus that of points (K, 2 or 3) with complex amplitudes (K,)."""
        field, look, fixed = self.field, self.look, self.fixed
        if field.tables is not None:
            places = np.zeros((len(positions), 3))
            places[:, : positions.shape[1]] = positions
            facing, pattern = outward(positions, look.centre_m), look.aspect.numbers
            others = places, facing, look.offset_m, pattern, amplitudes
            return field.tables.left(*others, fixed.looked)
        data = field.data
        if len(positions):
            data = data - amplitudes.astype(np.complex64) @ look.templates(field, positions)
        return np.asarray(np.abs(fixed.correlate(data)) ** 2)

    def left_by(self, points: Cleaned) -> NDArray[np.float64]:
        """`left` of the points, computed once."""
        if points.left is None:
            points.left = self.left(points.positions, points.amplitudes)
        return points.left

    def level(self, left: NDArray[np.float64]) -> float:
        """Level of noise and clutter in |b|^2 / ||s||^2; an exponential's median is ln 2 times its mean."""
        own = float(median(left)) / float(np.log(2)) / self.field.template_energy
        return float(max(own, self.field.noise_variance, 1e-12 * self.field.energy))

    def noise_level(self, left: NDArray[np.float64]) -> float:
        """`level`, limited to NOISE_MARGIN times the stated noise if that is known."""
        stated, own = self.field.noise_variance, self.level(left)
        return min(own, NOISE_MARGIN * stated) if stated > 0 else own


def refine_positions(
    field: MatchedField, positions: NDArray[np.float64], look: Appearance, reach_m: float = 12e-3
) -> tuple[NDArray[np.float64], NDArray[np.complex128], float]:
    """Free least-squares positions (K, 2 or 3), m, near the start; amplitudes; explained energy.

    Takes a parabolic step in all coordinates jointly if that improves the fit, else in the single best
    coordinate. Positions stay within +- `reach_m` of the start, heights within `height_scale` times as much.
    """
    k, axes = positions.shape
    if field.tables is not None and k <= MOST_POINTS:
        scale = field.height_scale if axes > 2 else 1.0
        steps = PointSteps(_FIRST_STEP_M, reach_m, scale, _ROUNDS, look.offset_m, NO_SIDE_M)
        return field.tables.moved_points(positions, look.centre_m, look.aspect.numbers, steps)
    start = positions
    places = positions.copy()
    unit = np.eye(axes * k).reshape(axes * k, k, axes)
    rise = np.array([1.0, 1.0, field.height_scale][:axes])
    unit, reach, step = unit * rise, reach_m * rise, _FIRST_STEP_M

    def explained(points: NDArray[np.float64], sets: NDArray[np.intp]) -> Explained:
        facing = outward(points, look.centre_m)
        return explained_by(field, look.aspect, points, facing, look.offset_m, sets)

    alone = np.arange(k)[None]
    # A trial moves one point along one axis: the templates of the others are those of the start.
    count = np.arange(2 * axes * k)
    owner = np.tile(np.repeat(np.arange(k), axes), 2)
    which = np.tile(np.arange(k), (len(count) + 1, 1))
    which[1 + count, owner] = k + count

    for _ in range(_ROUNDS):
        trial = places + np.concatenate([np.zeros((1, k, axes)), unit * step, -unit * step])
        trial = np.clip(trial, start - reach, start + reach)
        moved = trial[1 + count, owner]
        value = explained(np.concatenate([trial[0], moved]), which).explained
        plus, minus = value[1 : axes * k + 1], value[axes * k + 1 :]
        bend = 2 * value[0] - plus - minus
        slope = (plus - minus) / 2
        jump = np.where(bend > 0, slope / np.where(bend > 0, bend, 1), np.sign(slope))
        joint = places + np.clip(jump, -2, 2).reshape(k, axes) * rise * step
        joint = np.clip(joint, start - reach, start + reach)
        best = int(np.argmax(value))
        places = joint if explained(joint, alone).explained[0] >= value[best] else trial[best]
        step *= 0.7
    last = explained(places, alone)
    return places, last.amplitudes[0], float(last.explained[0])


def clean(
    disc: SearchDisc,
    positions: NDArray[np.float64],
    amplitudes: NDArray[np.complex128],
    settings: FinderSettings,
) -> tuple[NDArray[np.float64], NDArray[np.complex128], float]:
    """Add points to those given until no significant peak remains.

    Returns:
        (K', 2) positions, starting with those given, unmoved; (K',) amplitudes; the level of the residual.
    """
    given = Cleaned(positions, amplitudes, 0.0)
    last = [given, *_added(disc, given, settings)][-1]
    return last.positions, last.amplitudes, disc.level(disc.left_by(last))


def clean_steps(disc: SearchDisc, settings: FinderSettings) -> list[float]:
    """Energy that 1, 2, ... points explain, starting from none, all refined freely after each is added."""
    none = Cleaned(*no_points(disc), 0.0, disc.power)
    return [step.energy for step in _added(disc, none, settings)]


def no_points(disc: SearchDisc) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """No positions (0, 2 or 3) and amplitudes, from which `clean` begins where nothing is known."""
    return np.zeros((0, disc.points.shape[1])), np.zeros(0, dtype=np.complex128)


def _added(disc: SearchDisc, now: Cleaned, settings: FinderSettings) -> Iterator[Cleaned]:
    """The points after each added one."""
    field, given = disc.field, len(now.positions)
    while len(now.positions) < given + settings.maximum:
        count = len(now.positions)
        left = disc.left_by(now)
        level = disc.noise_level(left)
        peak = int(np.argmax(left))
        strongest = float(np.max(np.abs(now.amplitudes) ** 2, initial=0.0)) * field.template_energy
        floor = strongest * 10 ** (settings.floor_db / 10)
        if left[peak] / field.template_energy < max(settings.detection_nats * level, floor):
            return
        # Beginning with none, the points are the same whenever the search ends.
        if given == 0 and count < len(disc.alone):
            now = disc.alone[count]
        else:
            added = np.concatenate([now.positions, disc.points[peak][None]])
            now = _polished(field, added, given, disc)
            if given == 0:
                disc.alone.append(now)
        yield now


def _polished(field: MatchedField, points: NDArray[np.float64], fixed: int, disc: SearchDisc) -> Cleaned:
    """All but the first `fixed` points refined freely."""
    if fixed == 0:
        return Cleaned(*refine_positions(field, points, disc.look))
    moved, _, _ = refine_positions(field, points, disc.look, disc.step_m)
    positions = np.concatenate([points[:fixed], moved[fixed:]])
    return Cleaned(positions, *disc.fitted(positions))


@lru_cache(maxsize=4)
def _pixels(radius_m: float, step_m: float) -> NDArray[np.float64]:
    """(n, 2) pixels of a disc, m; those asked for last are kept."""
    half = int(np.ceil(radius_m / step_m))
    axis = np.arange(-half, half + 1) * step_m
    x, y = np.meshgrid(axis, axis)
    inside = x**2 + y**2 <= radius_m**2
    pixels = np.stack([x[inside], y[inside]], axis=-1)
    pixels.flags.writeable = False
    return pixels


def separate(
    positions: NDArray[np.float64], amplitudes: NDArray[np.complex128], given: int, height_scale: float = 1.0
) -> NDArray[np.intp]:
    """Indices of the first `given` points and of those that no stronger one kept is near to.

    The least distance is MIN_SPACING_M, see `distances_between`.

    The residual that a reflector's aspect pattern leaves resembles a second point a few millimetres away.
    """
    kept = list(range(given))
    for i in given + np.argsort(-np.abs(amplitudes[given:])):
        gap = distances_between(positions[kept], positions[i], height_scale)
        if not kept or gap.min() >= MIN_SPACING_M:
            kept.append(int(i))
    return np.array(kept, dtype=np.intp)


def as_reflectors(
    positions: NDArray[np.float64],
    amplitudes: NDArray[np.complex128],
    level: float,
    template_energy: float,
    matched: int = 0,
) -> tuple[Reflector, ...]:
    """Points as `Reflector` values; the first `matched` of them belong to a layout."""
    if not len(positions):
        return ()
    power = np.maximum(np.abs(amplitudes) ** 2, 1e-30)
    return tuple(
        Reflector(
            float(place[0]),
            float(place[1]),
            complex(a),
            float(10 * np.log10(p / power.max())),
            float(10 * np.log10(p * template_energy / level)),
            i < matched,
            float(place[2]) if len(place) == 3 else None,
        )
        for i, (place, a, p) in enumerate(zip(positions, amplitudes, power, strict=True))
    )


def distances_between(
    points: NDArray[np.float64], other: NDArray[np.float64], height_scale: float
) -> NDArray[np.float64]:
    """(...) distance of points (..., 2 or 3), m; heights count 1 / `height_scale` (see `MatchedField`)."""
    away = points - other
    square = away[..., 0] ** 2 + away[..., 1] ** 2
    if away.shape[-1] == 3:
        square = square + (away[..., 2] / height_scale) ** 2
    return np.asarray(np.sqrt(square))


def find_reflectors(scans: BasebandScans, settings: FinderSettings | None = None) -> tuple[Reflector, ...]:
    """Reflectors in focused scans, found without knowledge of any layout, strongest first.

    Raises DataError if the scans do not cover the object's range.
    """
    settings = settings or FinderSettings()
    radius = settings.radius_m + 0.02
    field = MatchedField(fold_views(scans, radius), radius)
    look = Appearance(TRANSPARENT, np.zeros(2))
    disc = SearchDisc(field, settings.radius_m, settings.step_m, look)
    empty = np.zeros((0, 2)), np.zeros(0, dtype=np.complex128)
    positions, amplitudes, level = clean(disc, *empty, settings)
    apart = separate(positions, amplitudes, 0)
    found = as_reflectors(positions[apart], amplitudes[apart], level, field.template_energy)
    floor = [r for r in found if r.amplitude_db >= settings.floor_db]
    return tuple(sorted(floor, key=lambda r: -abs(r.amplitude)))
