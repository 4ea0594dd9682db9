"""Where reflectors may stand: log evidences of arrangements on rings, from tables of single reflectors.

On an even turn a reflector at another angle is the same column, shifted by views: inner products depend on
the difference of the angles, and a Fourier transform gives them all; on other turns columns are made for all
angles. About another centre the recording moves, which moves the phase of every view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from tagid.loops import loop
from tagid.reading.columns import Model, nearest_ring, table_of
from tagid.reading.descent import Powers
from tagid.reading.spectra import Spectra
from tagid.reading.transfers.transfer import ANGLES, Transfer
from tagid.types import Complex, Floats
from tagid.workers import check_wanted

_sets = loop("tagid.reading._sets")

STEP_RAD, COARSE_RAD = np.deg2rad(5.0), np.deg2rad(6.0)
"""Turns of the tables are no farther apart, and starts of free reflectors."""
COARSE = 2
"""Every so many-th angle of a fine table is a start for free reflectors."""
GROWN = 24
"""Best sets to which a further reflector is added."""
UNIT = 8
"""Frequencies of a vector of the compiled loop; what is left over of full vectors is left out."""
ROOM = 1e3
"""Amplitude of a room's echo, of which nothing is left then."""

Parts = NDArray[np.float32]

Group = tuple[tuple[float, float, float], ...]
"""Radius, m, angle, rad, and height, m, of reflectors that turn together."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """Columns of groups of reflectors, whitened.

    Real and imaginary parts of tables are apart, in single precision, and the frequencies last, filled up to
    F, a multiple of 8.

    Attributes:
        columns: (F, B, P, M) of every block.
        shifts: V of an even turn, by which the turns of a block are apart in Fourier vectors; otherwise 1.
        count: of blocks of a group.
    """

    columns: Complex
    shifts: int
    count: int

    @cached_property
    def by_group(self) -> list[Blocks]:
        """Those of every group alone."""
        parts = np.split(self.columns, self.columns.shape[1] // self.count, axis=1)
        return [Blocks(part, self.shifts, self.count) for part in parts]

    @cached_property
    def planes(self) -> Parts:
        """(B, P, M, 2, F) of the columns."""
        return _apart(self.columns)

    def against(self, vectors: Complex) -> Parts:
        """(C, B V, P, J, 2, F) inner products of vectors (F, C, J, M) with all turns of the blocks."""
        f, b, p, m = self.columns.shape
        if self.shifts == 1:
            single = vectors.astype(np.complex64)
            product = self.columns[:, None] @ np.swapaxes(single.conj(), 2, 3)[:, :, None]
            return _apart(product)
        shape = (vectors.shape[1], b * m, p, vectors.shape[2], 2, _lanes(f))
        if _sets is None:
            # <q, w shifted by n> = sum over m of conj(q) w exp(-2 pi j m n / V).
            product = self.columns[:, None, :, :, None] * vectors.conj()[:, :, None, None]
            return _apart(np.moveaxis(np.fft.fft(product, axis=-1), 5, 3)).reshape(shape)
        out = np.empty(shape, dtype=np.float32)
        _sets.against(self.planes, _apart(vectors), _turn(m), out, shape[-1], b, p, shape[0], shape[3])
        return out

    @cached_property
    def pair(self) -> Parts:
        """(B, B, V, T, 2, F), see `_sets.c`."""
        w = self.columns
        f, b, p, m = w.shape
        row, column = np.tril_indices(p)
        out = np.zeros((b, b, self.shifts, len(row), 2, _lanes(f)), dtype=np.float32)
        if self.shifts > 1 and _sets is not None:
            _sets.pairs(self.planes, _turn(m), out, out.shape[-1], b, p)
        elif self.shifts > 1:
            first, second = w[:, :, row].conj(), w[:, :, column]
            back = -np.arange(m) % m
            # a with b turned by n views, and b with a: the second is the transform of what is reversed.
            product = first[:, :, None] * second[:, None]
            product += second[:, :, None][..., back] * first[:, None][..., back]
            out = _apart(np.moveaxis(np.fft.fft(product, axis=-1), 4, 3))
        else:
            for t, (i, j) in enumerate(zip(row, column, strict=True)):
                if i == j:
                    real = np.concatenate([w[:, :, i].real, w[:, :, i].imag], axis=2)
                    out[:, :, 0, t, 0, :f] = np.moveaxis(2 * real @ np.swapaxes(real, 1, 2), 0, -1)
                    continue
                product = w[:, :, i].conj() @ np.swapaxes(w[:, :, j], 1, 2)
                out[:, :, 0, t, :, :f] = _apart(product + np.swapaxes(product, 1, 2))[..., :f]
        return out

    @cached_property
    def gram(self) -> Parts:
        """(B, T, 2, F), see `_sets.c`."""
        row, column = np.tril_indices(self.columns.shape[2])
        return _apart((self.columns.conj() @ np.swapaxes(self.columns, 2, 3))[:, :, row, column])

    def below(self, sets: NDArray[np.int32]) -> Complex:
        """(H, F, T) inner products of sets of reflectors."""
        v = self.shifts
        block, shift = sets // v, sets % v
        below = _joined(self.gram[block].sum(axis=1))
        for a, c in combinations(range(sets.shape[1]), 2):
            below = below + _joined(self.pair[block[:, a], block[:, c], (shift[:, c] - shift[:, a]) % v])
        return below


@dataclass(frozen=True, eq=False)
class Choice:
    """Places from which sets of reflectors are chosen.

    Attributes:
        ids: (N,) their indices in the tables.
        clear: (N, N) places in both of which a reflector may stand.
        unlike: (N, N) places so far apart that sets which differ in them alone are two.
    """

    ids: NDArray[np.int32]
    clear: NDArray[np.bool_]
    unlike: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Tables:
    """Inner products of the columns of groups of reflectors about a centre, whitened, without room and body.

    Attributes:
        blocks: the columns.
        right: (B V, P, 2, F), held: (B V, P, J, 2, F), with the data, and with what is held out.
        power: (P, F) prior variances.
        base: log evidence without reflectors, up to what all centres share, nats.
        angles: turns of every group, `step_rad` apart.
        share: of the frequencies that the tables hold.
        pairs: log evidences (N, N) of all pairs of N places, once they are known.
    """

    blocks: Blocks
    right: Parts
    held: Parts
    power: Parts
    base: float
    angles: int
    step_rad: float
    share: float = 1.0
    pairs: list[Floats] = field(default_factory=list)

    def every(self, step: int = 1) -> NDArray[np.int32]:
        """(G, angles) indices of all turns of the groups, or of every so many-th."""
        i, shifts, count = np.arange(0, self.angles, step), self.blocks.shifts, self.blocks.count
        group = np.arange(self.blocks.columns.shape[1] // count)[:, None]
        return np.asarray((group * count + i % count) * shifts + i // count, dtype=np.int32)

    @property
    def by_group(self) -> list[Tables]:
        """Those of every group alone."""
        blocks = self.blocks.by_group
        right, held = np.split(self.right, len(blocks)), np.split(self.held, len(blocks))
        return [
            replace(self, blocks=b, right=r, held=h, pairs=[])
            for b, r, h in zip(blocks, right, held, strict=True)
        ]

    def scores(self, sets: NDArray[np.int32]) -> Floats:
        """(H,) log evidences of sets (H, K) of indices."""
        if not len(sets):
            return np.zeros(0)
        chosen = np.ascontiguousarray(sets, dtype=np.int32)
        if _sets is None:
            return self._whole(self._scored(chosen, self.blocks.below(chosen)))
        out = np.empty(len(sets))
        _sets.scores(*self._parts(chosen.shape[1]), chosen, out, *self._sizes, *chosen.shape)
        return self._whole(out)

    def _whole(self, gain: Floats) -> Floats:
        """Log evidences: the frequencies that are left out are supposed to tell as much as the others."""
        return np.asarray(self.base + gain / self.share)

    def _parts(self, members: int) -> tuple[Parts, ...]:
        """What the compiled loop takes for sets of so many."""
        pair = self.blocks.pair if members > 1 else np.zeros(0, dtype=np.float32)
        return self.blocks.gram, pair, self.held, self.right, self.power

    @property
    def _sizes(self) -> tuple[int, ...]:
        p, j, _, f = self.held.shape[1:]
        return f, self.blocks.columns.shape[1], self.blocks.shifts, p, j

    def grown(self, choice: Choice, most: int, kept: int) -> list[tuple[float, NDArray[np.intp]]]:
        """The best sets of one to `most` reflectors, 5 or fewer, grown one by one; `kept` of every number.

        Returns:
            Log evidences, and positions (K,) among the places of the choice.
        """
        if _sets is None:
            return self._grown(choice, most, kept)
        known = bool(self.pairs)
        pairs = self.pairs[0] if known else np.empty(choice.clear.shape)
        best, chosen = np.full((most, kept), -np.inf), np.zeros((most, kept, most), dtype=np.int32)
        before = *self._parts(most), choice.ids, choice.clear, choice.unlike, pairs, best, chosen
        _sets.grow(*before, *self._sizes, most, kept, GROWN, known)
        if most > 1:
            self.pairs[:] = [pairs]
        logs = self._whole(best)
        return [
            (float(logs[k, i]), chosen[k, i, : k + 1].astype(np.intp))
            for k in range(most)
            for i in range(kept)
            if best[k, i] > -np.inf
        ]

    def _grown(self, choice: Choice, most: int, kept: int) -> list[tuple[float, NDArray[np.intp]]]:
        """The same with numpy."""
        ids, clear, unlike = choice.ids, choice.clear, choice.unlike
        best: list[tuple[float, NDArray[np.intp]]] = []
        sets, order = np.arange(len(ids))[:, None], np.zeros(0, dtype=np.intp)
        for number in range(1, most + 1):
            if number == 2:
                sets = np.argwhere(np.triu(clear, 1))
            elif number > 2:
                sets = _more(sets[order[:GROWN]], clear)
            if not len(sets):
                break
            scores = self.scores(ids[sets])
            unlike_sets = order = np.argsort(-scores, kind="stable")
            for _ in range(kept):
                if not len(unlike_sets):
                    break
                best.append((float(scores[unlike_sets[0]]), sets[unlike_sets[0]]))
                if kept > 1:
                    unlike_sets = unlike_sets[
                        unlike[sets[unlike_sets][:, :, None], sets[unlike_sets[0]]].all(axis=2).any(axis=1)
                    ]
        return best

    def _scored(self, sets: NDArray[np.int32], below: Complex) -> Floats:
        """The same with numpy, from inner products of the sets (H, F, T)."""
        p = len(self.power)
        right = _joined(self.right[sets].sum(axis=1))
        held = _joined(self.held[sets].sum(axis=1))
        row, column = np.tril_indices(p)
        matrix = np.zeros((*below.shape[:-1], p, p), dtype=np.complex128)
        matrix[..., row, column] = below
        matrix[..., column, row] = below.conj()
        matrix = matrix - held.conj() @ np.swapaxes(held, 2, 3)
        matrix[..., np.arange(p), np.arange(p)] += 1 / self.power.T
        factor = np.linalg.cholesky(matrix)
        half = np.linalg.solve(factor, right[..., None])[..., 0]
        diagonal = np.einsum("hfpp->hfp", factor).real
        gain = (np.abs(half) ** 2).sum(axis=(1, 2)) - 2 * np.log(diagonal).sum(axis=(1, 2))
        return np.asarray(gain - np.log(self.power).sum())


@lru_cache(maxsize=4)
def _turn(views: int) -> NDArray[np.complex64]:
    return np.asarray(np.exp(-2j * np.pi * np.arange(views) / views), dtype=np.complex64)


def held_in(frequencies: int) -> int:
    """How many of the frequencies the tables hold: full vectors, if there is one."""
    return frequencies // UNIT * UNIT or frequencies


def _lanes(frequencies: int) -> int:
    return -(-frequencies // UNIT) * UNIT


def _apart(values: Complex) -> Parts:
    """(.., 2, F) parts of values (F, ..), with zeros up to full vectors."""
    f = len(values)
    out = np.zeros((*values.shape[1:], 2, _lanes(f)), dtype=np.float32)
    last = np.moveaxis(values, 0, -1)
    out[..., 0, :f], out[..., 1, :f] = last.real, last.imag
    return out


def _joined(parts: Parts) -> Complex:
    """Values (H, F, ..) of parts (H, .., 2, F)."""
    return np.asarray(np.moveaxis(parts[..., 0, :] + 1j * parts[..., 1, :], -1, 1))


def _filled(power: Floats) -> Parts:
    """(P, F) prior variances; of what the frequencies are filled up with, one."""
    out = np.ones((len(power), _lanes(power.shape[1])), dtype=np.float32)
    out[:, : power.shape[1]] = power
    return out


def tables(
    spectra: Spectra,
    model: Model,
    centres: Sequence[complex],
    groups: Sequence[Group],
    powers: Powers,
    bodies: Complex | None = None,
    step_rad: float = STEP_RAD,
) -> list[Tables]:
    """Tables of groups of reflectors of a model's transfer about every centre, x + jy, m.

    Args:
        model: transfer and disc are used.
        powers: of clutter and reflectors.
        bodies: (C, F, V) echo of the body beside them; None: a point in the centre, if there is one.
        step_rad: turns are no farther apart.
    """
    check_wanted()
    transfer, points, views = model.transfer, np.append(centres, 0), spectra.views
    blocks, root, step = _turning(spectra, transfer, model.disc, tuple(groups), powers.clutter, step_rad)
    waves, range_m = spectra.waves(points, np.zeros(len(points)))
    # (C, F, V) by which the recording moves, instead of the reflectors.
    moved = np.exp(1j * spectra.kappa[:, None] * (range_m[:-1] - range_m[-1])[:, None])
    seen = [ROOM * moved * room for room in spectra.rooms]
    if transfer.body:
        seen.append(moved * (np.moveaxis(waves[:, :-1], 1, 0) if bodies is None else bodies))
    every = np.stack([*seen, moved * spectra.data]).transpose(2, 0, 1, 3)
    white = spectra.whole[model.disc].apply(every.reshape(len(every), -1, views)) / root[:, None]
    *held_out, y = white.reshape(every.shape).transpose(1, 2, 0, 3)
    held, charge = _orthogonal(held_out, powers.body * spectra.moving)
    y, base = _cleared(y, held)
    variance = spectra.whiteners[model.disc].variance
    base -= float(np.log1p(powers.clutter * spectra.moving[:, None] * variance).sum())
    base -= charge if transfer.body else 0.0
    power = powers.tag * np.array(transfer.power)[:, None] * spectra.moving
    return about(blocks, y, np.stack(held, axis=2), power, base, step)


@lru_cache(maxsize=8)
def _turning(
    spectra: Spectra,
    transfer: Transfer,
    disc: int,
    groups: tuple[Group, ...],
    clutter: float,
    step_rad: float,
) -> tuple[Blocks, Floats, float]:
    """Groups at all turns about any centre, behind a root (F, V), and the step of the turns, rad."""
    views, whole = spectra.views, spectra.whole[disc]
    shifts = views if spectra.full_turn else 1
    fractions = int(np.ceil(2 * np.pi / shifts / step_rad - 1e-9))
    # An even turn goes from one view to the next.
    sense = np.sign(np.angle(spectra.antenna[1] / spectra.antenna[0])) if spectra.full_turn else 1
    step = float(sense * 2 * np.pi / (shifts * fractions))
    root = np.sqrt(1 + clutter * spectra.moving[:, None] * whole.variance)
    parts = [_columns(spectra, transfer, group, fractions, step) for group in groups]
    columns = np.concatenate(parts, axis=1)
    w = whole.apply(columns.reshape(len(columns), -1, views)) / root[:, None].astype(np.float32)
    return Blocks(w.reshape(columns.shape)[: held_in(len(w))], shifts, fractions), root, step


def _columns(
    spectra: Spectra, transfer: Transfer, group: Group, turns: int, step_rad: float
) -> NDArray[np.complex64]:
    """(F, T, P, V) of a group about the axis at so many turns."""
    parts = []
    for radius, angle, height in group:
        positions = radius * np.exp(1j * (angle + step_rad * np.arange(turns)))
        waves, _ = spectra.waves(positions, np.full(turns, height))
        parts.append(
            waves.astype(np.complex64)[:, :, None] * _seen(spectra, transfer, radius, angle, turns, step_rad)
        )
    return np.asarray(sum(parts[1:], parts[0]))


@lru_cache(maxsize=8)
def _seen(
    spectra: Spectra, transfer: Transfer, radius_m: float, angle: float, turns: int, step_rad: float
) -> NDArray[np.complex64]:
    """(F, T, P, V) patterns of a reflector at any height, at so many turns."""
    # The nearest angle of the table is near enough for a search.
    psi = spectra.direction - (angle + step_rad * np.arange(turns))[:, None]
    index = np.rint(psi * (ANGLES / (2 * np.pi))).astype(np.intp) % ANGLES
    table = table_of(transfer, spectra.kappa.tobytes(), nearest_ring(radius_m))
    return np.asarray(table.astype(np.complex64)[..., index].transpose(1, 2, 0, 3))


def about(
    blocks: Blocks, data: Complex, held: Complex, power: Floats, base: Floats, step_rad: float
) -> list[Tables]:
    """Tables about C centres, of data (C, F, M) and of what is held out (C, F, J, M); others as `Tables`."""
    some = len(blocks.columns)
    right, out = (
        blocks.against(np.swapaxes(vectors[:, :some], 0, 1)) for vectors in (data[:, :, None], held)
    )
    right = right[:, :, :, 0] * np.array([[1.0], [-1.0]], dtype=np.float32)
    angles, filled, share = blocks.shifts * blocks.count, _filled(power[:, :some]), some / power.shape[1]
    return [
        Tables(blocks, r, h, filled, float(b), angles, step_rad, share)
        for r, h, b in zip(right, out, base, strict=True)
    ]


def _orthogonal(vectors: Sequence[Complex], power: Floats) -> tuple[list[Complex], Floats]:
    """Vectors (C, F, M) made orthogonal, scaled so that y - q q^H y is y without each as far as its power is.

    Returns:
        The vectors, and the log determinant (C,) that the last of them adds.
    """
    out: list[Complex] = []
    strength = np.zeros((1, len(power), 1))
    units: list[Complex] = []
    for vector in vectors:
        rest = vector
        for unit in units:
            rest = rest - (unit.conj() * rest).sum(axis=2, keepdims=True) * unit
        size = (np.abs(rest) ** 2).sum(axis=2, keepdims=True)
        units.append(rest / np.sqrt(np.maximum(size, 1e-30)))
        strength = power[:, None] * size
        out.append(units[-1] * np.sqrt(strength / (1 + strength)))
    return out, np.asarray(np.log1p(strength).sum(axis=(1, 2)))


def _cleared(y: Complex, held_out: Sequence[Complex]) -> tuple[Complex, Floats]:
    """y (C, F, M) without what is held out, and -y^H C^-1 y (C,)."""
    rest = y
    for q in held_out:
        rest = rest - (q.conj() * y).sum(axis=2, keepdims=True) * q
    return rest, -(y.conj() * rest).sum(axis=(1, 2)).real


@dataclass(frozen=True)
class Start:
    """Angles of reflectors, rad, and the log evidence that the tables give them."""

    log: float
    angles: tuple[float, ...]


def turned(table: Tables, count: int) -> list[list[Start]]:
    """The best turns of every group: so many local maxima."""
    ids = table.every()
    scores = table.scores(ids.reshape(-1, 1)).reshape(ids.shape)
    peaks = (scores >= np.roll(scores, 1, axis=1)) & (scores >= np.roll(scores, -1, axis=1))
    scores = np.where(peaks, scores, -np.inf)
    best = np.argsort(-scores, axis=1)[:, :count]
    return [
        [Start(float(of_group[i]), (float(table.step_rad * i),)) for i in which if of_group[i] > -np.inf]
        for of_group, which in zip(scores, best, strict=True)
    ]


def free(table: Tables, apart_rad: float, most: int, kept: int) -> list[Start]:
    """The best sets of one to `most` of a table's reflectors, so far apart; `kept` of every number."""
    step = COARSE if table.angles >= 120 else 1
    (ids,) = table.every(step)
    angle = table.step_rad * step * np.arange(len(ids), dtype=np.float64)
    least = max(round(apart_rad / abs(angle[1] - angle[0])), 1)
    gap = np.abs(np.subtract.outer(np.arange(len(ids)), np.arange(len(ids))))
    gap = np.minimum(gap, len(ids) - gap)
    sets = table.grown(Choice(ids, gap >= least, gap >= max(least // 2, 1)), most, kept)
    return [Start(log, tuple(float(a) for a in angle[chosen])) for log, chosen in sets]


def _more(sets: NDArray[np.intp], clear: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Sets (H, K) with one more where it is clear of the others; every one once."""
    which, new = np.nonzero(clear[sets].all(axis=1))
    longer = np.sort(np.column_stack([sets[which], new]), axis=1)
    code = longer @ (len(clear) ** np.arange(longer.shape[1]))
    return np.asarray(longer[np.unique(code, return_index=True)[1]])
