"""Loads any recording as a capture prepared for imaging and reading.

read -> missing geometry -> reference background -> angles -> one turn. All commands and batch workers use
`load_capture`, so that a shared option has the same effect everywhere.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tagid.capture import Capture
from tagid.config import Config
from tagid.errors import ConfigError, DataError, UsageError
from tagid.imaging.bandcheck import band_warning
from tagid.pipeline.prepared import prepare
from tagid.pipeline.settings import ImagingSettings
from tagid.secret import MotionUrl
from tagid.storage.importers import read_any, remarks

_FLAT = 10.0
"""A path is in the x-z plane if its spread in x and z is this many times that in y."""
BACKGROUNDS = ("mean", "median", "reference", "none")


@dataclass(frozen=True)
class LoadDefault:
    """A value for captures that lack it.

    Attributes:
        value: the value; None if there is none.
        overrides: whether it also replaces the capture's own value (it was given on the command line).
    """

    value: Any = None
    overrides: bool = False


@dataclass(frozen=True, eq=False)
class LoadSettings:
    """Settings applied while a capture is loaded.

    Attributes:
        cable_delay_ps: two-way cable delay to subtract from the ranges of raw recordings, ps.
        node: number of the radar to read, if a log holds several.
        axis_distance_m, antenna_height_m, antenna_separation_m: geometry for captures that lack it, m.
        motion: URL of the device that rotated the object.
        motion_is_default: whether `motion` is the built-in default; a capture's URL then takes precedence.
        as_recorded: keep the angles of a capture even if the command line gives the motion, because the
            capture was recorded with it.
        wave_speed_m_s: replaces the wave speed of the capture, m/s.
        reference: recording of the empty scene to subtract; None for no subtraction.
        extent_m: width of the image, m, which tells how many views are needed.
    """

    cable_delay_ps: float = 0.0
    node: int | None = None
    axis_distance_m: LoadDefault = LoadDefault()
    antenna_height_m: LoadDefault = LoadDefault()
    antenna_separation_m: LoadDefault = LoadDefault()
    motion: LoadDefault = LoadDefault("free")
    motion_is_default: bool = True
    as_recorded: bool = False
    wave_speed_m_s: float | None = None
    reference: Capture | None = None
    extent_m: float = ImagingSettings.extent_m

    @classmethod
    def of(
        cls, config: Config, background: str = "mean", node: int | None = None, as_recorded: bool = False
    ) -> LoadSettings:
        """The settings of a configuration and of the option `--background`.

        Raises:
            UsageError: unknown background.
            ConfigError: a reference background is requested but was not recorded; StorageError and
                FileFormatError if its file cannot be read.
        """
        if background not in BACKGROUNDS:
            raise UsageError(f"`background` is {background!r}", f"Use {', '.join(BACKGROUNDS)}.")

        def default(name: str) -> LoadDefault:
            given = config.values[name]
            value = given.value.public if isinstance(given.value, MotionUrl) else given.value
            return LoadDefault(value, given.value is not None and given.source == "command line")

        return cls(
            config["radar.cable_delay_ps"],
            node,
            default("motion.axis_distance_m"),
            default("motion.antenna_height_m"),
            default("motion.antenna_separation_m"),
            default("motion.url"),
            config.values["motion.url"].source == "default",
            as_recorded,
            reference=_reference(config) if background == "reference" else None,
            extent_m=config["imaging.extent_m"],
        )

    def described(self) -> dict[str, Any]:
        """All settings that affect an answer, as JSON values."""
        given = {
            "motion.url": self.motion,
            "motion.axis_distance_m": self.axis_distance_m,
            "motion.antenna_height_m": self.antenna_height_m,
        }
        if self.antenna_separation_m.overrides:
            given["motion.antenna_separation_m"] = self.antenna_separation_m
        return {
            "given": {
                name: {"value": default.value, "from the command line": default.overrides}
                for name, default in given.items()
            },
            "cable_delay_ps": self.cable_delay_ps,
            "node": self.node,
            "wave_speed_m_s": self.wave_speed_m_s,
            "reference_uuid": None if self.reference is None else self.reference.uuid,
        }

    def motion_for(self, capture: Capture) -> str | None:
        """URL of the motion that determines the angles; None keeps those of the capture.

        Precedence: command line, angles or positions of the capture, the URL it was recorded with,
        configuration.
        """
        resolved = capture.angles_rad is not None or capture.antenna_positions_m is not None
        if self.motion.overrides and not (resolved and self.as_recorded):
            return str(self.motion.value)
        if resolved:
            return None
        if self.motion_is_default and capture.motion.url is not None:
            return capture.motion.url
        return str(self.motion.value)


def load_capture(source: Path | Capture, settings: LoadSettings | None = None, turn: bool = True) -> Capture:
    """A recording, prepared for imaging and reading.

    Args:
        source: a file in any supported format, or a capture in memory.
        settings: settings to apply; by default only the contents of the file are used.
        turn: resolve the angles and reduce the scans to one turn of views; False keeps every scan, for
            inspection.

    Raises:
        StorageError: the file cannot be read. FileFormatError: unknown format, or damaged.
        UsageError: scans of several radars and no `node`.
        DataError: no angles known or found, or the reference background does not match.
    """
    settings = settings or LoadSettings()
    capture = (
        source if isinstance(source, Capture) else read_any(source, settings.cable_delay_ps, settings.node)
    )
    distance, height = settings.axis_distance_m, settings.antenna_height_m
    if distance.overrides or (capture.axis_distance_m is None and distance.value is not None):
        capture = replace(capture, axis_distance_m=distance.value)
    if height.overrides:
        capture = replace(capture, antenna_height_m=height.value)
    if settings.antenna_separation_m.overrides:
        capture = replace(capture, antenna_separation_m=settings.antenna_separation_m.value)
    if settings.wave_speed_m_s is not None:
        capture = replace(capture, wave_speed_m_s=settings.wave_speed_m_s)
    if settings.reference is not None:
        from tagid.recording.calibration import without_background

        capture = without_background(capture, settings.reference)
    return prepare(capture, settings.motion_for(capture), settings.extent_m) if turn else capture


def intake_remarks(capture: Capture) -> tuple[str, ...]:
    """What a command says of a recording, one sentence each: how it was read, its samples and positions."""
    fault, up = None, _another_axis_up(capture)
    with suppress(DataError):  # a band that is none of a pulse, which imaging refuses
        fault = band_warning(capture)
    return (*remarks(capture), *filter(None, (fault, up)))


def _another_axis_up(capture: Capture) -> str | None:
    """A remark on antenna positions in the x-z plane, as trackers with y up export them."""
    if capture.antenna_positions_m is None or capture.views < 3:
        return None
    spread = capture.antenna_positions_m.std(axis=0)
    if spread[1] * _FLAT > min(spread[0], spread[2]):
        return None
    return (
        "the antenna moves in x and z only, and z is up: if y is up in the tracker's axes, store "
        "(x, -z, y) as antenna_positions_m"
    )


def _reference(config: Config) -> Capture:
    path = config["radar.background"]
    if not path:
        raise ConfigError(
            "there is no background reference",
            "Record one of the empty scene with `tagid radar calibrate --step empty`.",
        )
    return read_any(Path(path))
