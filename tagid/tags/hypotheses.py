"""Where each layout fits best: rotation, centre and range offset found jointly, in the data domain.

A coarse grid reads one image per range offset; the best few places of every layout are then refined on exact
templates, because three degrees are 6 mm at a helmet's rim and decide between layouts of one size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.tags.field import MatchedField
from tagid.tags.layout import Layout, rotation_matrix

FULLY_VISIBLE = 0.5
"""Visibility from which an amplitude is taken as measured."""
IMAGE_STEP_M = 3e-3
"""Pixel of the coarse image; its finest fringe is lambda_min / 2 = 31 mm: bilinear reading errs by < 5 %."""


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
    """

    arc_step_m: float = 6e-3
    centre_step_m: float = 4.5e-3
    centre_range_m: float = 14e-3
    offsets_m: tuple[float, ...] = tuple(i * 8e-3 for i in range(-2, 3))
    starts: int = 3
    iterations: int = 7
    balance: float = 0.35


@dataclass(frozen=True, eq=False)
class Fit:
    """The best place of one layout.

    Attributes:
        layout: which.
        rotation_rad: counter-clockwise turn about the layout's origin, within its symmetry.
        centre_m: (2,) where the origin lies, m.
        offset_m: range offset: measured distances are this much longer than the aperture says.
        positions: (K, 2) reflectors, m.
        amplitudes: (K,) complex least-squares amplitudes.
        sizes: (K,) their magnitudes, see `visible_sizes`.
        explained: b^H G^-1 b, energy.
        charged: the same after the charge for unlike amplitudes.
    """

    layout: Layout
    rotation_rad: float
    centre_m: NDArray[np.float64]
    offset_m: float
    positions: NDArray[np.float64]
    amplitudes: NDArray[np.complex128]
    sizes: NDArray[np.float64]
    explained: float
    charged: float


def least_squares(
    b: NDArray[np.complex128], gram: NDArray[np.complex128]
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Amplitudes (..., K) = G^-1 b and explained energy (...) = b^H G^-1 b; G is loaded by 1e-2 of itself."""
    k = b.shape[-1]
    size = np.abs(np.trace(gram, axis1=-2, axis2=-1)) / k
    load = 1e-2 * size[..., None, None] * np.eye(k)
    amplitudes = np.linalg.solve(gram + load, b[..., None])[..., 0]
    explained = np.real(np.sum(b.conj() * amplitudes, axis=-1))
    return np.asarray(amplitudes, dtype=np.complex128), np.maximum(
        np.asarray(explained, dtype=np.float64), 0.0
    )


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


def charge(explained: NDArray[np.float64], size: NDArray[np.float64], balance: float) -> NDArray[np.float64]:
    """Explained energy (...) scaled down where reflectors, all alike, come out of unlike size (..., K)."""
    ratio = size.min(axis=-1) / np.maximum(size.max(axis=-1), 1e-30)
    return np.asarray(explained * np.minimum(ratio / balance, 1.0), dtype=np.float64)


class _CoarseImage:
    """Complex image of b on a square, read by bilinear interpolation."""

    def __init__(self, field: MatchedField, radius_m: float) -> None:
        half = int(np.ceil(radius_m / IMAGE_STEP_M)) + 1
        self.half = half
        self.axis = np.arange(-half, half + 1) * IMAGE_STEP_M
        x, y = np.meshgrid(self.axis, self.axis)
        self.inside = x**2 + y**2 <= (radius_m + 2 * IMAGE_STEP_M) ** 2
        self.distances = field.distances(np.stack([x[self.inside], y[self.inside]], axis=-1))
        self.field = field

        static = field.static_part(self.distances)
        self.static = np.zeros((*self.inside.shape, static.shape[-1]), dtype=np.complex64)
        self.static[self.inside] = static

    def static_overlap(self, points: NDArray[np.float64]) -> NDArray[np.complex64]:
        """(..., K, K) part of the Gram matrix that is constant over views, to the nearest pixel."""
        index = np.rint(points / IMAGE_STEP_M).astype(np.int32) + self.half
        index = np.clip(index, 0, 2 * self.half)
        static = self.static[index[..., 1], index[..., 0]]
        overlap: NDArray[np.complex64] = np.matmul(static.conj(), np.swapaxes(static, -1, -2))
        return overlap * self.field.views

    def at_offsets(self, offsets_m: Sequence[float]) -> NDArray[np.complex64]:
        """(offsets, pixels, pixels) b, zero outside the disc."""
        images = np.zeros((len(offsets_m), *self.inside.shape), dtype=np.complex64)
        images[:, self.inside] = self.field.correlate_offsets(self.distances, offsets_m)
        return images

    def read(self, image: NDArray[np.complex64], points: NDArray[np.float64]) -> NDArray[np.complex64]:
        position = (points / IMAGE_STEP_M + self.half).astype(np.float32)
        index = np.clip(position.astype(np.int32), 0, 2 * self.half - 1)
        part = position - index
        width = 2 * self.half + 1
        base = index[..., 1] * width + index[..., 0]
        flat = image.ravel()
        fx, fy = part[..., 0], part[..., 1]
        low = flat[base] * (1 - fx) + flat[base + 1] * fx
        high = flat[base + width] * (1 - fx) + flat[base + width + 1] * fx
        return np.asarray(low * (1 - fy) + high * fy)


def search(field: MatchedField, layouts: Sequence[Layout], settings: SearchSettings) -> list[Fit]:
    """The best fit of every layout, in the order given."""
    reach = max(layout.radius_m for layout in layouts) + settings.centre_range_m * np.sqrt(2)
    coarse = _CoarseImage(field, reach)
    images = coarse.at_offsets(settings.offsets_m)
    fits = []
    for layout in layouts:
        starts = _coarse_starts(field, layout, coarse, images, settings)
        fits.append(_refine(field, layout, starts, settings))
    return fits


def _coarse_starts(
    field: MatchedField,
    layout: Layout,
    coarse: _CoarseImage,
    images: NDArray[np.complex64],
    settings: SearchSettings,
) -> NDArray[np.float64]:
    """(starts, 4) rotation, x, y, offset of the best distinct places."""
    turn = 2 * np.pi / layout.symmetry
    rotations = np.arange(0, turn - 1e-9, _rotation_step(layout, settings))
    count = int(np.floor(settings.centre_range_m / settings.centre_step_m))
    line = np.linspace(-1, 1, 2 * count + 1) * settings.centre_range_m
    x, y = np.meshgrid(line, line)
    shifts = np.stack([x.ravel(), y.ravel()], axis=-1)
    shifts = shifts[np.linalg.norm(shifts, axis=1) <= settings.centre_range_m * 1.05]
    placed = layout.positions @ np.swapaxes(rotation_matrix(rotations), -1, -2)
    points = placed[:, None] + shifts[None, :, None]
    gram = field.full_gram(field.distances(placed))[:, None] - coarse.static_overlap(points)
    load = 1e-2 * field.template_energy * np.eye(layout.size)
    inverse = np.linalg.inv(gram + load).astype(np.complex64)
    visibility = np.real(np.diagonal(gram, axis1=-2, axis2=-1)) / field.template_energy
    scores = np.empty((len(images), len(rotations), len(shifts)))
    for i, image in enumerate(images):
        b = coarse.read(image, points)
        amplitudes = np.matmul(inverse, b[..., None])[..., 0]
        explained = np.maximum(np.real(np.sum(b.conj() * amplitudes, axis=-1)), 0)
        scores[i] = charge(explained, visible_sizes(amplitudes, visibility), settings.balance)
    starts: list[tuple[float, float, float, float]] = []
    best = scores.max(axis=2)
    for _ in range(settings.starts):
        i, a = divmod(int(np.argmax(best)), best.shape[1])
        s = int(np.argmax(scores[i, a]))
        starts.append((rotations[a], shifts[s, 0], shifts[s, 1], settings.offsets_m[i]))
        gap = np.abs(np.angle(np.exp(1j * (rotations - rotations[a]) * layout.symmetry))) / layout.symmetry
        best[:, gap < np.deg2rad(8)] = -1
    return np.array(starts)


def _rotation_step(layout: Layout, settings: SearchSettings) -> float:
    """Coarse step of the rotation, rad: that of the arc at the outermost reflector, within 3 to 8 degrees."""
    return float(np.clip(settings.arc_step_m / layout.radius_m, np.deg2rad(3.0), np.deg2rad(8.0)))


def _evaluate(
    field: MatchedField, layout: Layout, places: NDArray[np.float64], balance: float
) -> tuple[NDArray[np.float64], NDArray[np.complex128], NDArray[np.float64], NDArray[np.float64]]:
    """Charged energy (H,), amplitudes, sizes (H, K), explained energy (H,) at places (H, 4), exactly."""
    points = layout.positions @ np.swapaxes(rotation_matrix(places[:, 0]), -1, -2) + places[:, None, 1:3]
    d = field.distances(points, np.asarray(layout.heights))
    templates = field.templates(d + places[:, 3, None, None])
    b, gram = field.correlate(templates), field.gram(templates)
    amplitudes, explained = least_squares(b, gram)
    visibility = np.real(np.diagonal(gram, axis1=-2, axis2=-1)) / field.template_energy
    sizes = visible_sizes(amplitudes, visibility)
    return charge(explained, sizes, balance), amplitudes, sizes, explained


def _refine(
    field: MatchedField, layout: Layout, starts: NDArray[np.float64], settings: SearchSettings
) -> Fit:
    """Parabolic steps along every coordinate of all starts at once, on exact templates, halving."""
    gap = settings.offsets_m[1] - settings.offsets_m[0] if len(settings.offsets_m) > 1 else 2e-3
    low = np.array([-np.inf, -settings.centre_range_m, -settings.centre_range_m, settings.offsets_m[0] - gap])
    high = np.array([np.inf, settings.centre_range_m, settings.centre_range_m, settings.offsets_m[-1] + gap])
    step = np.array([_rotation_step(layout, settings), settings.centre_step_m, settings.centre_step_m, gap])
    step = step * 0.5
    places = starts.copy()
    unit = np.eye(4)
    for _ in range(settings.iterations):
        stencil = np.concatenate([np.zeros((1, 4)), unit * step, -unit * step])
        trial = np.clip(places[:, None] + stencil[None], low, high)
        value = _evaluate(field, layout, trial.reshape(-1, 4), settings.balance)[0].reshape(len(places), 9)
        middle, plus, minus = value[:, :1], value[:, 1:5], value[:, 5:]
        bend = 2 * middle - plus - minus
        slope = (plus - minus) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            jump = np.where(bend > 0, slope / bend, np.sign(slope))
        jump = np.clip(np.nan_to_num(jump), -1, 1) * step
        joint = np.clip(places + jump, low, high)
        joint_value = _evaluate(field, layout, joint, settings.balance)[0]
        single = trial[np.arange(len(places)), value.argmax(axis=1)]
        better = joint_value >= value.max(axis=1)
        places = np.where(better[:, None], joint, single)
        step = step * 0.6
    charged, amplitudes, sizes, explained = _evaluate(field, layout, places, settings.balance)
    i = int(np.argmax(charged))
    rotation = float(np.mod(places[i, 0], 2 * np.pi / layout.symmetry))
    centre = places[i, 1:3]
    return Fit(
        layout,
        rotation,
        centre,
        float(places[i, 3]),
        layout.placed(rotation, centre),
        amplitudes[i],
        sizes[i],
        float(explained[i]),
        float(charged[i]),
    )
