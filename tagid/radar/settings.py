"""The P440's configuration as a validated value, and the grid to which the radar rounds a scan window.

Client, emulator and importers use this module to get the number of samples and the scan period.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tagid.constants import (
    BIN_PS,
    BINS_PER_SAMPLE,
    CLIP_COUNTS_PER_INTEGRATION,
    RANGE_STEP_M,
    SAMPLES_PER_BLOCK,
    SPEED_OF_LIGHT,
)
from tagid.errors import ConfigError
from tagid.metadata import RadarSettings
from tagid.radar.messages import CONFIG_DTYPE, MAX_SAMPLES_PER_SCAN

if TYPE_CHECKING:
    from tagid.config import Config

MAX_SAMPLES: Final = MAX_SAMPLES_PER_SCAN // SAMPLES_PER_BLOCK * SAMPLES_PER_BLOCK
ANTENNA_MODES: Final = (0, 1, 2, 3, 255)
SCAN_OVERHEAD_S: Final = 0.867e-3
BLOCK_TIME_S: Final = 105.31e-9
"""Scan period at interval 0: 0.867 ms + (N / 12) * 2^PII * 105.31 ns (measured on recordings)."""

_LIMITS: Final = {
    "node_id": (0, 2**32 - 1),
    "base_integration_index": (6, 15),
    "transmit_gain": (0, 63),
    "code_channel": (0, 10),
    "persist": (0, 1),
    "scan_start_ps": (-(2**31), 2**31 - 1),
    "scan_stop_ps": (-(2**31), 2**31 - 1),
}


def _grid_bin(time_ps: int) -> int:
    """The last bin whose time, truncated to whole ps as the radar reports it, is not after `time_ps`.

    A reported time read back gives the same bin: 15000 -> bin 7864 -> 14999 ps -> bin 7864.
    """
    return math.ceil((time_ps + 1) / BIN_PS) - 1


def _grid_ps(grid_bin: int) -> int:
    return math.floor(grid_bin * BIN_PS)


@dataclass(frozen=True)
class RadarConfig:
    """Settings of one P440 (CONFIG block of the P440 MRM API).

    Attributes:
        scan_start_ps, scan_stop_ps: two-way time of the scan window, ps, cable and antenna delay included.
        node_id: the radar's number.
        base_integration_index: PII, 6..15; 2^PII pulses are summed into a sample.
        antenna_mode: 0 A/A, 1 B/B, 2 transmit A receive B, 3 transmit B receive A, 255 the radar's default.
        transmit_gain: 0..63.
        code_channel: 0..10.
        persist: 1 to keep the settings in flash.

    Raises ConfigError if a value is out of range or the window is empty or too long.
    """

    scan_start_ps: int = 10_000
    scan_stop_ps: int = 39_000
    node_id: int = 1
    base_integration_index: int = 11
    antenna_mode: int = 2
    transmit_gain: int = 63
    code_channel: int = 0
    persist: int = 0

    def __post_init__(self) -> None:
        for name, (low, high) in _LIMITS.items():
            value = getattr(self, name)
            if not isinstance(value, int) or not low <= value <= high:
                raise ConfigError(
                    f"radar setting {name} is {value}", f"Give a whole number from {low} to {high}."
                )
        if self.antenna_mode not in ANTENNA_MODES:
            raise ConfigError(
                f"radar setting antenna_mode is {self.antenna_mode}",
                "Give 0 (A/A), 1 (B/B), 2 (TxA-RxB), 3 (TxB-RxA) or 255 (default).",
            )
        if self.scan_stop_ps <= self.scan_start_ps:
            raise ConfigError(
                f"the scan window ends at {self.scan_stop_ps} ps and starts at {self.scan_start_ps} ps",
                "Give a scan stop beyond the scan start.",
            )
        if self.samples > MAX_SAMPLES:
            raise ConfigError(
                f"the scan window holds {self.samples} samples",
                f"Give a window of at most {MAX_SAMPLES} samples ({MAX_SAMPLES * RANGE_STEP_M:.0f} m).",
            )

    @property
    def samples(self) -> int:
        """Samples of a scan: the window on the radar's grid, rounded up to a multiple of 96."""
        bins = _grid_bin(self.scan_stop_ps) - _grid_bin(self.scan_start_ps)
        return SAMPLES_PER_BLOCK * max(1, math.ceil(bins / (BINS_PER_SAMPLE * SAMPLES_PER_BLOCK)))

    def configured(self, config: Config) -> RadarConfig:
        """The same with integration, gain and antenna mode of the configuration. Raises ConfigError."""
        return replace(
            self,
            base_integration_index=config["radar.integration"],
            transmit_gain=config["radar.gain"],
            antenna_mode=config["radar.antenna_mode"],
        )

    def on(self, radar: RadarConfig) -> RadarConfig:
        """The same with number and code channel of a radar, by which neighbours are told apart."""
        return replace(self, node_id=radar.node_id, code_channel=radar.code_channel)

    def quantised(self) -> RadarConfig:
        """The settings as the radar applies them: start and stop on its grid.

        >>> RadarConfig(scan_start_ps=15_000, scan_stop_ps=20_000).quantised().scan_start_ps
        14999
        >>> c = RadarConfig(scan_start_ps=36_684, scan_stop_ps=106_996)  # a real recording's
        >>> c.quantised() == c, c.samples
        (True, 1152)
        """
        start = _grid_bin(self.scan_start_ps)
        return replace(
            self,
            scan_start_ps=_grid_ps(start),
            scan_stop_ps=_grid_ps(start + self.samples * BINS_PER_SAMPLE),
        )

    @property
    def scan_period_s(self) -> float:
        """Shortest time between scans, s: 0.867 ms + (N / 12) * 2^PII * 105.31 ns (measured).

        >>> round(RadarConfig(scan_start_ps=36_684, scan_stop_ps=106_996).scan_period_s * 1e3, 3)
        21.572
        """
        return SCAN_OVERHEAD_S + self.samples / 12 * (1 << self.base_integration_index) * BLOCK_TIME_S

    @property
    def clip_counts(self) -> int:
        """Amplitude at which a sample saturates: 127 * 2^PII counts (measured)."""
        return CLIP_COUNTS_PER_INTEGRATION * (1 << self.base_integration_index)

    @property
    def range_step_m(self) -> float:
        """One-way range between samples, m."""
        return RANGE_STEP_M

    def range_start_m(self, cable_delay_ps: float = 0.0) -> float:
        """One-way range of the first sample after subtracting the two-way cable delay (ps), m."""
        return (self.scan_start_ps - cable_delay_ps) * 1e-12 * SPEED_OF_LIGHT / 2

    def to_record(self) -> np.void:
        """The 32-byte CONFIG block as a structured scalar of `CONFIG_DTYPE`."""
        record = np.zeros(1, CONFIG_DTYPE)
        for name, value in asdict(self).items():
            record[name] = value
        record["resolution_bins"] = BINS_PER_SAMPLE
        block: np.void = record[0]
        return block

    @classmethod
    def from_record(cls, record: Any) -> RadarConfig:
        """Settings from a CONFIG block (structured scalar). Segments are not implemented in the radar.

        Raises ConfigError for values that a P440 cannot have.
        """
        resolution = int(record["resolution_bins"])
        if resolution != BINS_PER_SAMPLE:
            raise ConfigError(
                f"the scan resolution is {resolution} bins",
                f"Set the radar to {BINS_PER_SAMPLE} bins, the only resolution that tagid supports.",
            )
        return cls(**{name: int(record[name]) for name in cls.__dataclass_fields__})

    def stored(self) -> RadarSettings:
        """The settings as stored in a capture."""
        return RadarSettings(**asdict(self))

    @classmethod
    def of_stored(cls, settings: RadarSettings) -> RadarConfig:
        """The settings of a recording, with the P440's defaults for unknown values. Raises ConfigError."""
        known = {name: getattr(settings, name) for name in cls.__dataclass_fields__}
        return cls(**{name: value for name, value in known.items() if value is not None})

    def to_bytes(self) -> bytes:
        """The 32 bytes of the CONFIG block."""
        return self.to_record().tobytes()

    @classmethod
    def from_bytes(cls, data: bytes) -> RadarConfig:
        """Settings from the 32 bytes of a CONFIG block. Raises ConfigError."""
        if len(data) != CONFIG_DTYPE.itemsize:
            raise ConfigError(
                f"a configuration block has {len(data)} bytes, expected {CONFIG_DTYPE.itemsize}"
            )
        return cls.from_record(np.frombuffer(data, CONFIG_DTYPE, 1)[0])
