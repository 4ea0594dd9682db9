"""Limits of a recording, as commands take them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Limits of a recording, besides the end of the revolution.

    Attributes:
        scans: number of scans; None to record a full revolution.
        max_seconds: longest duration, s.
    """

    scans: int | None
    max_seconds: float
