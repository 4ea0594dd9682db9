"""A free-running turntable: it is not commanded, and its angle follows from time and period."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.angles.period import GOOD_QUALITY, NotRepeatingError, PeriodEstimate, find_period
from tagid.angles.views import Angles
from tagid.errors import DataError, UsageError
from tagid.metadata import ResolvedMotion
from tagid.motion.device import MotionStoppedError

OVERLAP_TURNS = 1.3
"""Turns to record: one, plus the overlap that gives the period to 0.1 % at 10 dB."""
AMBIGUOUS_TURNS = 2.3
"""Turns to record if the scans also repeat after a fraction of a turn."""
PARTIAL_TURNS = 8.0
"""Repetitions of lower quality to record: 1.3 turns of a tag of which a part repeats six times per turn."""
NOMINAL_SIGMA = 0.01
"""Relative standard deviation of a given speed that could not be checked against the data."""
MAX_SEARCH_SCANS = 2000
"""Maximum number of scans used by the running search; longer recordings are decimated."""


STILL_S = 12.0
"""Seconds without any change after which the table is considered stationary."""
_STILL_SIGMAS = 4.0
_BLOCKS = (1, 4, 16)


def nothing_changes(samples: NDArray[Any]) -> bool:
    """Whether scans differ by white noise only.

    Without motion, the variance of the means of k consecutive scans is 1/k of that of single scans, and half
    the mean square difference of neighbours equals that variance (J. von Neumann, "Distribution of the ratio
    of the mean square successive difference to the variance", 1941). Slow motion increases the variance of
    the means; averaging detects it down to about 0 dB per sample within 12 s.

    Args:
        samples: (scans, bins), real.
    """
    scans = np.asarray(samples, dtype=np.float64)
    noise = 0.5 * (np.diff(scans, axis=0) ** 2).mean(axis=0)
    noisy = noise > 0
    if not noisy.any():
        return not scans.var(axis=0).any()
    scaled = scans[:, noisy] / np.sqrt(noise[noisy])
    for k in _BLOCKS:
        blocks = len(scaled) // k
        if blocks < 4:
            break
        means = scaled[: blocks * k].reshape(blocks, k, -1).mean(axis=1)
        excess = k * means.var(axis=0, ddof=1) - 1
        # Standard deviations of the variance of Gaussian noise, and of its reference.
        alone = np.sqrt(2 / (blocks - 1) + 1.5 / len(scaled))
        together = alone / np.sqrt(noisy.sum())
        if excess.mean() > _STILL_SIGMAS * together or excess.max() > 2 * _STILL_SIGMAS * alone:
            return False
    return True


class FreeTurntable:
    """A free-running turntable.

    Args:
        rpm: nominal speed, turns per minute, accurate to 15 %; None to estimate it from the data alone.
        direction: +1 counter-clockwise from above, -1 clockwise.
        max_seconds: longest time to wait for a period, s.
        marker: a reflector off the axis was placed on the table, so that a symmetric object repeats only
            after a full turn: the best repetition is used, not the first good one.
    """

    moves = False
    measures = False

    def __init__(
        self,
        rpm: float | None = None,
        direction: int = 1,
        max_seconds: float = 120.0,
        marker: bool = False,
    ) -> None:
        if rpm is not None and not 0 < rpm <= 1000:
            raise UsageError(
                f"the table's speed is {rpm} rpm", "Give more than 0 and up to 1000 turns per minute."
            )
        if not 0 < max_seconds <= 3600:
            raise UsageError(f"max_seconds is {max_seconds}", "Give more than 0 and up to 3600 seconds.")
        self.rpm, self.direction, self.max_seconds, self.marker = rpm, direction, max_seconds, marker
        self.nominal_s = None if rpm is None else 60.0 / rpm
        self._tested_s = 0.0
        self._last: PeriodEstimate | None = None

    def start(self) -> None:
        """Discard the state of an earlier recording; the table turns by itself."""
        self._tested_s, self._last = 0.0, None

    def check(self) -> None:
        """Does nothing: there is nothing to monitor."""

    def track(self) -> None:
        """None: no angle is measured."""

    def stop(self) -> None:
        """Does nothing: the table turns by itself."""

    def needed_seconds(self) -> float | None:
        """1.3 turns at the nominal speed, or None if the speed is not known."""
        return None if self.nominal_s is None else OVERLAP_TURNS * self.nominal_s

    def finished(self, samples: Sequence[NDArray[Any]] | NDArray[Any], times_s: Sequence[float]) -> bool:
        """Whether to stop recording.

        With a known speed this depends on time alone. Otherwise the growing sinogram is searched each time it
        is 10 % longer, until two consecutive searches agree on a period and 1.3 turns of it are recorded
        (2.3 if it is ambiguous, 8 if the scans repeat only in part), or max_seconds have passed.

        Args:
            samples: one (bins,) array per scan, or (scans, bins).
            times_s: one time per scan, s.
        """
        if len(times_s) < 2:
            return False
        elapsed = float(times_s[-1]) - float(times_s[0])
        needed = self.needed_seconds()
        if needed is not None:
            return elapsed >= needed
        if elapsed >= self.max_seconds:
            return True
        if len(times_s) < 40 or elapsed < 1.1 * self._tested_s:
            return False
        self._tested_s = elapsed
        if elapsed >= STILL_S and nothing_changes(np.stack(list(samples))):
            raise MotionStoppedError(
                f"nothing turns: the scans of {elapsed:.0f} s differ by noise only",
                "Switch the table on; check that the antennas point at the object. If the object looks "
                "the same from all sides, give the speed: `motion.url=free?rpm=RPM`.",
            )
        every = -(-len(times_s) // MAX_SEARCH_SCANS)
        try:
            estimate = find_period(
                np.stack(list(samples[::every])),
                np.asarray(times_s[::every], dtype=np.float64),
                marker=self.marker,
            )
        except DataError:
            self._last = None
            return False
        last, self._last = self._last, estimate
        if last is None or abs(estimate.period_s - last.period_s) > 0.02 * last.period_s:
            return False
        if estimate.quality < GOOD_QUALITY:
            return estimate.turns >= PARTIAL_TURNS
        doubtful = estimate.harmonic_ambiguous or self.marker
        return estimate.turns >= (AMBIGUOUS_TURNS if doubtful else OVERLAP_TURNS)

    def resolve(
        self, samples: NDArray[Any], times_s: NDArray[np.floating], clock_sigma_s: float = 0.0
    ) -> Angles:
        """Angles from the period in the data; from the nominal speed if the data show none.

        sigma(t) = (2 pi / T) hypot(sqrt(2) sigma_clock, (t - t0) sigma_T / T): it grows with the time since
        the first scan, which has angle zero by definition.

        Args:
            samples: (scans, bins).
            times_s: (scans,) s, from `fit_clock`.
            clock_sigma_s: standard deviation of a time, s.

        Raises:
            DataError: no speed was given, and the data show no period.
        """
        times = np.asarray(times_s, dtype=np.float64)
        info: dict[str, Any] = {"kind": "free", "direction": self.direction, "nominal_rpm": self.rpm}
        try:
            estimate = find_period(samples, times, self.nominal_s, marker=self.marker)
            period, sigma = estimate.period_s, estimate.sigma_s
            info |= {
                "source": "data",
                "quality": estimate.quality,
                "harmonic_ambiguous": estimate.harmonic_ambiguous,
                "rivals_s": list(estimate.rivals_s),
                "marker": self.marker,
                "decided_by_nominal": estimate.harmonic_ambiguous and self.rpm is not None,
            }
        except DataError as error:
            if self.nominal_s is None:
                raise
            period, sigma = self.nominal_s, NOMINAL_SIGMA * self.nominal_s
            info |= {"source": "nominal", "reason": error.message, "harmonic_ambiguous": False}
            if isinstance(error, NotRepeatingError):
                info["repeats"] = False
        info |= {"period_s": period, "period_sigma_s": sigma}
        since = times - times[0]
        info["turns"] = float(since[-1] / period)
        speed = 2 * np.pi / period
        spread = speed * np.hypot(np.sqrt(2) * clock_sigma_s * (since > 0), since * sigma / period)
        angles = self.direction * speed * since
        return Angles(angles, np.asarray(spread, dtype=np.float64), ResolvedMotion.from_json(info))
