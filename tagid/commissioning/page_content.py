"""What the pages of a commissioning say and draw, in whatever form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tagid.commissioning.rows import StepReport
from tagid.constants import SAMPLE_STEP_S
from tagid.rig import RigProfile
from tagid.types import Floats


def heading(reports: Sequence[tuple[str, StepReport]], profile: RigProfile | None) -> tuple[str, str]:
    """(head line, sentence about the rig or nothing) of a page."""
    passed = all(report.passed for _, report in reports) and profile is not None
    head = "The rig is commissioned" if passed else "The rig is not commissioned yet"
    return head, "" if profile is None else f"Rig of {profile.day}, radar {profile.radar.serial}."


def plain(text: str) -> str:
    """A sentence without the marks around commands and settings."""
    return text.replace("`", "")


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve in a box.

    Attributes:
        x, y: its points.
        across, up: least and largest value that the box shows.
        title: of the box, with the unit across.
    """

    x: Floats
    y: Floats
    across: tuple[float, float]
    up: tuple[float, float]
    title: str

    def within(self, width: float, height: float) -> tuple[Floats, Floats]:
        """The points from the box's lower left corner, y upwards."""
        along = (self.x - self.across[0]) / (self.across[1] - self.across[0])
        above = (np.clip(self.y, *self.up) - self.up[0]) / (self.up[1] - self.up[0])
        return along * width, above * height

    def across_marks(self, width: float) -> list[tuple[float, str]]:
        """(place from the left side, words) of the whole numbers across."""
        first, last = self.across
        return [
            ((value - first) / (last - first) * width, f"{value:g}")
            for value in range(math.ceil(first), math.floor(last) + 1)
        ]

    def up_marks(self, height: float) -> list[tuple[float, str]]:
        """(place from the lower side, words) of the ends and the middle."""
        return [
            (share * height, f"{self.up[0] + share * (self.up[1] - self.up[0]):g}") for share in (0, 0.5, 1)
        ]


def curves_of(samples: Sequence[float]) -> tuple[Curve, Curve]:
    """The measured pulse over time and its spectrum."""
    wave: Floats = np.array(samples, dtype=np.float64)
    time_ns = np.asarray((np.arange(len(wave)) - len(wave) // 2) * SAMPLE_STEP_S * 1e9, dtype=np.float64)
    shown = (time_ns >= -2) & (time_ns <= 4)
    power = np.abs(np.fft.rfft(wave, 1024)) ** 2
    decibels = 10 * np.log10(np.maximum(power / power.max(), 1e-4))
    frequency = np.asarray(np.fft.rfftfreq(1024, SAMPLE_STEP_S) / 1e9, dtype=np.float64)
    band = (frequency >= 2.5) & (frequency <= 6)
    return (
        Curve(time_ns[shown], wave[shown], (-2.0, 4.0), (-1.0, 1.0), "pulse (ns)"),
        Curve(frequency[band], decibels[band], (2.5, 6.0), (-40.0, 0.0), "spectrum, dB (GHz)"),
    )
