"""The signal-to-noise ratio of a recording: the one definition that simulator, emulator and benchmarks share.

SNR = 20 log10(peak / sigma). `sigma` is the standard deviation of the noise in one sample of one scan. `peak`
is the largest value over all scans and samples of the noise-free envelope (magnitude of the analytic signal):

- per reflector ("reflector"): of the strongest single reflector's echo, mounted as it is on its body;
- summed ("summed"): of the echoes of all reflectors together, which may add up or cancel.

The body's own echo, the room and interference never count. In a scene without reflectors both peaks are
that of the reference stated with the scene, or of the whole object where it states none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tagid.errors import UsageError

if TYPE_CHECKING:
    from tagid.simulate.acquisition import Acquisition
    from tagid.simulate.render import PulseTable
    from tagid.simulate.scattering import Body
    from tagid.simulate.scene import Scene

REFERENCES = ("reflector", "summed")


@dataclass(frozen=True)
class EchoLevels:
    """Peaks that the SNR refers to, where a unit reflector on the axis peaks at 1.

    Attributes:
        reflector: of the strongest single reflector.
        summed: of all reflectors together.
    """

    reflector: float
    summed: float

    def of(self, reference: str) -> float:
        """The level of one of `REFERENCES`. Raises UsageError for another name."""
        if reference not in REFERENCES:
            raise UsageError(f"the SNR refers to {reference!r}", f"Use {' or '.join(REFERENCES)}.")
        return self.reflector if reference == "reflector" else self.summed


@dataclass(frozen=True)
class Snr:
    """Both SNRs of a recording, dB; None if there is no noise or no echo."""

    reflector_db: float | None
    summed_db: float | None

    @classmethod
    def of(cls, levels: EchoLevels, noise_std: float) -> Snr:
        """From the levels and the standard deviation of one sample, in the same unit."""
        return cls(ratio_db(levels.reflector, noise_std), ratio_db(levels.summed, noise_std))

    def __str__(self) -> str:
        """Both numbers, as every command and table prints them."""
        shown = ["-" if x is None else f"{x:.1f} dB" for x in (self.reflector_db, self.summed_db)]
        return f"SNR {shown[0]} per reflector, {shown[1]} summed"


def ratio_db(peak: float, noise_std: float) -> float | None:
    """20 log10(peak / sigma), dB; None where either is zero."""
    return float(20 * np.log10(peak / noise_std)) if peak > 0 and noise_std > 0 else None


def noise_std_for(snr_db: float, peak: float) -> float:
    """Standard deviation of one sample that gives a peak an SNR."""
    return float(peak / 10 ** (snr_db / 20))


def echo_levels(
    scene: Scene, acquisition: Acquisition, antenna: NDArray[np.float64], table: PulseTable
) -> EchoLevels:
    """The levels of a scene for antenna positions (views, 3), m, by rendering its reflectors alone."""
    from tagid.simulate.render import render_bodies

    def peak(bodies: tuple[Body, ...]) -> float:
        echo = np.zeros((len(antenna), acquisition.range_window.bins), dtype=np.complex128)
        render_bodies(bodies, acquisition.placement, antenna, acquisition, table, echo)
        return float(np.abs(echo).max(initial=0.0))

    if scene.reference_amplitude is not None:
        return EchoLevels(scene.reference_amplitude, scene.reference_amplitude)
    tag = scene.tag
    if tag is None or not len(tag.positions):
        level = peak(scene.object) or 1.0
        return EchoLevels(level, level)
    return EchoLevels(
        max(peak((tag.single(i),)) for i in range(len(tag.positions))) or 1.0,
        peak((tag,)) or 1.0,
    )
