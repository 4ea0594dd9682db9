"""Receiver noise: white or coloured, and narrow-band interference.

All noise is scaled to the standard deviation of one sample, to which an SNR refers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.constants import SPEED_OF_LIGHT
from tagid.errors import UsageError

_COLOUR_CENTRE_HZ = 3.95e9
_COLOUR_WIDTH_HZ = 0.85e9
"""Centre and half width of the P440's band, 3.1 to 4.8 GHz: a receiver filter shapes noise like a pulse."""


@dataclass(frozen=True)
class Interference:
    """A narrow-band transmitter: a tone of random phase in every scan.

    Attributes:
        level_db: RMS of the tone over the standard deviation of the noise, dB.
        frequency_hz: frequency of the tone, Hz.
        duty: fraction of the scans that contain it.
    """

    level_db: float
    frequency_hz: float = 3.5e9
    duty: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.level_db) and self.level_db <= 60):
            raise UsageError(f"interference of {self.level_db} dB", "Give at most 60 dB over the noise.")
        if not (1e8 <= self.frequency_hz <= 1e10 and 0 <= self.duty <= 1):
            raise UsageError(
                f"interference at {self.frequency_hz} Hz in {self.duty} of the scans",
                "Give 0.1 to 10 GHz and a fraction of 0 to 1.",
            )


@dataclass(frozen=True)
class NoiseShape:
    """The type of noise of a recording; its level is set in the acquisition.

    Attributes:
        colour: fraction of the noise power that has passed a filter of the radar's band; 0 is white noise.
        interference: a tone on top of the noise; None for none.
    """

    colour: float = 0.0
    interference: Interference | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.colour <= 1:
            raise UsageError(f"colour of the noise is {self.colour}", "Give 0 (white) to 1 (radar's band).")


def draw_noise(
    shape: NoiseShape, ranges_m: NDArray[np.float64], views: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """(views, bins) noise of unit standard deviation per sample, plus the tone, at equidistant one-way ranges
    (bins,), m. White noise draws in the order of the samples.
    """
    bins = len(ranges_m)
    noise = rng.standard_normal((views, bins))
    delay = 2 * ranges_m / SPEED_OF_LIGHT
    if shape.colour > 0 and bins > 1:
        # Twice the length, so that the two ends of a scan are independent.
        filtered = np.fft.rfft(rng.standard_normal((views, 2 * bins)), axis=1)
        frequency = np.fft.rfftfreq(2 * bins, delay[1] - delay[0])
        gain = np.exp(-0.5 * ((frequency - _COLOUR_CENTRE_HZ) / (_COLOUR_WIDTH_HZ / 2)) ** 2)
        # Every bin but the first and last of a real spectrum represents two.
        power = (2 * np.sum(gain**2) - gain[0] ** 2 - gain[-1] ** 2) / (2 * bins)
        coloured = np.fft.irfft(filtered * gain / np.sqrt(power), axis=1, n=2 * bins)[:, :bins]
        noise = np.sqrt(1 - shape.colour) * noise + np.sqrt(shape.colour) * coloured
    tone = shape.interference
    if tone is not None:
        phase = rng.uniform(0, 2 * np.pi, (views, 1))
        hit = rng.uniform(size=(views, 1)) < tone.duty
        level = np.sqrt(2) * 10 ** (tone.level_db / 20) * hit
        noise = noise + level * np.cos(2 * np.pi * tone.frequency_hz * delay + phase)
    return np.asarray(noise, dtype=np.float64)
