"""The radar equation of a P440 and its antennas: SNR and counts of a reflector, with sources.

Per pulse, the energy received from a reflector of scattering length b (RCS 4 pi |b|^2) at range R, for an
effective radiated energy E and a receiving antenna of gain G, is

    E_r = E G lambda^2 |b|^2 / ((4 pi)^2 R^4)        (radar equation: Skolnik, Introduction to Radar Systems)

so an echo of envelope peak A, E_r = A^2 T / 2 with T the integral of the squared envelope, has, over noise
of power k T0 F B in a sample, the SNR

    (A / sigma)^2 = 2 E_r N / (k T0 F B T L)

after summing N = 2^PII pulses: noise adds in power and echoes add in amplitude.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.constants import (
    BANDWIDTH_HZ,
    CENTER_FREQUENCY_HZ,
    CLIP_COUNTS_PER_INTEGRATION,
    SPEED_OF_LIGHT,
)
from tagid.errors import UsageError
from tagid.radar.settings import BLOCK_TIME_S
from tagid.rig import RigProfile
from tagid.simulate.scatterers import Scatterer

BOLTZMANN = 1.380649e-23
"""J/K (SI, exact)."""
ROOM_K = 290.0
"""Reference temperature of a noise figure, K (IEEE)."""
MOST_GAIN = 63


@dataclass(frozen=True)
class Term:
    """One number of a budget."""

    name: str
    value: float
    unit: str
    source: str


_TAU_S = np.sqrt(np.log(10)) / (np.pi * BANDWIDTH_HZ)
EQUIVALENT_HZ = float(np.sqrt(np.pi) / (2 * np.pi * _TAU_S))
DURATION_S = float(np.sqrt(np.pi) * _TAU_S)
"""Of the nominal pulse s(t) = exp(-t^2 / 2 tau^2) cos(2 pi f t), 3.1 to 4.8 GHz at -10 dB: integral of its
power spectrum over the spectrum's peak, and of its squared envelope, peak 1."""
PULSE_RATE_HZ = 1 / BLOCK_TIME_S
"""The scan period contains 2^PII x 105.31 ns per block of samples."""


@dataclass(frozen=True)
class LinkBudget:
    """A P440 with its antennas.

    Attributes:
        transmit_gain: 0 to 63.
        integration: PII; 2^PII pulses are summed.
        density_dbm_mhz: radiated power per MHz in the main direction at full gain, dBm.
        step_db: change of the radiated power per step of the gain, dB.
        receive_gain_dbi: of the receiving antenna.
        noise_figure_db: of the receiver.
        loss_db: all other losses.
        loss_source: where that number comes from.
    """

    transmit_gain: int = MOST_GAIN
    integration: int = 11
    density_dbm_mhz: float = -41.3
    step_db: float = 0.3
    receive_gain_dbi: float = 3.0
    noise_figure_db: float = 5.0
    loss_db: float = 9.3
    loss_source: str = (
        "fitted: a trihedral of 0.3 m at 10 m then has the 33 dB of the corner reflector in a "
        "public P440 recording, whose size is not published; uncertain by 6 dB"
    )

    def __post_init__(self) -> None:
        if not 0 <= self.transmit_gain <= MOST_GAIN:
            raise UsageError(f"the transmit gain is {self.transmit_gain}", f"Give 0 to {MOST_GAIN}.")
        if not 6 <= self.integration <= 15:
            raise UsageError(f"the integration index is {self.integration}", "Give 6 to 15.")

    @classmethod
    def on(cls, rig: RigProfile | None, transmit_gain: int, integration: int) -> LinkBudget:
        """The budget of a commissioned rig, with its measured gain in the losses; without one as assumed."""
        if rig is None:
            return cls(transmit_gain, integration)
        gain = rig.system_gain_db
        source = f"measured on the rig of {rig.day}, +-{gain.sigma:.1f} dB (tagid commission)"
        return cls(transmit_gain, integration, loss_db=cls.loss_db - gain.value, loss_source=source)

    @property
    def pulse_energy_j(self) -> float:
        """Effective isotropically radiated energy of a pulse, J."""
        reduced = self.density_dbm_mhz - self.step_db * (MOST_GAIN - self.transmit_gain)
        watts_per_hz = 10 ** (reduced / 10) * 1e-3 / 1e6
        return float(watts_per_hz * EQUIVALENT_HZ / PULSE_RATE_HZ)

    def snr_db(self, length_m: float, range_m: float) -> float:
        """20 log10(peak / sigma) in one sample of one scan, as `tagid.simulate.snr` defines it.

        Args:
            length_m: effective scattering length |b| of the pulse's peak, see `effective_length_m`, m.
            range_m: distance from the antennas to the reflector, m.
        """
        if not (length_m > 0 and range_m > 0):
            raise UsageError(f"a length of {length_m} m at {range_m} m", "Give positive metres.")
        wavelength = SPEED_OF_LIGHT / CENTER_FREQUENCY_HZ
        received = self.pulse_energy_j * 10 ** (self.receive_gain_dbi / 10) * wavelength**2 * length_m**2
        received /= (4 * np.pi) ** 2 * range_m**4
        noise = BOLTZMANN * ROOM_K * 10 ** (self.noise_figure_db / 10) * EQUIVALENT_HZ * DURATION_S
        ratio = 2 * received * (1 << self.integration) / noise
        return float(10 * np.log10(ratio) - self.loss_db)

    def clipping_margin_db(self, snr_db: float, noise_counts: float) -> float:
        """Margin of an echo's peak below saturation, dB, from its SNR and the standard deviation of the noise
        of a sample, counts, both at this integration.
        """
        clip = CLIP_COUNTS_PER_INTEGRATION * 2.0**self.integration
        return float(20 * np.log10(clip / noise_counts) - snr_db)

    def terms(self) -> tuple[Term, ...]:
        """Every number, with its source."""
        return (
            Term(
                "radiated power density", self.density_dbm_mhz, "dBm/MHz",
                "limit for handheld UWB devices, 47 CFR 15.519 (c); the P440 is designed for it",
            ),
            Term(
                "equivalent bandwidth", EQUIVALENT_HZ / 1e6, "MHz",
                "nominal pulse, 3.1 to 4.8 GHz at -10 dB (tagid.waveform)",
            ),
            Term(
                "transmit gain", float(self.transmit_gain), "of 63",
                f"radar.gain; {self.step_db:g} dB per step below 63, assumed",
            ),
            Term(
                "pulse rate", PULSE_RATE_HZ / 1e6, "MHz",
                "105.31 ns per pulse, measured: scan periods of recordings",
            ),
            Term("radiated energy per pulse", self.pulse_energy_j * 1e12, "pJ", "density x bandwidth / rate"),
            Term(
                "receiving antenna", self.receive_gain_dbi, "dBi",
                "assumed: typical of planar elliptical dipoles like those of the kit",
            ),
            Term("noise figure", self.noise_figure_db, "dB", "assumed: typical of receivers in this band"),
            Term(
                "integration", float(10 * np.log10(1 << self.integration)), "dB",
                f"2^{self.integration} pulses summed (radar.integration)",
            ),
            Term(
                "losses", self.loss_db, "dB", self.loss_source,
            ),
        )  # fmt: skip


def effective_length_m(scatterer: Scatterer) -> float:
    """|b| of the peak of a scatterer's echo to the nominal pulse, which is filtered by its response.

    max_t |integral S(f) b(f) exp(2 pi j f t) df| / integral S(f) df, S the pulse's positive spectrum.
    """
    frequency: NDArray[np.float64] = np.arange(1.0e9, 7.0e9, 10e6)
    spectrum = np.exp(-((2 * np.pi * _TAU_S * (frequency - CENTER_FREQUENCY_HZ)) ** 2) / 2)
    echo = spectrum * scatterer.scattering_length(frequency)
    # The envelope does not depend on the origin of the frequency axis; 64-fold padding samples it finely.
    envelope = np.abs(np.fft.ifft(echo, 64 * len(frequency))) * 64 * len(frequency)
    return float(envelope.max() / spectrum.sum())


def rcs_dbsm(length_m: float) -> float:
    """Radar cross-section 4 pi b^2 of a scattering length, dB relative to 1 m^2."""
    return float(10 * np.log10(4 * np.pi * length_m**2))
