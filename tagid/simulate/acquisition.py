"""How a scene is recorded: geometry, rotation, noise, imperfections, and what the file states about them.

Each imperfection of a field recording is one field here, zero by default, so that a test can switch on
exactly the one it is about.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Pulse
from tagid.constants import RANGE_STEP_M
from tagid.errors import UsageError
from tagid.simulate.noise import NoiseShape
from tagid.simulate.snr import REFERENCES

MAX_SAMPLES = 50_000_000


@dataclass(frozen=True)
class RangeWindow:
    """Range bins: bin b lies at start_m + b * step_m one way, without the cable delay."""

    start_m: float
    bins: int = 192
    step_m: float = RANGE_STEP_M

    @classmethod
    def around(cls, axis_distance_m: float, bins: int = 192) -> RangeWindow:
        """The window of so many bins with the rotation axis in its middle."""
        return cls(axis_distance_m - RANGE_STEP_M * (bins // 2), bins)

    @property
    def ranges_m(self) -> NDArray[np.float64]:
        """(bins,) one-way range, m."""
        return self.start_m + self.step_m * np.arange(self.bins, dtype=np.float64)


@dataclass(frozen=True)
class Placement:
    """How the object stands on the table: turned by rotation_rad, then shifted by centre_m (x, y).

    Attributes:
        centre_m: (x, y) of the object's origin from the rotation axis, m.
        rotation_rad: about its origin, rad.
        height_m: how far the tag's plane stands above the plane that the capture's antenna height refers to;
            the capture does not state it.
    """

    centre_m: tuple[float, float] = (0.0, 0.0)
    rotation_rad: float = 0.0
    height_m: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite((*self.centre_m, self.rotation_rad, self.height_m)).all():
            raise UsageError(
                "the object's place is not finite", "Give numbers for centre, rotation and height."
            )

    def apply(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Where points (n, 2) of the object, m, stand on the table."""
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        return np.asarray(points @ np.array([[c, s], [-s, c]]) + np.asarray(self.centre_m), dtype=np.float64)


@dataclass(frozen=True)
class Wobble:
    """Uneven rotation, as four harmonics with random phases (a bent axle, an off-centre belt).

    Attributes:
        speed: RMS deviation of the angular speed, as a fraction of the speed.
        radial_m: RMS deviation of the distance from radar to axis, m.
    """

    speed: float = 0.0
    radial_m: float = 0.0


@dataclass(frozen=True)
class Recording:
    """How the radar digitises the field.

    Attributes:
        dtype: "float32", "int32" or "complex64" (analytic signal, circular noise).
        counts_per_unit: counts of a unit reflector on the axis.
        clip_counts: saturation, counts; None for no saturation.
    """

    dtype: str = "float32"
    counts_per_unit: float = 1.0
    clip_counts: float | None = None

    def __post_init__(self) -> None:
        if self.dtype not in ("float32", "int32", "complex64"):
            raise UsageError(f"dtype {self.dtype!r} is unknown", "Use float32, int32 or complex64.")
        if not (np.isfinite(self.counts_per_unit) and self.counts_per_unit > 0):
            raise UsageError(f"counts per unit is {self.counts_per_unit}", "Give a positive number.")


@dataclass(frozen=True, eq=False)
class Acquisition:
    """One recording of a turning scene.

    Attributes:
        views: scans per turn.
        turns: turns recorded; scans are round(views * turns).
        period_s: seconds per turn.
        direction: +1 counter-clockwise from above, -1 clockwise.
        axis_distance_m, antenna_height_m: antenna position, m; the height refers to the plane at z = 0.
        antenna_separation_m: between a transmitting and a receiving antenna side by side, m, that position in
            their middle; 0: one antenna. Paths are exact; a body scatters as it does straight back to the
            middle.
        window: range bins; None for 192 bins with the axis in the middle.
        pulse: as received from a point; None for the nominal one.
        tell_pulse: whether the capture carries the pulse.
        snr_db: SNR of the recording, defined in `snr`; None for no noise.
        snr_reference: what snr_db refers to, "reflector" or "summed".
        noise_std: standard deviation of one sample, where a unit reflector on the axis peaks at 1; replaces
            snr_db.
        noise: white, coloured, with interference.
        placement, wobble: see there.
        axis_distance_error_m: stated minus true axis distance, m.
        angle_error_rad: standard deviation of the error of the stated angles, rad.
        beam_width_rad: full -3 dB width of the Gaussian one-way power pattern, rad; None for isotropic.
        range_law: amplitude ~ 1/R^2 (power 1/R^4), 1 at the axis.
        recording: counts, type and clipping.
    """

    views: int = 360
    turns: float = 1.0
    period_s: float = 30.0
    direction: int = 1
    axis_distance_m: float = 1.0
    antenna_height_m: float = 0.0
    antenna_separation_m: float = 0.0
    window: RangeWindow | None = None
    pulse: Pulse | None = None
    tell_pulse: bool = False
    snr_db: float | None = None
    snr_reference: str = "reflector"
    noise_std: float | None = None
    noise: NoiseShape = field(default_factory=NoiseShape)
    placement: Placement = field(default_factory=Placement)
    wobble: Wobble = field(default_factory=Wobble)
    axis_distance_error_m: float = 0.0
    angle_error_rad: float = 0.0
    beam_width_rad: float | None = None
    range_law: bool = False
    recording: Recording = field(default_factory=Recording)

    def __post_init__(self) -> None:
        if self.views < 1 or not (np.isfinite(self.turns) and self.turns > 0):
            raise UsageError(f"{self.views} views per turn and {self.turns} turns", "Give positive numbers.")
        if self.views * self.turns * self.range_window.bins > MAX_SAMPLES:
            raise UsageError(
                f"{self.views} views x {self.turns} turns x {self.range_window.bins} bins are too many",
                f"Stay below {MAX_SAMPLES:,} samples.",
            )
        if not (self.axis_distance_m > 0 and self.period_s > 0 and self.range_window.bins > 0):
            raise UsageError("axis distance, period and bins must be positive", "Give positive numbers.")
        if not 0 <= self.antenna_separation_m < self.axis_distance_m:
            raise UsageError(
                f"the antennas are {self.antenna_separation_m} m apart",
                "Give 0 to less than the axis distance.",
            )
        if self.direction not in (1, -1):
            raise UsageError(
                f"direction is {self.direction}", "Use +1 (counter-clockwise) or -1 (clockwise)."
            )
        if self.beam_width_rad is not None and not 0 < self.beam_width_rad <= 2 * np.pi:
            raise UsageError(f"the beam width is {self.beam_width_rad} rad", "Give 0 to 2 pi.")
        if self.snr_reference not in REFERENCES:
            raise UsageError(f"the SNR refers to {self.snr_reference!r}", f"Use {' or '.join(REFERENCES)}.")
        if self.noise_std is not None and self.noise_std < 0:
            raise UsageError(f"the noise has a standard deviation of {self.noise_std}", "Give 0 or more.")

    @property
    def scans(self) -> int:
        """Number of scans recorded."""
        return max(1, round(self.views * self.turns))

    @property
    def range_window(self) -> RangeWindow:
        """The given window, or the default one around the axis."""
        return self.window if self.window is not None else RangeWindow.around(self.axis_distance_m)


@dataclass(frozen=True, eq=False)
class Turn:
    """The true rotation: object angle and axis distance against the time in turns since the start.

    speed deviation = wobble.speed * sum_k c_k cos(2 pi k u + phi_k), so its integral is added to 2 pi u.
    """

    wobble: Wobble
    direction: int
    coefficients: NDArray[np.float64]
    phases: NDArray[np.float64]

    @classmethod
    def random(cls, wobble: Wobble, direction: int, rng: np.random.Generator) -> Turn:
        """Harmonics 1..4 with random phases and decreasing random weights, normalised to an RMS of 1."""
        weights = rng.uniform(0.3, 1.0, (2, 4)) / np.arange(1, 5)
        weights *= np.sqrt(2) / np.linalg.norm(weights, axis=1, keepdims=True)
        return cls(wobble, direction, weights, rng.uniform(0, 2 * np.pi, (2, 4)))

    def angles(self, turns: NDArray[np.floating]) -> NDArray[np.float64]:
        """Object angle, rad, at times in turns; zero at zero."""
        k = np.arange(1, 5)
        phase = 2 * np.pi * k * np.asarray(turns)[..., None] + self.phases[0]
        deviation = (self.coefficients[0] / k * (np.sin(phase) - np.sin(self.phases[0]))).sum(axis=-1)
        return np.asarray(self.direction * (2 * np.pi * np.asarray(turns) + self.wobble.speed * deviation))

    def radial(self, turns: NDArray[np.floating]) -> NDArray[np.float64]:
        """Deviation of the axis distance, m, at times in turns."""
        phase = 2 * np.pi * np.arange(1, 5) * np.asarray(turns)[..., None] + self.phases[1]
        return np.asarray(self.wobble.radial_m * (self.coefficients[1] * np.cos(phase)).sum(axis=-1))
