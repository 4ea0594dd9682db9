"""The state of a recording at one time, as drawn by the terminal and the page."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tagid.imaging.types import Image
from tagid.reading.preview import LayoutEvidence

if TYPE_CHECKING:
    from tagid.pipeline.answer import Identification


class Phase(StrEnum):
    """Phase of a scan."""

    CONNECTING = "connecting"
    TURNING = "turning"
    READING = "reading"
    DONE = "done"
    FAILED = "failed"


@dataclass(frozen=True, eq=False)
class Sinogram:
    """The moving part of the echo over the scans so far.

    Attributes:
        rows: (n, bins) float32 envelope of the scans without their mean, counts; the oldest first.
        range_m: one-way range of the first and the last bin, m.
    """

    rows: NDArray[np.float32]
    range_m: tuple[float, float]


@dataclass(frozen=True, eq=False)
class LiveState:
    """State of a recording at one time.

    Attributes:
        frame: number of the state, increasing.
        scans, lost: complete scans and lost ones.
        seconds: from the first scan to the last, by the radar's clock, s.
        turned_rad: angle covered, not negative; None while neither the motion nor the scans determine it.
        views: views in the image.
        snr_db: of the scans so far, see `tagid.signal.snr_db`; None if nothing changes beyond the noise.
        sinogram: of the scans so far; None before three of them.
        image: backprojection of the views so far; None before there is one.
        evidence: for each layout, the likeliest first; empty with too few views.
        answer: the newest answer; None before there is one.
        final: whether the answer is that of the stored capture; until then it is read from the scans so far.
        answer_after_s: host time from the last scan until this answer was first available, s; negative if
            it was available before the last scan. None before the final answer.
        note: most recent remark for the user; empty if none.
    """

    phase: Phase = Phase.CONNECTING
    frame: int = 0
    scans: int = 0
    lost: int = 0
    seconds: float = 0.0
    turned_rad: float | None = None
    views: int = 0
    snr_db: float | None = None
    sinogram: Sinogram | None = None
    image: Image | None = None
    evidence: tuple[LayoutEvidence, ...] = ()
    answer: Identification | None = None
    final: bool = False
    answer_after_s: float | None = None
    note: str = ""

    @property
    def turn_share(self) -> float | None:
        """The covered fraction of a turn, 0..1; None if the angle is unknown."""
        return None if self.turned_rad is None else min(self.turned_rad / (2 * np.pi), 1.0)
