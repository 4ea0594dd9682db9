"""Where reflectors may stand: log evidences of arrangements on rings, from tables of single reflectors.

On an even turn a reflector at another angle is the same column, shifted by views: inner products depend on
the difference of the angles, and a Fourier transform gives them all. The recording is centred before, which
moves the phase of every view. On other turns the tables are made column by column.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from tagid.loops import loop
from tagid.reading.columns import Model, patterns
from tagid.reading.descent import Powers
from tagid.reading.spectra import Complex, Floats, Spectra

_sets = loop("tagid.reading._sets")

STEP_RAD = np.deg2rad(3.0)
"""Reflectors of the tables are no farther apart."""
COARSE = 2
"""Every so many-th angle of the table is a start for free reflectors,"""
APART_RAD = np.deg2rad(24.0)
"""which stand at least so far apart on their ring."""
GROWN = 40
"""Best sets to which a further reflector is added."""


@dataclass(frozen=True, eq=False)
class Tables:
    """Inner products of the columns of single reflectors on rings, whitened, without room and body.

    Attributes:
        gram: (F, B, B, V, P, P), right: (F, B, V, P), held: (F, B, V, P, J), see `_sets.c`.
        power: (F, P) prior variances.
        base: log evidence without reflectors, up to what all centres share, nats.
        rings: number of rings; angles: of every ring, `step_rad` apart; fractions: blocks of a ring.
    """

    gram: Complex
    right: Complex
    held: Complex
    power: Floats
    base: float
    rings: int
    angles: int
    fractions: int
    step_rad: float

    def index(self, ring: NDArray[np.intp], angle: Floats) -> NDArray[np.int32]:
        """Indices of reflectors at angles, rad, of rings."""
        i = np.rint(np.asarray(angle) / self.step_rad).astype(np.intp) % self.angles
        shifts = self.angles // self.fractions
        block = ring * self.fractions + i % self.fractions
        return np.asarray(block * shifts + i // self.fractions, dtype=np.int32)

    def scores(self, sets: NDArray[np.int32]) -> Floats:
        """(H,) log evidences of sets (H, K) of indices."""
        f, b, _, v, p, _ = self.gram.shape
        out = np.empty(len(sets))
        if not len(sets):
            return out
        chosen = np.ascontiguousarray(sets, dtype=np.int32)
        if _sets is not None:
            j = self.held.shape[-1]
            _sets.scores(
                self.gram, self.held, self.right, self.power, chosen, out, f, b, v, p, j, *chosen.shape
            )
            return self.base + out
        return self.base + self._scored(chosen)

    def _scored(self, sets: NDArray[np.int32]) -> Floats:
        """The same with numpy."""
        v = self.gram.shape[3]
        block, shift = sets // v, sets % v
        right = self.right[:, block, shift].sum(axis=2)
        held = self.held[:, block, shift].sum(axis=2)
        apart = (shift[:, None, :] - shift[:, :, None]) % v
        matrix = self.gram[:, block[:, :, None], block[:, None, :], apart].sum(axis=(2, 3))
        matrix = (
            matrix
            - held.conj() @ np.swapaxes(held, 2, 3)
            + np.eye(self.power.shape[1]) / self.power[:, None, :, None]
        )
        factor = np.linalg.cholesky(matrix)
        half = np.linalg.solve(factor, right[..., None])[..., 0]
        gain = (np.abs(half) ** 2).sum(axis=(0, 2)) - 2 * np.log(np.einsum("fhpp->fhp", factor).real).sum(
            axis=(0, 2)
        )
        return np.asarray(gain - np.log(self.power).sum())


def tables(
    spectra: Spectra, model: Model, centre: complex, rings: Sequence[tuple[float, float]], powers: Powers
) -> Tables:
    """Tables of the reflectors of a model's transfer about a centre, x + jy, m.

    Args:
        model: transfer and disc are used.
        rings: radius and height of each, m.
        powers: of clutter and reflectors.
    """
    make = _even if spectra.full_turn else _uneven
    return make(spectra, model, centre, rings, powers)


def _even(
    spectra: Spectra, model: Model, centre: complex, rings: Sequence[tuple[float, float]], powers: Powers
) -> Tables:
    views, transfer = spectra.views, model.transfer
    fractions = int(np.ceil(2 * np.pi / views / STEP_RAD - 1e-9))
    sense = np.sign(np.angle(spectra.antenna[1] / spectra.antenna[0]))
    step = float(sense * 2 * np.pi / (views * fractions))
    variance = spectra.whiteners[model.disc].every
    root = np.sqrt(1 + powers.clutter * spectra.moving[:, None] * variance)
    columns = []
    for radius, height in rings:
        facing = np.asarray(step * np.arange(fractions), dtype=np.float64)
        waves, _ = spectra.waves(radius * np.exp(1j * facing), np.full(fractions, height))
        seen, _ = patterns(spectra, transfer, np.full(fractions, radius), facing)
        columns.append(waves[:, :, None] * np.moveaxis(seen, 2, 0))
    w = np.fft.fft(np.concatenate(columns, axis=1), axis=-1) / np.sqrt(views) / root[:, None, None]
    undone = np.exp(1j * spectra.kappa[:, None] * (np.abs(spectra.antenna - centre) - spectra.distance_m))
    room, body = (np.fft.fft(one, axis=-1) / np.sqrt(views) / root for one in (undone, np.ones_like(undone)))
    held_out, charge = _orthogonal([room, body] if transfer.body else [room], powers.body * spectra.moving)
    y = np.fft.fft(spectra.data * undone, axis=-1) / np.sqrt(views) / root
    y, base = _cleared(y, held_out)
    base -= 2 * float(np.log(root[:, 1:]).sum()) + (charge if transfer.body else 0.0)
    q = np.stack(held_out, axis=1)
    turned = w.conj()
    right = np.moveaxis(np.fft.ifft(turned * y[:, None, None], axis=-1) * views, 3, 2)
    held = np.fft.fft(w[:, :, :, None] * q.conj()[:, None, None], axis=-1)
    # <q, w shifted by n> = sum over m of conj(q) w exp(-2 pi j m n / V).
    held = np.moveaxis(held, 4, 2)
    product = turned[:, :, None, :, None] * w[:, None, :, None, :]
    gram = np.moveaxis(np.fft.fft(product, axis=-1), 5, 3)
    power = spectra.moving[:, None] * powers.tag * np.array(transfer.power)
    pack = np.ascontiguousarray
    return Tables(
        pack(gram), pack(right), pack(held), pack(power), base, len(rings), views * fractions, fractions, step
    )


def _uneven(
    spectra: Spectra, model: Model, centre: complex, rings: Sequence[tuple[float, float]], powers: Powers
) -> Tables:
    transfer, whitener = model.transfer, spectra.whiteners[model.disc]
    angles = round(2 * np.pi / (1.5 * STEP_RAD))
    step = 2 * np.pi / angles
    root = np.sqrt(1 + powers.clutter * spectra.moving[:, None] * whitener.variance)
    facing = np.asarray(step * np.arange(angles), dtype=np.float64)
    parts = []
    for radius, height in rings:
        waves, _ = spectra.waves(centre + radius * np.exp(1j * facing), np.full(angles, height))
        seen, _ = patterns(spectra, transfer, np.full(angles, radius), facing)
        parts.append(waves[:, :, None] * np.moveaxis(seen, 2, 0))
    w = np.concatenate(parts, axis=1)
    f, count, p, v = w.shape
    w = (whitener.apply(w.reshape(f, count * p, v)) / root[:, None]).reshape(f, count, p, -1)
    held_out: list[Complex] = []
    charge = 0.0
    if transfer.body:
        body, _ = spectra.waves(np.array([centre]), np.zeros(1))
        held_out, charge = _orthogonal([whitener.apply(body)[:, 0] / root], powers.body * spectra.moving)
    y, base = _cleared(spectra.white[model.disc] / root, held_out)
    base -= 2 * float(np.log(root).sum()) + charge
    q = np.stack(held_out, axis=1) if held_out else np.zeros((f, 0, y.shape[1]))
    held = np.ascontiguousarray((w @ np.swapaxes(q.conj(), 1, 2)[:, None])[:, :, None])
    flat = w.reshape(f, count * p, -1)
    gram = (flat.conj() @ np.swapaxes(flat, 1, 2)).reshape(f, count, p, count, p)
    gram = np.moveaxis(gram, 3, 2)[:, :, :, None]
    right = (flat.conj() @ y[..., None]).reshape(f, count, 1, p)
    power = spectra.moving[:, None] * powers.tag * np.array(transfer.power)
    pack = np.ascontiguousarray
    return Tables(pack(gram), pack(right), held, pack(power), base, len(rings), angles, angles, step)


def _orthogonal(vectors: Sequence[Complex], power: Floats) -> tuple[list[Complex], float]:
    """Vectors (F, M) made orthogonal, each scaled so that y - q q^H y is y without it as far as its power is.

    Returns:
        The vectors, and the log determinant that the last of them adds.
    """
    out: list[Complex] = []
    strength = np.zeros((len(power), 1))
    units: list[Complex] = []
    for vector in vectors:
        rest = vector
        for unit in units:
            rest = rest - (unit.conj() * rest).sum(axis=1, keepdims=True) * unit
        size = (np.abs(rest) ** 2).sum(axis=1, keepdims=True)
        units.append(rest / np.sqrt(np.maximum(size, 1e-30)))
        strength = power[:, None] * size
        out.append(units[-1] * np.sqrt(strength / (1 + strength)))
    return out, float(np.log1p(strength).sum())


def _cleared(y: Complex, held_out: Sequence[Complex]) -> tuple[Complex, float]:
    """y (F, M) without what is held out, and -y^H C^-1 y."""
    rest = y
    for q in held_out:
        rest = rest - (q.conj() * y).sum(axis=1, keepdims=True) * q
    return rest, -float((y.conj() * rest).sum().real)


@dataclass(frozen=True)
class Start:
    """Angles of reflectors, rad, and the log evidence that the tables give them."""

    log: float
    angles: tuple[float, ...]


def turned(table: Tables, ring: NDArray[np.intp], angle: Floats, count: int) -> list[Start]:
    """The best turns of a layout whose reflectors stand at angles of rings.

    Args:
        count: number of turns, which are local maxima.
    """
    turn = table.step_rad * np.arange(table.angles)
    sets = np.stack(
        [table.index(np.full(table.angles, r), turn + a) for r, a in zip(ring, angle, strict=True)], axis=1
    )
    scores = table.scores(sets)
    peaks = np.flatnonzero((scores >= np.roll(scores, 1)) & (scores >= np.roll(scores, -1)))
    best = peaks[np.argsort(-scores[peaks])][:count]
    return [Start(float(scores[i]), (float(turn[i]),)) for i in best]


@lru_cache(maxsize=8)
def _subsets(positions: int, least: int) -> NDArray[np.intp]:
    apart = [(a, b) for a, b in combinations(range(positions), 2) if min(b - a, positions - b + a) >= least]
    return np.array(apart, dtype=np.intp).reshape(-1, 2)


def free(table: Tables, ring: int, most: int, kept: int) -> list[Start]:
    """The best sets of one to `most` reflectors of a ring, grown one by one; `kept` of every number."""
    coarse = np.arange(0, table.angles, COARSE if table.angles >= 120 else 1)
    angle = np.asarray(coarse * table.step_rad, dtype=np.float64)
    ids = table.index(np.full(len(coarse), ring), angle)
    least = max(round(APART_RAD / abs(angle[1] - angle[0])), 1)
    found: list[Start] = []
    sets, order = np.arange(len(coarse))[:, None], np.zeros(0, dtype=np.intp)
    for number in range(1, most + 1):
        if number == 2:
            sets = _subsets(len(coarse), least)
        elif number > 2:
            sets = _more(sets[order[:GROWN]], len(coarse), least)
        if not len(sets):
            break
        scores = table.scores(ids[sets])
        order = np.argsort(-scores)
        taken: list[NDArray[np.intp]] = []
        for i in order:
            if len(taken) == kept:
                break
            if all(_far(sets[i], other, len(coarse), least) for other in taken):
                taken.append(sets[i])
                found.append(Start(float(scores[i]), tuple(float(a) for a in angle[sets[i]])))
    return found


def _far(a: NDArray[np.intp], b: NDArray[np.intp], positions: int, least: int) -> bool:
    """One of the reflectors of a stands away from all of b."""
    gap = np.abs(a[:, None] - b)
    return bool((np.minimum(gap, positions - gap).min(axis=1) >= max(least // 2, 1)).any())


def _more(sets: NDArray[np.intp], positions: int, least: int) -> NDArray[np.intp]:
    """Sets (H, K) with one more, at least so far from the others; every one once."""
    every = np.arange(positions)
    gap = np.abs(every - sets[..., None])
    far = np.minimum(gap, positions - gap).min(axis=1) >= least
    which, new = np.nonzero(far)
    grown = np.sort(np.column_stack([sets[which], new]), axis=1)
    code = grown @ (positions ** np.arange(grown.shape[1]))
    return np.asarray(grown[np.unique(code, return_index=True)[1]])
