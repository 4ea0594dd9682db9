"""Where the strongest echo circles: the middle of a round body that stands off the rotation axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tagid.capture import Capture
from tagid.imaging.preprocess import remove_background
from tagid.signal import analytic, median, peak_place

_FEWEST = 8
"""Views that a circle, three numbers, needs."""
_KEPT_DEVIATIONS = 3.0
_ROUNDS = 5


@dataclass(frozen=True)
class Circling:
    """The circle of the strongest echo.

    Attributes:
        centre_m: (x, y) in the turntable's frame, m.
        spread_m: RMS of the ranges about those of the circle, m, in the views that follow it.
        share: of the views that follow it.
        faintest: amplitude of the strongest echo in its faintest views (10 %) over its median.
    """

    centre_m: tuple[float, float]
    spread_m: float
    share: float
    faintest: float

    @property
    def radius_m(self) -> float:
        """Distance of the centre from the axis, m."""
        return float(np.hypot(*self.centre_m))


def circling(capture: Capture) -> Circling | None:
    """The circle that the range of each view's strongest moving echo describes; None for too few views.

    The front of a round body of radius a about the point c is at |antenna - c| - a, to first order in c at
    D - a - c . u with the direction u of the antenna. Reflectors, handles and noise are the strongest in some
    views; these are left out in turns.

    Args:
        capture: of a turntable, with angles.
    """
    if capture.angles_rad is None or capture.views < _FEWEST:
        return None
    envelope = np.abs(analytic(remove_background(capture.samples, "mean")))
    ranges = capture.range_start_m + capture.range_step_m * np.array([peak_place(view) for view in envelope])
    angles = capture.angles_rad
    columns = np.stack([np.ones(len(angles)), -np.cos(angles), np.sin(angles)], axis=1)
    kept = np.ones(len(angles), dtype=bool)
    for _ in range(_ROUNDS):
        found = np.linalg.lstsq(columns[kept], ranges[kept], rcond=None)[0]
        off = np.abs(ranges - columns @ found)
        # A median absolute deviation is 0.67 standard deviations; a quarter of a bin is the least.
        usual = max(float(median(off)) / 0.67, capture.range_step_m / 4)
        again = off <= _KEPT_DEVIATIONS * usual
        if again.sum() < _FEWEST or np.array_equal(again, kept):
            break
        kept = again
    spread = float(np.sqrt(np.mean((ranges - columns @ found)[kept] ** 2)))
    amplitudes = envelope.max(axis=1)
    faintest = float(np.quantile(amplitudes, 0.1) / max(float(median(amplitudes)), 1e-30))
    return Circling((float(found[1]), float(found[2])), spread, float(kept.mean()), faintest)
