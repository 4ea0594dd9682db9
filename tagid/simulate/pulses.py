"""Random received pulses that differ from the nominal one, modelled on those of real radars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tagid.capture import Pulse

Range = tuple[float, float]
PULSE_STEP_S = 1e-11


@dataclass(frozen=True)
class PulseShapes:
    """Ranges of a pulse made of a main lobe, a ring and a late echo.

    They cover least-squares fits of four Gabor atoms to seven pulses recorded with P440 radars (residual 4 to
    10 % of the amplitude): main lobe at 3.98 to 4.28 GHz of 0.33 to 0.69 ns, a ring within 1.1 ns, an echo of
    0.18 to 0.34 at 1.6 to 2.3 ns.

    Attributes:
        main_hz, main_sigma_s: frequency and width of the main lobe.
        ring_amplitude, ring_delay_s, ring_hz, ring_sigma_s: the ring, amplitude relative to the main lobe.
        late_amplitude, late_delay_s, late_hz, late_sigma_s: the late echo.
    """

    main_hz: Range = (3.9e9, 4.3e9)
    main_sigma_s: Range = (0.2e-9, 0.6e-9)
    ring_amplitude: Range = (0.0, 0.4)
    ring_delay_s: Range = (0.3e-9, 1.1e-9)
    ring_hz: Range = (3.4e9, 4.4e9)
    ring_sigma_s: Range = (0.25e-9, 0.7e-9)
    late_amplitude: Range = (0.0, 0.35)
    late_delay_s: Range = (1.6e-9, 2.4e-9)
    late_hz: Range = (3.6e9, 4.0e9)
    late_sigma_s: Range = (0.25e-9, 0.6e-9)


def random_pulse(rng: np.random.Generator, shapes: PulseShapes | None = None) -> Pulse:
    """A pulse of main lobe, ring and late echo with random phases."""
    d = shapes or PulseShapes()
    t = np.arange(-300, 501) * PULSE_STEP_S
    ranges = (
        ((1.0, 1.0), (0.0, 0.0), d.main_hz, d.main_sigma_s),
        (d.ring_amplitude, d.ring_delay_s, d.ring_hz, d.ring_sigma_s),
        (d.late_amplitude, d.late_delay_s, d.late_hz, d.late_sigma_s),
    )
    # Fixed values draw nothing from the generator.
    atoms = [[low if low == high else float(rng.uniform(low, high)) for low, high in atom] for atom in ranges]
    samples = np.zeros(len(t))
    for a, delay, frequency, sigma in atoms:
        envelope = a * np.exp(-((t - delay) ** 2) / (2 * sigma**2))
        samples += envelope * np.cos(2 * np.pi * frequency * (t - delay) + rng.uniform(0, 2 * np.pi))
    # A pulse's time zero is its middle sample, so the shorter side is padded with zeros.
    return Pulse(np.concatenate([np.zeros(200), samples]), PULSE_STEP_S)
