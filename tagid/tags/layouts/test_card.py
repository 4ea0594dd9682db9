"""The test card of a rig: four reflectors on a printed disc, under a name that no object can have.

It is no candidate of ordinary readings. Radii and gaps between the angles differ, so that its mirror image
and each card with a reflector missing are other arrangements; it fits on one sheet of A4 at 1:1.
"""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np

from tagid.tags.layouts.layout import Layout

NAME: Final = "test-card"
_RADII_M: Final = (0.072, 0.050, 0.066, 0.058)
_ANGLES_DEG: Final = (0.0, 80.0, 200.0, 275.0)


@cache
def test_card() -> Layout:
    """The layout of the card."""
    angles = np.deg2rad(_ANGLES_DEG)
    positions = np.array(_RADII_M)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return Layout(NAME, np.round(positions, 5), "other", label="test card", notes="for `tagid commission`")


test_card.__test__ = False  # type: ignore[attr-defined]
