"""The compiled inner loops of the matched field and of the coarse search.

Where no compiler was present at installation callers do the same with numpy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.loops import loop

_matched = loop("tagid.tags.reading._matched")
_coarse = loop("tagid.tags.reading._coarse")

MOST_POINTS = 24
"""Points of one set, at most."""
_LANES = 4
"""Numbers of coordinates are padded to a multiple of this."""
_OFFSETS = 8
"""Numbers of range offsets are padded to a multiple of this."""


@dataclass(frozen=True, eq=False)
class FieldTables:
    """A matched field in the form that the compiled loops take.

    Attributes:
        field: antennas (ways, 3, views), circle of each view (views,), profiles (entries, 2, width) as real
            and imaginary parts, and the scalars that belong to them.
        data: (2, views, width) float32, the scans in the basis.
    """

    field: tuple[Any, ...]
    data: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        antennas: Sequence[NDArray[np.float64]],
        groups: Sequence[NDArray[np.intp]],
        profiles: NDArray[np.complex64],
        axis: tuple[float, float, float],
        data: NDArray[np.complex64],
    ) -> FieldTables | None:
        """The tables of a field; None where the loops were not compiled.

        Args:
            antennas: (views, 3) positions of one antenna or of two, m.
            groups: views of each antenna height.
            profiles: (entries, rank) coordinates of the range profiles.
            axis: distance of the first profile and between profiles, m, and the carrier's wavenumber, rad/m.
            data: (views, rank) coordinates of the scans.
        """
        if _matched is None:
            return None
        ways = np.ascontiguousarray(
            np.stack([np.asarray(antenna, dtype=np.float64).T for antenna in antennas])
        )
        circle = np.empty(ways.shape[2], dtype=np.int32)
        for number, views in enumerate(groups):
            circle[views] = number
        split = np.ascontiguousarray(np.moveaxis(_split(profiles), 0, 1))
        field = (ways, circle, split, len(groups), split.shape[2], *(float(x) for x in axis))
        return cls(field, _split(data))

    def moved_points(
        self, positions: NDArray[np.float64], step_m: float, reach_m: float, rounds: int
    ) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
        """Free places near the start (K, 2), and their amplitudes.

        Args:
            places: start, m.
            step_m: of the first round; the others are 0.7 of the one before.
            reach_m: largest distance from the start, in every coordinate.
            rounds: number of rounds.
        """
        positions_out = np.array(positions, dtype=np.float64, order="C")
        amplitudes = np.empty(len(positions_out), dtype=np.complex128)
        _matched.move_points(self.field, self.data, (step_m, reach_m), rounds, positions_out, amplitudes)
        return positions_out, amplitudes


@dataclass(frozen=True, eq=False)
class CoarseTables:
    """A coarse image in the form that the compiled loops take.

    Attributes:
        images: (side, side, 2, offsets with their padding) float32.
        static: (side, side, 2, rank with its padding) float32.
        offsets: number of range offsets.
    """

    images: NDArray[np.float32]
    static: NDArray[np.float32]
    offsets: int

    @classmethod
    def of(
        cls,
        inside: NDArray[np.bool_],
        static: NDArray[np.complexfloating],
        images: NDArray[np.complexfloating],
    ) -> CoarseTables | None:
        """The tables of pixels `inside` (side, side); None where the loops were not compiled.

        Args:
            inside: see above.
            static: (points, rank) constant parts of the points inside.
            images: (offsets, points) of the points inside.
        """
        if _coarse is None:
            return None
        return cls(_padded(images.T, _OFFSETS, inside), _padded(static, _LANES, inside), len(images))


@dataclass(frozen=True, eq=False)
class CoarseGridTask:
    """A layout's hypotheses on one coarse image.

    Attributes:
        tables: of the image.
        placed: (A, K, 2) rotated reflectors, m.
        shifts: (S, 2) m.
        gram: (A, K, K) of whole templates.
        step_m: of a pixel.
        template_energy, balance: see `CoarseGrid.energies`.
        visible: visibility from which an amplitude is taken as measured.
        views: number of views.
    """

    tables: CoarseTables
    placed: NDArray[np.float64]
    shifts: NDArray[np.float64]
    gram: NDArray[np.complex128]
    step_m: float
    template_energy: float
    balance: float
    visible: float
    views: int

    def energies(self) -> NDArray[np.float32]:
        """(offsets, A) charged energies, as of `CoarseGrid.energies`."""
        rotations, size = self.placed.shape[:2]
        best = np.empty((self.tables.offsets, rotations), dtype=np.float32)
        _coarse.energies(
            self.tables.images,
            self.tables.static,
            np.ascontiguousarray(self.placed),
            np.ascontiguousarray(self.shifts),
            np.ascontiguousarray(self.gram, dtype=np.complex128),
            self.tables.offsets,
            self.tables.static.shape[0] // 2,
            size,
            self.step_m,
            self.template_energy,
            self.balance,
            self.visible,
            float(self.views),
            best,
        )
        return best


def _padded(
    values: NDArray[np.complexfloating], lanes: int, inside: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """(side, side, 2, n) real and imaginary parts of values (points, n) inside, n padded to a multiple."""
    count = values.shape[-1]
    out = np.zeros((*inside.shape, 2, -(-count // lanes) * lanes), dtype=np.float32)
    out[inside, 0, :count], out[inside, 1, :count] = values.real, values.imag
    return out


def _split(values: NDArray[np.complex64]) -> NDArray[np.float32]:
    """(2, n, width) real and imaginary parts of (n, rank), padded."""
    rank = values.shape[1]
    out = np.zeros((2, len(values), -(-rank // _LANES) * _LANES), dtype=np.float32)
    out[0, :, :rank], out[1, :, :rank] = values.real, values.imag
    return out
