"""Where an object stood still that should have turned: a held table, a dead motor, a power cut.

A stop is not the only reason why scans stop changing: a can looks the same from many sides, and noise hides
what little changes. A stop shows in three ways that these do not have together:

- scans over a long part of the turn differ by noise only, and changes well below those of the turning object
  would have been seen;
- the change is abrupt: the echoes moved at their usual rate just before and, if it turned again, just after.
  Reflectors that turn out of sight fade over tens of degrees;
- the same part of the turn, where it was recorded a second time, did change.

What does not show in all of them is not reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.angles.sinogram import moving_echo
from tagid.types import Floats

LEAST_TURNS = 0.25
"""Shortest standstill that is reported, in expected turns. Cans turned without a stop look still for up to
0.2 turns at 5 dB."""
_ANCHOR_TURNS = 0.08
_SMOOTHED_TURNS = 0.012
_SIGMAS = 4.5
_VISIBLE, _VISIBLE_BETWEEN = 0.15, 0.07
"""Largest change that noise could hide over the lag of the usual change, as a share of it: where the
recording ends with the standstill, and where the object would have gone on."""
_ABRUPT = 0.3
"""Smallest change around the standstill, as a share of the usual change over the same angle."""
_SHOWN, _SHOWN_LAST = 10.0, 0.4
"""Smallest echo in the still scans beyond their background: that many times the change that noise could hide;
where the recording ends with the standstill, no more than this share of the usual change."""
_SEEN_BEFORE = 0.3
"""Smallest change in the same part of another turn, as a share of the usual change."""
_PER_TURN = 360
"""Scans per turn that are examined; more are averaged."""
_LAGS_TURNS = (0.004, 0.006, 0.008, 0.012, 0.016, 0.02, 0.025, 0.03, 0.04, 0.05, 0.06, 0.08)


@dataclass(frozen=True)
class Still:
    """Scans between which nothing changed.

    Attributes:
        first, stop: the first of these scans and the one after the last.
    """

    first: int
    stop: int


def find_standstill(
    samples: NDArray[np.generic], turns: NDArray[np.floating], tolerance: float
) -> Still | None:
    """The longest standstill of a recording (scans, bins), real RF or complex; None if the scans show none.

    `turns` (scans,) are those that the object should have made since the first scan, increasing, to a
    relative tolerance.
    """
    step = float(np.median(np.diff(turns))) if len(turns) > 1 else 0.0
    if step <= 0 or len(turns) != len(samples):
        return None
    together = max(1, int(1 / (step * _PER_TURN)))
    count = len(turns) // together
    if count < 3:
        return None
    kept = count * together
    flat = np.concatenate([samples.real, samples.imag], axis=1) if np.iscomplexobj(samples) else samples
    scans = flat[:kept].reshape(count, together, -1).mean(axis=1, dtype=np.float64).astype(np.float32)
    positions = np.asarray(turns, dtype=np.float64)[:kept].reshape(count, together).mean(axis=1)
    scans -= scans.mean(axis=0)
    parts = 2 if np.iscomplexobj(samples) else 1
    echo = moving_echo(scans, np.ones(count - 1, dtype=bool), parts).astype(np.float64)
    still = _longest_still(echo, positions) if echo.shape[1] else None
    if still is None or not _Witness(echo, positions, still).confirms(tolerance):
        return None
    last = still.stop == count
    return Still(still.first * together, len(turns) if last else still.stop * together)


def _longest_still(echo: Floats, turns: Floats) -> Still | None:
    """The longest part that differs from its own mean by noise only, however short; None if not even an
    anchor is still. Arguments as of `_Witness`.
    """
    per_turn = 1 / float(np.median(np.diff(turns)))
    width = _odd(per_turn * _SMOOTHED_TURNS)
    size, count = max(8, round(per_turn * _ANCHOR_TURNS)), len(echo)
    best: Still | None = None
    for first in range(0, count - size + 1, max(1, size // 6)):
        anchor = echo[first : first + size]
        noise = _noise(anchor)
        away = ((echo - anchor.mean(axis=0)) ** 2).sum(axis=1)
        half = size // 2
        drift = ((anchor[:half].mean(axis=0) - anchor[-half:].mean(axis=0)) ** 2).sum()
        inside = away[first : first + size]
        if inside.sum() > 1.3 * noise * (size - 1) or drift > 2.5 * 2 * noise / half:
            continue
        allowed = _SIGMAS * inside.std() / np.sqrt(width) + 0.02 * noise
        beyond = np.flatnonzero(_smoothed(away, width) > noise * (1 + 1 / size) + allowed)
        before, after = beyond[beyond < first], beyond[beyond >= first + size]
        start = int(before[-1]) + 1 if len(before) else 0
        stop = int(after[0]) if len(after) else count
        if best is None or stop - start > best.stop - best.first:
            best = Still(start, stop)
    return best


class _Witness:
    """Compares a still part with the rest of the recording, of moving echo (scans, columns) and expected
    turns (scans,).
    """

    def __init__(self, echo: Floats, turns: Floats, still: Still) -> None:
        self._echo, self._turns, self._still = echo, turns, still
        self._per_turn = 1 / float(np.median(np.diff(turns)))
        self._width = _odd(self._per_turn * _SMOOTHED_TURNS)
        edge = self._width // 2 if still.stop - still.first > 4 * self._width else 0
        inner = echo[still.first + edge : still.stop - edge]
        self._noise = _noise(inner)
        self._mean = inner.mean(axis=0)
        self._away = ((echo - self._mean) ** 2).sum(axis=1) - self._noise * (1 + 1 / len(inner))
        self._spread = float(((inner - self._mean) ** 2).sum(axis=1).std())
        self._moving = np.ones(len(echo), dtype=bool)
        self._moving[still.first : still.stop] = False
        self._lag, self._usual = self._usual_change()

    def confirms(self, tolerance: float) -> bool:
        """Whether the object stood still there."""
        still, last = self._still, len(self._echo) - 1
        if self._turns[still.stop - 1] - self._turns[still.first] < LEAST_TURNS or self._usual <= 0:
            return False
        begins, ends = still.first > 0, still.stop <= last
        hidden = _SIGMAS * self._spread / np.sqrt(max(self._width, self._lag)) / self._usual
        if hidden > (_VISIBLE_BETWEEN if ends else _VISIBLE):
            return False
        shown = _SHOWN * hidden if ends else min(_SHOWN * hidden, _SHOWN_LAST)
        if not begins or (ends and not self._abrupt(still.stop + self._lag, still.stop, last + 1)):
            return False
        if not self._abrupt(still.first - 1 - self._lag, 0, still.first):
            return False
        return self._shows(shown) and all(
            self._changed_in_another_turn(1 + off) for off in (-tolerance, 0.0, tolerance)
        )

    def _usual_change(self) -> tuple[int, float]:
        """(lag, change): the lag at which the moving scans differ by half of the most, and by how much."""
        moving = self._moving
        side = np.arange(len(self._echo)) >= self._still.stop
        lags = np.unique([max(1, round(self._per_turn * turns)) for turns in _LAGS_TURNS])
        changes = []
        for lag in lags:
            both = moving[lag:] & moving[:-lag] & (side[lag:] == side[:-lag])
            apart = ((self._echo[lag:] - self._echo[:-lag]) ** 2).sum(axis=1)[both]
            changes.append(float(apart.mean()) - 2 * self._noise if len(apart) > 5 else 0.0)
        half = 0.5 * max(changes)
        chosen = next(i for i, change in enumerate(changes) if change >= half or i == len(changes) - 1)
        return int(lags[chosen]), changes[chosen]

    def _shows(self, least: float) -> bool:
        """Whether the still scans contain so much of the echo that moved, and not its background alone."""
        moving = self._moving
        background = self._echo[moving].mean(axis=0)
        chance = self._noise * (1 / (len(moving) - moving.sum()) + 1 / moving.sum())
        shown = float(((self._mean - background) ** 2).sum()) - chance
        return bool(shown >= least * self._usual)

    def _abrupt(self, centre: int, low: int, high: int) -> bool:
        """Whether the scans around one differ from the still ones about as usual."""
        half = self._width // 2 + 1
        some = self._away[max(low, centre - half) : min(high, centre + half + 1)]
        return len(some) > 0 and float(some.mean()) >= _ABRUPT * self._usual

    def _changed_in_another_turn(self, turn: float) -> bool:
        """Whether the same part of another turn changed; True where it was not recorded."""
        still = self._still
        low, high = self._turns[still.first], self._turns[still.stop - 1]
        for off in (-turn, turn):
            inside = (self._turns >= low + off) & (self._turns <= high + off)
            inside[still.first : still.stop] = False
            if self._turns[inside].size and np.ptp(self._turns[inside]) >= _ANCHOR_TURNS:
                other = self._echo[inside]
                change = 2 * (((other - other.mean(axis=0)) ** 2).sum() / (len(other) - 1) - self._noise)
                if change < _SEEN_BEFORE * self._usual:
                    return False
        return True


def _noise(scans: Floats) -> float:
    """Energy of the noise of one scan, from the differences of neighbours."""
    return float(0.5 * (np.diff(scans, axis=0) ** 2).sum(axis=1).mean())


def _smoothed(values: Floats, width: int) -> NDArray[Any]:
    window = np.ones(width)
    return np.asarray(np.convolve(values, window, "same") / np.convolve(np.ones(len(values)), window, "same"))


def _odd(width: float) -> int:
    return max(1, round(width)) | 1
