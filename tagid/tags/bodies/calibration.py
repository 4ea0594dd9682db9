"""What the setting `tags.false_accept` rests on: order statistics of a stated population."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Bound:
    """The promise behind a name.

    Attributes:
        p_value: share of calibration objects, this one counted, that were at least as convincing.
        false_accept: the setting.
        objects: null and foreign objects in this stratum.
        stratum: which one.
        population: what they are.
    """

    p_value: float
    false_accept: float
    objects: int
    stratum: str
    population: str
