"""From a prepared capture to an image, without printing: one function for commands, reports and notebooks."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid._version import __version__
from tagid.capture import Capture
from tagid.errors import MissingExtraError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.ats.adapt import fit_adapted, settings_of
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.autofocus import FAR_WAVELENGTHS, AxisFocus
from tagid.imaging.backprojection import backproject
from tagid.imaging.bandcheck import band_warning
from tagid.imaging.copies import path_warning
from tagid.imaging.coupled import coupled_recovery
from tagid.imaging.facts import HeldOutFacts, OutsideFacts, facts_of, is_coupled
from tagid.imaging.farfield import polar_format, range_doppler
from tagid.imaging.geometrycheck import axis_warning, turn_warning
from tagid.imaging.heldout import check, left_out
from tagid.imaging.lengths import finest_cell_m, pixel_warning
from tagid.imaging.outside import NOT_SEARCHED, Outside, find_outside, views_searched
from tagid.imaging.preprocess import select_views
from tagid.imaging.pulsefit import PulseEstimate
from tagid.imaging.region import Region, choose_region
from tagid.imaging.restore import restore
from tagid.imaging.sparse import omp, sparse_recovery
from tagid.imaging.types import BasebandScans, Image
from tagid.pipeline.prepared import PreparedCapture, as_prepared, check_moved, remarked
from tagid.pipeline.settings import MOST_FREE_PIXELS, ImagingSettings, Stopwatch
from tagid.types import Progress

OMP_POINTS = 32
"""Maximum number of points of matching pursuit: two to three times the number of reflectors of a tag."""
OMP_STOP = 4.5
"""Matching pursuit stops when no correlation exceeds this number of noise standard deviations: the largest
of 10^4 pixels of pure noise reaches 3.5 to 4."""


@dataclass(frozen=True)
class MethodInfo:
    """A method and its preprocessing requirements.

    Attributes:
        title: title for tables and pictures.
        matched_filter: whether it needs scans correlated with the pulse.
        sparse: whether its pixels are reflectivities, finer than the resolution of the data.
    """

    title: str
    matched_filter: bool
    sparse: bool = False


METHODS = {
    "bp": MethodInfo("matched-filter BP", True),
    "bp-raw": MethodInfo("BP", False),
    "range-doppler": MethodInfo("range-Doppler", True),
    "polar": MethodInfo("polar format", True),
    "sparse": MethodInfo("FISTA", False, True),
    "omp": MethodInfo("OMP", False, True),
    "ats": MethodInfo("ATS", False, True),
}


def make_image(
    scans: BasebandScans,
    grid: ImageGrid,
    method: str,
    seed: int = 0,
    preset: str = "field",
    progress: Progress | None = None,
    ats: AtsSettings | None = None,
) -> Image:
    """Image of scans, preprocessed as its `MethodInfo` requires, by a method of `METHODS`.

    The preset of ats is "field", with the settings `ats` but for their seed, or "paper". `progress` is called
    during the slow methods.
    """

    def steps(step: int, of: int, loss: float) -> None:
        if progress:
            progress(step, of, f"loss {loss:.3g}")

    if method in ("bp", "bp-raw"):
        return backproject(scans, grid)
    if method == "sparse":
        return sparse_recovery(scans, grid)
    if method == "omp":
        return omp(scans, grid, OMP_POINTS, OMP_STOP)
    if method in ("range-doppler", "polar"):
        return (polar_format if method == "polar" else range_doppler)(scans, grid)
    if preset == "paper":
        if importlib.util.find_spec("torch") is None:
            raise MissingExtraError(
                "`preset=paper` needs torch",
                "Install it with `pip install 'tagid[ats]'`, or use `preset=field`.",
            )
        from tagid.imaging.ats.fit_paper import PaperSettings, fit_paper

        return fit_paper(scans, grid, PaperSettings(seed=seed), steps)
    return fit_adapted(scans, grid, replace(ats or AtsSettings(), seed=seed), steps).image


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An image and how it was computed.

    Attributes:
        image: complex reflectivity.
        method: the method used, never "auto".
        focus: result of the search for the axis distance; None if there was none.
        region: path delay and position of the image for free antenna positions; None for a turntable.
        pulse: result of the pulse estimate; None if not requested.
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
    *,
    tell_outside: bool = True,
) -> Reconstruction:
    """Image a prepared capture.

    Args:
        capture: the result of `prepare`, or a `PreparedCapture`, which has its own settings.
        settings: imaging settings; only with a plain capture.
        progress: called with (done, total, remark) by iterative methods.
        tell_outside: search echoes outside the image also for methods that cannot subtract them.

    Raises:
        DataError: too few views or bins, or the object lies outside the range window.
        MissingExtraError: the requested engine is not installed.
    """
    prepared = as_prepared(capture, settings)
    method = "ats" if prepared.settings.method == "auto" else prepared.settings.method
    watch = Stopwatch()
    check_moved(prepared.given)
    prepared, settings, grid, region = _placed(prepared, watch)
    check_extent(prepared.given, grid)
    prepared.choose_pulse(progress)
    matched = METHODS[method].matched_filter
    scans = prepared.scans(settings.preprocessing_for_focus(prepared.given, matched))
    focus, scans = prepared.focus(), prepared.focused(scans)
    unfiltered, sparse = _unfiltered(prepared, scans, method), METHODS[method].sparse
    outside: Outside | None = None
    with watch.stage("focus"):
        warnings, focus = _geometry(prepared, grid, focus)
    if settings.outside and settings.preset != "paper" and (tell_outside or sparse):
        with watch.stage("outside"):
            remark = remarked(progress, "echoes outside the image")
            outside = find_outside(unfiltered, grid, remark, subtracts=sparse)
            if sparse and not views_searched(unfiltered, grid, sparse):
                warnings.append(NOT_SEARCHED)
    subtracted = outside is not None and sparse
    imaged = outside.removed(scans) if outside is not None and subtracted else scans
    with watch.stage("image"):
        image = make_image(imaged, grid, method, settings.seed, settings.preset, progress, settings.ats)
    with watch.stage("held out"):
        remark = remarked(progress, "held-out views")
        predicted = _held_out(prepared, scans, grid, method, settings, image, subtracted, remark)
    with watch.stage("image"):
        if settings.restore and METHODS[method].sparse and settings.preset != "paper":
            image = restore(image, scans.wavenumber)
    beyond = None if outside is None else outside.facts(subtracted)
    facts = _facts(prepared, scans, image, focus, region, beyond, predicted, warnings)
    centre_m = image.centre_m if region is None else region.centre_m
    image = replace(image, centre_m=centre_m, settings={**image.settings, **facts})
    seconds = {**prepared.watch.seconds, **watch.seconds}
    return Reconstruction(
        image, method, focus, scans.aperture.views, seconds, region, prepared.pulse_estimate
    )


def _geometry(
    prepared: PreparedCapture, grid: ImageGrid, focus: AxisFocus | None
) -> tuple[list[str], AxisFocus | None]:
    """What seems to be wrong with the angles, or else with an axis distance that was not found better; it is
    the reason of the focus, too.
    """
    if prepared.given.angles_rad is None:
        return [], focus
    plain = prepared.settings.preprocessing(matched_filter=False)
    wide = replace(plain, margin_m=FAR_WAVELENGTHS * prepared.given.wavelength_m)
    scans = prepared.focused(prepared.scans(wide))
    if (warning := turn_warning(scans, grid)) is not None:
        return [warning], focus  # under wrong angles no distance can be told
    if focus is None or focus.reliable or (warning := axis_warning(scans, grid)) is None:
        return [], focus
    return [warning], replace(focus, reason=warning)


def _placed(
    prepared: PreparedCapture, watch: Stopwatch
) -> tuple[PreparedCapture, ImagingSettings, ImageGrid, Region | None]:
    """The capture as seen from the middle of its image, with settings, grid and place of that image.

    The place is None for a turntable. Raises UsageError where the settings do not apply to it.
    """
    settings = prepared.settings
    grid = ImageGrid(settings.extent_m, settings.pixels)
    if prepared.given.antenna_positions_m is not None:
        if settings.focus_m:
            raise UsageError(
                "the capture has antenna positions and no axis distance",
                "Omit `focus_m`; `delay_m` sets the search for the path delay.",
            )
        with watch.stage("focus"):
            region = choose_region(
                prepared.given,
                grid,
                settings.centre_m,
                settings.delay_m,
                settings.background,
                settings.towards_m,
                free_extent=settings.free_extent,
                free_pixels=settings.free_pixels,
            )
        settings = replace(settings, extent_m=region.grid.extent, pixels=region.grid.pixels)
        return PreparedCapture(region.capture, settings), settings, region.grid, region
    if settings.centre_m is not None:
        raise UsageError(
            "images of a turntable are always centred on the rotation axis",
            "Omit `centre_m`, or give a larger `imaging.extent_m`.",
        )
    if settings.towards_m is not None or settings.delay_m:
        what = "side of its path" if settings.towards_m is not None else "path delay"
        raise UsageError(
            f"the capture is from a turntable, which has no {what}",
            "Omit `towards_m` and `delay_m`; `focus_m` sets the search for the axis distance.",
        )
    if settings.free_pixels:
        finest = finest_cell_m(prepared.given.wavelength_m)
        pixels = int(np.clip(np.ceil(grid.extent / finest), grid.pixels, max(grid.pixels, MOST_FREE_PIXELS)))
        grid = ImageGrid(grid.extent, pixels)
        settings = replace(settings, pixels=pixels)
    return prepared, settings, grid, None


def _facts(
    prepared: PreparedCapture,
    scans: BasebandScans,
    image: Image,
    focus: AxisFocus | None,
    region: Region | None,
    outside: OutsideFacts | None,
    predicted: HeldOutFacts | None,
    warnings: list[str],
) -> dict[str, Any]:
    """What the image's settings say of its data, as JSON values; `warnings` are those known already."""
    facts: dict[str, Any] = {
        "tool_version": __version__,
        "capture_uuid": prepared.given.uuid,
        "views": scans.aperture.views,
        "axis_distance_m": scans.aperture.axis_distance,
        "background": prepared.settings.background,
        "wavelength_m": scans.wavelength_m,
    }
    if focus is not None:
        facts["focus"] = focus.facts()
    elif region is not None and region.focus is not None:
        facts["focus"] = region.focus.facts()
    if outside is not None:
        facts["outside"] = outside
    coarse = pixel_warning(image.grid.extent, image.grid.pixels, scans.wavelength_m)
    copies = None if region is None else path_warning(scans, image.grid.extent)
    every = [warning for warning in (band_warning(prepared.given), coarse, copies, *warnings) if warning]
    if every:
        facts["warnings"] = every
    if predicted is not None:
        facts["held_out"] = predicted
    learned = image.settings.get("calibration", {}).get("axis")
    if learned:
        facts["axis_distance_m"] = learned["distance_m"]
    if region is not None:
        delay_m = region.focus.delay_m if region.focus else 0.0
        facts |= {"path_delay_m": delay_m, "mirrored": region.mirrored}
        facts |= {"centre_m": list(region.centre_m), "extent_m": region.grid.extent}
    facts["pulse"] = _pulse_facts(prepared)
    return facts


def _unfiltered(prepared: PreparedCapture, scans: BasebandScans, method: str) -> BasebandScans:
    """The scans of a method as they are without the matched filter."""
    if not METHODS[method].matched_filter:
        return scans
    settings = prepared.settings.preprocessing_for_focus(prepared.given, matched_filter=False)
    return prepared.scans(settings).with_aperture(scans.aperture)


_NO_PREDICTION = ("range-doppler",)
"""Methods whose image has no phase and therefore predicts no scans."""


def _held_out(
    prepared: PreparedCapture,
    scans: BasebandScans,
    grid: ImageGrid,
    method: str,
    settings: ImagingSettings,
    made: Image,
    outside: bool,
    progress: Callable[[int, int], None],
) -> HeldOutFacts | None:
    """Prediction of held-out views by this method, with the priors of the image.

    Echoes from outside the image, found in the other views alone, are subtracted from all if `outside`.
    `told` is called with (done, total) of every fit.
    """
    if settings.preset == "paper" or method in _NO_PREDICTION or not settings.held_out:
        return None
    unfiltered = _unfiltered(prepared, scans, method)
    if method in ("bp", "bp-raw"):
        return check(scans, unfiltered, grid, None)
    if outside:
        unseen = left_out(scans.aperture.views)
        seen = np.setdiff1d(np.arange(scans.aperture.views), unseen)
        echoes = find_outside(select_views(scans, seen), grid, progress)
        scans = scans if echoes is None else echoes.removed(scans)
        unfiltered = scans
    # The image was made with this seed, whatever the settings of ATS say.
    facts = facts_of(made.settings)
    ats, coupled = replace(settings_of(facts, settings.ats), seed=settings.seed), is_coupled(facts)
    axis = made.settings.get("calibration", {}).get("axis")
    if axis:
        moved = scans.aperture.with_axis_distance(axis["distance_m"])
        scans, unfiltered = scans.with_aperture(moved), unfiltered.with_aperture(moved)

    def make(some: BasebandScans) -> Image:
        if coupled:
            return coupled_recovery(some, grid)
        return make_image(some, grid, method, settings.seed, "field", None, ats)

    def predicted(all_views: BasebandScans, unseen: NDArray[np.intp]) -> float:
        return fit(all_views, grid, ats, lambda step, of, _: progress(step, of), unseen).held_out

    return check(scans, unfiltered, grid, make, predicted if method == "ats" and not coupled else None)


def check_extent(capture: Capture, grid: ImageGrid) -> None:
    """Raise UsageError if the image area reaches beyond all recorded ranges."""
    antenna = capture.aperture().positions
    reach = float(np.linalg.norm(antenna, axis=1).max()) + float(capture.ranges_m[-1])
    if grid.extent > 2 * reach:
        raise UsageError(
            f"an image of {grid.extent:g} m reaches beyond the recorded ranges, which end at "
            f"{capture.ranges_m[-1]:.3g} m",
            f"Give an `imaging.extent_m` of up to {2 * reach:.3g} m.",
        )


def _pulse_facts(prepared: PreparedCapture) -> dict[str, Any]:
    estimate = prepared.pulse_estimate
    if estimate is None:
        known = prepared.settings.pulse == "auto" and prepared.given.pulse is not None
        return {"kind": "measured" if known else "nominal"}
    numbers = {"assumed_residual": estimate.assumed_residual, "residual": estimate.residual}
    values = {name: value if np.isfinite(value) else None for name, value in numbers.items()}
    if not estimate.taken:
        return {"kind": "assumed", **values}
    # The values needed to store it in an NPZ file: `pulse` and `pulse_step_s`.
    samples = [round(float(v), 6) for v in estimate.pulse.samples]
    return {"kind": "estimated", **values, "pulse": samples, "pulse_step_s": estimate.pulse.step}
