"""Alternative explanations of the echo: any number of free points, compared with the best layout's fit.

An enrolled layout is one of all arrangements that an unenrolled tag may have. The likelihood ratio of the
two, each averaged over its possible positions, measures how strongly the scans prefer the layout.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.tags.layouts.layout import MIN_SPACING_M
from tagid.tags.reading.aspect import TRANSPARENT
from tagid.tags.reading.field import MatchedField
from tagid.tags.reading.hypotheses import (
    ALIKE,
    ELEVATION_RANGE_M,
    Fit,
    SearchSettings,
    visible_sizes,
)
from tagid.tags.reading.reflectors import (
    FinderSettings,
    SearchDisc,
    clean_steps,
    distances_between,
    refine_positions,
)
from tagid.tags.reading.uneven import UnevenFit


@dataclass(frozen=True)
class Rivals:
    """Energies over noise, and the layout's reflectors when fitted freely.

    Attributes:
        further_nats: energy that one more point than the layout has, all free, explains beyond the layout
            with reflectors of uneven amplitude.
        gain_nats: the same beyond the layout with reflectors of constant amplitude, if that fit is the
            likelier.
        odds_nats: log likelihood ratio of the layout, even or uneven, over the best number of free points,
            each averaged over its positions and amplitudes (Laplace's approximation).
        displacement_m: RMS distance of the freely fitted reflectors from the layout's positions.
        uneven_nats: log likelihood ratio of the layout with reflectors of uneven amplitude over that with
            constant ones, its freedom charged.
        sizes: (K,) magnitudes of the layout's reflectors, from the uneven fit.
        outward: see `Evidence`.
        positions: (K, 2) freely fitted positions of the layout's reflectors, m; (K, 3) where heights show.
    """

    gain_nats: float
    further_nats: float
    odds_nats: float
    displacement_m: float
    uneven_nats: float
    sizes: NDArray[np.float64]
    outward: float
    positions: NDArray[np.float64]


def rivals(disc: SearchDisc, best: Fit, noise: float, search: SearchSettings) -> Rivals:
    """Fits of up to one more free point than the layout has reflectors.

    Points are searched in two ways: starting at the layout's positions plus the strongest other peak, and
    starting from none.

    Args:
        disc: search area, with the aspect of the layout's own reflectors.
        best: the best layout's fit.
        noise: variance of b / ||s|| from noise alone.
        search: settings of the layout search, for the range of its centre.
    """
    matched, size = disc.field, best.layout.size
    uneven = UnevenFit.of(matched, best, noise)
    gap = distances_between(disc.points[:, None], best.points[None], matched.height_scale).min(axis=1)
    apart = gap > MIN_SPACING_M
    energy, moved = _free_energies(disc, best, apart)
    further = _further(disc, apart, uneven)
    if not best.aspect.uniform:
        # Another object need not be opaque too, nor have its axis at the layout's centre.
        plain = replace(disc.look, aspect=TRANSPARENT)
        clear = SearchDisc(matched, disc.radius_m, disc.step_m, plain, disc.heights_m)
        energy = np.maximum(energy, _free_energies(clear, best, apart)[0])
        further = max(further, _further(clear, apart, uneven))
    each = max(best.explained / noise / size, 1.0)
    free = energy / noise - np.arange(1, size + 2) * _point_cost(matched, disc, each)
    even, less = best.explained / noise, uneven.explained / noise
    beyond = max(further, float(energy[size] - max(uneven.explained, best.explained))) / noise
    less_charged = less - uneven.cost_nats - float(np.log(matched.independent_samples))
    own = max(even, less_charged) - _layout_cost(matched, best, each, search)
    return Rivals(
        gain_nats=float(energy[size]) / noise - even if even >= less_charged else beyond,
        further_nats=beyond,
        odds_nats=float(own - free.max()),
        displacement_m=rigid_distance(moved, best.points, matched.height_scale),
        uneven_nats=float(less_charged - even),
        sizes=visible_sizes(uneven.sizes.astype(np.complex128), best.visibility),
        outward=uneven.outward,
        positions=moved,
    )


def _further(disc: SearchDisc, apart: NDArray[np.bool_], uneven: UnevenFit) -> float:
    """Largest energy that one more point, `apart` (pixels,) from the layout's, explains beyond the fit."""
    return float(np.where(apart, uneven.gains(disc.field, disc.fixed), 0.0).max())


def _free_energies(
    disc: SearchDisc, best: Fit, apart: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(K + 1,) energies that 1 to K + 1 free points explain, and the freely fitted positions (K, 2 or 3).

    The point beyond the layout's begins at a pixel that is `apart` (pixels,) from them.
    """
    matched, size = disc.field, best.layout.size
    amplitudes, _ = disc.fitted(best.points)
    power = disc.left(best.points, amplitudes)
    peak = disc.points[int(np.argmax(np.where(apart, power, 0.0)))]
    moved, _, freed = refine_positions(matched, best.points, disc.look)
    more = refine_positions(matched, np.concatenate([best.points, peak[None]]), disc.look)[2]
    only = FinderSettings(maximum=size + 1, floor_db=-30.0, detection_nats=0.0)
    energy = np.zeros(size + 1)
    for count, step in enumerate(clean_steps(disc, only)):
        energy[count:] = step
    energy[size - 1] = max(energy[size - 1], freed)
    energy[size] = max(energy[size], more)
    return energy, moved


def _place_variance(matched: MatchedField, each: float) -> float:
    """Variance, m^2, of one coordinate of a point with e = `each` nats over a full turn: 1 / (4 k^2 e)."""
    return 1 / (4 * matched.wavenumber**2 * each)


def _amplitude_cost(each: float) -> float:
    """Nats: prior of an amplitude with any phase and a size known to within ALIKE, over its error."""
    return float(np.log1p(2 * np.sqrt(2 * np.pi) * ALIKE * each))


def _point_cost(matched: MatchedField, disc: SearchDisc, each: float) -> float:
    """Nats: the disc's area over that of a point's error, plus the cost of its amplitude.

    With several antenna heights also the range of heights over the error of a height.
    """
    levels = 1 if disc.heights_m is None else len(disc.heights_m)
    area = len(disc.points) / levels * disc.step_m**2
    place = np.log1p(area / (2 * np.pi * _place_variance(matched, each)))
    rise = 0.0 if disc.heights_m is None else float(np.ptp(disc.heights_m))
    return float(place) + _height_cost(matched, rise, each) + _amplitude_cost(each)


def _height_cost(matched: MatchedField, range_m: float, each: float) -> float:
    """Nats: a range of heights over the error of a height measured with `each` nats."""
    variance = _place_variance(matched, each) * matched.height_scale**2
    return float(np.log1p(range_m / np.sqrt(2 * np.pi * variance)))


def _layout_cost(matched: MatchedField, best: Fit, each: float, search: SearchSettings) -> float:
    """Nats: the ranges of rotation, centre and elevation over their errors, plus that of the amplitudes."""
    variance = _place_variance(matched, each)
    lever = float(np.sum(best.layout.positions**2))
    turn = np.log1p(2 * np.pi / best.layout.symmetry / np.sqrt(2 * np.pi * variance / lever))
    area = np.pi * search.centre_range_m**2
    centre = np.log1p(area / (2 * np.pi * variance / best.layout.size))
    rise = 2 * ELEVATION_RANGE_M if matched.several_heights else 0.0
    elevation = _height_cost(matched, rise, each * best.layout.size)
    return float(turn + centre) + elevation + best.layout.size * _amplitude_cost(each)


def rigid_distance(a: NDArray[np.float64], b: NDArray[np.float64], height_scale: float = 1.0) -> float:
    """RMS distance, m, of points (K, 2), paired in order, after the best rotation and shift (Kabsch 1976).

    Heights of points (K, 3) are compared after the best common shift, and count 1 / `height_scale`.
    """
    a = a - a.mean(axis=0)
    b = b - b.mean(axis=0)
    turn = np.angle(np.sum((a[:, 0] + 1j * a[:, 1]).conj() * (b[:, 0] + 1j * b[:, 1])))
    turned = (a[:, 0] + 1j * a[:, 1]) * np.exp(1j * turn)
    square = np.abs(turned - (b[:, 0] + 1j * b[:, 1])) ** 2
    if a.shape[1] == 3:
        square = square + ((a[:, 2] - b[:, 2]) / height_scale) ** 2
    return float(np.sqrt(np.mean(square)))
