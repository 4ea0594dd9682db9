"""All arrangements on a ring about one centre, scored from one Gram matrix, so that thousands cost little."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies import compiled
from tagid.tags.bodies.reflectors_fit import Pattern
from tagid.tags.bodies.spectra import Spectra, centred

GAP_DEG = 20.0
"""Reflectors nearer than this on a ring are one."""
_RIDGE = 1e-3
BEAM = 20
"""Sets of one size that are extended by one reflector more."""


@dataclass(frozen=True, eq=False)
class Ring:
    """Reflectors at equally spaced angles around a centre, with body and room projected out.

    Attributes:
        radius_m: m.
        pattern: of every reflector.
        angles: (N,) rad.
        energy: of the data that body and room leave, at the frequencies used.
        gram: (F, N M, N M) complex64 inner products of the columns, those of one angle side by side.
        right: (F, N M) complex64 inner products with the data.
        ridge: (F,) added to the diagonal.
    """

    radius_m: float
    pattern: Pattern
    angles: NDArray[np.float64]
    energy: float
    gram: NDArray[np.complex64]
    right: NDArray[np.complex64]
    ridge: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        spectra: Spectra,
        body: NDArray[np.complex128] | None,
        centre: complex,
        radius_m: float,
        pattern: Pattern,
        count: int,
    ) -> Ring:
        """A ring of `count` angles; `body` (F, V) is the body's echo at its pose, None for none."""
        angles = np.arange(count) * 2 * np.pi / count
        cols = ring_columns(spectra, centre, radius_m, pattern, angles)
        return cls.from_columns(spectra.data, cols, body, radius_m, pattern, angles)

    @classmethod
    def from_columns(
        cls,
        data: NDArray[np.complex128],
        cols: NDArray[np.complex128],
        body: NDArray[np.complex128] | None,
        radius_m: float,
        pattern: Pattern,
        angles: NDArray[np.float64],
    ) -> Ring:
        """A ring of reflectors of known echoes: columns (F, N M, V) without the room; the rest as `of`."""
        if body is not None:
            unit = centred(body)
            size = np.linalg.norm(unit, axis=-1, keepdims=True)
            unit = unit / np.maximum(size, 1e-9)
            cols = cols - (cols @ unit.conj()[..., None]) * unit[:, None]
            data = data - (data * unit.conj()).sum(axis=-1, keepdims=True) * unit
        narrow = cols.astype(np.complex64)
        m = pattern.terms
        gram = narrow.conj() @ np.swapaxes(narrow, 1, 2)
        right = (narrow.conj() @ data.astype(np.complex64)[..., None])[..., 0]
        ridge = _RIDGE * np.einsum("fnn->f", gram).real / (len(angles) * m)
        return cls(
            radius_m,
            pattern,
            angles,
            float((np.abs(data) ** 2).sum()),
            gram,
            right,
            ridge.astype(np.float32),
        )

    def explained(self, sets: NDArray[np.intp]) -> NDArray[np.float64]:
        """(H,) energies explained by sets (H, n) of angle indices."""
        one = np.s_[None]
        found = set_energies(self.gram[one], self.right[one], self.ridge[one], sets, self.pattern.terms)
        return np.asarray(found[0])

    def best(self, most: int, keep: int) -> dict[int, tuple[NDArray[np.intp], NDArray[np.float64]]]:
        """The best sets of 1 to `most` reflectors: {n: (sets (keep, n), energies (keep,))}.

        Singles and pairs are tried all; larger sets extend the best smaller ones by every angle.
        """
        count = len(self.angles)
        gap = max(round(np.deg2rad(GAP_DEG) / float(self.angles[1] - self.angles[0])), 1)
        found: dict[int, tuple[NDArray[np.intp], NDArray[np.float64]]] = {}
        sets = np.arange(count)[:, None]
        found[1] = _leading(sets, self.explained(sets), keep)
        a, b = np.triu_indices(count, gap)
        near = count - (b - a) >= gap
        sets = np.stack([a[near], b[near]], axis=1)
        values = self.explained(sets)
        found[2] = _leading(sets, values, keep)
        beam = _leading(sets, values, max(keep, BEAM))[0]
        for n in range(3, most + 1):
            sets, values = self._extended(beam, gap)
            found[n] = _leading(sets, values, keep)
            beam = _leading(sets, values, max(keep, BEAM))[0]
        return found

    def _extended(self, beam: NDArray[np.intp], gap: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Every set of the beam (B, n) with every further angle, each set once."""
        count, n = len(self.angles), beam.shape[1]
        sets = np.concatenate(
            [np.repeat(beam, count, axis=0), np.tile(np.arange(count), len(beam))[:, None]], axis=1
        )
        away = np.abs(sets[:, :-1] - sets[:, -1:])
        apart = np.minimum(away, count - away).min(axis=1) >= gap
        sets = np.sort(sets[apart], axis=1)
        key = sets @ (count ** np.arange(n + 1))
        sets = sets[np.unique(key, return_index=True)[1]]
        return sets, self.explained(sets)


def set_energies(
    gram: NDArray[np.complex64],
    right: NDArray[np.complex64],
    ridge: NDArray[np.float32],
    sets: NDArray[np.intp],
    terms: int,
) -> NDArray[np.float64]:
    """(B, H) energies that sets (H, n) of angle indices explain on B rings, see `compiled.set_energies`."""
    fast = compiled.set_energies(gram, right, ridge, sets, terms)
    if fast is not None:
        return fast
    b, f, size = right.shape
    blocks = gram.reshape(b, f, size // terms, terms, size // terms, terms)
    parts = right.reshape(b, f, size // terms, terms)
    n = sets.shape[1]
    # (H, B, F, M, M) and (B, F, H, M): indices apart from each other lead.
    total = sum(blocks[:, :, sets[:, k], :, sets[:, m]] for k in range(n) for m in range(n))
    given = np.moveaxis(np.asarray(sum(parts[:, :, sets[:, k]] for k in range(n))), 2, 0)
    return np.ascontiguousarray(_solved_energies(np.asarray(total), given, ridge).T)


def _solved_energies(
    gram: NDArray[np.complex64], right: NDArray[np.complex64], ridge: NDArray[np.float32]
) -> NDArray[np.float64]:
    """(H, B) sum_f b^H G^-1 b of small systems (H, B, F, M, M), (H, B, F, M) by Cholesky and substitution."""
    m = right.shape[-1]
    total = np.zeros(right.shape[:-1], dtype=np.float32)
    factor: dict[tuple[int, int], NDArray[np.complex64]] = {}
    solved: list[NDArray[np.complex64]] = []
    for p in range(m):
        for q in range(p):
            value = gram[..., p, q]
            for s in range(q):
                value = value - factor[p, s] * factor[q, s].conj()
            factor[p, q] = value / factor[q, q]
        pivot = gram[..., p, p].real + ridge
        for s in range(p):
            pivot = pivot - np.abs(factor[p, s]) ** 2
        factor[p, p] = np.sqrt(np.maximum(pivot, 0.5 * ridge)).astype(np.complex64)
        value = right[..., p]
        for s in range(p):
            value = value - factor[p, s] * solved[s]
        solved.append(value / factor[p, p])
        total += np.abs(solved[p]) ** 2
    return np.asarray(total.sum(axis=-1), dtype=np.float64)


def ring_columns(
    spectra: Spectra, centre: complex, radius_m: float, pattern: Pattern, angles: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """(F, N M, V) columns, without the room, of reflectors at angles (N,) in the object's plane."""
    toward = (spectra.antenna - centre)[None] * np.exp(-1j * angles)[:, None] - radius_m
    plane = np.abs(toward)
    cosine = toward.real / plane
    distance = np.hypot(plane, spectra.height_m[None])
    facing = ((1 + cosine) / 2) ** 2 if pattern.tilt else 1.0
    weight = facing * (spectra.distance_m / distance) ** 2
    # cos(p psi) by Chebyshev's recurrence.
    terms = np.ones((max(pattern.terms, 2), *cosine.shape))
    terms[1] = cosine
    for p in range(2, pattern.terms):
        terms[p] = 2 * cosine * terms[p - 1] - terms[p - 2]
    waves = spectra.waves(distance)
    # (F, N, M, V)
    cols = waves[:, :, None] * (weight * terms[: pattern.terms]).transpose(1, 0, 2)[None]
    return centred(cols).reshape(len(waves), len(angles) * pattern.terms, -1)


@dataclass(frozen=True, eq=False)
class PairSearch:
    """Pairs on a ring about many centres at once, for finding the centre of a body whose echo is weak.

    Attributes:
        spectra: few frequencies are enough.
        radius_m: of the ring, m.
        count: angles on it.
    """

    spectra: Spectra
    radius_m: float
    count: int

    def left(
        self, centres: NDArray[np.complex128], echoes: NDArray[np.complex128]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Energy that the best pair leaves about every centre (C,), and its angles (C, 2), rad.

        Patterns of two terms, 1 and cos psi.

        Args:
            centres: (C,) x + jy, m.
            echoes: (C, F, V) the body's echo about each.
        """
        angles = np.arange(self.count) * 2 * np.pi / self.count
        ring = (self.spectra.antenna[None] - centres[:, None])[:, None]
        toward = ring * np.exp(-1j * angles)[None, :, None] - self.radius_m
        plane = np.abs(toward)
        waves = self.spectra.waves(np.hypot(plane, self.spectra.height_m)) / plane**2
        waves *= self.spectra.distance_m**2
        cols = centred(np.stack([waves, waves * (toward.real / plane)[None]], axis=3))
        f, c, n, m, v = cols.shape
        unit = centred(np.moveaxis(echoes, 1, 0))
        unit = unit / np.maximum(np.linalg.norm(unit, axis=-1, keepdims=True), 1e-9)
        flat = cols.reshape(f, c, n * m, v)
        flat = flat - (flat @ unit.conj()[..., None]) * unit[:, :, None]
        data = self.spectra.data[:, None]
        data = data - (data * unit.conj()).sum(axis=-1, keepdims=True) * unit
        narrow = np.swapaxes(flat, 0, 1).astype(np.complex64, order="C")
        given = np.swapaxes(data, 0, 1).astype(np.complex64)[..., None]
        gram = narrow.conj() @ np.swapaxes(narrow, -1, -2)
        right = (narrow.conj() @ given)[..., 0]
        gap = max(round(np.deg2rad(GAP_DEG) * n / (2 * np.pi)), 1)
        a, b = np.triu_indices(n, gap)
        pairs = np.stack([a, b], axis=1)[n - (b - a) >= gap]
        ridge = _RIDGE * np.einsum("cfnn->cf", gram).real / (n * m)
        total = set_energies(gram, right, ridge.astype(np.float32), pairs, m)
        best = total.argmax(axis=1)
        energy = (data.real**2 + data.imag**2).sum(axis=(0, 2))
        return np.asarray(energy - total[np.arange(c), best], dtype=np.float64), angles[pairs[best]]


def _leading(
    sets: NDArray[np.intp], values: NDArray[np.float64], keep: int
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The sets of highest value, best first."""
    order = np.argsort(-values)[:keep]
    return sets[order], values[order]


def peaks(values: NDArray[np.float64], most: int) -> list[int]:
    """Indices of the largest values that are local maxima on a circle."""
    peak = (values >= np.roll(values, 1)) & (values >= np.roll(values, -1))
    order = [int(i) for i in np.argsort(-values) if peak[i]]
    return order[:most]
