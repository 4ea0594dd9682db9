"""What the station works with, asked for at the start of each scan, report or enrolment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tagid.operate.workplace import TURN_S, Workplace


@dataclass(frozen=True)
class Source:
    """Source of the station's settings; queried whenever they are needed.

    Attributes:
        place: a workplace with the current settings. Raises ConfigError, UsageError, StorageError.
        max_seconds: longest recording, s.
        demo: whether an emulated radar is used.
    """

    place: Callable[[], Workplace]
    max_seconds: float = TURN_S
    demo: bool = False
