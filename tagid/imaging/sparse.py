"""Sparse recovery: the image of few points that explains the scans.

A tag is a handful of reflectors, so this is the serious rival of any learned method and stands beside it in
every comparison.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.types import BasebandScans, Image

Progress = Callable[[int, int], None]
"""Called with (iterations done, iterations at most)."""

_FIRST_SHARE = 0.3
"""Pixels whose |A^H y| exceeds this share of its maximum are tried first."""
_ACTIVE_SHARE = 0.5
"""With more than this share of the pixels active, all are taken: a smaller operator would save nothing."""
_ROUNDS = 5
_ROUGH_ITERATIONS = 20
"""Enough to see which pixels are missing, before the work is put in."""
_SLACK = 1.02
"""A left-out pixel may exceed the optimality bound |A^H (y - A x)| <= lambda by this, far under noise."""
_NORM_MARGIN = 1.1
"""Power iteration comes from below (6 % in 12 steps); FISTA needs a step no longer than 1 / norm."""


@dataclass(frozen=True)
class SparseSettings:
    """Parameters of `sparse_recovery`.

    Attributes:
        regularisation: weight of the l1 norm, relative to max |A^H y|, at which the image is blank.
        noise_factor: the weight is never less than this times the standard deviation of A^H noise (0 where
            the noise is not known), so that noise does not become points.
        iterations: at most.
        tolerance: stop when the image changes by less, relative to its norm.
    """

    regularisation: float = 0.1
    noise_factor: float = 3.0
    iterations: int = 150
    tolerance: float = 2e-3


def sparse_recovery(
    scans: BasebandScans,
    grid: ImageGrid,
    settings: SparseSettings | None = None,
    progress: Progress | None = None,
    operator: ForwardOperator | None = None,
) -> Image:
    """argmin_x 1/2 ||A x - y||^2 + lambda ||x||_1 by FISTA (Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009).

    The soft threshold is the complex one, x max(0, 1 - t / |x|); the momentum restarts when it points uphill
    (O'Donoghue and Candes, Found. Comput. Math. 15, 2015). The scans y are best without matched filter (the
    operator A holds the response); A is made unless it is given.
    """
    x, facts = sparse_amplitudes(scans, grid.points, settings, progress, operator)
    facts = {"method": "sparse", "axis_distance_m": scans.aperture.axis_distance, **facts}
    return Image(x.reshape(grid.pixels, grid.pixels), grid, facts)


def sparse_amplitudes(
    scans: BasebandScans,
    points: NDArray[np.float64],
    settings: SparseSettings | None = None,
    progress: Progress | None = None,
    operator: ForwardOperator | None = None,
    start: NDArray[np.complex64] | None = None,
) -> tuple[NDArray[np.complex64], dict[str, Any]]:
    """Amplitudes (n,) of points (n, 2) or (n, 3), m, and the facts of the fit; see `sparse_recovery`.

    The iterations begin at `start`, (n,), or at zero.
    """
    settings = settings or SparseSettings()
    operator = operator or ForwardOperator(scans, points)
    back = operator.adjoint(scans.samples)
    top = float(np.abs(back).max())
    facts: dict[str, Any] = {**asdict(settings), "debias": False}  # what was a setting once
    if top == 0:
        return np.zeros(len(points), dtype=np.complex64), {**facts, "iterations_done": 0}
    floor = settings.noise_factor * scans.noise_std * column_norm(scans)
    weight = min(max(settings.regularisation * top, floor), 0.95 * top)
    x, done = _by_active_set(scans, points, operator, back, weight, settings, progress, start)
    return x, {**facts, "lambda": weight, "iterations_done": done}


def column_norm(scans: BasebandScans) -> float:
    """Norm of one column of the operator, ||A e_p||: sqrt(views * sum_b |response(R_b)|^2), about the same
    for all points well inside the range gate."""
    response = scans.response
    energy = float((np.abs(response.samples) ** 2).sum()) * response.step_m / scans.range_step_m
    return float(np.sqrt(scans.aperture.views * energy))


def omp(
    scans: BasebandScans,
    grid: ImageGrid,
    points: int,
    stop: float = 0.0,
    operator: ForwardOperator | None = None,
) -> Image:
    """Orthogonal matching pursuit (Pati, Rezaiifar, Krishnaprasad, Asilomar 1993) on the grid's pixels.

    It ends with so many points, 1 to 1000, else UsageError, or when no correlation exceeds `stop` standard
    deviations of noise.
    """
    if not 1 <= points <= min(grid.pixels**2, scans.samples.size, 1000):
        raise UsageError(f"matching pursuit of {points} points", "Give between 1 and 1000.")
    operator = operator or ForwardOperator(scans, grid)
    y = scans.samples.ravel()
    residual, chosen = y.copy(), list[int]()
    columns = np.empty((y.size, points), dtype=np.complex64)
    amplitudes = np.zeros(0, dtype=np.complex64)
    least = stop * scans.noise_std * column_norm(scans)
    for k in range(points):
        correlation = np.abs(operator.adjoint(residual))
        correlation[chosen] = 0
        best = int(np.argmax(correlation))
        if correlation[best] <= least:
            break
        chosen.append(best)
        unit = np.zeros(operator.points, dtype=np.complex64)
        unit[best] = 1
        columns[:, k] = operator.forward(unit).ravel()
        amplitudes = np.linalg.lstsq(columns[:, : k + 1], y, rcond=None)[0].astype(np.complex64)
        residual = y - columns[:, : k + 1] @ amplitudes
    x = np.zeros(operator.points, dtype=np.complex64)
    x[chosen] = amplitudes
    facts = {"method": "omp", "axis_distance_m": scans.aperture.axis_distance, "points": len(chosen)}
    return Image(x.reshape(grid.pixels, grid.pixels), grid, facts)


def soft_threshold(x: NDArray[np.complexfloating], level: float) -> NDArray[np.complex64]:
    """x max(0, 1 - level / |x|), zero where x is zero."""
    magnitude = np.abs(x)
    gain = np.maximum(magnitude - np.float32(level), 0) / np.maximum(magnitude, np.float32(1e-30))
    return np.asarray(x * gain, dtype=np.complex64)


def _by_active_set(
    scans: BasebandScans,
    points: NDArray[np.float64],
    operator: ForwardOperator,
    back: NDArray[np.complex64],
    weight: float,
    settings: SparseSettings,
    progress: Progress | None,
    start: NDArray[np.complex64] | None,
) -> tuple[NDArray[np.complex64], int]:
    """min_x 1/2 ||A x - y||^2 + weight ||x||_1, with back = A^H y, on the pixels that may be non-zero.

    Those that break the optimality conditions join in rounds. The solution is that of all pixels: outside
    the support it needs |A^H (y - A x)| <= weight, which is checked. A tag's image is nearly empty, so the
    small operator costs a tenth.
    """
    strength = np.abs(back)
    active = strength > max(weight, _FIRST_SHARE * float(strength.max()))
    x = np.zeros_like(back) if start is None else start.astype(np.complex64)
    active |= x != 0
    done = 0
    budget = settings.iterations

    def solve(some: ForwardOperator, among: NDArray[np.bool_], limit: int) -> int:
        effort = replace(settings, iterations=max(1, min(limit, budget - done)))

        def report(count: int, _: int) -> None:
            if progress is not None:
                progress(min(done + count, budget), budget)

        x[among], count = _fista(some, back[among], weight, effort, report, x[among])
        return count

    for _ in range(_ROUNDS):
        if active.mean() > _ACTIVE_SHARE or not active.any():
            break
        some = ForwardOperator(scans, points[active])
        for limit in (_ROUGH_ITERATIONS, budget):
            done += solve(some, active, limit)
            slope = np.abs(back - operator.adjoint(some.forward(x[active])))
            missing = (slope > _SLACK * weight) & ~active
            if missing.any():
                break
        else:
            return x, done
        # What stayed zero goes again, so that the operator keeps the size of the image's support.
        active = (active & (x != 0)) | missing
    return x, done + solve(operator, np.ones_like(active), budget)


def _fista(
    operator: ForwardOperator,
    back: NDArray[np.complex64],
    weight: float,
    settings: SparseSettings,
    progress: Progress,
    start: NDArray[np.complex64],
) -> tuple[NDArray[np.complex64], int]:
    step = 1 / (_NORM_MARGIN * operator.norm_squared)
    x = start
    z, momentum = x, 1.0
    for done in range(1, settings.iterations + 1):
        gradient = operator.adjoint(operator.forward(z)) - back
        new = soft_threshold(z - np.float32(step) * gradient, step * weight)
        change = new - x
        if np.vdot(z - new, change).real > 0:
            momentum = 1.0
        after = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        z = new + np.float32((momentum - 1) / after) * change
        moved, size = float(np.linalg.norm(change)), float(np.linalg.norm(new))
        x, momentum = new, after
        progress(done, settings.iterations)
        if done > 5 and moved <= settings.tolerance * size:
            return x, done
    return x, settings.iterations
