"""What a hypothesis leaves of a recording, and where reflectors may stand in that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.reading.arrangement import Arrangement
from tagid.reading.columns import APART_M, REACH_M, Model
from tagid.reading.descent import Estimate, Powers, refined, variance
from tagid.reading.hypothesis import MOST_REFLECTORS, Hypothesis
from tagid.reading.search import Blocks, Choice, Tables, about, held_in
from tagid.reading.spectra import Spectra, Whitener
from tagid.reading.transfers.transfer import Transfer
from tagid.types import Complex, Floats

SPOTS, SPOT_M = 110, 7e-3
"""Places that are combined, and the grid from which they are chosen, m."""
KEPT, FITTED = 2, 4
"""The best sets of every number of reflectors, and those of all numbers that are fitted."""


@dataclass(frozen=True, eq=False)
class Remainder:
    """A recording without what a hypothesis explains, its amplitudes integrated out.

    Attributes:
        root: (F, M) standard deviation of noise and clutter.
        data: (F, M) what is left.
        held: (F, J, M) q: what is left of columns w is w - q q^H w, in inner products with anything.
        power: (F,) prior variance of a reflector.
        base: log evidence of the hypothesis.
    """

    whitener: Whitener
    root: Floats
    data: Complex
    held: Complex
    power: Floats
    base: float

    @classmethod
    def of(cls, spectra: Spectra, model: Model, values: Complex, powers: Powers) -> Remainder:
        """That of a model with columns (F, n, V)."""
        whitener = spectra.whiteners[model.disc]
        root = np.sqrt(variance(spectra, model, powers.clutter))
        columns = whitener.apply(values) / root[:, None]
        prior = model.power(spectra.moving, *powers.amplitudes)
        within = columns @ np.swapaxes(columns.conj(), 1, 2) + np.eye(prior.shape[1]) / prior[:, None]
        factor = np.linalg.cholesky(within)
        q = np.asarray(np.linalg.solve(factor, columns))
        data = spectra.white[model.disc] / root
        residual = data - (np.swapaxes(q, 1, 2) @ (q.conj() @ data[..., None]))[..., 0]
        base = -float((data.conj() * residual).sum().real) - 2 * float(np.log(root).sum())
        base -= float(np.log(np.einsum("fnn->fn", factor).real ** 2 * prior).sum())
        return cls(whitener, root, residual, q, spectra.moving * powers.tag, base)

    def whitened(self, values: Complex) -> Complex:
        """(F, N, M) of columns (F, N, V)."""
        return np.asarray(self.whitener.apply(values) / self.root[:, None])

    def likeliest(self, columns: Complex) -> NDArray[np.intp]:
        """Numbers of the `SPOTS` whitened columns (F, N, M) that add most alone."""
        power = self.power[:, None]
        explained = np.abs(columns @ np.swapaxes(self.held.conj(), 1, 2)) ** 2
        size = (np.abs(columns) ** 2).sum(axis=2) - explained.sum(axis=2)
        right = (columns.conj() @ self.data[..., None])[..., 0]
        gain = (np.abs(right) ** 2 / (1 / power + size) - np.log1p(power * size)).sum(axis=0)
        return np.asarray(np.argsort(-gain)[:SPOTS])

    def tables(self, columns: Complex, turns: int) -> Tables:
        """Tables of whitened columns (F, N, M), those of a group one after the other."""
        columns = columns[: held_in(len(columns)), :, None].astype(np.complex64)
        blocks, step = Blocks(columns, 1, turns), 2 * np.pi / turns
        base = np.array([self.base])
        return about(blocks, self.data[None], self.held[None], self.power[None], base, step)[0]


def grid(radius_m: float) -> Complex:
    """Places x + jy within a radius, m."""
    line = np.arange(-radius_m, radius_m + SPOT_M / 2, SPOT_M)
    positions = (line[:, None] + 1j * line).ravel()
    return np.asarray(positions[np.abs(positions) <= radius_m])


def sets(table: Tables, positions: Complex, most: int) -> list[tuple[float, Complex]]:
    """The best sets of one to `most` reflectors, `KEPT` of each number: log evidence and places.

    Args:
        table: of reflectors at places (N,), x + jy, m.
    """
    clear = np.abs(positions[:, None] - positions) >= APART_M
    choice = Choice(np.arange(len(positions), dtype=np.int32), clear, clear)
    best = table.grown(choice, most, KEPT)
    return [(log, positions[chosen]) for log, chosen in best]


def anywhere(spectra: Spectra, before: Sequence[Hypothesis], height_m: float) -> list[Estimate]:
    """The best arrangements of one to `MOST_REFLECTORS` alike reflectors anywhere, under much clutter.

    Args:
        before: hypotheses; beside the best untagged ones of points with one odd scatterer and without.
        height_m: of the reflectors.
    """
    bodies: dict[tuple[Transfer, int], Estimate] = {}
    for hypothesis in sorted(before, key=lambda hypothesis: -hypothesis.log_z):
        model = hypothesis.estimate.model
        if type(model) is Model and model.tag is None and model.odd < 2:
            bodies.setdefault((model.transfer, model.odd), hypothesis.estimate)
    fitted, nodes = [], grid(REACH_M)
    waves, _ = spectra.waves(nodes, np.full(len(nodes), height_m))
    for body in bodies.values():
        model = body.model
        values = model.at(spectra, body.x, slopes=False).values
        remainder = Remainder.of(spectra, model, values, replace(body.powers, clutter=1e-2, tag=0.3))
        spots = remainder.whitened(waves)
        chosen = remainder.likeliest(spots)
        table = remainder.tables(spots[:, chosen], len(chosen))
        for _, points in sets(table, nodes[chosen], MOST_REFLECTORS):
            tagged = replace(model, tag=Arrangement.points(points - body.centre))
            moved = np.r_[np.zeros(2 * len(points)), [height_m] * tagged.lifts]
            x = np.r_[body.x[: model.head], moved, body.x[model.head :]]
            fitted.append(refined(spectra, tagged, x, (1e-2,), 4))
    return sorted(fitted, key=lambda fit: -fit.log_z)[:FITTED]
