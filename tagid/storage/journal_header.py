"""What a journal states before its scans: all of a capture that is known when the recording begins."""

from __future__ import annotations

import uuid
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from tagid._version import __version__
from tagid.metadata import METADATA_VERSION, MotionInfo, ObjectInfo, RadarInfo
from tagid.storage.metadata import VERSION_KEY


def _new_uuid() -> str:
    return str(uuid.uuid4())


def _now_utc() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


@dataclass(frozen=True)
class JournalHeader:
    """The fields of a Capture besides the scans.

    Attributes:
        range_start_m, range_step_m: range of the first bin, and from bin to bin, m.
        axis_distance_m, antenna_height_m, antenna_separation_m: geometry, m; None: not known.
        radar, motion, object: what is known of each.
        uuid: of the capture.
        created_utc: start of the recording, ISO 8601.
        tool_version: of the writer.
    """

    range_start_m: float
    range_step_m: float
    axis_distance_m: float | None = None
    antenna_height_m: float | None = None
    antenna_separation_m: float | None = None
    radar: RadarInfo = field(default_factory=RadarInfo)
    motion: MotionInfo = field(default_factory=MotionInfo)
    object: ObjectInfo = field(default_factory=ObjectInfo)
    uuid: str = field(default_factory=_new_uuid)
    created_utc: str = field(default_factory=_now_utc)
    tool_version: str = __version__

    def to_json(self) -> dict[str, Any]:
        """The header as `JournalWriter` stores it and `journal_capture` reads it."""
        return {
            "range_start_m": self.range_start_m,
            "range_step_m": self.range_step_m,
            "axis_distance_m": self.axis_distance_m,
            "antenna_height_m": self.antenna_height_m,
            "antenna_separation_m": self.antenna_separation_m,
            "uuid": self.uuid,
            "created_utc": self.created_utc,
            "tool_version": self.tool_version,
            VERSION_KEY: METADATA_VERSION,
            "radar": self.radar.to_json(),
            "motion": self.motion.to_json(),
            "object": self.object.to_json(),
        }
