"""From a capture with antenna positions at several heights to a volume, without printing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tagid._version import __version__
from tagid.capture import Capture
from tagid.errors import DataError, UsageError
from tagid.geometry import ImageGrid, VolumeGrid
from tagid.imaging.copies import height_warning
from tagid.imaging.facts import HeldOutFacts
from tagid.imaging.heldout import held_out_facts, left_out
from tagid.imaging.lengths import pixel_warning
from tagid.imaging.memory import require_memory
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.outside import NOT_SEARCHED, Outside, find_outside, views_searched
from tagid.imaging.preprocess import PreprocessSettings, preprocess, select_views
from tagid.imaging.types import BasebandScans
from tagid.imaging.volume import (
    Volume,
    backproject_volume,
    part_of,
    sparse_volume,
    vertical_resolution_m,
)
from tagid.pipeline.join import heights_of, without_background_of_each_height
from tagid.pipeline.reconstruct import check_extent
from tagid.pipeline.settings import Stopwatch
from tagid.types import Progress

METHODS = ("bp", "sparse", "ats")
_MOST_LEVELS = 200


@dataclass(frozen=True)
class VolumeSettings:
    """Settings of a volume.

    Attributes:
        method: of `METHODS`.
        extent_m, pixels: width of each level, m and pixels.
        heights_m: lowest and highest height, m; None: half the extent below and above the object's plane.
        levels: number of levels; None: three per vertical resolution, but none thinner than a pixel.
        background: static part to subtract from the views of each height: mean, median or none.
        held_out: compute how well the volume predicts held-out views.
        centre_m: (x, y) of the volume's axis for free antenna positions, m; None: the origin.
        outside: search echoes from outside the volume, and subtract them in a fit (sparse, ats).
    """

    method: str = "bp"
    extent_m: float = 0.5
    pixels: int = 128
    heights_m: tuple[float, float] | None = None
    levels: int | None = None
    background: str = "mean"
    held_out: bool = True
    centre_m: tuple[float, float] | None = None
    outside: bool = True

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise UsageError(f"there is no volume by {self.method!r}", f"Use {', '.join(METHODS)}.")
        if self.background not in ("mean", "median", "none"):
            raise UsageError(f"background is {self.background!r}", "Choose mean, median or none.")
        if self.centre_m is not None and not (np.abs(self.centre_m) <= 1e4).all():
            raise UsageError(f"the volume's centre is {self.centre_m}", "Give X,Y in metres.")


@dataclass(frozen=True, eq=False)
class VolumeReconstruction:
    """A volume and how it was computed.

    Attributes:
        volume: complex reflectivity.
        views, heights: numbers of views and of antenna heights.
        seconds: of each stage.
    """

    volume: Volume
    views: int
    heights: int
    seconds: dict[str, float]


def reconstruct_volume(
    capture: Capture, settings: VolumeSettings | None = None, progress: Progress | None = None
) -> VolumeReconstruction:
    """Image a capture with antenna positions or angles in three dimensions; `tagid.pipeline.join` joins
    several.

    Raises DataError: all antenna positions have one height, or the scans cannot be preprocessed. UsageError:
    a volume that reaches beyond the recorded ranges or would not fit into memory.
    """
    settings = settings or VolumeSettings()
    square = ImageGrid(settings.extent_m, settings.pixels)
    centre_m = settings.centre_m or (0.0, 0.0)
    if settings.centre_m is not None:
        capture = capture.shifted(np.array([*centre_m, 0.0]))
    check_extent(capture, square)
    watch = Stopwatch()
    positions = capture.aperture().positions
    if float(np.ptp(positions[:, 2])) < 1e-3:
        raise DataError(
            "all antenna positions have the same height, so the heights of the object cannot be resolved",
            "Join captures of several antenna heights: `tagid join A B C --out all.npz`.",
        )
    low, high = settings.heights_m or (-settings.extent_m / 2, settings.extent_m / 2)
    with watch.stage("preprocess"):
        clean = without_background_of_each_height(capture, settings.background)
        plain = PreprocessSettings("none", False, extent_m=settings.extent_m, heights_m=(low, high))
        unfiltered = preprocess(clean, settings=plain)
        matched = preprocess(clean, settings=replace(plain, matched_filter=True))
    levels = settings.levels or _levels(unfiltered, square, high - low)
    grid = VolumeGrid(square, low, high, levels)
    with watch.stage("volume"):
        whole = part_of(progress, 0.0, 0.5 if settings.held_out else 1.0)
        fits = settings.method != "bp" and settings.outside
        outside = find_outside(unfiltered, grid) if fits else None
        clear, clear_unfiltered = _without(outside, matched, unfiltered)
        volume = _make(settings.method, clear, clear_unfiltered, grid, whole)
    facts: dict[str, Any] = {
        "tool_version": __version__,
        "capture_uuid": capture.uuid,
        "views": capture.views,
        "background": settings.background,
        "wavelength_m": unfiltered.wavelength_m,
        "vertical_resolution_m": vertical_resolution_m(unfiltered),
        "heights_m": [low, high],
        "levels": levels,
        "extent_m": settings.extent_m,
    }
    if settings.centre_m is not None:
        facts["centre_m"] = list(centre_m)
    if outside is not None:
        facts["outside"] = outside.facts(subtracted=True)
    coarse = pixel_warning(settings.extent_m, settings.pixels, unfiltered.wavelength_m)
    copies = height_warning(matched, high - low, len(heights_of(capture)))
    warnings = [warning for warning in (coarse, copies) if warning]
    if fits and not views_searched(unfiltered, grid, subtracts=True):
        warnings.append(NOT_SEARCHED)
    if warnings:
        facts["warnings"] = warnings
    if settings.held_out:
        with watch.stage("held out"):
            again = part_of(progress, 0.5, 1.0, "held-out views")
            predicted = _held_out(settings.method, matched, unfiltered, grid, outside is not None, again)
        if predicted is not None:
            facts["held_out"] = predicted
    volume = replace(volume, settings={**volume.settings, **facts}, centre_m=centre_m)
    return VolumeReconstruction(volume, capture.views, len(heights_of(capture)), watch.seconds)


def _without(
    outside: Outside | None, matched: BasebandScans, unfiltered: BasebandScans
) -> tuple[BasebandScans, BasebandScans]:
    """Scans less the echoes from outside."""
    if outside is None:
        return matched, unfiltered
    return outside.removed(matched), outside.removed(unfiltered)


def _levels(scans: BasebandScans, square: ImageGrid, rise_m: float) -> int:
    thin = max(vertical_resolution_m(scans) / 3, square.step)
    return int(np.clip(np.ceil(rise_m / thin), 2, _MOST_LEVELS))


def _make(
    method: str,
    matched: BasebandScans,
    unfiltered: BasebandScans,
    grid: VolumeGrid,
    progress: Progress | None,
) -> Volume:
    if method == "bp":
        return backproject_volume(matched, grid, progress)
    if method == "ats":
        from tagid.imaging.ats.volume import fit_volume

        return fit_volume(matched, unfiltered, grid, progress=progress)
    require_memory(
        80 * grid.voxels, f"{grid.voxels:,} voxels of a fit", "Use fewer pixels (`imaging.pixels`) or levels."
    )
    return sparse_volume(unfiltered, grid, progress=progress)


def _held_out(
    method: str,
    matched: BasebandScans,
    unfiltered: BasebandScans,
    grid: VolumeGrid,
    outside: bool,
    progress: Progress | None = None,
) -> HeldOutFacts | None:
    """Residual on views held out from the volume, and that of backprojection; None with too few views.

    Echoes from outside the volume, found in the other views alone, are subtracted from all if `outside`.
    """
    unseen = left_out(unfiltered.aperture.views)
    if outside and len(unseen):
        others = np.setdiff1d(np.arange(unfiltered.aperture.views), unseen)
        matched, unfiltered = _without(
            find_outside(select_views(unfiltered, others), grid), matched, unfiltered
        )
    test = select_views(unfiltered, unseen)
    if not len(unseen) or not np.any(test.samples):
        return None
    seen = np.setdiff1d(np.arange(unfiltered.aperture.views), unseen)
    some, plain = select_views(matched, seen), select_views(unfiltered, seen)
    first = backproject_volume(some if method == "bp" else plain, grid, progress if method == "bp" else None)
    back = _residual(test, first)
    plain_residual = back if method == "bp" else _residual(test, _make(method, some, plain, grid, progress))
    return held_out_facts(plain_residual, back, unfiltered, unseen)


def _residual(test: BasebandScans, volume: Volume) -> float:
    """||y - s A x||^2 / ||y||^2 with the best complex s; zero voxels are omitted from A."""
    x = volume.values.ravel()
    bright = np.flatnonzero(x)
    if not len(bright):
        return 1.0
    fit = ForwardOperator(test, volume.grid.points()[bright]).forward(x[bright]).astype(np.complex128)
    y = test.samples.astype(np.complex128)
    power, energy = float(np.vdot(fit, fit).real), float(np.vdot(y, y).real)
    return 1 - float(np.abs(np.vdot(fit, y)) ** 2) / (power * energy) if power > 0 else 1.0
