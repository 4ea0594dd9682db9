"""Where an enrolled body stands: its log evidence over centres and turns, alone or beside reflectors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from tagid.reading import search
from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import APART_M
from tagid.reading.descent import BODY, Powers
from tagid.reading.signature import HEAD, EnrolledBody, SignatureModel
from tagid.reading.spectra import Spectra
from tagid.tags.bodies.signature import angular
from tagid.types import Complex, Floats

CLUTTER = 1e-2
"""Power of the clutter under which it is looked for, over the moving energy."""
STEP_M, REACH_M = 3.5e-3, 0.0125
"""Step and reach of the centres that are tried, m: half a diagonal is a phase of 0.5 rad."""
PER_ORDER = 8
"""Turns that are tried, over the largest harmonic."""
DIFFERENT_RAD, DIFFERENT_M = np.deg2rad(20.0), 6e-3
"""Poses that differ by less are one."""


class Poses:
    """Echoes of one enrolled body in all poses, whitened, at every other frequency."""

    def __init__(self, spectra: Spectra, body: EnrolledBody, disc: int) -> None:
        self._spectra = spectra
        self._disc = disc
        thin = spectra.thinned(2)
        self._moving = thin.moving
        self._root = np.sqrt(1 + CLUTTER * thin.moving[:, None] * spectra.whiteners[disc].thinned(2).variance)
        count = int(REACH_M / STEP_M)
        line = STEP_M * np.arange(-count, count + 1)
        grid = (line[:, None] + 1j * line).ravel()
        self._centres = grid[np.abs(grid) <= REACH_M]
        self._turns = 2 * np.pi / (PER_ORDER * body.order) * np.arange(PER_ORDER * body.order)
        carrier, _ = thin.waves(self._centres, np.zeros(len(self._centres)))
        order = np.arange(-body.order, body.order + 1)
        weights = body.at(thin)[:, None] * np.exp(-1j * self._turns[:, None] * order)
        echoes = []
        for i, centre in enumerate(self._centres):
            basis = angular(np.angle(thin.antenna - centre), body.order)
            pattern = weights.astype(np.complex64) @ basis.T.astype(np.complex64)
            echoes.append(self._whitened(pattern * carrier[:, i, None]).astype(np.complex64))
        self._echoes = np.concatenate(echoes, axis=1)
        self._size = (self._echoes.real**2 + self._echoes.imag**2).sum(axis=2)

    def _whitened(self, columns: Complex) -> Complex:
        """(F, n, M) of columns (F, n, V)."""
        whitener = self._spectra.whiteners[self._disc].thinned(2)
        return np.asarray(whitener.apply(columns) / self._root[:, None])

    def best(self, count: int, beside: Complex | None = None) -> list[Floats]:
        """Parameters (HEAD,), of an even turn, of the best poses that differ.

        Args:
            beside: (F, j, V) columns of what else stands there, with any amplitudes.
        """
        y = self._whitened(self._spectra.thinned(2).data[:, None])
        size = self._size
        if beside is not None:
            q = np.linalg.qr(np.swapaxes(self._whitened(beside[::2]), 1, 2))[0]
            y = y - np.swapaxes(q @ (np.swapaxes(q.conj(), 1, 2) @ np.swapaxes(y, 1, 2)), 1, 2)
            along = self._echoes @ q.conj().astype(np.complex64)
            size = np.maximum(size - (along.real**2 + along.imag**2).sum(axis=2), 0)
        product = (self._echoes @ np.swapaxes(y.conj(), 1, 2).astype(np.complex64))[..., 0]
        right = product.real**2 + product.imag**2
        score = np.full(size.shape[1], -np.inf)
        for power in BODY:
            p = power * self._moving[:, None]
            score = np.maximum(score, (right / (1 / p + size) - np.log1p(p * size)).sum(axis=0))
        return list(self._distinct(score, count))

    def _distinct(self, score: Floats, count: int) -> Iterator[Floats]:
        taken: list[tuple[complex, float]] = []
        for i in np.argsort(-score)[:2000]:
            c, t = divmod(int(i), len(self._turns))
            centre, turn = complex(self._centres[c]), float(self._turns[t])
            if all(
                abs(np.angle(np.exp(1j * (turn - other)))) > DIFFERENT_RAD
                or abs(centre - there) > DIFFERENT_M
                for there, other in taken
            ):
                taken.append((centre, turn))
                yield np.append([centre.real, centre.imag, turn], np.zeros(HEAD - 3))
            if len(taken) == count:
                return


def altered(
    spectra: Spectra,
    models: Sequence[tuple[float, SignatureModel]],
    x: Floats,
    powers: Powers,
    most: int,
) -> list[tuple[SignatureModel, Floats]]:
    """Where one to `most` alike reflectors less or more than an enrolled object's stand most likely.

    Args:
        models: of the object alone, with the transfer of its reflectors and the radius of their ring, m.
        x: (P,) parameters of the object alone.
        powers: under which they are looked for.
    """
    best: dict[int, tuple[float, SignatureModel, Floats]] = {}
    echo = models[0][1].at(spectra, x, slopes=False).values[:, 0]
    for radius, model in models:
        group = ((radius, 0.0, 0.0),)
        centre = [complex(x[0], x[1])]
        (table,) = search.tables(spectra, model, centre, [group], powers, echo[None], search.COARSE_RAD)
        for start in search.free(table, 2 * float(np.arcsin(APART_M / 2 / radius)), most, 1):
            count = len(start.angles)
            if count not in best or start.log > best[count][0]:
                ringed = replace(model, tag=Arrangement.ring(radius, np.array(start.angles)))
                head = np.append(x[:HEAD], [0.0, 0.0])
                best[count] = start.log, ringed, np.append(head, np.zeros(count + 1))
    return [(model, x) for _, model, x in best.values()]
