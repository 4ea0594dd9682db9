"""The SNR of a simulated recording, and the peaks to which its noise is set.

The SNR is that of `tagid.signal.snr_db`: of everything that changes, so that it can be measured. The noise is
set by a peak instead, 20 log10(peak / sigma), with the same sigma: the standard deviation of the noise in one
sample of one scan. `peak` is the largest noise-free envelope over all scans and samples:

- per reflector ("reflector"): of the strongest single reflector's echo, as mounted on its body;
- summed ("summed"): of the echoes of all reflectors together, which may add up or cancel.

The body's own echo, the room and interference never count. A scene whose reflectors are not known one by one
has a reference instead: both peaks are the reference's, and it says which of the two that is. Without either,
they are those of the whole object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.signal import changing_power

REFERENCES = ("reflector", "summed")


@dataclass(frozen=True)
class EchoLevels:
    """Peaks over the noise may refer to, relative to the peak of a unit reflector on the axis.

    Attributes:
        reflector: peak of the strongest single reflector, or of the reference.
        summed: peak of all reflectors together, or of the reference.
        known: which of `REFERENCES` are peaks of reflectors; the others are those of the reference.
        reference: what is used in place of the scene's own reflectors, in words; empty if nothing is.
    """

    reflector: float
    summed: float
    known: tuple[str, ...] = REFERENCES
    reference: str = ""

    def of(self, reference: str) -> float:
        """The level of one of `REFERENCES`."""
        return self.reflector if reference == "reflector" else self.summed


@dataclass(frozen=True)
class Snr:
    """SNR of a recording and its peaks over the noise, dB; None if there is no noise, or no such echo.

    Attributes:
        reflector_db, summed_db: peak of the strongest reflector, and of all together.
        reference_db: peak of the reference, where it tells neither of the two.
        reference: see `EchoLevels`.
        changing_db: SNR, see `tagid.signal.snr_db`; None if nothing rotates.
    """

    reflector_db: float | None
    summed_db: float | None
    reference_db: float | None = None
    reference: str = ""
    changing_db: float | None = None

    @classmethod
    def of(cls, levels: EchoLevels, noise_std: float, echo: NDArray[np.complex128]) -> Snr:
        """From levels, standard deviation of one sample and noise-free scans (views, bins), in one unit."""
        reflector, summed = (
            ratio_db(levels.of(name), noise_std) if name in levels.known else None for name in REFERENCES
        )
        whole = None if levels.known else ratio_db(levels.reflector, noise_std)
        changing = ratio_db(float(np.sqrt(changing_power(echo))), noise_std)
        return cls(reflector, summed, whole, levels.reference, changing)

    def __str__(self) -> str:
        """The values that are known and what they refer to, as every command and table prints them."""
        peaks = ((self.reflector_db, " per reflector"), (self.summed_db, " summed"), (self.reference_db, ""))
        known = ", ".join(f"{value:.1f} dB{what}" for value, what in peaks if value is not None)
        snr = "nothing changes" if self.changing_db is None else f"SNR {self.changing_db:.1f} dB"
        what = f", of {self.reference}" * bool(self.reference)
        return f"{snr}; peak over noise {known}{what}" if known else "no noise"


def ratio_db(peak: float, noise_std: float) -> float | None:
    """20 log10(peak / sigma), dB; None if either is zero."""
    return float(20 * np.log10(peak / noise_std)) if peak > 0 and noise_std > 0 else None


def noise_std_for(snr_db: float, peak: float) -> float:
    """Standard deviation of one sample for a given peak and SNR."""
    return float(peak / 10 ** (snr_db / 20))
