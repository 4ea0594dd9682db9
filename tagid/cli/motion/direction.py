"""True direction of a table, from scans of an object that is not its own mirror image.

A single antenna cannot distinguish a reversed table from the object's mirror image; a layout with known
positions resolves this.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from tagid.errors import DataError, UsageError

if TYPE_CHECKING:
    from tagid.capture import Capture
    from tagid.tags.layouts.layout import Layout

_LEAST_DIFFERENCE_M: Final = 5e-3
"""Smallest resolvable RMS distance between a layout and its mirror image: a few position errors."""


def chirality_m(layout: Layout) -> float:
    """RMS distance of a layout from its mirror image after the best rotation, shift and pairing, m."""
    from tagid.tags.layouts.codebook import best_pairing

    return best_pairing(layout.mirrored().positions, layout.positions, 0.2).rms_m


def turned_the_other_way(capture: Capture, layout: Layout) -> bool:
    """Whether the object rotated opposite to its capture's angles (its mirror image is read).

    Args:
        capture: prepared, with angles in the commanded direction.
        layout: the object on the table.

    Raises:
        UsageError: the layout is its own mirror image. DataError: neither it nor its mirror image is read.
    """
    from tagid.pipeline.identify import identify
    from tagid.pipeline.settings import ImagingSettings

    if layout.size > 7 or chirality_m(layout) < _LEAST_DIFFERENCE_M:
        raise UsageError(
            f"layout {layout.name} is its own mirror image (or has more than 7 reflectors)",
            "Use an object whose reflectors do not form a symmetric pattern.",
        )
    mirror = replace(layout.mirrored(), name=f"{layout.name}-mirrored")
    answer = identify(capture, [layout, mirror], ImagingSettings(direction_known=True))
    read = answer.reading.layout if answer.status == "identified" and answer.reading is not None else None
    if read not in (layout.name, mirror.name):
        raise DataError(
            f"neither layout {layout.name} nor its mirror image was read ({answer.status})",
            "Check --layout and the axis distance, and record a full revolution with a clear view of it.",
        )
    return read == mirror.name
