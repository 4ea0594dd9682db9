"""The profile of a commissioned rig: what was measured of a radar, its antennas and its turntable.

`tagid commission` writes it; configuration, imaging, reading, planning and simulation take the defaults
they need from it. One TOML file holds values and standard errors, date, radar, antennas and software.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from tagid._version import __version__
from tagid.capture import Capture, Pulse
from tagid.constants import RIG_FILE
from tagid.errors import ConfigError, DataError, FileFormatError
from tagid.files import make_folder, read_toml, storage_error, write_bytes

FORMAT_VERSION: Final = 1
MAX_BYTES: Final = 1 << 18
"""Largest profile, bytes: a pulse of some hundred samples is its largest part."""
_WRITE_AGAIN: Final = "Write it again with `tagid commission`, or delete it."
_DELAY_TOLERANCE_PS: Final = 20.0
"""Drift of the delay with the temperature of a P440 between two days (assumed; 3 mm of range)."""
_AXIS_TOLERANCE_M: Final = 0.005
"""How well a table stands in its old place after it was moved and put back (assumed)."""
_PERIOD_TOLERANCE: Final = 0.02
"""A free-running table of the same setting differs by less from day to day (assumed)."""


@dataclass(frozen=True)
class Measured:
    """A value and its standard error, in the same unit."""

    value: float
    sigma: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.value) and math.isfinite(self.sigma) and self.sigma >= 0):
            raise DataError(f"{self.value} with a standard error of {self.sigma} is no measurement")


@dataclass(frozen=True)
class Radar:
    """The radar that was commissioned, and the settings that the values hold for.

    Attributes:
        serial: serial number, 0 if it is not to be told.
        package: hardware package.
        antenna_mode, transmit_gain, integration: as in the P440 MRM API.
    """

    serial: int
    package: str
    antenna_mode: int
    transmit_gain: int
    integration: int


@dataclass(frozen=True, eq=False)
class RigProfile:
    """A commissioned rig.

    Attributes:
        date_utc: when it was commissioned, ISO 8601.
        radar: see `Radar`.
        path_delay_ps: two-way delay of cables and antennas for the stored pulse, ps.
        axis_distance_m: antennas to rotation axis, horizontally, m.
        antenna_height_m: of the antennas above the reflectors' plane, m.
        antenna_separation_m: between transmitting and receiving antenna, m.
        period_s: of a turn, s.
        direction: +1 counter-clockwise from above, -1 clockwise.
        speed_variation: RMS deviation of the angular speed, relative.
        system_gain_db: received echo over that of the link budget with its assumed losses, dB.
        noise_counts: standard deviation of the noise of a sample at the integration of `radar`, counts.
        pulse: as received from the reference target; its middle sample is time zero.
        software: version of tagid.
    """

    date_utc: str
    radar: Radar
    path_delay_ps: Measured
    axis_distance_m: Measured
    antenna_height_m: Measured
    antenna_separation_m: Measured
    period_s: Measured
    direction: int
    speed_variation: Measured
    system_gain_db: Measured
    noise_counts: Measured
    pulse: Pulse
    software: str = __version__

    def to_toml(self) -> dict[str, Any]:
        """The content of the file."""
        measured = {name: asdict(value) for name, value in vars(self).items() if isinstance(value, Measured)}
        return {
            "format": "tagid.rig",
            "format_version": FORMAT_VERSION,
            "date_utc": self.date_utc,
            "software": self.software,
            "radar": asdict(self.radar),
            "turntable": {"direction": self.direction},
            "measured": measured,
            "pulse": {
                "step_ps": self.pulse.step * 1e12,
                "samples": [round(float(sample), 5) for sample in self.pulse.samples],
            },
        }

    @classmethod
    def from_toml(cls, data: Mapping[str, Any], where: str) -> RigProfile:
        """The profile of a file's content. Raises FileFormatError naming the file."""
        try:
            if data["format"] != "tagid.rig" or data["format_version"] != FORMAT_VERSION:
                raise ValueError(f"format {data['format']}, version {data['format_version']}")
            names = [item.name for item in fields(cls) if item.type == "Measured"]
            measured = {name: Measured(**data["measured"][name]) for name in names}
            pulse = Pulse(
                np.array(data["pulse"]["samples"], dtype=np.float64), data["pulse"]["step_ps"] * 1e-12
            )
            direction = data["turntable"]["direction"]
            if direction not in (1, -1):
                raise ValueError(f"direction {direction}")
            for name in ("axis_distance_m", "period_s"):
                if measured[name].value <= 0:
                    raise ValueError(f"{name} {measured[name].value:g}")
            return cls(
                str(data["date_utc"]),
                Radar(**data["radar"]),
                direction=direction,
                pulse=pulse,
                software=str(data["software"]),
                **measured,
            )
        except (KeyError, TypeError, ValueError, DataError) as error:
            raise FileFormatError(
                f"{where} is no rig profile of this version: {error}", _WRITE_AGAIN
            ) from None

    @property
    def day(self) -> str:
        """The date alone, ISO 8601."""
        return self.date_utc[:10]

    def settings(self) -> dict[str, float]:
        """Settings of the configuration that the profile has values for."""
        return {
            "radar.cable_delay_ps": self.path_delay_ps.value,
            "radar.cable_delay_sigma_ps": self.path_delay_ps.sigma,
            "motion.axis_distance_m": self.axis_distance_m.value,
            "motion.antenna_height_m": self.antenna_height_m.value,
            "motion.antenna_separation_m": self.antenna_separation_m.value,
        }

    def contradictions(self, capture: Capture) -> tuple[str, ...]:
        """How a capture contradicts the profile, one sentence each: delay, axis, period, radar, band."""
        name = f"the rig profile of {self.day}"
        remarks = []
        delay, expected = capture.radar.cable_delay_ps, self.path_delay_ps
        if delay is not None and abs(delay - expected.value) > 3 * math.hypot(
            expected.sigma, _DELAY_TOLERANCE_PS
        ):
            remarks.append(
                f"the path delay of this recording is {delay:.0f} ps, {name} measured "
                f"{expected.value:.0f} ps: other cables, or a delay set by hand"
            )
        axis, measured = capture.axis_distance_m, self.axis_distance_m
        if axis is not None and abs(axis - measured.value) > 3 * math.hypot(
            measured.sigma, _AXIS_TOLERANCE_M
        ):
            remarks.append(
                f"the axis distance of this recording is {axis:.3f} m, {name} measured "
                f"{measured.value:.3f} m: radar or table moved, or a distance set by hand"
            )
        turned = capture.motion.resolved
        period = None if turned is None or turned.source == "nominal" else turned.period_s
        if period is not None:
            allowed = 3 * math.hypot(self.period_s.sigma, _PERIOD_TOLERANCE * self.period_s.value)
            if abs(period - self.period_s.value) > allowed:
                remarks.append(
                    f"a turn took {period:.2f} s, {name} measured {self.period_s.value:.2f} s: "
                    "another speed, or the table slips"
                )
        if not self.fits_band(capture):
            remarks.append(
                f"the band of this recording around {capture.center_frequency_hz / 1e9:.2f} GHz is not that "
                f"of {name}: its pulse is not used"
            )
        serial = capture.radar.serial
        if serial is not None and self.radar.serial and str(serial) != str(self.radar.serial):
            remarks.append(
                f"this recording is of another radar (serial {serial}) than {name}, whose path delay may not "
                "be its own: commission this one"
            )
        return tuple(remarks)

    def recorded_by(self, capture: Capture) -> bool:
        """Whether this radar recorded a capture through these antennas, so that it has this pulse."""
        config = capture.radar.config
        mode = None if config is None else config.antenna_mode
        same = str(capture.radar.serial) == str(self.radar.serial) and mode == self.radar.antenna_mode
        return same and self.fits_band(capture)

    def fits_band(self, capture: Capture) -> bool:
        """Whether most of the pulse's energy lies in the band of a capture."""
        energy = np.abs(np.fft.rfft(self.pulse.samples)) ** 2
        frequency = np.fft.rfftfreq(len(self.pulse.samples), self.pulse.step)
        inside = np.abs(frequency - capture.center_frequency_hz) <= capture.bandwidth_hz / 2
        return bool(energy[inside].sum() > 0.5 * energy.sum())


def read_profile(path: Path) -> RigProfile:
    """The profile of a file. Raises StorageError, FileFormatError."""
    return RigProfile.from_toml(read_toml(path, MAX_BYTES), str(path))


def installed_profile(folder: Path) -> RigProfile | None:
    """The profile in a data folder; None if the rig is not commissioned.

    Raises:
        StorageError: the file cannot be read. ConfigError: it is damaged.
    """
    path = folder / RIG_FILE
    try:
        data = read_toml(path, MAX_BYTES, missing_ok=True)
        return RigProfile.from_toml(data, str(path)) if data else None
    except FileFormatError as error:
        raise ConfigError(error.message, _WRITE_AGAIN) from None


def set_aside_damaged(folder: Path) -> Path | None:
    """Rename a damaged profile in a data folder; returns its new path, or None if it is not damaged.

    Raises StorageError.
    """
    try:
        installed_profile(folder)
    except ConfigError:
        path = folder / RIG_FILE
        aside = path.with_stem(f"{path.stem}.damaged")
        try:
            path.replace(aside)
        except OSError as error:
            raise storage_error(error, path, "renaming") from None
        return aside
    return None


def write_profile(profile: RigProfile, folder: Path) -> Path:
    """Write the profile into a data folder; returns the file. Raises StorageError, DiskFullError."""
    import tomli_w

    make_folder(folder)
    path = folder / RIG_FILE
    write_bytes(path, tomli_w.dumps(profile.to_toml()).encode())
    return path
