"""Limits of a recording, as commands take them, and the settings of a demo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from urllib.parse import quote


@dataclass(frozen=True)
class Limits:
    """Limits of a recording, besides the end of the revolution.

    Attributes:
        scans: number of scans; None to record a full revolution.
        max_seconds: longest duration, s.
    """

    scans: int | None
    max_seconds: float


def demo_settings(scene: str) -> dict[str, Any]:
    """Settings of a demo, by their configuration names: a P440 that is emulated in this process in real time.

    Raises UsageError for an unknown scene.
    """
    from tagid.recording.radars import emulated_object

    # Objects are never exactly on the axis: object and body are 6 mm off.
    url = f"emulator://{quote(scene)}?rpm=6&centre=0.005,-0.003&rate=1"
    emulated_object(url)
    return {"radar.url": url, "motion.url": "free?rpm=6", "motion.axis_distance_m": 1.0}
