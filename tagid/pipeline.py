"""The way from a capture to an image and to a name, as two functions without printing.

Commands, reports and tests call these, so that an answer does not depend on who asked.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tagid import __version__
from tagid.capture import Capture
from tagid.errors import DataError, UsageError
from tagid.geometry import ImageGrid
from tagid.identification import Identification
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.autofocus import AxisFocus, focus_axis_distance
from tagid.imaging.methods import METHODS as IMAGING_METHODS
from tagid.imaging.methods import make_image
from tagid.imaging.preprocess import Background, PreprocessSettings, nominal, preprocess
from tagid.imaging.pulsefit import PulseEstimate, estimate_pulse
from tagid.imaging.region import Region, choose_region
from tagid.imaging.restore import restore
from tagid.imaging.types import Image
from tagid.motion.resolve import one_turn
from tagid.turn import resolve_turn

if TYPE_CHECKING:
    from tagid.tags.averaging import Sighting
    from tagid.tags.bodies.hypothesis import Enrolled
    from tagid.tags.bodies.signature import Signature
    from tagid.tags.bodies.spectra import Spectra
    from tagid.tags.layout import Layout
    from tagid.tags.matcher import ReaderSettings
    from tagid.tags.reading import Reading
    from tagid.tags.second_look import SecondLook

Progress = Callable[[float, float, str], None]
"""Called with (done, total, remark)."""

METHODS = ("auto", *IMAGING_METHODS)
PULSES = ("auto", "nominal", "estimate")
PRESETS = ("field", "paper")
FOCUS_M = 0.04
"""The axis distance is searched so far to both sides: errors of 3 cm are then inside of the search, not at
its edge, where nothing is trusted."""
MAX_VIEWS = 360
"""Scans are averaged into at most this many views a turn: 1 degree, the paper's step; it moves a reflector on
the rim of a 0.25 m object by 4.4 mm, under an eighth of a wavelength."""
MIN_SIGNATURE_VIEWS = 24
"""Views of a capture that a signature is made of: two per harmonic of a cup, one per two of a helmet; three
captures share the rest."""
MAX_POSITIONS = 2000
"""Free antenna positions are not averaged: a path may need every one of them, a long one this many."""


@dataclass(frozen=True)
class ImagingSettings:
    """How a capture becomes an image.

    Attributes:
        method: a name of `tagid.imaging.methods.METHODS`, or "auto", which is ats.
        ats: how ats with the preset "field" fits; the seed is the one of these settings.
        extent_m, pixels: the image's side, m and pixels.
        background: static background that is removed, "mean", "median" or "none".
        focus_m: how far the axis distance is searched to both sides, m; 0 takes it as given.
        seed: of everything random.
        preset: what ats is: "field", or "paper", the published method to the letter.
        centre_m: (x, y) of the image's middle, m; None is the rotation axis or, for free antenna positions,
            wherever the strong echoes lie.
        delay_m: how far the path delay of free antenna positions is searched to both sides, one-way m.
        restore: show sparse images at the resolution of the data (`tagid.imaging.restore`), or bare pixels.
        free_size: whether extent and pixels may follow the echoes of free antenna positions.
        pulse: "auto", the one in the capture or else the nominal one of its band; "nominal"; or "estimate",
            found from the scans where that explains them better (`tagid.imaging.pulsefit`).
        false_accept: probability of naming what is no tag, or a tag that nobody enrolled.
        direction_known: see `tags.matcher.ReaderSettings`.
    """

    method: str = "auto"
    extent_m: float = 0.5
    pixels: int = 128
    background: Background = "mean"
    focus_m: float = FOCUS_M
    seed: int = 0
    preset: str = "field"
    centre_m: tuple[float, float] | None = None
    delay_m: float = 1.0
    restore: bool = True
    free_size: tuple[bool, bool] = (False, False)
    ats: AtsSettings = field(default_factory=AtsSettings)
    pulse: str = "auto"
    false_accept: float = 1e-3
    direction_known: bool = True

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise UsageError(f"there is no preset {self.preset!r}", f"Use {' or '.join(PRESETS)}.")
        if self.centre_m is not None and not (np.abs(self.centre_m) <= 1000).all():
            raise UsageError(f"the image's centre is {self.centre_m}", "Give X,Y in metres.")
        if not (np.isfinite(self.delay_m) and 0 <= self.delay_m <= 2):
            raise UsageError(f"the delay search is {self.delay_m} m", "Give 0 to 2 m.")
        if self.pulse not in PULSES:
            raise UsageError(f"there is no pulse {self.pulse!r}", f"Use {', '.join(PULSES)}.")
        if self.method not in METHODS:
            raise UsageError(f"there is no imaging method {self.method!r}", f"Use {', '.join(METHODS)}.")
        if not (np.isfinite(self.focus_m) and 0 <= self.focus_m <= 0.1):
            raise UsageError(f"the focus range is {self.focus_m} m", "Give 0 to 0.1 m.")


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


def prepare(capture: Capture, motion: str | None = None) -> Capture:
    """The capture as imaging wants it: angles known, one turn, at most 360 views.

    Args:
        capture: any capture.
        motion: device URL of what turned the object; None takes the angles that are there, or the period
            found in the data.

    Raises:
        DataError: the angles can neither be had nor found.
    """
    turned = resolve_turn(capture, motion)
    return one_turn(turned, MAX_VIEWS if turned.antenna_positions_m is None else MAX_POSITIONS)


def reconstruct(
    capture: Capture, settings: ImagingSettings | None = None, progress: Progress | None = None
) -> Reconstruction:
    """Image a prepared capture (see `prepare`).

    Raises:
        DataError: too few views or bins, or the object lies outside the range window.
        MissingExtraError: the engine asked for is not installed.
    """
    settings = settings or ImagingSettings()
    method = "ats" if settings.method == "auto" else settings.method
    watch = Stopwatch()
    grid = ImageGrid(settings.extent_m, settings.pixels)
    region: Region | None = None
    if capture.antenna_positions_m is not None:
        with watch.stage("focus"):
            region = choose_region(
                capture,
                grid,
                settings.centre_m,
                settings.delay_m,
                settings.background,
                settings.free_size,
            )
        capture, grid = region.capture, region.grid
        settings = replace(settings, extent_m=grid.extent, pixels=grid.pixels)
    elif settings.centre_m is not None:
        raise UsageError(
            "an image of a turntable lies about its axis", "Leave --centre away, or give a larger --extent."
        )
    capture, estimate = _with_pulse(capture, settings, watch)
    with watch.stage("preprocess"):
        matched = IMAGING_METHODS[method].matched_filter
        scans = preprocess(capture, settings=_to_be_focused(settings, matched))
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
        "capture_uuid": capture.uuid,
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
    facts["pulse"] = _pulse_facts(capture, settings, estimate)
    image = replace(image, settings={**image.settings, **facts})
    return Reconstruction(image, method, focus, scans.aperture.views, watch.seconds, region, estimate)


def _with_pulse(
    capture: Capture, settings: ImagingSettings, watch: Stopwatch
) -> tuple[Capture, PulseEstimate | None]:
    """The capture with the pulse that the settings want."""
    if settings.pulse == "nominal":
        return replace(capture, pulse=nominal(capture)), None
    if settings.pulse == "auto":
        return capture, None
    with watch.stage("pulse"):
        grid = ImageGrid(settings.extent_m, settings.pixels)
        found = estimate_pulse(capture, grid, settings.background, settings.focus_m)
    return replace(capture, pulse=found.pulse), found


def _pulse_facts(
    capture: Capture, settings: ImagingSettings, estimate: PulseEstimate | None
) -> dict[str, Any]:
    if estimate is None:
        known = settings.pulse == "auto" and capture.pulse is not None
        return {"kind": "measured" if known else "nominal"}
    numbers = {"assumed_residual": estimate.assumed_residual, "residual": estimate.residual}
    told = {name: value if np.isfinite(value) else None for name, value in numbers.items()}
    if not estimate.taken:
        return {"kind": "assumed", **told}
    # Enough for whoever wants to keep it in an NPZ file: `pulse` and `pulse_step_s`.
    samples = [round(float(v), 6) for v in estimate.pulse.samples]
    return {"kind": "estimated", **told, "pulse": samples, "pulse_step_s": estimate.pulse.step}


def _preprocessing(settings: ImagingSettings, matched_filter: bool) -> PreprocessSettings:
    return PreprocessSettings(
        background=settings.background, matched_filter=matched_filter, extent_m=settings.extent_m
    )


def _to_be_focused(settings: ImagingSettings, matched_filter: bool) -> PreprocessSettings:
    """As `_preprocessing`, with room for the search of the axis distance."""
    plain = _preprocessing(settings, matched_filter)
    return replace(plain, margin_m=max(plain.margin_m, settings.focus_m))


def identify(
    capture: Capture,
    layouts: Sequence[Layout],
    settings: ImagingSettings | None = None,
    registry_version: int | None = None,
    signatures: Sequence[Signature] = (),
) -> Identification:
    """Name the object of a prepared capture (see `prepare`).

    Reads the tag in the data domain, where no image's artefact can mislead it. A wrong axis distance is found
    by the reader itself, as a range offset.

    Args:
        capture: the capture.
        layouts: enrolled layouts.
        settings: of preprocessing and decision.
        registry_version: for the answer.
        signatures: enrolled bodies and objects.

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
    capture, _ = _with_pulse(capture, settings, watch)
    with watch.stage("preprocess"):
        scans = preprocess(capture, settings=_preprocessing(settings, matched_filter=False))
    with watch.stage("read"):
        enrolled = _enrolled(capture, signatures, settings)
        reading = read_tag(scans, layouts, _reading(settings), enrolled)
    with watch.stage("look again"):
        second = _second_look(capture, settings, reading)
    labels = {one.name: one.label for one in signatures if one.kind == "object"}
    labels |= {layout.name: layout.label for layout in layouts}
    label = labels.get(reading.layout or "", "")
    return Identification(
        reading.status, reading, capture.uuid, registry_version, label, dict(watch.seconds), second=second
    )


def without_body(capture: Capture, answer: Identification) -> Capture:
    """A prepared capture minus the echo of the body that its reading found, for a picture of the tag.

    The capture itself where no body won.
    """
    from tagid.tags.bodies import subtract
    from tagid.tags.bodies.hypothesis import Kind

    reading = answer.reading
    if reading is None or reading.body is None or reading.kind is Kind.BARE:
        return capture
    return subtract.without_body(capture, reading.body)


def _second_look(capture: Capture, settings: ImagingSettings, reading: Reading) -> SecondLook | None:
    """The network's view of the backprojection, on its own grid; None for free antenna positions."""
    from tagid.tags.planes import GRID
    from tagid.tags.second_look import look_again

    if capture.angles_rad is None:
        return None
    matched = PreprocessSettings(settings.background, matched_filter=True, extent_m=GRID.extent)
    return look_again(preprocess(capture, settings=matched), reading.reflectors, reading.offset_m)


def identify_together(
    captures: Sequence[Capture],
    layouts: Sequence[Layout],
    settings: ImagingSettings | None = None,
    registry_version: int | None = None,
) -> tuple[Identification, list[Identification]]:
    """Name the object of several prepared captures at once, and of each alone (see `tags.vote`).

    Raises as `identify` does.
    """
    from tagid.tags.vote import read_together

    settings = settings or ImagingSettings()
    watch = Stopwatch()
    recordings = []
    for capture in captures:
        if capture.views < 3:
            raise DataError(f"a capture has {capture.views} views, too few to read a tag", "Leave it out.")
        capture, _ = _with_pulse(capture, settings, watch)
        with watch.stage("preprocess"):
            recordings.append(preprocess(capture, settings=_preprocessing(settings, matched_filter=False)))
    with watch.stage("read"):
        joint, alone = read_together(recordings, layouts, _reading(settings))
    labels = {layout.name: layout.label for layout in layouts}

    with watch.stage("look again"):
        seconds = [_second_look(c, settings, reading) for reading, c in zip(alone, captures, strict=True)]

    def answer(reading: Reading, uuid: str | None, second: SecondLook | None) -> Identification:
        label, spent = labels.get(reading.layout or "", ""), dict(watch.seconds)
        return Identification(reading.status, reading, uuid, registry_version, label, spent, second=second)

    each = [answer(r, c.uuid, second) for r, c, second in zip(alone, captures, seconds, strict=True)]
    only = len(captures) == 1
    return answer(joint, captures[0].uuid if only else None, seconds[0] if only else None), each


def _reading(settings: ImagingSettings) -> ReaderSettings:
    from tagid.tags.bodies.contest import ContestSettings
    from tagid.tags.decision import DecisionSettings
    from tagid.tags.matcher import ReaderSettings

    decision = DecisionSettings(false_accept=settings.false_accept)
    contest = ContestSettings(false_accept=settings.false_accept)
    return ReaderSettings(decision=decision, contest=contest, direction_known=settings.direction_known)


def _enrolled(
    capture: Capture, signatures: Sequence[Signature], settings: ImagingSettings
) -> Enrolled | None:
    """Enrolled bodies and objects as hypotheses; None where there are none of the capture's band."""
    if not signatures or capture.angles_rad is None:
        return None
    from tagid.tags.bodies.enrolled import hypotheses, signature_wavenumbers

    wavenumbers = signature_wavenumbers(capture.center_frequency_hz, capture.bandwidth_hz)
    return hypotheses(signatures, wavenumbers, direction_known=settings.direction_known)


def aspect_spectra(capture: Capture, settings: ImagingSettings | None = None) -> Spectra:
    """Spectra of a prepared capture from which the signature of its object can be estimated.

    Raises DataError as `identify` does, and for free antenna positions.
    """
    from tagid.tags.bodies.enrolled import signature_wavenumbers
    from tagid.tags.bodies.signature import MAX_RADIUS_M
    from tagid.tags.bodies.spectra import Spectra
    from tagid.tags.views import fold_views

    settings = settings or ImagingSettings()
    if capture.angles_rad is None:
        raise DataError(
            "the signature of an object needs it on a turntable, this capture has free antenna positions",
            "Record the object turning, or enrol its reflectors with --point.",
        )
    if capture.views < MIN_SIGNATURE_VIEWS:
        raise DataError(
            f"the capture has {capture.views} views, a signature needs {MIN_SIGNATURE_VIEWS}",
            "Record more views per turn.",
        )
    capture, _ = _with_pulse(capture, settings, Stopwatch())
    scans = preprocess(capture, settings=_preprocessing(settings, matched_filter=False))
    wavenumbers = signature_wavenumbers(capture.center_frequency_hz, capture.bandwidth_hz)
    if len(wavenumbers) < 3:
        raise DataError(
            f"a band of {capture.bandwidth_hz / 1e6:.0f} MHz holds {len(wavenumbers)} frequencies of a "
            "signature, 3 are needed",
            "Correct the capture's bandwidth_hz.",
        )
    return Spectra.of(fold_views(scans, MAX_RADIUS_M), wavenumbers=wavenumbers)


def sight_reflectors(capture: Capture, name: str, settings: ImagingSettings | None = None) -> Sighting:
    """Strong reflectors of a prepared capture, without knowledge of any layout, with their covariance.

    Raises DataError as `identify` does.
    """
    from tagid.tags.averaging import MOST_SEARCHED_M, SEARCHED_M, Sighting

    settings = settings or ImagingSettings()
    capture, _ = _with_pulse(capture, settings, Stopwatch())
    scans = preprocess(capture, settings=_to_be_focused(settings, matched_filter=False))
    if settings.focus_m > 0 and scans.aperture.angles is not None:
        grid = ImageGrid(settings.extent_m, settings.pixels)
        scans, _ = focus_axis_distance(scans, grid, settings.focus_m)
    radius = float(np.clip(settings.extent_m / 2 - 0.01, SEARCHED_M, MOST_SEARCHED_M))
    return Sighting.of(scans, name, radius)
