"""A capture prepared for imaging and reading; each derived quantity is computed once and shared.

Imaging, reading and the network share its baseband scans and pulse.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from tagid.capture import Capture
from tagid.errors import DataError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.autofocus import AxisFocus, focus_axis_distance
from tagid.imaging.lengths import views_needed
from tagid.imaging.preprocess import PreprocessSettings, nominal, preprocess
from tagid.imaging.types import BasebandScans
from tagid.pipeline.join import heights_of, without_background_of_each_height
from tagid.pipeline.resolve import has_angles, one_turn
from tagid.pipeline.settings import ImagingSettings, Progress, Stopwatch
from tagid.pipeline.standstill import without_standstill

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
    moved = max(float(np.ptp(places, axis=0).max()) for places in antennas)
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
        settings: as given.
        watch: seconds per stage ("pulse", "preprocess").
    """

    def __init__(self, capture: Capture, settings: ImagingSettings | None = None) -> None:
        self.settings = settings or ImagingSettings()
        self.watch = Stopwatch()
        self._given = capture
        self._with_pulse: Capture | None = None
        self._estimate: PulseEstimate | None = None
        self._scans: dict[PreprocessSettings, BasebandScans] = {}
        self._focus: AxisFocus | None = None

    @property
    def given(self) -> Capture:
        """The capture as given, before a pulse was selected."""
        return self._given

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
        same axis in every image.

        Raises:
            DataError: as `scans`. UsageError: the search is too wide.
        """
        settings = self.settings
        if settings.focus_m == 0 or self._given.antenna_positions_m is not None:
            return None
        if self._focus is None:
            scans = self.scans(settings.preprocessing_for_focus(self._given, matched_filter=False))
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
            return replace(self._given, pulse=nominal(self._given))
        if settings.pulse == "auto":
            return self._given
        from tagid.imaging.pulsefit import estimate_pulse

        with self.watch.stage("pulse"):
            grid = ImageGrid(settings.extent_m, settings.pixels)
            report = None if progress is None else partial(_report_pulse, progress)
            found = estimate_pulse(self._given, grid, settings.background, settings.focus_m, report)
        self._estimate = found
        return replace(self._given, pulse=found.pulse)


def _report_pulse(progress: Progress, done: int, total: int) -> None:
    progress(done, total, "estimating the pulse")


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
