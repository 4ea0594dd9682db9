"""Where each layout fits best: rotation, centre and range offset found jointly, in the data domain.

A coarse grid reads one image per range offset; the best few places of every layout are then refined on exact
templates, because three degrees are 6 mm at a helmet's rim and decide between layouts of one size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.signal import median
from tagid.tags.layouts.layout import Layout, rotation_matrix
from tagid.tags.reading.aspect import PATTERNS, ROUND, TRANSPARENT, Appearance, Aspect, outward
from tagid.tags.reading.coarse import IMAGE_STEP_M, CoarseImage, static_overlap
from tagid.tags.reading.compiled import (
    MOST_POINTS,
    CoarseGridTask,
    Explained,
    LayoutShape,
    LayoutSteps,
    is_compiled,
)
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.squares import explained_by, separate_sets, whole_grams

ALIKE = 0.25
"""Spread of the logarithm of a tag's amplitudes: its reflectors differ by up to 20 %, and by aspect."""
ODD_NATS = 8.0
"""What one reflector of another strength can cost a layout: a factor of 2.7, or a missing one."""
BEGINNING = 2
"""Rounds of refinement from all starts, before the hopeless are left where they are."""
FINISHED = 6
"""Layouts refined to the end, at most: the name hangs on the best and the runner-up."""
REACH_NATS, REACH_SHARE = 15.0, 0.4
"""The hopeless lack so many nats and this share of the best's energy: the coarse grid costs up to a quarter,
the runner-up matters within the decision's margins, and noise gains some nats."""
ELEVATION_RANGE_M, ELEVATION_STEP_M = 0.03, 0.015
"""The height of the object's plane is searched within so much of the given one, and the first step of it,
where antennas at several heights show it."""
FULLY_VISIBLE = 0.5
"""Visibility from which an amplitude is taken as measured."""


@dataclass(frozen=True)
class SearchSettings:
    """Extent and steps of the search.

    Attributes:
        arc_step_m, centre_step_m: the coarse grid, at the outermost reflector and of the centre.
        centre_range_m: the object's axis is searched within +- this in x and y of the turntable's axis.
        offsets_m: range offsets (errors of the axis distance) tried coarsely; refined between.
        starts: places a layout that are refined.
        iterations: halvings of the refinement's steps.
        balance: amplitudes whose smallest is under this share of the largest are charged for.
        aspects: patterns of the search; every layout is looked for with each of them.
        patterns: patterns tried at the best places that were found.
    """

    arc_step_m: float = 6e-3
    centre_step_m: float = 4.5e-3
    centre_range_m: float = 14e-3
    offsets_m: tuple[float, ...] = tuple(i * 8e-3 for i in range(-2, 3))
    starts: int = 3
    iterations: int = 7
    balance: float = 0.35
    aspects: tuple[Aspect, ...] = (TRANSPARENT, ROUND)
    patterns: tuple[Aspect, ...] = PATTERNS

    def within(self, offset_m: float) -> SearchSettings:
        """The same with range offsets up to this, m; the refinement goes one step beyond the outermost."""
        step = self.offsets_m[1] - self.offsets_m[0]
        count = max(round(offset_m / step) - 1, 1)
        finer = offset_m / (count + 1)
        return replace(self, offsets_m=tuple(i * finer for i in range(-count, count + 1)))


@dataclass(frozen=True, eq=False)
class Fit:
    """The best place of one layout.

    Attributes:
        layout: which.
        aspect: from which sides its reflectors are seen.
        place: (4,) counter-clockwise rotation about the layout's origin, x and y of that origin, and range
            offset: measured distances are this much longer than the aperture says; rad, m. With several
            antenna heights (5,): also the height of the object's plane, m.
        positions: (K, 2) reflectors, m.
        amplitudes: (K,) complex least-squares amplitudes.
        sizes: (K,) their magnitudes, see `visible_sizes`.
        visibility: (K,) share of a template's energy that is seen and varies over the views.
        explained: b^H G^-1 b, energy.
        charged: the same after the charge for unlike amplitudes.
        criterion: J of `criterion`, lower is better.
    """

    layout: Layout
    aspect: Aspect
    place: NDArray[np.float64]
    positions: NDArray[np.float64]
    amplitudes: NDArray[np.complex128]
    sizes: NDArray[np.float64]
    visibility: NDArray[np.float64]
    explained: float
    charged: float
    criterion: float

    @property
    def rotation_rad(self) -> float:
        """The turn within the layout's symmetry, rad."""
        return float(np.mod(self.place[0], 2 * np.pi / self.layout.symmetry))

    @property
    def centre_m(self) -> NDArray[np.float64]:
        """(2,) where the layout's origin lies, m."""
        return self.place[1:3]

    @property
    def offset_m(self) -> float:
        """The range offset, m."""
        return float(self.place[3])

    @property
    def elevation_m(self) -> float:
        """Height of the object's plane, m; 0 where one antenna height does not show it."""
        return float(self.place[4]) if len(self.place) > 4 else 0.0

    @property
    def points(self) -> NDArray[np.float64]:
        """(K, 2) positions of the reflectors, or (K, 3) with their heights where these show, m."""
        return self.positions if len(self.place) == 4 else self.places

    @property
    def places(self) -> NDArray[np.float64]:
        """(K, 3) positions of the reflectors with their heights, m."""
        heights = np.asarray(self.layout.heights) + self.elevation_m
        return np.column_stack([self.positions, heights])

    def distances(self, field: MatchedField) -> NDArray[np.float64]:
        """(K, views) measured distances of the reflectors, m."""
        places = self.places
        return field.distances(places[:, :2], places[:, 2]) + self.offset_m

    @property
    def look(self) -> Appearance:
        """How any other point of this object would look."""
        return Appearance(self.aspect, self.centre_m, self.offset_m)


@dataclass(frozen=True, eq=False)
class Values:
    """Least squares at many places (H, ...), fields as of `Fit`."""

    amplitudes: NDArray[np.complex128]
    sizes: NDArray[np.float64]
    visibility: NDArray[np.float64]
    explained: NDArray[np.float64]
    charged: NDArray[np.float64]


def visible_sizes(
    amplitudes: NDArray[np.complex128], visibility: NDArray[np.floating]
) -> NDArray[np.float64]:
    """|amplitudes| (..., K), drawn to the mean of the visible ones where a reflector can hardly be seen.

    Visibility is the share of a template's energy that varies over the views; near the axis it goes to zero.
    """
    trust = np.minimum(visibility / FULLY_VISIBLE, 1.0)
    size = np.abs(amplitudes)
    typical = np.sum(trust * size, axis=-1, keepdims=True) / np.maximum(trust.sum(-1, keepdims=True), 1e-9)
    return np.asarray(trust * size + (1 - trust) * typical, dtype=np.float64)


def charge(
    explained: NDArray[np.float64], size: NDArray[np.floating], balance: float, axis: int = -1
) -> NDArray[np.float64]:
    """Explained energy (...) scaled down where reflectors, all alike, come out of unlike size (..., K)."""
    ratio = size.min(axis=axis) / np.maximum(size.max(axis=axis), 1e-30)
    return np.asarray(explained * np.minimum(ratio / balance, 1.0), dtype=np.float64)


def likeness(size: NDArray[np.float64], each: NDArray[np.float64]) -> NDArray[np.float64]:
    """(...) nats against amplitudes |a| (..., K) that belong to one tag, measured with e = `each` (...) nats.

    Their logarithms spread by ALIKE and by the error of 1 / (2 e); one reflector costs ODD_NATS at most,
    because a damaged one says nothing about where the others are.
    """
    logarithm = np.log(np.maximum(size, 1e-6 * size.max(axis=-1, keepdims=True) + 1e-30))
    off = logarithm - median(logarithm, axis=-1, keepdims=True)
    spread = ALIKE**2 + 0.5 / np.maximum(each, 0.5)
    return np.asarray(np.minimum(off**2 / (2 * spread[..., None]), ODD_NATS).sum(axis=-1))


def criterion(field: MatchedField, value: Values, uniform: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(H,) J = n log(1 - e / E) + sum_k log(1 + n v_k) + log n where the pattern is not uniform + likeness.

    Each amplitude is charged for what the data say about it (G. Schwarz, 1978, with the template's own share
    v (..., K) of the samples), so a layout gains nothing by reflectors that nobody could have seen.
    """
    n = field.independent_samples
    left = np.maximum(1 - value.charged / field.energy, 1e-9)
    unknowns = np.log1p(n * value.visibility).sum(axis=-1)
    noise = field.noise_variance if field.noise_variance > 0 else left * field.energy / n
    each = value.explained / noise / value.sizes.shape[-1]
    odd = likeness(value.sizes, np.asarray(each))
    return np.asarray(n * np.log(left) + unknowns + np.where(uniform, 0.0, np.log(n)) + odd)


def search(field: MatchedField, layouts: Sequence[Layout], settings: SearchSettings) -> list[Fit]:
    """The best fit of every layout, in the order given.

    All layouts are refined a little, and only those that may still win or come second to the end.
    """
    reach = max(layout.radius_m for layout in layouts) + settings.centre_range_m * np.sqrt(2)
    levels = sorted({_level(field, height) for layout in layouts for height in np.asarray(layout.heights)})
    at_level = [
        CoarseImage.of_each(field, reach, settings.aspects, settings.offsets_m, level) for level in levels
    ]
    images = [dict(zip(levels, each, strict=True)) for each in zip(*at_level, strict=True)]
    coarse = [[_coarse_starts(field, layout, rows, settings) for rows in images] for layout in layouts]
    most = max(score for found in coarse for _, score in found)
    begun: list[list[Fit]] = []
    for layout, found in zip(layouts, coarse, strict=True):
        tried = []
        for aspect, (starts, score) in zip(settings.aspects, found, strict=True):
            places = starts
            if score >= (1 - REACH_SHARE) * most - REACH_NATS * field.noise_variance:
                places = _refine(field, layout, aspect, starts, settings, range(BEGINNING))
            tried.append(_Tried(aspect, places))
        begun.append(_best_fits(field, layout, tried, settings.balance))
    least = min(fit.criterion for fits in begun for fit in fits)
    leaders = sorted(min(fit.criterion for fit in fits) for fits in begun)[:FINISHED]
    reach_nats = min(least + REACH_NATS + REACH_SHARE * abs(least), leaders[-1])
    results = []
    for fits in begun:
        hopeful = [fit for fit in fits if fit.criterion <= reach_nats]
        results.append(_finished(field, hopeful, settings) if hopeful else min(fits, key=_criterion))
    return results


def _criterion(fit: Fit) -> float:
    return fit.criterion


def _finished(field: MatchedField, found: list[Fit], settings: SearchSettings) -> Fit:
    """Fits of one layout refined to the end, every other pattern tried there, and the best one moved."""
    layout = found[0].layout
    rest = range(BEGINNING, settings.iterations)
    refined = [
        _Tried(fit.aspect, _refine(field, layout, fit.aspect, fit.place[None], settings, rest))
        for fit in found
    ]
    fits = _best_fits(field, layout, refined, settings.balance)
    others = [aspect for aspect in settings.patterns if aspect not in settings.aspects]
    there = [_Tried(aspect, fit.place[None]) for fit in fits for aspect in others]
    best = min([*fits, *_best_fits(field, layout, there, settings.balance)], key=_criterion)
    if best.aspect in settings.aspects:
        return best
    places = _refine(field, layout, best.aspect, best.place[None], settings, range(2, 5))
    moved = _best_fits(field, layout, [_Tried(best.aspect, places)], settings.balance)
    return min([best, *moved], key=_criterion)


@dataclass(frozen=True, eq=False)
class GridEnergies:
    """Energies (offsets, A, S) of a grid's hypotheses, and the largest of all shifts (offsets, A)."""

    values: NDArray[np.floating]
    best: NDArray[np.floating]


DISTINCT_DEG = 8.0
"""Starts of one layout are rotated by as much against each other."""


@dataclass(frozen=True, eq=False)
class CoarseGrid:
    """The coarse hypotheses of one layout: every rotation at every place of its origin.

    Attributes:
        rotations: (A,) counter-clockwise, within the layout's symmetry, rad.
        shifts: (S, 2) places of the layout's origin, m.
        placed: (A, K, 2) rotated reflectors, m.
        symmetry: of the layout.
    """

    rotations: NDArray[np.float64]
    shifts: NDArray[np.float64]
    placed: NDArray[np.float64]
    symmetry: int

    @cached_property
    def facing(self) -> NDArray[np.float64]:
        """(A, K, 2) outward unit vectors of the rotated reflectors."""
        return outward(self.placed, np.zeros(2))

    @cached_property
    def near(self) -> NDArray[np.bool_]:
        """(A, A) rotations within DISTINCT_DEG of each other, of which one is a start."""
        away = self.rotations - self.rotations[:, None]
        gap = np.abs(np.angle(np.exp(1j * away * self.symmetry))) / self.symmetry
        return np.asarray(gap < np.deg2rad(DISTINCT_DEG))

    @classmethod
    @lru_cache(maxsize=64)
    def of(cls, layout: Layout, settings: SearchSettings) -> CoarseGrid:
        """The grid of a layout; those used last are kept."""
        turn = 2 * np.pi / layout.symmetry
        rotations = np.arange(0, turn - 1e-9, _rotation_step(layout, settings))
        count = int(np.floor(settings.centre_range_m / settings.centre_step_m))
        line = np.linspace(-1, 1, 2 * count + 1) * settings.centre_range_m
        x, y = np.meshgrid(line, line)
        shifts = np.stack([x.ravel(), y.ravel()], axis=-1)
        shifts = shifts[np.linalg.norm(shifts, axis=1) <= settings.centre_range_m * 1.05]
        placed = layout.positions @ np.swapaxes(rotation_matrix(rotations), -1, -2)
        return cls(rotations, shifts, placed, layout.symmetry)

    def energies(
        self,
        coarse: CoarseImage | Sequence[CoarseImage],
        full_gram: NDArray[np.complex128],
        template_energy: float,
        balance: float,
    ) -> GridEnergies:
        """Energy that each hypothesis explains, charged for unlike amplitudes.

        Args:
            coarse: where b is read; with several antenna heights, the image at each reflector's height.
            full_gram: (A, K, K) of the templates at the turntable's axis, their constant parts included.
            template_energy: as of `MatchedField`.
            balance: see `SearchSettings`.
        """
        size = self.placed.shape[1]
        rows = [coarse] * size if isinstance(coarse, CoarseImage) else coarse
        first = rows[0]
        if is_compiled() and size <= MOST_POINTS and all(image is first for image in rows):
            task = CoarseGridTask(
                first.tables,
                self.placed,
                self.shifts,
                full_gram,
                IMAGE_STEP_M,
                template_energy,
                balance,
                FULLY_VISIBLE,
                first.views,
            )
            return GridEnergies(*task.energies())
        points = self.placed[:, None] + self.shifts[None, :, None]
        gram = full_gram[:, None] - static_overlap(rows, points)
        visibility = np.real(np.diagonal(gram, axis1=-2, axis2=-1)) / template_energy
        load = 1e-2 * template_energy * np.eye(size)
        inverse = np.moveaxis(np.linalg.inv(gram + load).astype(np.complex64), (-2, -1), (0, 1)).copy()
        # The reflectors lead, so that sums over them run along the memory.
        b = np.stack([rows[k].read(points[..., k, :]) for k in range(size)])
        amplitudes = np.stack([sum(inverse[k, j] * b[j] for j in range(size)) for k in range(size)])
        explained = np.maximum(sum((b[k].conj() * amplitudes[k]).real for k in range(size)), 0)
        trust = np.minimum(np.moveaxis(visibility, -1, 0)[:, None] / FULLY_VISIBLE, 1.0).astype(np.float32)
        seen = np.abs(amplitudes)
        typical = (trust * seen).sum(axis=0) / np.maximum(trust.sum(axis=0), 1e-9)
        seen = trust * seen + (1 - trust) * typical
        values = charge(explained, seen, balance, axis=0)
        return GridEnergies(values, values.max(axis=2))


def _level(field: MatchedField, height_m: float) -> float:
    """Height of the coarse image in which a reflector is read: 0 for all where heights do not show, m."""
    return round(float(height_m), 3) if field.several_heights else 0.0


def _coarse_starts(
    field: MatchedField, layout: Layout, images: Mapping[float, CoarseImage], settings: SearchSettings
) -> tuple[NDArray[np.float64], float]:
    """(starts, 4 or 5) best distinct places, as of `Fit.place`, and the charged energy of the best."""
    grid = CoarseGrid.of(layout, settings)
    rotations, shifts, placed = grid.rotations, grid.shifts, grid.placed
    levels = np.zeros(layout.size)
    if field.several_heights:
        levels = np.array([_level(field, height) for height in np.asarray(layout.heights)])
    rows = [images[level] for level in levels.tolist()]
    gram = whole_grams(field, rows[0].aspect, placed, levels, grid.facing)
    scores = grid.energies(rows, gram, field.template_energy, settings.balance)
    starts: list[tuple[float, ...]] = []
    elevation = (0.0,) if field.several_heights else ()
    best = scores.best.copy()
    most = float(best.max())
    for _ in range(settings.starts):
        i, a = divmod(int(np.argmax(best)), best.shape[1])
        s = int(np.argmax(scores.values[i, a]))
        starts.append((rotations[a], shifts[s, 0], shifts[s, 1], settings.offsets_m[i], *elevation))
        best[:, grid.near[a]] = -1
    return np.array(starts), most


def _rotation_step(layout: Layout, settings: SearchSettings) -> float:
    """Coarse step of the rotation, rad: that of the arc at the outermost reflector, within 3 to 8 degrees."""
    return float(np.clip(settings.arc_step_m / layout.radius_m, np.deg2rad(3.0), np.deg2rad(8.0)))


@dataclass(frozen=True, eq=False)
class _Tried:
    """A pattern at places (H, 4 or 5), as of `Fit.place`."""

    aspect: Aspect
    places: NDArray[np.float64]


def _evaluate(field: MatchedField, layout: Layout, tried: Sequence[_Tried], balance: float) -> Values:
    """Exact templates at the places of each pattern, one after another."""
    found = _explained(field, layout, tried)
    amplitudes = np.concatenate([one.amplitudes for one in found])
    explained = np.concatenate([one.explained for one in found])
    own = np.concatenate([np.diagonal(one.gram, axis1=-2, axis2=-1).real for one in found])
    visibility = own / field.template_energy
    sizes = visible_sizes(amplitudes, visibility)
    return Values(amplitudes, sizes, visibility, explained, charge(explained, sizes, balance))


def _explained(field: MatchedField, layout: Layout, tried: Sequence[_Tried]) -> list[Explained]:
    """Least squares at the places of each pattern."""
    if field.tables is not None and layout.size <= MOST_POINTS:
        shape = _shape(layout)
        return [field.tables.placed(one.places, shape, one.aspect.numbers) for one in tried]
    places = np.concatenate([one.places for one in tried])
    turned = np.swapaxes(rotation_matrix(places[:, 0]), -1, -2)
    points = layout.positions @ turned + places[:, None, 1:3]
    heights = np.broadcast_to(np.asarray(layout.heights), points.shape[:-1])
    if places.shape[1] > 4:
        heights = heights + places[:, 4, None]
    facing = outward(layout.positions, np.zeros(2)) @ turned
    solid = np.concatenate([points, heights[..., None]], axis=2)
    found, first = [], 0
    for one in tried:
        part = slice(first, first + len(one.places))
        first = part.stop
        found.append(
            explained_by(
                field,
                one.aspect,
                solid[part].reshape(-1, 3),
                facing[part].reshape(-1, 2),
                np.repeat(one.places[:, 3], layout.size),
                separate_sets(len(one.places), layout.size),
            )
        )
    return found


@lru_cache(maxsize=64)
def _shape(layout: Layout) -> LayoutShape:
    """A layout for the compiled loops; those used last are kept."""
    return LayoutShape.of(
        layout.positions, np.asarray(layout.heights), outward(layout.positions, np.zeros(2))
    )


def _best_fits(field: MatchedField, layout: Layout, tried: Sequence[_Tried], balance: float) -> list[Fit]:
    """The best place of each pattern."""
    value = _evaluate(field, layout, tried, balance)
    uniform = np.repeat([one.aspect.uniform for one in tried], [len(one.places) for one in tried])
    criteria = criterion(field, value, uniform)
    fits, first = [], 0
    for one in tried:
        own = int(np.argmin(criteria[first : first + len(one.places)]))
        i, place = first + own, one.places[own]
        first += len(one.places)
        fits.append(
            Fit(
                layout,
                one.aspect,
                place,
                layout.placed(float(place[0]), place[1:3]),
                value.amplitudes[i],
                value.sizes[i],
                value.visibility[i],
                float(value.explained[i]),
                float(value.charged[i]),
                float(criteria[i]),
            )
        )
    return fits


def _refine(
    field: MatchedField,
    layout: Layout,
    aspect: Aspect,
    starts: NDArray[np.float64],
    settings: SearchSettings,
    rounds: range,
) -> NDArray[np.float64]:
    """(H, 4 or 5) places after parabolic steps along every coordinate of all starts at once.

    The steps shrink with every round; `rounds` says which of them are taken.
    """
    gap = settings.offsets_m[1] - settings.offsets_m[0] if len(settings.offsets_m) > 1 else 2e-3
    low = np.array([-np.inf, -settings.centre_range_m, -settings.centre_range_m, settings.offsets_m[0] - gap])
    high = np.array([np.inf, settings.centre_range_m, settings.centre_range_m, settings.offsets_m[-1] + gap])
    step = np.array([_rotation_step(layout, settings), settings.centre_step_m, settings.centre_step_m, gap])
    places = starts.copy()
    count = places.shape[1]
    if count > 4:
        low, high = np.append(low, -ELEVATION_RANGE_M), np.append(high, ELEVATION_RANGE_M)
        step = np.append(step, ELEVATION_STEP_M)
    unit = np.eye(count)

    if field.tables is not None and layout.size <= MOST_POINTS:
        scales = (settings.balance, field.template_energy, FULLY_VISIBLE)
        steps = LayoutSteps(step, low, high, rounds)
        return field.tables.moved_layouts(starts, _shape(layout), aspect.numbers, steps, scales)

    def charged(at: NDArray[np.float64]) -> NDArray[np.float64]:
        return _evaluate(field, layout, [_Tried(aspect, at)], settings.balance).charged

    for turn in rounds:
        now = step * 0.5 * 0.6**turn
        stencil = np.concatenate([np.zeros((1, count)), unit * now, -unit * now])
        trial = np.clip(places[:, None] + stencil[None], low, high)
        value = charged(trial.reshape(-1, count)).reshape(len(places), 2 * count + 1)
        middle, plus, minus = value[:, :1], value[:, 1 : count + 1], value[:, count + 1 :]
        bend = 2 * middle - plus - minus
        slope = (plus - minus) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            jump = np.where(bend > 0, slope / bend, np.sign(slope))
        jump = np.clip(np.nan_to_num(jump), -1, 1) * now
        joint = np.clip(places + jump, low, high)
        joint_value = charged(joint)
        single = trial[np.arange(len(places)), value.argmax(axis=1)]
        better = joint_value >= value.max(axis=1)
        places = np.where(better[:, None], joint, single)
    return places
