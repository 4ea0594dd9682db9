"""Where an odd scatterer stands most likely beside a hypothesis: a handle, a seam, a flat wall, dirt.

A face is seen from about its normal alone, which is supposed to point away from the axis.
"""

from __future__ import annotations

from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from tagid.reading.columns import (
    CLOSEST_M,
    FACE_POWER,
    FACES,
    ODD_POWER,
    OWN_SD_M,
    PAST,
    REACH_M,
    Face,
    seen_of,
)
from tagid.reading.descent import Estimate
from tagid.reading.sheet import SheetModel
from tagid.reading.spectra import Spectra
from tagid.signal import median
from tagid.types import Complex, Floats

GAIN = -3.0
"""Nats that a place adds at least before it is refined: the map is coarse, and its clutter not yet less."""
CLOSE = 20.0
"""Nats by which the map tells a point from a face."""
_OUT_M, _ALONG_M = 0.007, 0.008
"""Steps of the map outward and along its rings."""
WIDTHS_RAD = (0.12, 0.3, 1.0)
"""Widths of faces that are tried: a flat wall, a handle, and what the body hides from behind."""
_FACES_FROM_M = 0.015
"""Nearer to the axis no face is looked for."""


class OddMap:
    """The map of one recording, which all hypotheses share."""

    def __init__(self, spectra: Spectra) -> None:
        self._spectra = spectra
        self._spots: dict[int, tuple[NDArray[np.complex64], NDArray[np.float32]]] = {}
        self._sizes: dict[tuple[int, bytes], NDArray[np.float32]] = {}

    def _whitened(self, disc: int) -> tuple[NDArray[np.complex64], NDArray[np.float32]]:
        """(F, Q, M) conjugate columns of the places in the basis of a clutter's disc, and their energy."""
        if disc not in self._spots:
            waves, _ = self._spectra.waves(*self._spots_of)
            toward, width = self._faces
            waves[:, self._points :] *= seen_of(toward[:, None], width[:, None], self._spectra.direction)
            spots = self._spectra.whiteners[disc].apply(waves).conj().astype(np.complex64)
            self._spots[disc] = spots, spots.real**2 + spots.imag**2
        return self._spots[disc]

    def _size(self, disc: int, lam: Floats) -> NDArray[np.float32]:
        """(F, Q) energy of the columns under variances (F, M)."""
        key = disc, lam.tobytes()
        if key not in self._sizes:
            energy = self._whitened(disc)[1]
            self._sizes[key] = (energy @ (1 / lam).astype(np.float32)[..., None])[..., 0]
        return self._sizes[key]

    @cached_property
    def _spots_of(self) -> tuple[Complex, Floats]:
        """(Q,) places of the map, x + jy, and their heights, m: of points, then of faces of every width."""
        rises, faces = self._spectra.rises(2 * OWN_SD_M), np.tile(_outside(), len(self._widths))
        positions = np.concatenate([np.tile(_places(), len(rises)), faces])
        return positions, np.append(np.repeat(rises, len(_places())), np.zeros(len(faces)))

    @cached_property
    def _faces(self) -> tuple[Floats, Floats]:
        """Directions and widths of the faces."""
        outside = np.angle(_outside())
        return np.tile(outside, len(self._widths)), np.repeat(self._widths, len(outside))

    @cached_property
    def _points(self) -> int:
        """Number of the places that are points: they come first."""
        return len(self._spots_of[0]) - len(self._faces[0])

    @cached_property
    def _widths(self) -> list[float]:
        """Those of faces that are half seen over more than views are apart: one alone may be anything."""
        apart = float(median(np.diff(np.sort(self._spectra.direction))))
        return [width for width in WIDTHS_RAD if 2 * np.sqrt(2 * np.log(2)) * width > apart]

    def likeliest(self, estimate: Estimate, *, faces: bool = True) -> list[tuple[Floats, Face | None]]:
        """Parameters of the point and of the face that add most evidence to a hypothesis, the better first.

        Beside a sheet the point may stand in its field or be seen past it. What adds less than `GAIN` is left
        out, and what adds less than the other by `CLOSE`.
        """
        spectra, model, (positions, heights) = self._spectra, estimate.model, self._spots_of
        spots, _ = self._whitened(model.disc)
        columns, data, lam, power = estimate.whitened(spectra)
        columns, y = columns / np.sqrt(lam)[:, None], data / np.sqrt(lam)
        matrix = columns.conj() @ np.swapaxes(columns, 1, 2) + np.eye(columns.shape[1]) / power[:, None, :]
        held = np.linalg.solve(np.linalg.cholesky(matrix), columns.conj())
        residual = y - ((held @ y[..., None])[..., 0][:, None] @ held.conj())[:, 0]
        # Single precision is enough to find the spot, which is refined.
        against = np.concatenate([held.conj(), residual[:, None]], axis=1) / np.sqrt(lam)[:, None]
        product = spots @ np.swapaxes(against.astype(np.complex64), 1, 2)
        product = product.real**2 + product.imag**2
        size = self._size(model.disc, lam) - product[..., :-1].sum(axis=-1)
        points = self._points
        prior = np.full((len(spectra.moving), len(positions)), ODD_POWER)
        prior[:, points:] = FACE_POWER
        prior *= spectra.moving[:, None]
        gain = (product[..., -1] / (1 / prior + size) - np.log1p(prior * size)).sum(axis=0)
        gain[points:] += np.log(FACES)
        used = np.concatenate([estimate.positions, estimate.odd])
        gain[(np.abs(positions[:, None] - used) < CLOSEST_M).any(axis=1)] = -np.inf
        best = [int(gain[:points].argmax())]
        if faces and points < len(gain):
            best.insert(0, points + int(gain[points:].argmax()))
        least = max(GAIN, float(gain[best].max()) - CLOSE)
        return [
            (np.array([positions[i].real, positions[i].imag, heights[i]])[: model.spot], seen)
            for i in sorted(best, key=lambda i: -gain[i])
            if gain[i] > least
            for seen in ((None, PAST) if i < points and isinstance(model, SheetModel) else (self._face(i),))
        ]

    def _face(self, place: int) -> Face | None:
        """That of a place of the map, by its number; None for a point."""
        toward, width = self._faces
        face = place - self._points
        return None if face < 0 else (float(toward[face]), float(width[face]))


@cache
def _outside() -> Complex:
    """Those of the map at which faces are looked for, every other one: they are wide along their rings."""
    positions = _places()
    return np.asarray(positions[np.abs(positions) > _FACES_FROM_M][::2])


@cache
def _places() -> Complex:
    """(Q,) places of the map, x + jy, m."""
    rings = []
    for radius in np.arange(0.0, REACH_M + 1e-3, _OUT_M):
        count = max(1, int(2 * np.pi * radius / _ALONG_M))
        rings.append(radius * np.exp(2j * np.pi * np.arange(count) / count))
    return np.concatenate(rings)
