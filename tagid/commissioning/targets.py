"""Reference targets with a known echo: where the tape measure ends, and how they change the pulse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import UsageError
from tagid.simulate.scatterers import Octahedron
from tagid.simulate.specification import parse_length
from tagid.types import Complex, Floats

LEVEL_SIGMA_DB: Final = 1.0
"""Standard error of the echo of a target that was made by hand and pointed by eye (assumed)."""


CAN_HEIGHT_M: Final = 0.100


@dataclass(frozen=True)
class Kind:
    """A kind of target.

    Attributes:
        size: what its size is.
        tape_to: where the tape measure ends.
        default_m, least_m, most_m: its size, m.
    """

    size: str
    tape_to: str
    default_m: float
    least_m: float
    most_m: float


KINDS: Final = {
    "octahedron": Kind("tip to tip", "its centre", 0.040, 0.02, 0.06),
    "corner": Kind("inner edge", "its inner corner", 0.20, 0.10, 0.60),
    "sphere": Kind("radius", "its nearest point", 0.10, 0.06, 0.30),
    "can": Kind("radius", "its nearest line", 0.033, 0.02, 0.08),
}


@dataclass(frozen=True)
class Target:
    """A reference target: a name of `KINDS` and its size, m."""

    kind: str = "octahedron"
    size_m: float = 0.040

    @property
    def tape_to(self) -> str:
        """Where the tape measure ends."""
        return KINDS[self.kind].tape_to

    def scattering_length(self, frequency_hz: Floats) -> Complex:
        """b (m), phase reference where the tape ends.

        A corner of three square-edged triangles, seen along its axis of symmetry, has the RCS
        4 pi a^4 / (3 lambda^2) (Skolnik, Introduction to Radar Systems), a the inner edge, and a path as to
        its apex. The nearest point of a sphere much larger than the wavelength reflects, b = r / 2; of an
        upright can at the height of the antennas the nearest line, RCS k r h^2, whose phase of 45 degrees is
        the same at all frequencies, which delays no envelope.
        """
        if self.kind == "octahedron":
            return Octahedron(self.size_m).scattering_length(frequency_hz)
        if self.kind == "corner":
            length = self.size_m**2 * frequency_hz / (np.sqrt(3) * SPEED_OF_LIGHT)
        elif self.kind == "sphere":
            length = np.full(np.shape(frequency_hz), self.size_m / 2)
        else:
            k = 2 * np.pi * frequency_hz / SPEED_OF_LIGHT
            length = CAN_HEIGHT_M * np.sqrt(k * self.size_m / (4 * np.pi))
        return np.asarray(length, dtype=np.complex128)

    def __str__(self) -> str:
        return f"{self.kind}:{round(self.size_m * 1e3, 1):g}mm"


def parse_target(text: str) -> Target:
    """A target from `--target`, e.g. corner:20cm. Raises UsageError."""
    kind, colon, size = text.strip().partition(":")
    if kind not in KINDS:
        raise UsageError(
            f"`target`: target {kind[:40]!r} is unknown", f"Use {', '.join(KINDS)}, e.g. octahedron:40mm."
        )
    rule = KINDS[kind]
    size_m = parse_length(f"`target={kind}`", size) if colon else rule.default_m
    if not rule.least_m <= size_m <= rule.most_m:
        raise UsageError(
            f"the {rule.size} of the target is {size_m * 1e3:g} mm",
            f"Give {rule.least_m * 1e3:g}mm to {rule.most_m * 1e3:g}mm.",
        )
    return Target(kind, size_m)
