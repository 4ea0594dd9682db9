"""Reference targets with a known echo: where the tape measure ends, and how they change the pulse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from tagid.constants import CENTER_FREQUENCY_HZ, SPEED_OF_LIGHT
from tagid.errors import UsageError
from tagid.signal import peak_place
from tagid.simulate.scatterers import Octahedron, Scatterer
from tagid.simulate.specification import parse_length
from tagid.types import Complex, Floats
from tagid.waveform import analytic_pulse, nominal_pulse

LEVEL_SIGMA_DB: Final = 1.0
"""Standard error of the echo of a target that was made by hand and pointed by eye (assumed)."""


@dataclass(frozen=True)
class Corner:
    """A trihedral corner of three square-edged triangles, seen along its axis of symmetry.

    RCS 4 pi a^4 / (3 lambda^2) (Skolnik, Introduction to Radar Systems), a the inner edge; the path through
    it is that to its apex.
    """

    edge_m: float

    def scattering_length(self, frequency_hz: Floats) -> Complex:
        """b (m), phase reference at the apex."""
        return np.asarray(self.edge_m**2 * frequency_hz / (np.sqrt(3) * SPEED_OF_LIGHT), dtype=np.complex128)


@dataclass(frozen=True)
class Sphere:
    """A metal sphere much larger than the wavelength: its nearest point reflects, b = r / 2."""

    radius_m: float

    def scattering_length(self, frequency_hz: Floats) -> Complex:
        """b (m), phase reference at the nearest point."""
        return np.full(np.shape(frequency_hz), self.radius_m / 2, dtype=np.complex128)


@dataclass(frozen=True)
class Can:
    """An upright metal can at the height of the antennas: its nearest line reflects, RCS k r h^2.

    Its phase of 45 degrees is the same at all frequencies, which delays no envelope.
    """

    radius_m: float
    height_m: float = 0.100

    def scattering_length(self, frequency_hz: Floats) -> Complex:
        """b (m), phase reference at the nearest line."""
        k = 2 * np.pi * np.asarray(frequency_hz) / SPEED_OF_LIGHT
        return np.asarray(self.height_m * np.sqrt(k * self.radius_m / (4 * np.pi)), dtype=np.complex128)


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

    @property
    def scatterer(self) -> Scatterer:
        """Its echo."""
        if self.kind == "octahedron":
            return Octahedron(self.size_m)
        if self.kind == "corner":
            return Corner(self.size_m)
        return Sphere(self.size_m) if self.kind == "sphere" else Can(self.size_m)

    def delay_ps(self) -> float:
        """How much later its echo peaks than that of a point where the tape ends, two-way, ps.

        Behind the filter matched to the nominal pulse, as `tagid.recording.calibration.estimate_delay`.
        """
        pulse = nominal_pulse()
        fine = 4 * len(pulse.samples)
        spectrum = np.fft.fft(analytic_pulse(pulse), fine)
        frequency = np.fft.fftfreq(fine, pulse.step)
        length = np.zeros(fine, dtype=np.complex128)
        band = np.abs(frequency - CENTER_FREQUENCY_HZ) < CENTER_FREQUENCY_HZ / 2
        # The scattering length turns the phase of exp(-j 2 pi f t) backwards.
        length[band] = self.scatterer.scattering_length(frequency[band])
        echo = np.fft.fftshift(np.abs(np.fft.ifft(np.abs(spectrum) ** 2 * length)))
        return float((peak_place(echo) - fine // 2) * pulse.step * 1e12)

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
