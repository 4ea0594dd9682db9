"""A rotating scene as source of the radar emulator: one scan at a time, at the time of the scan.

It renders with the capture simulator's functions, so a scan over the wire and a simulated capture at the same
time contain the same echo.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tagid.constants import CLIP_COUNTS_PER_INTEGRATION, SPEED_OF_LIGHT
from tagid.errors import StorageError, UsageError
from tagid.files import read_head
from tagid.metadata import ObjectInfo
from tagid.radar.settings import RadarConfig
from tagid.simulate.acquisition import Acquisition, RangeWindow, Turn
from tagid.simulate.capture import object_settings
from tagid.simulate.noise import draw_noise
from tagid.simulate.render import PulseTable, antennas, echo_levels, render_bodies, render_room
from tagid.simulate.scene import Scene
from tagid.simulate.snr import Snr, noise_std_for

NOISE_COUNTS = 120.0
"""Noise std of one sample at integration index 11, counts (recordings: 90 to 160)."""
NOISE_INDEX = 11
_LEVEL_VIEWS = 72
"""Views per turn over which the SNR is computed."""
MAX_ANTENNA_HEIGHT_M = 10.0


def noise_counts(integration: int) -> float:
    """Noise std of one sample at an integration index, counts."""
    return NOISE_COUNTS * math.sqrt(2.0 ** (integration - NOISE_INDEX))


@dataclass(frozen=True)
class Stop:
    """A table that stops, as if it were held.

    Attributes:
        after_turns: turns since the first scan of a run.
        seconds: how long it stands, s; infinite where it does not go on.
    """

    after_turns: float
    seconds: float = math.inf

    def __post_init__(self) -> None:
        if not (0 <= self.after_turns < math.inf and self.seconds > 0):
            raise UsageError(
                f"the emulated table stops after {self.after_turns} turns for {self.seconds} s",
                "Give zero turns or more, and more than zero seconds.",
            )


class HeightFile:
    """Height of an emulated antenna, m, as another program writes it to a text file.

    Calling it returns the current height. A file that cannot be read for a moment leaves the height
    unchanged.

    Args:
        path: the file; it must contain a height when the emulator starts.

    Raises UsageError if it does not.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        read = self._read()
        if read is None:
            raise UsageError(
                f"{path} does not contain the height of the emulated antenna",
                f"Write a number of metres from -{MAX_ANTENNA_HEIGHT_M:g} to {MAX_ANTENNA_HEIGHT_M:g} to it.",
            )
        self._height = read

    def __call__(self) -> float:
        read = self._read()
        if read is not None:
            self._height = read
        return self._height

    def _read(self) -> float | None:
        try:
            height = float(read_head(self._path, 64))
        except (StorageError, ValueError):
            return None
        return height if abs(height) <= MAX_ANTENNA_HEIGHT_M else None


class TurningScene:
    """A scene on a turntable with constant speed (except for its wobble) from time zero.

    Echoes grow with the number of pulses integrated, 2^index, and noise with its square root; samples
    saturate at 127 * 2^index (P440 MRM API; measured on recordings).

    Args:
        rpm: turns per minute; 0 is stationary.
        seed: random seed of wobble and noise; scan `index` has the same noise whenever it is requested.
        acquisition: axis distance, height, pulse, placement, wobble, noise, beam, range law, direction. Its
            window, period, turns and recording are not used: the radar's configuration and rpm replace them.
            Its snr_db (20 by default) holds at integration index 11 and refers to what `snr` defines; a
            positive noise_std, at the same index, replaces it.
        cable_delay_s: two-way delay in addition to the path through the air, s.
        true_angle: replaces rpm: function from time.monotonic() to the angle, rad.
        stop: when the table stops; None for never. Not with `true_angle`.
        antenna_height: replaces the acquisition's height: function that returns the current height of the
            antenna above the object's plane, m, called for every scan.

    Attributes:
        snr: SNR and peaks over the noise at integration index 11.
    """

    def __init__(
        self,
        scene: Scene,
        rpm: float = 2.0,
        seed: int = 0,
        acquisition: Acquisition | None = None,
        cable_delay_s: float = 0.0,
        true_angle: Callable[[float], float] | None = None,
        antenna_height: Callable[[], float] | None = None,
        stop: Stop | None = None,
    ) -> None:
        if not (np.isfinite(rpm) and 0 <= rpm <= 1000):
            raise UsageError(f"the emulated table turns at {rpm} rpm", "Give 0 to 1000 turns per minute.")
        acq = Acquisition() if acquisition is None else acquisition
        self.scene, self.rpm, self.seed, self.cable_delay_s = scene, rpm, seed, cable_delay_s
        self._acquisition = acq
        self._table = PulseTable.of(acq.pulse)
        self._turn = Turn.random(acq.wobble, acq.direction, np.random.default_rng(seed))
        every = self._turn.angles(np.arange(_LEVEL_VIEWS) / _LEVEL_VIEWS)
        antenna = antennas(every, np.full(_LEVEL_VIEWS, acq.axis_distance_m), acq.antenna_height_m)
        around = replace(acq, window=RangeWindow.around(acq.axis_distance_m))
        levels = echo_levels(scene, around, antenna, self._table)
        snr_db = 20.0 if acq.snr_db is None else acq.snr_db
        self._noise = acq.noise_std or noise_std_for(snr_db, levels.of(acq.snr_reference))
        echo = render_bodies(scene.object, acq.placement, antenna, around, self._table)
        self.snr = Snr.of(levels, self._noise, echo)
        self._true_angle = true_angle
        self._stop = stop
        self._began_s = 0.0
        self._antenna_height = antenna_height
        self._monotonic: Callable[[float], float] | None = None
        self._room: tuple[RangeWindow, NDArray[np.complex128]] | None = None

    def about(self) -> ObjectInfo:
        """The object and the truth of a recording, as in `simulate_capture`; SNR at index 11."""
        return object_settings(self.scene, self._acquisition, self.snr)

    def follow(self, monotonic: Callable[[float], float]) -> None:
        """Set the function from the time since the start to time.monotonic()."""
        self._monotonic = monotonic

    def _turns(self, time_s: float) -> float:
        if self._true_angle is None:
            return self._moved_s(time_s) * self.rpm / 60
        if self._monotonic is None:
            raise UsageError(
                "a scene rotated by another device needs an emulated radar in real time", "Give rate=1."
            )
        # The angle includes the direction of rotation.
        angle = self._true_angle(self._monotonic(time_s))
        return self._turn.direction * angle / (2 * np.pi)

    def _moved_s(self, time_s: float) -> float:
        """Time for which the table has turned, s."""
        if self._stop is None or not self.rpm:
            return time_s
        stops_s = self._began_s + self._stop.after_turns * 60 / self.rpm
        return min(time_s, max(stops_s, time_s - self._stop.seconds))

    def angle(self, time_s: float) -> float:
        """True object angle at a time since the start, rad."""
        return float(self._turn.angles(np.array([self._turns(time_s)]))[0])

    def window(self, config: RadarConfig) -> RangeWindow:
        """The range bins of a configuration, without the cable delay."""
        start_s = config.scan_start_ps * 1e-12 - self.cable_delay_s
        return RangeWindow(start_s * SPEED_OF_LIGHT / 2, config.samples)

    def counts_per_unit(self, config: RadarConfig) -> float:
        """Counts of a unit reflector on the axis."""
        return float(NOISE_COUNTS / self._noise * 2.0 ** (config.base_integration_index - NOISE_INDEX))

    def room_echo(self, scene: Scene, config: RadarConfig) -> NDArray[np.complex128]:
        """(samples,) analytic echo of the room of a scene, in units of a reflector on the axis."""
        return render_room(scene, self.window(config), self._table)

    def clean(self, time_s: float, config: RadarConfig) -> NDArray[np.float64]:
        """(samples,) noise-free scan, counts, neither rounded nor clipped."""
        window = self.window(config)
        acq = replace(self._acquisition, window=window, views=1, turns=1.0)
        if self._room is None or self._room[0] != window:
            self._room = window, self.room_echo(self.scene, config)
        turns = np.array([self._turns(time_s)])
        distance = acq.axis_distance_m + self._turn.radial(turns)
        height = acq.antenna_height_m if self._antenna_height is None else self._antenna_height()
        antenna = antennas(self._turn.angles(turns), distance, height)
        echo = render_bodies(self.scene.object, acq.placement, antenna, acq, self._table)[0] + self._room[1]
        return np.asarray(echo.real * self.counts_per_unit(config), dtype=np.float64)

    def scan(self, index: int, time_s: float, config: RadarConfig) -> NDArray[np.int32]:
        """(config.samples,) int32 counts: scan `index`, which seeds its noise, as the radar would send it at
        a time since the table started, s.
        """
        if index == 0:
            self._began_s = time_s
        rng = np.random.default_rng([self.seed & 0xFFFFFFFF, index & 0xFFFFFFFF])
        noise = noise_counts(config.base_integration_index)
        shape, ranges = self._acquisition.noise, self.window(config).ranges_m
        counts = self.clean(time_s, config) + noise * draw_noise(shape, ranges, 1, rng)[0]
        clip = CLIP_COUNTS_PER_INTEGRATION * 2**config.base_integration_index
        return np.asarray(np.clip(np.rint(counts), -clip, clip), dtype=np.int32)
