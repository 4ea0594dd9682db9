"""A capture prepared for imaging and reading; each derived quantity is computed once and shared.

Imaging, reading and the network share its baseband scans and pulse.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tagid.capture import Capture
from tagid.config import Config, data_folder
from tagid.errors import ConfigError, DataError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.autofocus import AxisFocus, focus_axis_distance
from tagid.imaging.bandcheck import band_warning
from tagid.imaging.lengths import views_needed
from tagid.imaging.preprocess import PreprocessSettings, nominal, preprocess
from tagid.imaging.types import BasebandScans
from tagid.pipeline.join import heights_of, without_background_of_each_height
from tagid.pipeline.resolve import has_angles, one_turn, without_standstill
from tagid.pipeline.settings import ImagingSettings, Stopwatch
from tagid.rig import RigProfile, installed_profile
from tagid.secret import MotionUrl
from tagid.storage.importers import read_any, remarks
from tagid.types import Progress

if TYPE_CHECKING:
    from tagid.imaging.pulsefit import PulseEstimate

MAX_VIEWS = 2000
"""Most views of a turn or a path, so that an image takes seconds. Those of free antenna positions are
decimated, not averaged."""
_STILL_WAVELENGTHS = 1e-3


def prepare(
    capture: Capture, motion: str | None = None, extent_m: float = ImagingSettings.extent_m
) -> Capture:
    """The capture as required by imaging: known angles, one revolution, as many views as the image needs.

    Args:
        capture: any capture.
        motion: URL of the motion device; None keeps the angles of the capture, or estimates the rotation
            period from the data if it has none.
        extent_m: width of the image, m. Denser scans are averaged into the views that it needs
            (`tagid.imaging.lengths.views_needed`).

    Raises:
        DataError: the angles are neither known nor found in the data.
    """
    if motion is not None or not has_angles(capture):
        from tagid.pipeline.turn import resolve_turn

        capture = resolve_turn(capture, motion)
    if capture.antenna_positions_m is not None:
        return one_turn(capture, MAX_VIEWS)
    capture = without_standstill(capture)
    return one_turn(capture, min(views_needed(extent_m, capture.wavelength_m), MAX_VIEWS))


def check_moved(capture: Capture) -> None:
    """Raise DataError if several views were taken from one place: they tell ranges only, not bearings."""
    wavelength = capture.wave_speed_m_s / capture.center_frequency_hz
    antennas = capture.aperture().antennas
    moved = max(float(np.ptp(positions, axis=0).max()) for positions in antennas)
    if capture.views > 1 and moved < _STILL_WAVELENGTHS * wavelength:
        what = "angles" if capture.angles_rad is not None else "antenna positions"
        remedy = f"Give each view its own {'angle' if capture.angles_rad is not None else 'position'}."
        if capture.motion.resolved is not None:
            remedy = "Check the speed, and the unit of the times: timestamps_s is in seconds."
        raise DataError(
            f"the {what} of all {capture.views} views are the same: nothing is seen from one place", remedy
        )


class PreparedCapture:
    """A prepared capture with its settings, pulse and baseband scans.

    Args:
        capture: the result of `prepare`.
        settings: settings of imaging and reading.

    Attributes:
        given: the capture, before a pulse was selected.
        settings: as given.
        watch: seconds per stage ("pulse", "preprocess").
    """

    def __init__(self, capture: Capture, settings: ImagingSettings | None = None) -> None:
        self.settings = settings or ImagingSettings()
        self.watch = Stopwatch()
        self.given = capture
        self._with_pulse: Capture | None = None
        self._estimate: PulseEstimate | None = None
        self._scans: dict[PreprocessSettings, BasebandScans] = {}
        self._focus: AxisFocus | None = None

    @property
    def capture(self) -> Capture:
        """The capture with the pulse selected by the settings. Raises DataError if the estimate fails."""
        return self.choose_pulse()

    def choose_pulse(self, progress: Progress | None = None) -> Capture:
        """As `capture`; an estimate, which takes a while, reports its progress as (done, total, remark)."""
        if self._with_pulse is None:
            self._with_pulse = self._selected_pulse(progress)
        return self._with_pulse

    def elsewhere(self, capture: Capture) -> PreparedCapture:
        """Other scans, made from `capture`, with these settings: their pulse is chosen already."""
        return PreparedCapture(capture, replace(self.settings, pulse="auto"))

    def at_axis(self, distance_m: float, held_out: bool = True) -> PreparedCapture:
        """The same scans with the axis at a known distance, m, which is not searched for; without `held_out`
        images do not say how well they predict held-out views, whatever the settings ask for.
        """
        settings = replace(self.settings, focus_m=0.0, held_out=self.settings.held_out and held_out)
        return PreparedCapture(replace(self.given, axis_distance_m=distance_m), settings)

    @property
    def pulse_estimate(self) -> PulseEstimate | None:
        """The estimate of the pulse; None if the settings select none."""
        return self._estimate if self.capture is not None else None

    def scans(self, settings: PreprocessSettings) -> BasebandScans:
        """The baseband scans for these settings, computed at the first call.

        Raises:
            DataError: too few views or bins, or the object is outside the range window.
        """
        if settings not in self._scans:
            capture = self.capture
            with self.watch.stage("preprocess"):
                if settings.background != "none" and len(heights_of(capture)) > 1:
                    # The room's echo depends on the antenna's height.
                    clean = without_background_of_each_height(capture, settings.background)
                    plain = replace(settings, background="none")
                    made = replace(preprocess(clean, settings=plain), background_removed=True)
                else:
                    made = preprocess(capture, settings=settings)
                self._scans[settings] = made
        return self._scans[settings]

    def focus(self) -> AxisFocus | None:
        """The search for the axis distance, one for all methods and for reading; None without a search.

        It takes the scans without the matched filter, whatever the method takes: the same capture has the
        same axis in every image. Raises DataError as `scans`. UsageError: the search is too wide.
        """
        settings = self.settings
        if settings.focus_m == 0 or self.given.antenna_positions_m is not None:
            return None
        if self._focus is None:
            scans = self.scans(settings.preprocessing_for_focus(self.given, matched_filter=False))
            with self.watch.stage("focus"):
                grid = ImageGrid(settings.extent_m, settings.pixels)
                _, self._focus = focus_axis_distance(scans, grid, settings.focus_m)
        return self._focus

    def focused(self, scans: BasebandScans) -> BasebandScans:
        """Scans of this capture under the axis distance of `focus`, or unchanged where none was taken."""
        focus = self.focus()
        if focus is None or not focus.reliable or focus.axis_distance_m is None:
            return scans
        return scans.with_aperture(scans.aperture.with_axis_distance(focus.axis_distance_m))

    def _selected_pulse(self, progress: Progress | None) -> Capture:
        settings = self.settings
        if settings.pulse == "nominal":
            return replace(self.given, pulse=nominal(self.given))
        if settings.pulse == "auto":
            return self.given
        from tagid.imaging.pulsefit import estimate_pulse

        with self.watch.stage("pulse"):
            grid = ImageGrid(settings.extent_m, settings.pixels)
            report = remarked(progress, "estimating the pulse")
            estimate = estimate_pulse(self.given, grid, settings.background, settings.focus_m, report)
        self._estimate = estimate
        return replace(self.given, pulse=estimate.pulse)


def remarked(progress: Progress | None, remark: str) -> Callable[[int, int], None]:
    """Passes (done, total) on with a remark."""

    def report(done: int, total: int) -> None:
        if progress is not None:
            progress(done, total, remark)

    return report


def as_prepared(capture: Capture | PreparedCapture, settings: ImagingSettings | None) -> PreparedCapture:
    """The prepared capture itself, or one of a plain capture and settings.

    Raises UsageError if settings are given with a `PreparedCapture`, which has its own.
    """
    if isinstance(capture, Capture):
        return PreparedCapture(capture, settings)
    if settings is not None and settings != capture.settings:
        raise UsageError(
            "a PreparedCapture has its own settings", "Create a new one with different settings."
        )
    return capture


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
        rig: profile of the commissioned rig, whose pulse is used for captures of its radar.
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
    rig: RigProfile | None = None

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
            rig=installed_profile(data_folder()),
        )

    @property
    def yielding(self) -> LoadSettings:
        """The same for recordings made elsewhere: what they say precedes what was given."""
        given = {
            name: replace(getattr(self, name), overrides=False)
            for name in ("axis_distance_m", "antenna_height_m", "antenna_separation_m", "motion")
        }
        return replace(self, **given, motion_is_default=True)

    def against_the_rig(self, capture: Capture) -> tuple[str, ...]:
        """How a recording contradicts the profile of the rig; nothing for a simulated one."""
        simulated = capture.radar.kind == "simulated"
        return () if self.rig is None or simulated else self.rig.contradictions(capture)

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
            "rig": None if self.rig is None else self.rig.date_utc,
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


def load_capture(
    source: Path | str | Capture, settings: LoadSettings | None = None, turn: bool = True
) -> Capture:
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
    if settings.rig is not None and capture.pulse is None and settings.rig.recorded_by(capture):
        capture = replace(capture, pulse=settings.rig.pulse)
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
