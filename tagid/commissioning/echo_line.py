"""The newest scan as a line of text: what the antennas see while a step runs."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tagid.signal import analytic

WIDTH: Final = 24
"""Characters of the line, from the nearest range of the window to the farthest."""
_LEVELS: Final = "▁▂▃▄▅▆▇█"
_STEP_DB: Final = 6.0


def echo_line(samples: NDArray[np.generic]) -> str:
    """The largest echo of every part of the window, in steps of 6 dB below the largest of all.

    >>> echo_line(np.where(np.arange(240) == 200, 100, 1))[20]
    '█'
    """
    envelope = np.abs(analytic(np.asarray(samples)[None]))[0]
    peaks = np.array([part.max() for part in np.array_split(envelope, WIDTH) if part.size])
    below = -20 * np.log10(np.maximum(peaks, 1e-9) / max(float(envelope.max()), 1e-9))
    steps = np.clip(len(_LEVELS) - 1 - below // _STEP_DB, 0, None).astype(int)
    return "".join(_LEVELS[step] for step in steps)
