"""How far an answer is from the truth of a simulated or emulated object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tagid.capture import Capture
from tagid.pipeline.answer import Identification
from tagid.tags.layouts.layout import Layout


@dataclass(frozen=True)
class Comparison:
    """Comparison of an answer with the truth of a simulated or emulated object.

    Attributes:
        layout: the layout that the object carries; None: it carries none.
        right: whether the answer names this layout, or nothing if there is none.
        rotation_error_deg: error of the rotation, at most 180 degrees divided by the layout's symmetry; None
            if the layout was not named or the rotation is unknown, as on an emulated table, which turns
            before the first scan, and of a layout measured from captures, whose directions are its own.
        centre_error_m: distance between estimated and true centre, m; None where the rotation's error is.
        instead: the wrong name that the answer gives; None if it gives none.
    """

    layout: str | None
    right: bool
    rotation_error_deg: float | None = None
    centre_error_m: float | None = None
    instead: str | None = None


def compare(capture: Capture, answer: Identification, layouts: Sequence[Layout]) -> Comparison | None:
    """Compare an answer with the truth of its capture; None if the capture holds none."""
    truth, carried = capture.object.truth, capture.object.layout
    if truth is None or answer.status == "failed":
        return None
    reading = answer.reading
    named = reading.layout if reading is not None and answer.status == "identified" else None
    if named is None or named != carried or reading is None:
        return Comparison(carried, named == carried, instead=None if named == carried else named)
    layout = next((layout for layout in layouts if layout.name == named), None)
    measured = layout is not None and layout.covariance is not None
    # An emulated table turns before the first scan: rotation and centre then are not those of the truth.
    if measured or capture.radar.kind != "simulated":
        return Comparison(carried, True)
    order = (layout.symmetry if layout is not None else 0) or 1
    turn = 360.0 / order
    rotation = centre = None
    if truth.rotation_deg is not None:
        rotation = float((reading.rotation_deg - truth.rotation_deg + turn / 2) % turn - turn / 2)
    if truth.centre_m is not None:
        centre = float(np.hypot(*np.subtract(reading.centre_m, truth.centre_m[:2])))
    return Comparison(carried, True, rotation, centre)
