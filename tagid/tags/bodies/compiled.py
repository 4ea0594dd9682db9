"""The compiled inner loops of the reading on bodies.

Where no compiler was present at installation every function gives None, and callers do the same with numpy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.loops import loop

_arrangements = loop("tagid.tags.bodies._arrangements")
_cylinders = loop("tagid.tags.bodies._cylinders")
_walls = loop("tagid.tags.bodies._walls")

MOST_TERMS = 7
"""Terms of a pattern, at most."""
MOST_MOVES = 32
"""Moves of an arrangement, at most."""
MOST_AMPLITUDES = 8
"""Amplitudes per frequency of a wall with planes of symmetry, at most."""
MOST_RINGED = 8
"""Reflectors beside a wall, at most."""


def waves(path_m: NDArray[np.float64], wavenumbers: NDArray[np.float64]) -> NDArray[np.complex128] | None:
    """(F, ...) exp(-j kappa path) of paths (...), m, at equally spaced wavenumbers (F,), rad/m."""
    if _arrangements is None:
        return None
    path = np.ascontiguousarray(path_m, dtype=np.float64)
    out = np.empty((len(wavenumbers), *path.shape), dtype=np.complex128)
    _arrangements.waves(path, len(wavenumbers), float(wavenumbers[0]), _step(wavenumbers), out)
    return out


def set_energies(
    gram: NDArray[np.complex64],
    right: NDArray[np.complex64],
    ridge: NDArray[np.float32],
    sets: NDArray[np.intp],
    terms: int,
) -> NDArray[np.float64] | None:
    """(B, H) sum over f of b^H G^-1 b, G and b the sums over the angles of a set of blocks of a ring.

    Args:
        gram: (B, F, N M, N M) inner products of the columns of B rings, of N angles and M terms each.
        right: (B, F, N M) those with the data.
        ridge: (B, F) added to the diagonal.
        sets: (H, n) indices of angles.
        terms: M.
    """
    if _arrangements is None or terms > MOST_TERMS:
        return None
    rings, frequencies = ridge.shape
    out = np.empty((rings, len(sets)))
    index = np.ascontiguousarray(sets, dtype=np.int32)
    _arrangements.energies(gram, right, ridge, index, rings, frequencies, terms, sets.shape[1], out)
    return out


@dataclass(frozen=True, eq=False)
class SpectraTables:
    """Spectra in the form that the compiled loops take.

    Attributes:
        antenna: (2, V) x and y, m.
        height: (V,) m.
        data: (F, 2, V) real and imaginary parts.
        scalars: first wavenumber and the step between two, rad/m; distance to which phases refer, m.
    """

    antenna: NDArray[np.float64]
    height: NDArray[np.float64]
    data: NDArray[np.float64]
    scalars: tuple[float, float, float]

    @classmethod
    def of(
        cls,
        antenna: NDArray[np.complex128],
        height_m: NDArray[np.float64],
        data: NDArray[np.complex128],
        wavenumbers: NDArray[np.float64],
        distance_m: float,
    ) -> SpectraTables:
        """The tables of `Spectra` of these fields."""
        return cls(
            np.stack([antenna.real, antenna.imag]),
            np.ascontiguousarray(height_m, dtype=np.float64),
            np.stack([data.real, data.imag], axis=1),
            (float(wavenumbers[0]), _step(wavenumbers), distance_m),
        )


def walls_left(
    spectra: SpectraTables, places: NDArray[np.float64], order: int, amplitudes: int
) -> NDArray[np.float64] | None:
    """(H,) energy that walls at places (H, 3) of centre x and y, m, and gamma, rad, leave.

    See `symmetric`; fastest where places of one centre follow one another.
    """
    if _walls is None or amplitudes > MOST_AMPLITUDES:
        return None
    left = np.empty(len(places))
    at = np.ascontiguousarray(places, dtype=np.float64)
    there = spectra.antenna, spectra.height, spectra.data, spectra.scalars
    _walls.left(*there, at, order, amplitudes, left)
    return left


@dataclass(frozen=True, eq=False)
class RingedRows:
    """Reflectors around one centre beside one wall each: see `cylinder_fit`.

    Attributes:
        shells: (H,) index of the wall.
        at: (H, 3 + K) centre x and y and what is added to the radii, m, and angles, rad.
        radii, heights, present: (H, K), as in `Batch`.
    """

    shells: NDArray[np.intp]
    at: NDArray[np.float64]
    radii: NDArray[np.float64]
    heights: NDArray[np.float64]
    present: NDArray[np.float64]

    def moved(self, places: NDArray[np.float64]) -> RingedRows:
        """(H P,) the same at other places (H, P, 3 + K)."""
        each = self._each(np.arange(len(self.at)).repeat(places.shape[1]))
        return replace(each, at=places.reshape(-1, places.shape[2]))

    def beside(self, shells: NDArray[np.intp]) -> RingedRows:
        """(S,) the first one beside each of some walls (S,)."""
        return replace(self._each(np.zeros(len(shells), dtype=np.intp)), shells=shells)

    def _each(self, rows: NDArray[np.intp]) -> RingedRows:
        shells, at, radii = self.shells[rows], self.at[rows], self.radii[rows]
        return RingedRows(shells, at, radii, self.heights[rows], self.present[rows])

    def fits(self) -> bool:
        """Whether the compiled loop takes so many reflectors, and runs at all."""
        return _cylinders is not None and self.radii.shape[1] <= MOST_RINGED

    def rest(
        self,
        spectra: SpectraTables,
        patterns: NDArray[np.complex128],
        body: NDArray[np.complex128] | None = None,
    ) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
        """What they leave of the spectra (H, F, V), and its energies (H,).

        Args:
            spectra: the scans.
            patterns: (2, S, F, angles) beside every wall, of the electric and the magnetic dipole.
            body: (F, V) echo of the body in its pose; None for one of revolution about each centre.
        """
        rest = np.empty((len(self.at), patterns.shape[2], len(spectra.height)), dtype=np.complex128)
        left = np.empty(len(self.at))
        rows = (self.at, self.radii, self.heights, self.present)
        plain = (np.ascontiguousarray(one, dtype=np.float64) for one in rows)
        shells = np.ascontiguousarray(self.shells, dtype=np.int64)
        there = spectra.antenna, spectra.height, spectra.data, spectra.scalars
        own = None if body is None else np.stack([body.real, body.imag], axis=1)
        _cylinders.left(*there, patterns, patterns.shape[3], shells, *plain, own, rest, left)
        return rest, left


@dataclass(frozen=True, eq=False)
class Arrangements:
    """Rows of `Batch`, as the compiled loop takes them: see there for the fields."""

    at: NDArray[np.float64]
    radii: NDArray[np.float64]
    heights: NDArray[np.float64]
    present: NDArray[np.float64]
    lean: NDArray[np.float64]
    tilt: NDArray[np.float64]
    terms: NDArray[np.float64]
    moves: NDArray[np.float64]

    def fits(self) -> bool:
        """Whether the compiled loop takes so many terms and moves, none that leans, and runs at all."""
        small = self.terms.max() <= MOST_TERMS and self.moves.shape[1] <= MOST_MOVES
        return _arrangements is not None and bool(small) and not np.any(self.lean)

    def left(
        self, spectra: SpectraTables, echoes: NDArray[np.complex128], steps: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(H,) energies left, see `linear`."""
        none = np.empty(0)
        return self._linear(spectra, echoes[:1], steps, none, none)

    def linear(
        self, spectra: SpectraTables, echoes: NDArray[np.complex128], steps: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Energies left (H,), and real inner products of the slopes (H, P, P) and with what is left (H, P).

        Args:
            spectra: the scans.
            echoes: (B, H, F, V) of the body at its place, and moved along each of its coordinates; B = 0 for
                no body.
            steps: (3,) by how much it was moved, m and rad.
        """
        rows, moves = self.moves.shape[:2]
        normal, gradient = np.empty((rows, moves, moves)), np.empty((rows, moves))
        return self._linear(spectra, echoes, steps, normal, gradient), normal, gradient

    def _linear(
        self,
        spectra: SpectraTables,
        echoes: NDArray[np.complex128],
        steps: NDArray[np.float64],
        normal: NDArray[np.float64],
        gradient: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        left = np.empty(len(self.at))
        rows = (self.at, self.radii, self.heights, self.present, self.tilt, self.terms, self.moves)
        plain = (np.ascontiguousarray(one, dtype=np.float64) for one in rows)
        there = spectra.antenna, spectra.height, spectra.data, spectra.scalars
        _arrangements.linear(*there, *plain, np.ascontiguousarray(echoes), steps, left, normal, gradient)
        return left


def _step(wavenumbers: NDArray[np.float64]) -> float:
    return float(wavenumbers[1] - wavenumbers[0]) if len(wavenumbers) > 1 else 0.0
