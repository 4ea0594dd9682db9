"""What the shipped network says of the image beside what was read in the scans: a second witness.

The name comes from the scans; the network tells the operator whether a spot beyond the layout is a reflector
or a ghost, and whether there is any reflector on an object that was not named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from tagid.imaging.backprojection import backproject
from tagid.imaging.types import BasebandScans
from tagid.tags.network.detector import Detection, Detector
from tagid.tags.network.planes import GRID, NetworkInput
from tagid.tags.reading.reflectors import Reflector

PFA = 0.01
SAME_M = 0.012
"""A detection this near to a reflector of the reading is that reflector, m."""
SHOWN_M = 0.02
"""An image shows a reflector where a detection is this near, m: on a cup it seems up to 13 mm further out
than it was measured."""
SHOWN = 0.1
"""The image contradicts a name none of whose reflectors is more probable in it. Of 388 right names of
simulated tags, half of them on bodies, it contradicts 4, on cans at 12 to 18 views and up to 10 dB, of 76 of
full-wave tags none; of other layouts in the place of the 388 some 300."""


@dataclass(frozen=True)
class Opinion:
    """The network on one reflector of the reading: probabilities of its being one, and of being a ghost."""

    probability: float
    ghost: float


@dataclass(frozen=True)
class SecondLook:
    """The network's answer.

    Attributes:
        present: probability that the object carries any reflector.
        opinions: one for every reflector of the reading, in its order.
        beyond: reflectors that only the network sees, surest first.
        model_sha256: of the network's file.
        disagrees: what the image says otherwise than the reading's reflectors, in words; empty for nothing.
    """

    present: float
    opinions: tuple[Opinion, ...]
    beyond: tuple[Detection, ...]
    model_sha256: str
    disagrees: str = ""


@cache
def shipped_detector() -> Detector:
    """The package's network, opened once. Raises ModelError, StorageError."""
    return Detector.shipped()


def look_again(scans: BasebandScans, reflectors: Sequence[Reflector], offset_m: float = 0.0) -> SecondLook:
    """Compare the network's detections with the reflectors of a reading.

    Args:
        scans: with matched filter.
        reflectors: of the reading.
        offset_m: range offset that the reading found, m; it is the axis distance's error.
    """
    distance = scans.aperture.axis_distance
    if distance is not None and scans.aperture.angles is not None and distance + offset_m > 0:
        scans = scans.with_aperture(scans.aperture.with_axis_distance(distance + offset_m))
    detector = shipped_detector()
    answer = detector.detect(NetworkInput.of(backproject(scans, GRID), scans), pfa=1.0)
    threshold = detector.contract.threshold(PFA)
    nearest = [_nearest(r, answer.found) for r in reflectors]
    taken = {id(d) for d in nearest if d is not None}
    return SecondLook(
        answer.present,
        tuple(Opinion(0.0, 0.0) if d is None else Opinion(d.probability, d.ghost) for d in nearest),
        tuple(d for d in answer.found if d.probability >= threshold and id(d) not in taken),
        detector.sha256,
        disagreement([r for r in reflectors if r.matched], answer.found, threshold),
    )


def disagreement(own: Sequence[Reflector], found: Sequence[Detection], threshold: float) -> str:
    """What the image says otherwise than a name, in words; empty where it bears the name out.

    Args:
        own: the reflectors of what was named; none say nothing.
        found: all detections, however improbable.
        threshold: probability from which a detection elsewhere counts as a reflector.
    """
    if not own:
        return ""
    gaps = np.array([[np.hypot(d.x_m - r.x_m, d.y_m - r.y_m) for r in own] for d in found])
    near = gaps.reshape(len(found), len(own)).min(axis=1) <= SHOWN_M
    if not any(d.probability >= SHOWN for d, there in zip(found, near, strict=True) if there):
        return "the image does not show its reflectors"
    further = [d for d, there in zip(found, near, strict=True) if not there and d.probability >= threshold]
    if not further:
        return ""
    best = max(further, key=lambda d: d.probability)
    where = f"({best.x_m * 1e3:.0f}, {best.y_m * 1e3:.0f}) mm"
    return f"the image shows a reflector at {where} that it does not have"


def _nearest(reflector: Reflector, found: Sequence[Detection]) -> Detection | None:
    gaps = [float(np.hypot(d.x_m - reflector.x_m, d.y_m - reflector.y_m)) for d in found]
    best = int(np.argmin(gaps)) if gaps else -1
    return found[best] if gaps and gaps[best] <= SAME_M else None
