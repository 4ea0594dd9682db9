"""Arrangements of the reflectors of a tag: where they stand, and which of them move together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tagid.types import Complex, Floats

MOUNTING_SD_M = 1.5e-3
"""Standard deviation of a reflector's distance from the centre as enrolled, m."""
GLUED_SD_M = 1e-3
"""Standard deviation of a reflector's place as it was glued, per axis, beside what moves all alike, m."""


def gaps_deg(angles: NDArray[np.floating]) -> NDArray[np.float64]:
    """(K,) angles between neighbours on a ring, degrees, in counter-clockwise order.

    >>> gaps_deg(np.array([0.0, np.pi / 2])).tolist()
    [90.0, 270.0]
    """
    a = np.sort(np.rad2deg(angles) % 360)
    return np.diff(np.append(a, a[0] + 360))


@dataclass(frozen=True, eq=False)
class Arrangement:
    """Reflectors of one tag, alike but for their transfer.

    Attributes:
        radius_m, angle, height_m: (K,) places about the centre, before turn and stretch.
        turn, stretch: (K,) number of the turn and of the stretch that moves each.
        free: (S,) whether the radius is free that a stretch moves; otherwise it has the mounting's prior.
        lift: (K,) number of the lift that raises each.
        tall: its heights differ: then they show from one antenna height, too.
        glued: every reflector stands a little off its enrolled place: all have a turn, a stretch and a lift.
    """

    radius_m: Floats
    angle: Floats
    height_m: Floats
    turn: NDArray[np.intp]
    stretch: NDArray[np.intp]
    free: NDArray[np.bool_]
    lift: NDArray[np.intp]
    tall: bool = False
    glued: bool = False

    @classmethod
    def of_layout(cls, positions: Floats, heights: Floats | None) -> Arrangement:
        """That of a layout's positions (K, 2) and heights (K,), m."""
        return cls.rigid(positions[:, 0] + 1j * positions[:, 1], heights)

    @classmethod
    def rigid(cls, positions: Complex, heights: Floats | None = None) -> Arrangement:
        """Reflectors at known places (K,), x + jy, and heights (K,), m, that turn together."""
        zero = np.zeros(len(positions), dtype=np.intp)
        up = np.zeros(len(positions)) if heights is None else np.asarray(heights, dtype=float)
        rigid = np.zeros(1, dtype=bool)
        return cls(np.abs(positions), np.angle(positions), up, zero, zero, rigid, zero, bool(np.ptp(up) > 0))

    @classmethod
    def ring(cls, radius_m: float, angle: Floats) -> Arrangement:
        """Reflectors at any angles (K,), rad, of one free ring."""
        k = len(angle)
        numbers, zero, free = np.arange(k), np.zeros(k, dtype=np.intp), np.ones(1, dtype=bool)
        return cls(np.full(k, radius_m), np.asarray(angle), np.zeros(k), numbers, zero, free, numbers)

    @classmethod
    def points(cls, positions: Complex) -> Arrangement:
        """Reflectors anywhere (K,), x + jy, m."""
        k = np.arange(len(positions))
        free = np.ones(len(k), dtype=bool)
        return cls(np.abs(positions), np.angle(positions), np.zeros(len(k)), k, k, free, k)

    @classmethod
    def about(cls, positions: Complex, apart_m: float = 2 * MOUNTING_SD_M) -> Arrangement:
        """Free reflectors near places (K,), x + jy, m: of one ring where their radii differ by no more."""
        out = np.abs(positions)
        if np.ptp(out) > apart_m:
            return cls.points(positions)
        return cls.ring(float(out.mean()), np.angle(positions))

    def of(self, which: NDArray[np.intp]) -> Arrangement:
        """Some of the reflectors."""
        positions = self.radius_m[which], self.angle[which], self.height_m[which]
        groups = self.turn[which], self.stretch[which]
        return Arrangement(*positions, *groups, self.free, self.lift[which], self.tall)

    def by_hand(self) -> Arrangement:
        """The same with every reflector a little off its place."""
        numbers = np.arange(self.count)
        rigid = np.zeros(self.count, dtype=bool)
        return replace(self, turn=numbers, stretch=numbers, free=rigid, lift=numbers, glued=True)

    def glue(self, *common_sd_m: float) -> tuple[float, Floats]:
        """Log density at the enrolled places of turns, stretches and lifts, and precision (2 K or 3 K, ..).

        Args:
            common_sd_m: standard deviation of what moves all outward, and of what lifts all, m; lifts are
                left out where that is not given.
        """
        k, along = self.count, (np.maximum(self.radius_m, GLUED_SD_M) / GLUED_SD_M) ** 2
        precision = np.zeros(((1 + len(common_sd_m)) * k,) * 2)
        # Any turn of all is as likely: it is integrated out.
        precision[:k, :k] = np.diag(along) - np.outer(along, along) / along.sum()
        log = (
            -np.log(2 * np.pi)
            + 0.5 * np.log(2 * np.pi / along.sum())
            + 0.5 * np.log(along / (2 * np.pi)).sum()
        )
        for i, sd in enumerate(common_sd_m, start=1):
            block = np.linalg.inv(GLUED_SD_M**2 * np.eye(k) + sd**2)
            precision[i * k : (i + 1) * k, i * k : (i + 1) * k] = block
            log += 0.5 * np.linalg.slogdet(block / (2 * np.pi))[1]
        return float(log), precision

    def unbound(self, turn: Floats) -> Arrangement:
        """The same reflectors turned by (K,), rad, every one free to go anywhere."""
        numbers, free = np.arange(self.count), np.ones(self.count, dtype=bool)
        return replace(self, angle=self.angle + turn, turn=numbers, stretch=numbers, free=free, glued=False)

    def resized(self, radius_m: float) -> Arrangement:
        """The same angles at any distance from the centre, about so much at most, m."""
        scaled = self.radius_m * (radius_m / self.radius_m.max())
        return replace(self, radius_m=scaled, free=np.ones(len(self.free), dtype=bool))

    def raised(self) -> Arrangement:
        """The same with any heights."""
        return replace(self, lift=np.arange(self.count), tall=True)

    def and_one(self, place: complex) -> Arrangement:
        """One reflector more, anywhere, x + jy, m, with a turn and a stretch of its own."""
        return Arrangement(
            np.append(self.radius_m, abs(place)),
            np.append(self.angle, np.angle(place)),
            np.append(self.height_m, 0.0),
            np.append(self.turn, self.turns),
            np.append(self.stretch, self.stretches),
            np.append(self.free, True),
            np.append(self.lift, self.lifts),
            self.tall,
        )

    @cached_property
    def turns(self) -> int:
        """Number of groups that turn by themselves."""
        return int(self.turn.max()) + 1

    @cached_property
    def stretches(self) -> int:
        """Number of groups that move outward by themselves."""
        return int(self.stretch.max()) + 1

    @cached_property
    def lifts(self) -> int:
        """Number of groups that rise by themselves."""
        return int(self.lift.max()) + 1

    @property
    def count(self) -> int:
        """Number of reflectors."""
        return len(self.radius_m)
