"""The way from a capture to an image and to a name, as two functions without printing.

Commands, reports and tests call these, so that an answer does not depend on who asked.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tagid import __version__
from tagid.capture import Capture
from tagid.errors import DataError, MissingExtraError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.autofocus import AxisFocus, focus_axis_distance
from tagid.imaging.preprocess import Background, PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans, Image
from tagid.motion.resolve import one_turn
from tagid.turn import resolve_turn

if TYPE_CHECKING:
    from tagid.tags.layout import Layout
    from tagid.tags.matcher import Reading
    from tagid.tags.reflectors import Reflector

Progress = Callable[[float, float, str], None]
"""Called with (done, total, remark)."""

METHODS = ("auto", "bp", "sparse", "ats")
MAX_VIEWS = 360
"""Scans are averaged into at most this many views a turn: 1 degree, the paper's step; it moves a reflector on
the rim of a 0.25 m object by 4.4 mm, under an eighth of a wavelength."""


@dataclass(frozen=True)
class ImagingSettings:
    """How a capture becomes an image.

    Attributes:
        method: "bp", "sparse", "ats", or "auto": ats where torch is installed, sparse elsewhere.
        extent_m, pixels: the image's side, m and pixels.
        background: static background that is removed, "mean", "median" or "none".
        focus_m: how far the axis distance is searched to both sides, m; 0 takes it as given.
        seed: of everything random.
    """

    method: str = "auto"
    extent_m: float = 0.5
    pixels: int = 128
    background: Background = "mean"
    focus_m: float = 0.03
    seed: int = 0

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise UsageError(f"there is no imaging method {self.method!r}", f"Use {', '.join(METHODS)}.")
        if not (np.isfinite(self.focus_m) and 0 <= self.focus_m <= 0.03):
            raise UsageError(f"the focus range is {self.focus_m} m", "Give 0 to 0.03 m.")


@dataclass
class Stopwatch:
    """Seconds of each stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time one stage; stages of one name add up."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An image with how it came about.

    Attributes:
        image: complex reflectivity.
        method: the method used, never "auto".
        focus: result of the search for the axis distance; None where there was none.
        views: number of views imaged, after averaging.
        seconds: of each stage.
    """

    image: Image
    method: str
    focus: AxisFocus | None
    views: int
    seconds: dict[str, float]


@dataclass(frozen=True, eq=False)
class Identification:
    """The answer to "what is this object" (contract: Identification).

    Attributes:
        reading: what the scans say; None where status is "failed".
        status: "identified", "unknown", "ambiguous", "no_tag" or "failed".
        capture_uuid, registry_version, label: provenance and the name for people.
        seconds: of each stage.
        error: {code, message, remedy} where status is "failed".
    """

    status: str
    reading: Reading | None
    capture_uuid: str | None
    registry_version: int | None
    label: str = ""
    seconds: dict[str, float] = field(default_factory=dict)
    error: dict[str, str] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values, with all fields of the contract."""
        r = self.reading
        reflectors = r.reflectors if r else ()
        scores = r.scores if r else ()
        return {
            "status": self.status,
            "reason": r.reason if r else (self.error or {}).get("message", ""),
            "layout": r.layout if r else None,
            "label": self.label,
            "score": r.score if r else 0.0,
            "margin": r.margin if r else 0.0,
            "rotation_deg": r.rotation_deg if r and r.layout else None,
            "centre_m": list(r.centre_m) if r and r.layout else None,
            "reflectors": [
                {"x_m": p.x_m, "y_m": p.y_m, "amplitude_db": p.amplitude_db, "matched": p.matched}
                for p in reflectors
            ],
            "missing": r.missing if r else 0,
            "extra": r.extra if r else 0,
            "scores": [{"layout": s.name, "criterion": s.criterion, "share": s.share} for s in scores],
            "capture_uuid": self.capture_uuid,
            "tool_version": __version__,
            "model_sha256": None,
            "registry_version": self.registry_version,
            "seconds": {name: round(value, 4) for name, value in self.seconds.items()},
            "error": self.error,
        }


def choose_method(method: str) -> str:
    """What "auto" stands for on this machine; MissingExtraError where ats is wanted without torch."""
    has_torch = importlib.util.find_spec("torch") is not None
    if method == "auto":
        return "ats" if has_torch else "sparse"
    if method == "ats" and not has_torch:
        raise MissingExtraError(
            "--method ats needs torch, which is not installed",
            "Install it with `pip install 'tagid[ats]'`, or use --method sparse.",
        )
    return method


def prepare(capture: Capture, motion: str | None = None) -> Capture:
    """The capture as imaging wants it: angles known, one turn, at most 360 views.

    Args:
        capture: any capture.
        motion: device URL of what turned the object; None takes the angles that are there, or the period
            found in the data.

    Raises:
        DataError: the angles can neither be had nor found.
    """
    return one_turn(resolve_turn(capture, motion), MAX_VIEWS)


def reconstruct(
    capture: Capture, settings: ImagingSettings | None = None, progress: Progress | None = None
) -> Reconstruction:
    """Image a prepared capture (see `prepare`).

    Raises:
        DataError: too few views or bins, or the object lies outside the range window.
        MissingExtraError: ats without torch.
    """
    settings = settings or ImagingSettings()
    method = choose_method(settings.method)
    watch = Stopwatch()
    grid = ImageGrid(settings.extent_m, settings.pixels)
    with watch.stage("preprocess"):
        scans = preprocess(capture, settings=_preprocessing(settings, matched_filter=method == "bp"))
    focus: AxisFocus | None = None
    if settings.focus_m > 0 and scans.aperture.angles is not None:
        with watch.stage("focus"):
            scans, focus = focus_axis_distance(scans, grid, settings.focus_m)
    with watch.stage("image"):
        image = _image(scans, grid, method, settings.seed, progress)
    facts = {
        "tool_version": __version__,
        "capture_uuid": capture.uuid,
        "views": scans.aperture.views,
        "axis_distance_m": scans.aperture.axis_distance,
        "background": settings.background,
    }
    image = replace(image, settings={**image.settings, **facts})
    return Reconstruction(image, method, focus, scans.aperture.views, watch.seconds)


def _preprocessing(settings: ImagingSettings, matched_filter: bool) -> PreprocessSettings:
    return PreprocessSettings(
        background=settings.background, matched_filter=matched_filter, extent_m=settings.extent_m
    )


def _image(scans: BasebandScans, grid: ImageGrid, method: str, seed: int, progress: Progress | None) -> Image:
    if method == "bp":
        from tagid.imaging.backprojection import backproject

        return backproject(scans, grid)
    if method == "sparse":
        from tagid.imaging.sparse import sparse_recovery

        return sparse_recovery(scans, grid)
    from tagid.imaging.ats.fit import AtsSettings, fit

    def report(step: int, steps: int, loss: float) -> None:
        if progress:
            progress(step, steps, f"loss {loss:.3g}")

    return fit(scans, grid, AtsSettings(seed=seed), report)


def identify(
    capture: Capture,
    layouts: Sequence[Layout],
    settings: ImagingSettings | None = None,
    registry_version: int | None = None,
) -> Identification:
    """Name the object of a prepared capture (see `prepare`).

    Reads the tag in the data domain, where no image's artefact can mislead it. A wrong axis distance is found
    by the reader itself, as a range offset.

    Raises:
        DataError: too few views or bins, or the object lies outside the range window.
        RegistryError: no layout is enrolled.
    """
    from tagid.tags.matcher import read_tag

    settings = settings or ImagingSettings()
    if capture.views < 3:
        raise DataError(
            f"the capture has {capture.views} views, too few to read a tag", "Record at least 12 in a turn."
        )
    watch = Stopwatch()
    with watch.stage("preprocess"):
        scans = preprocess(capture, settings=_preprocessing(settings, matched_filter=False))
    with watch.stage("read"):
        reading = read_tag(scans, layouts)
    label = next((layout.label for layout in layouts if layout.name == reading.layout), "")
    return Identification(reading.status, reading, capture.uuid, registry_version, label, dict(watch.seconds))


def locate_reflectors(capture: Capture, settings: ImagingSettings | None = None) -> tuple[Reflector, ...]:
    """Reflectors of a prepared capture without knowledge of any layout, strongest first.

    Raises DataError as `identify` does.
    """
    from tagid.tags.reflectors import find_reflectors

    settings = settings or ImagingSettings()
    scans = preprocess(capture, settings=_preprocessing(settings, matched_filter=False))
    if settings.focus_m > 0 and scans.aperture.angles is not None:
        grid = ImageGrid(settings.extent_m, settings.pixels)
        scans, _ = focus_axis_distance(scans, grid, settings.focus_m)
    return find_reflectors(scans)
