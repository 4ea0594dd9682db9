"""The compiled inner loops of the reader: templates of points, what they explain, and where it is most.

Where no compiler was present at installation `FieldTables.of` gives None, and callers do the same with numpy.
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
if _matched is None or _coarse is None:
    _matched = _coarse = None

MOST_POINTS = 24
"""Points of one set, at most."""
_LANES = 4
"""Numbers of coordinates are padded to a multiple of this."""
_OFFSETS = _OTHERS = 8
"""Numbers of range offsets, and of templates, are padded to a multiple of this."""

Pattern = tuple[float, float, float]
"""Edge, softness and floor of an `Aspect`."""


def is_compiled() -> bool:
    """True if the C extension runs; False where numpy stands in for it."""
    return _matched is not None


@dataclass(frozen=True, eq=False)
class Explained:
    """Least squares of the data on sets of points.

    Attributes:
        amplitudes: (H, K) G^-1 b of every set, G loaded by 1e-2 of itself.
        explained: (H,) b^H G^-1 b.
        gram: (H, K, K) G, not loaded.
    """

    amplitudes: NDArray[np.complex128]
    explained: NDArray[np.float64]
    gram: NDArray[np.complex128]


@dataclass(frozen=True)
class PointSteps:
    """How free points move.

    Attributes:
        step_m: of the first round; the others are 0.7 of the one before.
        reach_m: largest distance from the start, in every coordinate; heights move `rise` times as far.
        rise: see there.
        rounds: number of rounds.
        offset_m: range offset.
        no_side_m: a point nearer than this to the centre has no outward side.
    """

    step_m: float
    reach_m: float
    rise: float
    rounds: int
    offset_m: float
    no_side_m: float


@dataclass(frozen=True, eq=False)
class LayoutShape:
    """A layout at rotation zero: positions (K, 2) and heights (K,), m, and what reflectors face (K, 2).

    Contiguous in double precision, see `of`.
    """

    positions: NDArray[np.float64]
    heights: NDArray[np.float64]
    facing: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        positions: NDArray[np.floating],
        heights: NDArray[np.floating],
        facing: NDArray[np.floating],
    ) -> LayoutShape:
        """The shape in the form that the compiled loops take."""
        return cls(_plain(positions), _plain(heights), _plain(facing))


@dataclass(frozen=True, eq=False)
class LayoutSteps:
    """How a layout moves: first step, lower and upper limit of every coordinate (D,), and which rounds."""

    step: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    rounds: range


@dataclass(frozen=True, eq=False)
class Looked:
    """Many points in every view.

    Attributes:
        index: (views, N) int32, range profile.
        turn: (views, 2, N) float32, real and imaginary part of phase times amplitude.
    """

    index: NDArray[np.int32]
    turn: NDArray[np.float32]

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.index[0])


@dataclass(frozen=True, eq=False)
class FieldTables:
    """A matched field in the form that the compiled loops take.

    Attributes:
        field: antennas (ways, 3, views), their middles (3, views), circle of each view (views,), profiles
            (entries, 2, width) as real and imaginary parts, and the scalars that belong to them.
        data: (2, views, width) float32, the scans in the basis.
        table: (views, entries) inner products of the profiles with the scans.
        views, rank, width: numbers of views, of coordinates, and of coordinates with their padding.
    """

    field: tuple[Any, ...]
    data: NDArray[np.float32]
    table: NDArray[np.complex64]
    views: int
    rank: int
    width: int

    @classmethod
    def of(
        cls,
        antennas: Sequence[NDArray[np.float64]],
        groups: Sequence[NDArray[np.intp]],
        profiles: NDArray[np.complex64],
        axis: tuple[float, float, float],
        data: NDArray[np.complex64],
        table: NDArray[np.complex64],
    ) -> FieldTables | None:
        """The tables of a field; None where the loops were not compiled.

        Args:
            antennas: (views, 3) positions of one antenna or of two, m.
            groups: views of each antenna height.
            profiles: (entries, rank) coordinates of the range profiles.
            axis: distance of the first profile and between profiles, m, and the carrier's wavenumber, rad/m.
            data: (views, rank) coordinates of the scans.
            table: (views, entries) inner products of the profiles with the scans.
        """
        if _matched is None:
            return None
        ways = np.ascontiguousarray(np.stack([np.asarray(one, dtype=np.float64).T for one in antennas]))
        circle = np.empty(ways.shape[2], dtype=np.int32)
        for number, views in enumerate(groups):
            circle[views] = number
        rank = profiles.shape[1]
        width = -(-rank // _LANES) * _LANES
        split = np.zeros((len(profiles), 2, width), dtype=np.float32)
        split[:, 0, :rank], split[:, 1, :rank] = profiles.real, profiles.imag
        middle = np.ascontiguousarray(ways.mean(axis=0))
        field = (ways, middle, circle, split, len(groups), width, *(float(x) for x in axis))
        return cls(field, _split(data, rank, width), table, ways.shape[2], rank, width)

    def explained(
        self,
        points: NDArray[np.float64],
        facing: NDArray[np.float64],
        offsets: NDArray[np.float64],
        pattern: Pattern,
        sets: NDArray[np.integer],
        whole: bool = False,
    ) -> Explained:
        """Least squares on sets (H, K) of points (N, 3) that face (N, 2), with range offsets (N,), m.

        `whole` leaves what is constant over the views in the templates.
        """
        h, k = sets.shape
        found = Explained(
            np.empty((h, k), dtype=np.complex128), np.empty(h), np.empty((h, k, k), dtype=np.complex128)
        )
        _matched.evaluate(
            self.field,
            pattern,
            self.data,
            _plain(points),
            _plain(facing),
            _plain(offsets),
            np.ascontiguousarray(sets, dtype=np.int32),
            k,
            whole,
            found.amplitudes,
            found.explained,
            found.gram,
        )
        return found

    def moved_points(
        self,
        places: NDArray[np.float64],
        centre_m: NDArray[np.floating],
        pattern: Pattern,
        steps: PointSteps,
    ) -> tuple[NDArray[np.float64], NDArray[np.complex128], float]:
        """Free places near the start (K, 2 or 3), their amplitudes, and what they explain.

        The points face away from `centre_m`, see `Appearance`.
        """
        found = np.array(places, dtype=np.float64, order="C")
        amplitudes, explained = np.empty(len(found), dtype=np.complex128), np.empty(1)
        numbers = (steps.no_side_m, steps.offset_m, steps.step_m, steps.reach_m, steps.rise)
        _matched.move_points(
            self.field,
            pattern,
            self.data,
            _plain(centre_m),
            numbers,
            steps.rounds,
            found,
            amplitudes,
            explained,
        )
        return found, amplitudes, float(explained[0])

    def moved_layouts(
        self,
        places: NDArray[np.float64],
        shape: LayoutShape,
        pattern: Pattern,
        steps: LayoutSteps,
        scales: tuple[float, float, float],
    ) -> NDArray[np.float64]:
        """(H, 4 or 5) places of a layout, as of `Fit.place`, after parabolic steps from all starts.

        Args:
            places: where to begin.
            shape: the layout.
            pattern: of its reflectors.
            steps: see there.
            scales: balance, energy of a template, and the visibility from which amplitudes are trusted.
        """
        found = np.array(places, dtype=np.float64, order="C")
        _matched.move_layouts(
            self.field,
            pattern,
            self.data,
            shape.positions,
            shape.heights,
            shape.facing,
            _plain(steps.step),
            _plain(steps.low),
            _plain(steps.high),
            scales,
            steps.rounds.start,
            steps.rounds.stop,
            found,
        )
        return found

    def placed(self, places: NDArray[np.float64], shape: LayoutShape, pattern: Pattern) -> Explained:
        """Least squares on a layout at places (H, 4 or 5), as of `Fit.place`."""
        h, k = len(places), len(shape.positions)
        found = Explained(
            np.empty((h, k), dtype=np.complex128), np.empty(h), np.empty((h, k, k), dtype=np.complex128)
        )
        _matched.place_layout(
            self.field,
            pattern,
            self.data,
            shape.positions,
            shape.heights,
            shape.facing,
            _plain(places),
            found.amplitudes,
            found.explained,
            found.gram,
        )
        return found

    def looked(
        self, points: NDArray[np.float64], facing: NDArray[np.float64], offset_m: float, pattern: Pattern
    ) -> Looked:
        """Points (N, 3) that face (N, 2) in every view."""
        found = Looked(
            np.empty((self.views, len(points)), dtype=np.int32),
            np.empty((self.views, 2, len(points)), dtype=np.float32),
        )
        places, faced = _plain(points), _plain(facing)
        _matched.look(self.field, pattern, places, faced, offset_m, found.index, found.turn)
        return found

    def correlated(self, data: NDArray[np.complex64], looked: Looked) -> NDArray[np.complex128]:
        """(N,) <s_p, data> of points with data (views * rank,), less what is constant over the views."""
        rows = _split(data.reshape(self.views, self.rank), self.rank, self.width)
        found = np.empty(looked.count, dtype=np.complex128)
        _coarse.correlate(self.field, rows, looked.index, looked.turn, found)
        return found

    def left(
        self,
        points: NDArray[np.float64],
        facing: NDArray[np.float64],
        offset_m: float,
        pattern: Pattern,
        amplitudes: NDArray[np.complex128],
        looked: Looked,
    ) -> NDArray[np.float64]:
        """(N,) |<s_p, z>|^2 of points, z being what others leave of the scans.

        The others are points (K, 3) that face (K, 2), with amplitudes (K,).
        """
        found = np.empty(looked.count)
        own = np.ascontiguousarray(amplitudes, dtype=np.complex128)
        places, faced = _plain(points), _plain(facing)
        points_of = looked.index, looked.turn
        _coarse.left(self.field, pattern, self.data, places, faced, offset_m, own, *points_of, found)
        return found

    def beyond(
        self, looked: Looked, others: NDArray[np.complex64], inverse: NDArray[np.complex128]
    ) -> NDArray[np.float64]:
        """(N,) ||s_p||^2 - s^T inverse s* of points, with s (P,) = <s_p, other>.

        The others (P, views * rank) are without what is constant over the views, as templates are.
        """
        count = len(others)
        room = -(-count // _OTHERS) * _OTHERS
        found = np.empty(looked.count)
        there = np.zeros((self.views, self.width, 2, room), dtype=np.float32)
        turned = np.moveaxis(others.reshape(count, self.views, self.rank), 0, -1)
        there[:, : self.rank, 0, :count], there[:, : self.rank, 1, :count] = turned.real, turned.imag
        split = np.zeros((count, 2, room))
        split[:, 0, :count], split[:, 1, :count] = inverse.real, inverse.imag
        _coarse.beyond(self.field, looked.index, looked.turn, there, split, found)
        return found

    def coarse(
        self,
        points: NDArray[np.float64],
        facing: NDArray[np.float64],
        pixel: NDArray[np.int32],
        side: int,
        patterns: Sequence[Pattern],
        offsets_m: Sequence[float],
    ) -> list[CoarseTables]:
        """Images of (side, side) pixels for each pattern, of points (N, 3) at pixels (N,), facing (N, 2)."""
        room = -(-len(offsets_m) // _OFFSETS) * _OFFSETS
        static = np.zeros((len(patterns), side, side, 2, self.width), dtype=np.float32)
        images = np.zeros((len(patterns), side, side, 2, room), dtype=np.float32)
        _coarse.coarse(
            self.field,
            self.table,
            _plain(points),
            _plain(facing),
            pixel,
            np.array(patterns, dtype=np.float64),
            np.array(offsets_m, dtype=np.float64),
            room,
            static,
            images,
        )
        return [CoarseTables(*each, len(offsets_m), self.rank) for each in zip(images, static, strict=True)]


@dataclass(frozen=True, eq=False)
class CoarseTables:
    """A coarse image in the form that the compiled loops take.

    Attributes:
        images: (side, side, 2, offsets with their padding) float32.
        static: (side, side, 2, rank with its padding) float32.
        offsets: number of range offsets.
        rank: number of coordinates.
    """

    images: NDArray[np.float32]
    static: NDArray[np.float32]
    offsets: int
    rank: int

    @classmethod
    def of(
        cls,
        inside: NDArray[np.bool_],
        static: NDArray[np.complexfloating],
        images: NDArray[np.complexfloating],
    ) -> CoarseTables:
        """The tables of pixels `inside` (side, side).

        Args:
            inside: see above.
            static: (points, rank) constant parts of the points inside.
            images: (offsets, points) of the points inside.
        """
        pixel = np.flatnonzero(inside)
        return cls(
            _padded(images.T, _OFFSETS, pixel, inside.shape),
            _padded(static, _LANES, pixel, inside.shape),
            len(images),
            static.shape[-1],
        )


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

    def energies(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(offsets, A, S) charged energies, as of `CoarseGrid.energies`, and (offsets, A) the largest."""
        rotations, size = self.placed.shape[:2]
        out = np.empty((self.tables.offsets, rotations, len(self.shifts)), dtype=np.float32)
        best = np.empty(out.shape[:2], dtype=np.float32)
        _coarse.energies(
            self.tables.images,
            self.tables.static,
            _plain(self.placed),
            _plain(self.shifts),
            np.ascontiguousarray(self.gram, dtype=np.complex128),
            self.tables.offsets,
            self.tables.static.shape[0] // 2,
            size,
            self.step_m,
            self.template_energy,
            self.balance,
            self.visible,
            float(self.views),
            out,
            best,
        )
        return out, best


def _padded(
    values: NDArray[np.complexfloating], lanes: int, pixel: NDArray[np.intp], shape: tuple[int, ...]
) -> NDArray[np.float32]:
    """(*shape, 2, n) real and imaginary parts of values (points, n) at pixels, n padded to a multiple."""
    count = values.shape[-1]
    out = np.zeros((*shape, 2, -(-count // lanes) * lanes), dtype=np.float32)
    flat = out.reshape(-1, 2, out.shape[-1])
    flat[pixel, 0, :count], flat[pixel, 1, :count] = values.real, values.imag
    return out


def _plain(values: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.ascontiguousarray(values, dtype=np.float64)


def _split(values: NDArray[np.complex64], rank: int, width: int) -> NDArray[np.float32]:
    """(2, views, width) real and imaginary parts of (views, rank), padded."""
    out = np.zeros((2, len(values), width), dtype=np.float32)
    out[0, :, :rank], out[1, :, :rank] = values.real, values.imag
    return out
