"""Which layout a set of detected reflectors is: the likelihood over rotation and centre.

It reads positions, not scans, so it works on whatever found the reflectors (the network, local maxima, a
person), and shows what an image loses against the reading in the data (`tagid.tags.matching.matcher`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from tagid.tags.layouts.layout import Layout
from tagid.tags.network.detector import Detection


@dataclass(frozen=True)
class ConstellationSettings:
    """What the likelihood takes for granted.

    Attributes:
        detection: probability that a reflector which is there is detected.
        area_m2: where false detections and unknown reflectors may lie.
        placement_m: standard deviation of a reflector's place on its object.
        centre_m: standard deviation of each coordinate of the object's centre.
        unknown: prior of an object with reflectors of no enrolled layout, over that of any one layout.
        margin: log likelihood ratio over the runner-up below which the answer is ambiguous.
    """

    detection: float = 0.9
    area_m2: float = 0.07
    placement_m: float = 2e-3
    centre_m: float = 8e-3
    unknown: float = 0.05
    margin: float = 3.0


@dataclass(frozen=True)
class Match:
    """The best place of one layout.

    Attributes:
        layout: which.
        log_ratio: log likelihood over that of no reflectors at all.
        rotation_rad, centre_m: where.
        pairs: (detection, reflector of the layout) indexes.
    """

    layout: Layout
    log_ratio: float
    rotation_rad: float
    centre_m: tuple[float, float]
    pairs: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class ConstellationReading:
    """The answer: "identified", "unknown", "ambiguous" or "no_tag", and every layout's match, best first."""

    status: str
    matches: tuple[Match, ...]

    @property
    def layout(self) -> str | None:
        """Name of the layout where identified."""
        return self.matches[0].layout.name if self.status == "identified" else None


def _logit(p: float) -> float:
    q = min(max(p, 1e-6), 1 - 1e-6)
    return float(np.log(q / (1 - q)))


def read_constellation(
    detections: Sequence[Detection], layouts: Sequence[Layout], settings: ConstellationSettings | None = None
) -> ConstellationReading:
    """Name the layout that the detections show.

    With p_i the detections' probabilities, a layout placed somewhere has over "all are false" the log ratio
    sum_pairs [logit p_i + log(P_d A N(d_i; position, sigma_i^2))] + missing log(1 - P_d), averaged over turns
    and centres and counted once for each turn that maps the layout onto itself; "unknown" has
    sum max(0, logit p_i) with no position to answer for, and its prior.

    Args:
        detections: of one image.
        layouts: enrolled.
        settings: see there.
    """
    s = settings or ConstellationSettings()
    found = [d for d in detections if d.probability > 0.02]
    matches = sorted((best_match(found, layout, s) for layout in layouts), key=lambda m: -m.log_ratio)
    unknown = sum(max(0.0, _logit(d.probability)) for d in found) + np.log(s.unknown)
    best = matches[0].log_ratio if matches else -np.inf
    second = matches[1].log_ratio if len(matches) > 1 else -np.inf
    if max(best, unknown) <= 0:
        status = "no_tag"
    elif best < unknown:
        status = "unknown"
    elif best - max(second, unknown, 0.0) < s.margin:
        status = "ambiguous"
    else:
        status = "identified"
    return ConstellationReading(status, tuple(matches))


def best_match(found: Sequence[Detection], layout: Layout, s: ConstellationSettings) -> Match:
    """The likeliest place of a layout among detections.

    Every pair of detections taken for every pair of reflectors gives one rotation and centre to try, every
    single one a turn of the layout about the axis; the best is refined by a weighted rigid fit.
    """
    points = layout.positions[:, :2]
    none = Match(layout, layout.size * float(np.log(1 - s.detection)), 0.0, (0.0, 0.0), ())
    if not found:
        return none
    at = np.array([[d.x_m, d.y_m] for d in found])
    sigma = np.hypot([d.sigma_m for d in found], s.placement_m)
    weight = np.array([_logit(d.probability) for d in found])
    best = none
    for angle, centre in _trials(at, points, s):
        for _ in range(2):
            placed = _placed(points, angle, centre)
            ratio, pairs = _log_ratio(at, sigma, weight, placed, centre, s)
            ratio += np.log(layout.symmetry)
            if ratio > best.log_ratio:
                place = (float(centre[0]), float(centre[1]))
                best = Match(layout, ratio, angle, place, pairs)
            if len(pairs) < 2:
                break
            i, j = (np.array(side) for side in zip(*pairs, strict=True))
            angle, centre = _rigid_fit(points[j], at[i], sigma[i], s.centre_m)
    return best


def _placed(points: NDArray[np.float64], angle: float, centre: NDArray[np.float64]) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]) + centre)


def _trials(
    at: NDArray[np.float64], points: NDArray[np.float64], s: ConstellationSettings
) -> list[tuple[float, NDArray[np.float64]]]:
    """(rotation, centre) worth trying: plausible centres and lengths that agree."""
    p, q = at @ np.array([1, 1j]), points @ np.array([1, 1j])
    trials = []
    for k in range(len(q)):
        for i in range(len(p)):
            if abs(q[k]) > 1e-9:
                trials.append((float(np.angle(p[i] / q[k])), np.zeros(2)))
            for m in range(len(q)):
                for j in range(len(p)):
                    if m == k or j == i or abs(abs(q[m] - q[k]) - abs(p[j] - p[i])) > 0.015:
                        continue
                    turn = np.angle((p[j] - p[i]) / (q[m] - q[k]))
                    centre = (p[i] + p[j]) / 2 - np.exp(1j * turn) * (q[k] + q[m]) / 2
                    if abs(centre) < 4 * s.centre_m:
                        trials.append((float(turn), np.array([centre.real, centre.imag])))
    return trials


def _log_ratio(
    at: NDArray[np.float64],
    sigma: NDArray[np.float64],
    weight: NDArray[np.float64],
    placed: NDArray[np.float64],
    centre: NDArray[np.float64],
    s: ConstellationSettings,
) -> tuple[float, tuple[tuple[int, int], ...]]:
    """The log ratio of one place, with the pairing that makes it largest."""
    squared = ((at[:, None] - placed[None]) ** 2).sum(axis=2)
    density = -squared / (2 * sigma[:, None] ** 2) - np.log(2 * np.pi * sigma[:, None] ** 2)
    miss = np.log(1 - s.detection)
    gain = weight[:, None] + np.log(s.detection * s.area_m2) + density - miss
    rows, columns = linear_sum_assignment(-np.maximum(gain, 0))
    pairs = tuple((int(i), int(k)) for i, k in zip(rows, columns, strict=True) if gain[i, k] > 0)
    off = float(centre @ centre) / (2 * s.centre_m**2)
    narrow = _narrowness(placed - centre, sigma, pairs, s)
    return sum(float(gain[i, k]) for i, k in pairs) + len(placed) * miss - off + narrow, pairs


def _narrowness(
    points: NDArray[np.float64],
    sigma: NDArray[np.float64],
    pairs: tuple[tuple[int, int], ...],
    s: ConstellationSettings,
) -> float:
    """Log share of all turns and centres that fits the pairs (Laplace's approximation).

    The likelihood is averaged over where the layout may lie, not taken at its best: one detection fits every
    layout at some turn and proves none.
    """
    if not pairs:
        return 0.0
    weight = np.array([1 / sigma[i] ** 2 for i, _ in pairs])
    lever = float((weight * np.array([points[k] @ points[k] for _, k in pairs])).sum())
    turn = min(1.0, np.sqrt(2 * np.pi / max(lever, 1e-12)) / (2 * np.pi))
    return float(np.log(turn) - np.log1p(weight.sum() * s.centre_m**2))


def _rigid_fit(
    source: NDArray[np.float64], target: NDArray[np.float64], sigma: NDArray[np.float64], centre_m: float
) -> tuple[float, NDArray[np.float64]]:
    """Rotation and centre that bring points (n, 2) onto others (W. Kabsch, 1976), drawn to zero."""
    weight = 1 / sigma**2
    a, b = source @ np.array([1, 1j]), target @ np.array([1, 1j])
    mean_a, mean_b = (weight * a).sum() / weight.sum(), (weight * b).sum() / weight.sum()
    angle = float(np.angle(np.sum(weight * np.conj(a - mean_a) * (b - mean_b))))
    shift = (mean_b - np.exp(1j * angle) * mean_a) * weight.sum() / (weight.sum() + 1 / centre_m**2)
    return angle, np.array([shift.real, shift.imag])
