"""A body without reflectors that is not round, but has planes of symmetry: an oval wall, a box, a shell.

Per frequency f and view v, with the room subtracted from data and columns alike,

    Y = sum_p A_p cos(n p (phi_v - gamma)) exp(-j kappa (rho_v - d)) (d / rho_v)^2,  p < P,

phi_v and rho_v the direction and the distance of the antenna from the body's centre, n the order of its
symmetry and gamma the direction of one plane. A pair of opposite reflectors has the two planes of symmetry of
an oval body, and a pattern of many terms makes it explain any of them: of a helmet shell, 78 x 101 mm, it
leaves 0.1 %. P = 4, as many amplitudes as a round body and a pattern of three terms have, leaves 0.5 % of
the shell, but 5 % or more of tags on cans and cups: their reflectors stand further from the centre than the
distance of such a wall varies.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tagid.tags.bodies.compiled import walls_left
from tagid.tags.bodies.reflectors_fit import solve
from tagid.tags.bodies.spectra import Spectra, centred

MOST = 4
"""Largest P."""
REACH_M, GRID_M = 0.0145, 3.5e-3
TURNS = 12
_STARTS, _ROUNDS = 3, 8
_STEPS = np.array([2e-4, 2e-4, 4e-3])


def symmetric_left(
    spectra: Spectra, order: int, amplitudes: int = MOST, hints: tuple[complex, ...] = ()
) -> float:
    """Energy that the best body of that symmetry leaves.

    Args:
        spectra: the scans.
        order: n, 2 or more: n planes of symmetry, and the same after each n-th of a turn.
        amplitudes: P, amplitudes per frequency.
        hints: further centres to try, x + jy, m.
    """
    count = int(REACH_M / GRID_M)
    line = np.arange(-count, count + 1) * GRID_M
    grid = (line[:, None] + 1j * line[None]).ravel()
    grid = np.append(grid[np.abs(grid) <= REACH_M], np.asarray(hints, dtype=np.complex128))
    turns = np.arange(TURNS) * np.pi / order / TURNS
    starts = np.stack([np.repeat(grid.real, TURNS), np.repeat(grid.imag, TURNS)], axis=1)
    starts = np.column_stack([starts, np.tile(turns, len(grid))])
    left = _left(spectra.thinned(4), order, amplitudes, starts)
    chosen: list[int] = []
    for i in np.argsort(left):
        if all(np.hypot(*(starts[i] - starts[j])[:2]) > GRID_M / 2 for j in chosen):
            chosen.append(int(i))
        if len(chosen) == _STARTS:
            break
    return _refined(spectra, order, amplitudes, starts[chosen])


def _left(spectra: Spectra, order: int, amplitudes: int, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H,) energy left at places (H, 3) of centre x and y, m, and gamma, rad."""
    fast = walls_left(spectra.tables, places, order, amplitudes)
    if fast is not None:
        return fast
    toward = spectra.antenna[None] - (places[:, 0] + 1j * places[:, 1])[:, None]
    rho, side = np.abs(toward), np.angle(toward) - places[:, 2:]
    waves = np.moveaxis(spectra.waves(rho) * (spectra.distance_m / rho) ** 2, 0, 1)
    shape = np.cos(order * np.arange(amplitudes)[:, None] * side[:, None])
    return solve(spectra.data, centred(waves[:, :, None] * shape[:, None])).left


def _refined(spectra: Spectra, order: int, amplitudes: int, starts: NDArray[np.float64]) -> float:
    """Least energy left after Newton's steps from all starts (S, 3) at once.

    Each goes along every coordinate, and along the largest fall of all, and takes the best of these.
    """
    at, step = starts.copy(), np.array([GRID_M / 2, GRID_M / 2, np.pi / order / TURNS])
    rows = np.arange(len(at))
    least = _left(spectra, order, amplitudes, at)
    unit = np.concatenate([np.eye(3), -np.eye(3)])
    for _ in range(_ROUNDS):
        around = at[:, None] + unit * step
        values = _left(spectra, order, amplitudes, around.reshape(-1, 3)).reshape(len(at), 6)
        ahead, behind = values[:, :3], values[:, 3:]
        bend, slope = ahead + behind - 2 * least[:, None], (ahead - behind) / 2
        move = np.where(bend > 0, -slope / np.where(bend > 0, bend, 1.0), -np.sign(slope))
        joint = at + np.clip(move, -1, 1) * step
        trials = np.concatenate([around, joint[:, None]], axis=1)
        values = np.column_stack([values, _left(spectra, order, amplitudes, joint)])
        best = values.argmin(axis=1)
        lower = values[rows, best] < least
        at = np.where(lower[:, None], trials[rows, best], at)
        least = np.where(lower, values[rows, best], least)
        step = np.maximum(step * 0.5, _STEPS)
    return float(least.min())
