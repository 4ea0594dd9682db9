"""How a scene is recorded: geometry, rotation, noise, imperfections, and the metadata in the file.

Each imperfection of a field recording is one field here, zero by default, so that a test can enable them
individually.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Pulse
from tagid.config import IMPLAUSIBLE_AXIS_M
from tagid.constants import RANGE_STEP_M
from tagid.errors import UsageError
from tagid.simulate.noise import NoiseShape
from tagid.simulate.snr import REFERENCES

MAX_SAMPLES = 50_000_000
SNR_RANGE_DB = (-100.0, 300.0)
"""Beyond it, samples of single precision hold noise only, or none."""
MAX_NOISE_STD = 1e6
MAX_CENTRE_M = 0.25
"""Half the width of an image (`imaging.extent_m`): the axis of a farther object is not in it."""
MAX_RADIAL_M = 1.0
IMPLAUSIBLE_CENTRE_M = 1.0
"""From here on, an object's place was probably given in millimetres."""
MAX_WOBBLE = 0.5
"""Beyond it, the table would stop or turn back."""


@dataclass(frozen=True)
class RangeWindow:
    """Range bins: bin b is at one-way range start_m + b * step_m, without the cable delay."""

    start_m: float
    bins: int = 192
    step_m: float = RANGE_STEP_M

    @classmethod
    def around(cls, axis_distance_m: float, bins: int = 192) -> RangeWindow:
        """The window of a given number of bins, centred on the rotation axis."""
        return cls(axis_distance_m - RANGE_STEP_M * (bins // 2), bins)

    @property
    def ranges_m(self) -> NDArray[np.float64]:
        """(bins,) one-way range, m."""
        return self.start_m + self.step_m * np.arange(self.bins, dtype=np.float64)


@dataclass(frozen=True)
class Placement:
    """Placement of the object on the table: rotated by rotation_rad, then shifted by centre_m (x, y).

    Attributes:
        centre_m: (x, y) of the object's origin from the rotation axis, at most `MAX_CENTRE_M` away, m.
        rotation_rad: rotation about its origin, rad.
        height_m: height of the tag's plane above the plane to which the capture's antenna height refers;
            not given in the capture.
    """

    centre_m: tuple[float, float] = (0.0, 0.0)
    rotation_rad: float = 0.0
    height_m: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite((*self.centre_m, self.rotation_rad, self.height_m)).all():
            raise UsageError(
                "the object's placement is not finite", "Give numbers for centre, rotation and height."
            )
        farthest = max(self.centre_m, key=abs)
        if abs(farthest) >= IMPLAUSIBLE_CENTRE_M:
            raise UsageError(
                f"the object's centre is {farthest:g} m off the axis. {farthest:g} m? Give metres",
                f"e.g. {farthest / 1000:g} for {farthest:g} mm; at most {MAX_CENTRE_M:g} m.",
            )
        if (off := float(np.hypot(*self.centre_m))) > MAX_CENTRE_M:
            raise UsageError(
                f"the object's centre is {off:.3g} m off the rotation axis",
                f"Give at most {MAX_CENTRE_M:g} m: images of the usual width end there.",
            )

    def apply(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Positions on the table of points (n, 2) of the object, m."""
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

    def __post_init__(self) -> None:
        if not 0 <= self.speed < MAX_WOBBLE:
            raise UsageError(f"the wobble is {self.speed}", "Give 0 to 0.5, e.g. 0.01 for 1 %.")
        if not 0 <= self.radial_m < MAX_RADIAL_M:
            raise UsageError(f"the axis wobbles by {self.radial_m} m", "Give metres, e.g. 0.001.")


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
    """One recording of a rotating scene.

    Attributes:
        views: scans per turn.
        turns: turns recorded; scans are round(views * turns).
        period_s: seconds per turn.
        direction: +1 counter-clockwise from above, -1 clockwise.
        axis_distance_m, antenna_height_m: antenna position, m; the height refers to the plane at z = 0.
        antenna_separation_m: distance of a transmitting and a receiving antenna side by side, m, with the
            antenna position midway; 0: one antenna. Path lengths are exact; bodies scatter as they do
            monostatically towards the midpoint.
        window: range bins; None for 192 bins with the axis in the middle.
        pulse: received from a point reflector; None for the nominal one.
        tell_pulse: whether the capture contains the pulse.
        snr_db: peak over noise, defined in `snr`, dB; None for no noise.
        snr_reference: what snr_db refers to, "reflector" or "summed".
        noise_std: standard deviation of one sample, if a unit reflector on the axis peaks at 1; replaces
            snr_db.
        noise: colour and interference.
        placement, wobble: see the classes.
        axis_distance_error_m: given minus true axis distance, m.
        angle_error_rad: standard deviation of the error of the given angles, rad.
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
        self._check_places()
        if self.views < 1 or not (np.isfinite(self.turns) and self.turns > 0):
            raise UsageError(f"{self.views} views per turn and {self.turns} turns", "Give positive numbers.")
        if self.views * self.turns * self.range_window.bins > MAX_SAMPLES:
            raise UsageError(
                f"{self.views} views x {self.turns} turns x {self.range_window.bins} bins are too many",
                f"Stay below {MAX_SAMPLES:,} samples.",
            )
        if not (0 < self.period_s < np.inf and self.range_window.bins > 0):
            raise UsageError("period and bins must be positive", "Give positive numbers.")
        if not 0 <= self.antenna_separation_m < self.axis_distance_m:
            raise UsageError(
                f"the antennas are {self.antenna_separation_m} m apart",
                "Give 0 to less than the axis distance.",
            )
        if self.direction not in (1, -1):
            raise UsageError(
                f"direction is {self.direction}", "Use +1 (counter-clockwise) or -1 (clockwise)."
            )
        if self.beam_width_rad is not None and not 1e-3 <= self.beam_width_rad <= 2 * np.pi:
            degrees = float(np.rad2deg(self.beam_width_rad))
            raise UsageError(f"the beam width is {degrees:g} degrees", "Give 0.1 to 360.")
        if self.snr_reference not in REFERENCES:
            raise UsageError(f"the SNR refers to {self.snr_reference!r}", f"Use {' or '.join(REFERENCES)}.")
        if self.noise_std is not None and not 0 <= self.noise_std <= MAX_NOISE_STD:
            raise UsageError(
                f"the noise has a standard deviation of {self.noise_std}", f"Give 0 to {MAX_NOISE_STD:g}."
            )
        low, high = SNR_RANGE_DB
        if self.snr_db is not None and not low <= self.snr_db <= high:
            raise UsageError(
                f"the SNR is {self.snr_db:g} dB",
                f"Give {low:g} to {high:g} dB, e.g. 20; {high:g} dB is practically no noise.",
            )

    def _check_places(self) -> None:
        """Raises UsageError for distances and heights that are no numbers, or obviously not metres."""
        stated = self.axis_distance_m + self.axis_distance_error_m
        for what, value, positive in (
            ("axis distance", self.axis_distance_m, True),
            ("stated axis distance (true distance plus error)", stated, True),
            ("antenna height", self.antenna_height_m, False),
        ):
            if not abs(value) < IMPLAUSIBLE_AXIS_M or (positive and value <= 0):
                raise UsageError(
                    f"the {what} is {value:g} m",
                    f"Give metres, less than {IMPLAUSIBLE_AXIS_M:g}, e.g. 1.0 (1 for 100 cm or 1000 mm).",
                )

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
