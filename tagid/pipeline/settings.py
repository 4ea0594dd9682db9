"""Settings of the pipeline from capture to image and answer, validated when made."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from tagid.capture import Capture
from tagid.config import METHODS as METHODS
from tagid.errors import UsageError
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.lengths import search_range_m
from tagid.imaging.preprocess import MARGIN_WAVELENGTHS, Background, PreprocessSettings

PULSES = ("auto", "nominal", "estimate")
PRESETS = ("field", "paper")
MOST_PRIOR_M = 0.05
"""Largest value of a prior that a user may set, m."""
MOST_FREE_PIXELS = 512
"""Largest default number of pixels per side, used for short wavelengths."""


@dataclass(frozen=True)
class TagPriors:
    """What is known of a tag's place before the scans, m. The defaults are those of the calibration.

    Attributes:
        centre_sigma_m: standard deviation of an object's centre about the rotation axis, per coordinate.
        radius_sigma_m: standard deviation of a reflector's distance from the centre about the enrolled one;
            what a wall adds to it is the wall's.
    """

    centre_sigma_m: float = 6e-3
    radius_sigma_m: float = 1.5e-3

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and 0 < value <= MOST_PRIOR_M):
                raise UsageError(
                    f"the prior {name} is {value} m", f"Give metres, up to {MOST_PRIOR_M:g}, above 0."
                )


@dataclass(frozen=True)
class ImagingSettings:
    """Settings of imaging and reading.

    Attributes:
        method: a name of `tagid.pipeline.reconstruct.METHODS`, or "auto", which is ats.
        ats: settings of ats with the preset "field"; its seed is `seed`.
        extent_m, pixels: width of the image, m and pixels.
        background: static background that is removed, "mean", "median" or "none".
        focus_m: half-width of the axis-distance search, m; 0 uses the given value, None: from the
            wavelength.
        seed: random seed.
        preset: variant of ats: "field", or "paper", the method exactly as published.
        centre_m: (x, y) of the image centre, m; None: the rotation axis or, for free antenna positions,
            the position of the strong echoes.
        delay_m: half-width of the path-delay search for free antenna positions, one-way m; 0 uses the
            ranges as given, None: from the wavelength.
        towards_m: a point (x, y) on the side of a straight path to be imaged, m.
        restore: show sparse images at the resolution of the data (`tagid.imaging.restore`), or single pixels.
        held_out: compute how well the image predicts held-out views
            (`tagid.imaging.heldout`).
        free_extent: whether the extent may be adapted to the echoes of free antenna positions.
        free_pixels: whether the number of pixels may be adapted to the wavelength.
        pulse: "auto", the pulse of the capture or else the nominal one of its band; "nominal"; or "estimate",
            estimated from the scans if that fits them better (`tagid.imaging.pulsefit`).
        false_accept: probability of identifying an object without an enrolled tag.
        direction_known: see `tagid.reading.reader.ReaderSettings`.
        priors: on the place of a tag.
        outside: search echoes from outside the image (`tagid.imaging.outside`).
    """

    method: str = "auto"
    extent_m: float = 0.5
    pixels: int = 128
    background: Background = "mean"
    focus_m: float | None = None
    seed: int = 0
    preset: str = "field"
    centre_m: tuple[float, float] | None = None
    delay_m: float | None = None
    towards_m: tuple[float, float] | None = None
    restore: bool = True
    held_out: bool = True
    free_extent: bool = False
    free_pixels: bool = False
    ats: AtsSettings = field(default_factory=AtsSettings)
    pulse: str = "auto"
    false_accept: float = 5e-3
    direction_known: bool = True
    priors: TagPriors = field(default_factory=TagPriors)
    outside: bool = True

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise UsageError(f"there is no preset {self.preset!r}", f"Use {' or '.join(PRESETS)}.")
        for name, place in (("centre", self.centre_m), ("side", self.towards_m)):
            if place is not None and not (np.abs(place) <= 1e4).all():
                raise UsageError(f"the image's {name} is {place}", "Give X,Y in metres.")
        for name, reach in (("delay search", self.delay_m), ("focus range", self.focus_m)):
            if reach is not None and not (np.isfinite(reach) and reach >= 0):
                raise UsageError(f"the {name} is {reach} m", "Give zero or more metres.")
        if self.pulse not in PULSES:
            raise UsageError(f"unknown pulse {self.pulse!r}", f"Use {', '.join(PULSES)}.")
        if self.method not in METHODS:
            raise UsageError(f"there is no imaging method {self.method!r}", f"Use {', '.join(METHODS)}.")

    def preprocessing(self, matched_filter: bool) -> PreprocessSettings:
        """Preprocessing for a given axis distance, with or without the matched filter."""
        return PreprocessSettings(
            background=self.background, matched_filter=matched_filter, extent_m=self.extent_m
        )

    def preprocessing_for_focus(self, capture: Capture, matched_filter: bool) -> PreprocessSettings:
        """As `preprocessing`, with a margin that covers the search of the axis distance."""
        wavelength = capture.wavelength_m
        reach = search_range_m(wavelength) if self.focus_m is None else self.focus_m
        margin = max(MARGIN_WAVELENGTHS * wavelength, reach)
        return replace(self.preprocessing(matched_filter), margin_m=margin)


@dataclass
class Stopwatch:
    """Seconds of each stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time one stage; stages of the same name add up."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def add(self, other: Stopwatch) -> None:
        """Add the seconds of another watch, stage by stage."""
        for name, seconds in other.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds
