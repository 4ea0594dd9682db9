"""What the configuration adds to a capture that lacks it: where the radar stood and how the object turned.

The commands and the batch ask here, so that a file is completed alike whoever reads it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tagid.errors import ConfigError

if TYPE_CHECKING:
    from tagid.capture import Capture
    from tagid.config import Config


def complete(capture: Capture, config: Config) -> Capture:
    """The capture with the configuration's geometry where it has none, or where the command line insists."""
    changes: dict[str, Any] = {}
    for field, name in (
        ("axis_distance_m", "motion.axis_distance_m"),
        ("antenna_height_m", "motion.antenna_height_m"),
    ):
        given = config.values[name]
        lacking = field == "axis_distance_m" and capture.axis_distance_m is None
        if given.value is not None and (given.source == "command line" or lacking):
            changes[field] = given.value
    return replace(capture, **changes)


def motion_of(config: Config, capture: Capture) -> str | None:
    """Motion to apply to a file: what the command line says, else, where it has no angles, what it was
    recorded with, else the configuration."""
    given = config.values["motion.url"]
    if given.source == "command line":
        return str(given.value)
    if capture.angles_rad is not None or capture.antenna_positions_m is not None:
        return None
    recorded_with = capture.motion.get("url")
    if given.source == "default" and isinstance(recorded_with, str):
        return recorded_with
    return str(given.value)


def without_reference(capture: Capture, config: Config, background: str) -> Capture:
    """The capture without the empty scene, where `background` is "reference"; else as it is.

    Raises ConfigError where none was taken, DataError where it does not fit.
    """
    if background != "reference":
        return capture
    if not config["radar.background"]:
        raise ConfigError(
            "there is no background reference",
            "Take one of the empty scene with `tagid radar calibrate --step empty`.",
        )
    from tagid.calibration import without_background
    from tagid.storage.importers import read_any

    return without_background(capture, read_any(Path(config["radar.background"])))
