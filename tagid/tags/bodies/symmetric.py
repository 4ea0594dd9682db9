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
    return min(_refined(spectra, order, amplitudes, starts[i]) for i in chosen)


def _left(spectra: Spectra, order: int, amplitudes: int, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H,) energy left at places (H, 3) of centre x and y, m, and gamma, rad."""
    toward = spectra.antenna[None] - (places[:, 0] + 1j * places[:, 1])[:, None]
    rho, side = np.abs(toward), np.angle(toward) - places[:, 2:]
    waves = np.moveaxis(spectra.waves(rho) * (spectra.distance_m / rho) ** 2, 0, 1)
    shape = np.cos(order * np.arange(amplitudes)[:, None] * side[:, None])
    return solve(spectra.data, centred(waves[:, :, None] * shape[:, None])).left


def _refined(spectra: Spectra, order: int, amplitudes: int, start: NDArray[np.float64]) -> float:
    """Energy left after Newton's steps along each coordinate, and along the largest fall of all."""
    at, step = start.copy(), np.array([GRID_M / 2, GRID_M / 2, np.pi / order / TURNS])
    least = float(_left(spectra, order, amplitudes, at[None])[0])
    unit = np.eye(3)
    for _ in range(_ROUNDS):
        around = np.concatenate([at + unit * step, at - unit * step])
        ahead, behind = np.split(_left(spectra, order, amplitudes, around), 2)
        bend, slope = ahead + behind - 2 * least, (ahead - behind) / 2
        move = np.where(bend > 0, -slope / np.where(bend > 0, bend, 1.0), -np.sign(slope))
        trials = np.concatenate([around, (at + np.clip(move, -1, 1) * step)[None]])
        values = np.append(np.append(ahead, behind), _left(spectra, order, amplitudes, trials[-1:]))
        best = int(np.argmin(values))
        if values[best] < least:
            at, least = trials[best], float(values[best])
        step = np.maximum(step * 0.5, _STEPS)
    return least
