"""The objects of `tagid station --demo`: an enrolled one, and one with which enrolling can be tried."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from tagid.config import ConfigValue
from tagid.operate.workplace import Workplace

_OFF_AXIS_M: Final = 6e-3
_TURN_DEG: Final = 137.5
"""Rotation from one scan to the next: the golden section of a turn, which repeats no earlier pose."""
_NEW_FILE: Final = Path(__file__).with_name("demo_object.toml")


@dataclass(frozen=True)
class DemoObject:
    """An object on the table of the demonstration.

    Attributes:
        words: as the page offers it.
        radar: URL of its emulated radar.
        moves: whether it lies in another pose in each scan.
    """

    name: str
    words: str
    radar: str
    moves: bool = False

    def placed(self, place: Workplace, number: int) -> Workplace:
        """A workplace with this object on the table in a scan."""
        url = self.radar
        if self.moves:
            place_rad = 1.7 * number
            x, y = _OFF_AXIS_M * math.cos(place_rad), _OFF_AXIS_M * math.sin(place_rad)
            rotation = _TURN_DEG * number % 360
            url += f"&centre={x:.4f},{y:.4f}&rotation={rotation:.1f}&seed={number % 1000}"
        values = {**place.config.values, "radar.url": ConfigValue(url, "command line")}
        return Workplace(replace(place.config, values=values), place.background)


def demo_objects(scene: str, settings: Mapping[str, Any]) -> tuple[DemoObject, ...]:
    """The object of a demonstration with these settings, and another one that is not enrolled."""
    new = f"emulator://demo-object?file={quote(str(_NEW_FILE))}&reflector=octahedron&rpm=6&rate=1"
    return (
        DemoObject(scene, f"{scene} (the demonstration's own)", str(settings["radar.url"])),
        DemoObject("demo-object", "another object, which is not enrolled", new, moves=True),
    )
