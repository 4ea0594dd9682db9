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
    """

    present: float
    opinions: tuple[Opinion, ...]
    beyond: tuple[Detection, ...]
    model_sha256: str


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
    )


def _nearest(reflector: Reflector, found: Sequence[Detection]) -> Detection | None:
    gaps = [float(np.hypot(d.x_m - reflector.x_m, d.y_m - reflector.y_m)) for d in found]
    best = int(np.argmin(gaps)) if gaps else -1
    return found[best] if gaps and gaps[best] <= SAME_M else None
