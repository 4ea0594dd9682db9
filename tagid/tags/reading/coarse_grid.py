"""The coarse search for a layout: rotation, place and range offset on a grid, read on images of the field."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from tagid.tags.layouts.layout import Layout, rotation_matrix
from tagid.tags.reading.aspect import PATTERNS, ROUND, TRANSPARENT, Aspect, outward
from tagid.tags.reading.coarse import IMAGE_STEP_M, CoarseImage
from tagid.tags.reading.compiled import MOST_POINTS, CoarseGridTask

FULLY_VISIBLE = 0.5
"""Visibility from which an amplitude is taken as measured."""


@dataclass(frozen=True)
class SearchSettings:
    """Extent and steps of the search.

    Attributes:
        arc_step_m, centre_step_m: of the grid, at the outermost reflector and of the centre.
        centre_range_m: the object's axis is searched within +- this in x and y of the turntable's axis.
        offsets_m: range offsets (errors of the axis distance) tried.
        balance: amplitudes whose smallest is under this share of the largest are charged for.
        aspects: patterns of the search; every layout is looked for with each of them.
        patterns: patterns that a layout may have; their number says how many places are searched.
    """

    arc_step_m: float = 6e-3
    centre_step_m: float = 4.5e-3
    centre_range_m: float = 14e-3
    offsets_m: tuple[float, ...] = tuple(i * 8e-3 for i in range(-2, 3))
    balance: float = 0.35
    aspects: tuple[Aspect, ...] = (TRANSPARENT, ROUND)
    patterns: tuple[Aspect, ...] = PATTERNS


@dataclass(frozen=True, eq=False)
class GridEnergies:
    """Largest energies (offsets, A) of a grid's hypotheses over all places of the origin."""

    best: NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class CoarseGrid:
    """The coarse hypotheses of one layout: every rotation at every place of its origin.

    Attributes:
        shifts: (S, 2) places of the layout's origin, m.
        placed: (A, K, 2) reflectors at every rotation, m.
    """

    shifts: NDArray[np.float64]
    placed: NDArray[np.float64]

    @cached_property
    def facing(self) -> NDArray[np.float64]:
        """(A, K, 2) outward unit vectors of the rotated reflectors."""
        return outward(self.placed, np.zeros(2))

    @classmethod
    @lru_cache(maxsize=64)
    def of(cls, layout: Layout, settings: SearchSettings) -> CoarseGrid:
        """The grid of a layout; those used last are kept."""
        # The step of the arc at the outermost reflector, within 3 to 8 degrees.
        step = np.clip(settings.arc_step_m / layout.radius_m, np.deg2rad(3.0), np.deg2rad(8.0))
        rotations = np.arange(0, 2 * np.pi / layout.symmetry - 1e-9, step)
        count = int(np.floor(settings.centre_range_m / settings.centre_step_m))
        line = np.linspace(-1, 1, 2 * count + 1) * settings.centre_range_m
        x, y = np.meshgrid(line, line)
        shifts = np.stack([x.ravel(), y.ravel()], axis=-1)
        shifts = shifts[np.linalg.norm(shifts, axis=1) <= settings.centre_range_m * 1.05]
        return cls(shifts, layout.positions @ np.swapaxes(rotation_matrix(rotations), -1, -2))

    def energies(
        self,
        coarse: CoarseImage,
        full_gram: NDArray[np.complex128],
        template_energy: float,
        balance: float,
    ) -> GridEnergies:
        """Energy that each hypothesis explains, charged for unlike amplitudes.

        Reflectors are all alike: the energy is scaled down where the smallest amplitude is under `balance` of
        the largest. That of a reflector which can hardly be seen is drawn to the mean of the visible ones.

        Args:
            coarse: where b is read.
            full_gram: (A, K, K) of the templates at the turntable's axis, their constant parts included.
            template_energy: as of `MatchedField`.
            balance: see `SearchSettings`.
        """
        size = self.placed.shape[1]
        if coarse.tables is not None and size <= MOST_POINTS:
            task = CoarseGridTask(
                coarse.tables,
                self.placed,
                self.shifts,
                full_gram,
                IMAGE_STEP_M,
                template_energy,
                balance,
                FULLY_VISIBLE,
                coarse.views,
            )
            return GridEnergies(task.energies())
        points = self.placed[:, None] + self.shifts[None, :, None]
        gram = full_gram[:, None] - coarse.static_overlap(points)
        visibility = np.real(np.diagonal(gram, axis1=-2, axis2=-1)) / template_energy
        load = 1e-2 * template_energy * np.eye(size)
        inverse = np.moveaxis(np.linalg.inv(gram + load).astype(np.complex64), (-2, -1), (0, 1)).copy()
        # The reflectors lead, so that sums over them run along the memory.
        b = np.stack([coarse.read(points[..., k, :]) for k in range(size)])
        amplitudes = np.stack([sum(inverse[k, j] * b[j] for j in range(size)) for k in range(size)])
        explained = np.maximum(sum((b[k].conj() * amplitudes[k]).real for k in range(size)), 0)
        trust = np.minimum(np.moveaxis(visibility, -1, 0)[:, None] / FULLY_VISIBLE, 1.0).astype(np.float32)
        seen = np.abs(amplitudes)
        typical = (trust * seen).sum(axis=0) / np.maximum(trust.sum(axis=0), 1e-9)
        seen = trust * seen + (1 - trust) * typical
        ratio = seen.min(axis=0) / np.maximum(seen.max(axis=0), 1e-30)
        return GridEnergies((explained * np.minimum(ratio / balance, 1.0)).max(axis=2))
