"""From a prepared capture to an image, without printing: one function for commands, reports and notebooks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tagid import __version__
from tagid.capture import Capture
from tagid.errors import UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.autofocus import AxisFocus, focus_axis_distance
from tagid.imaging.pulsefit import PulseEstimate
from tagid.imaging.region import Region, choose_region
from tagid.imaging.restore import restore
from tagid.imaging.types import Image
from tagid.pipeline.methods import METHODS as IMAGING_METHODS
from tagid.pipeline.methods import make_image
from tagid.pipeline.prepared import PreparedCapture, as_prepared
from tagid.pipeline.settings import ImagingSettings, Progress, Stopwatch


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An image with how it came about.

    Attributes:
        image: complex reflectivity.
        method: the method used, never "auto".
        focus: result of the search for the axis distance; None where there was none.
        region: path delay and place of the image for free antenna positions; None for a turntable.
        pulse: result of the estimate of the pulse; None where none was asked for.
        views: number of views imaged, after averaging.
        seconds: of each stage.
    """

    image: Image
    method: str
    focus: AxisFocus | None
    views: int
    seconds: dict[str, float]
    region: Region | None = None
    pulse: PulseEstimate | None = None


def reconstruct(
    capture: Capture | PreparedCapture,
    settings: ImagingSettings | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Image a prepared capture.

    Args:
        capture: the result of `prepare`, or a `PreparedCapture`, which brings its settings.
        settings: how to image it; only with a plain capture.
        progress: called with (done, total, remark) by the methods that iterate.

    Raises:
        DataError: too few views or bins, or the object lies outside the range window.
        MissingExtraError: the engine asked for is not installed.
    """
    prepared = as_prepared(capture, settings)
    settings = prepared.settings
    method = "ats" if settings.method == "auto" else settings.method
    watch = Stopwatch()
    grid = ImageGrid(settings.extent_m, settings.pixels)
    region: Region | None = None
    if prepared.given.antenna_positions_m is not None:
        with watch.stage("focus"):
            region = choose_region(
                prepared.given,
                grid,
                settings.centre_m,
                settings.delay_m,
                settings.background,
                settings.free_size,
            )
        grid = region.grid
        settings = replace(settings, extent_m=grid.extent, pixels=grid.pixels)
        prepared = PreparedCapture(region.capture, settings)
    elif settings.centre_m is not None:
        raise UsageError(
            "an image of a turntable lies about its axis", "Leave --centre away, or give a larger --extent."
        )
    scans = prepared.scans(settings.preprocessing_for_focus(IMAGING_METHODS[method].matched_filter))
    focus: AxisFocus | None = None
    if settings.focus_m > 0 and scans.aperture.angles is not None:
        with watch.stage("focus"):
            scans, focus = focus_axis_distance(scans, grid, settings.focus_m)
    with watch.stage("image"):
        image = make_image(scans, grid, method, settings.seed, settings.preset, progress, settings.ats)
        if settings.restore and IMAGING_METHODS[method].sparse and settings.preset != "paper":
            image = restore(image, scans.wavenumber)
    facts: dict[str, Any] = {
        "tool_version": __version__,
        "capture_uuid": prepared.given.uuid,
        "views": scans.aperture.views,
        "axis_distance_m": scans.aperture.axis_distance,
        "background": settings.background,
    }
    learned = image.settings.get("calibration", {}).get("axis")
    if learned:
        facts["axis_distance_m"] = learned["distance_m"]
    if region is not None:
        found = region.focus
        facts |= {"path_delay_m": found.delay_m if found else 0.0, "mirrored": region.mirrored}
        facts |= {"centre_m": list(region.centre_m), "extent_m": grid.extent}
        image = replace(image, centre_m=region.centre_m)
    facts["pulse"] = _pulse_facts(prepared)
    image = replace(image, settings={**image.settings, **facts})
    seconds = {**prepared.watch.seconds, **watch.seconds}
    return Reconstruction(
        image, method, focus, scans.aperture.views, seconds, region, prepared.pulse_estimate
    )


def _pulse_facts(prepared: PreparedCapture) -> dict[str, Any]:
    estimate = prepared.pulse_estimate
    if estimate is None:
        known = prepared.settings.pulse == "auto" and prepared.given.pulse is not None
        return {"kind": "measured" if known else "nominal"}
    numbers = {"assumed_residual": estimate.assumed_residual, "residual": estimate.residual}
    told = {name: value if np.isfinite(value) else None for name, value in numbers.items()}
    if not estimate.taken:
        return {"kind": "assumed", **told}
    # Enough for whoever wants to keep it in an NPZ file: `pulse` and `pulse_step_s`.
    samples = [round(float(v), 6) for v in estimate.pulse.samples]
    return {"kind": "estimated", **told, "pulse": samples, "pulse_step_s": estimate.pulse.step}
