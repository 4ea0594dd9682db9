"""Settings of the pipeline from capture to image and answer, validated when made."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from tagid.errors import UsageError
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.preprocess import Background, PreprocessSettings
from tagid.pipeline.methods import METHODS as IMAGING_METHODS

Progress = Callable[[float, float, str], None]
"""Called with (done, total, remark)."""

METHODS = ("auto", *IMAGING_METHODS)
PULSES = ("auto", "nominal", "estimate")
PRESETS = ("field", "paper")
FOCUS_M = 0.04
"""Half-width of the axis distance search, m: an error of 3 cm is then inside the search and not at its
edge, where a maximum is not accepted."""


@dataclass(frozen=True)
class ImagingSettings:
    """Settings of imaging and reading.

    Attributes:
        method: a name of `tagid.pipeline.methods.METHODS`, or "auto", which is ats.
        ats: settings of ats with the preset "field"; the seed is `seed`.
        extent_m, pixels: side of the image, m and pixels.
        background: static background to remove, "mean", "median" or "none".
        focus_m: half-width of the axis distance search, m; 0 for no search.
        seed: random seed.
        preset: variant of ats: "field", or "paper", exactly the published method.
        centre_m: (x, y) of the image centre, m; None is the rotation axis or, for free antenna positions,
            the location of the strong echoes.
        delay_m: half-width of the path delay search for free antenna positions, one-way m.
        restore: show sparse images at the resolution of the data (`tagid.imaging.restore`), or as raw pixels.
        free_size: whether extent and pixels may follow the echoes of free antenna positions.
        pulse: "auto", the pulse of the capture or else the nominal one of its band; "nominal"; or "estimate",
            estimated from the scans if that fits them better (`tagid.imaging.pulsefit`).
        false_accept: probability of identifying an object without an enrolled tag.
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
            raise UsageError(f"unknown preset {self.preset!r}", f"Use {' or '.join(PRESETS)}.")
        if self.centre_m is not None and not (np.abs(self.centre_m) <= 1000).all():
            raise UsageError(f"the image centre is {self.centre_m}", "Give X,Y in metres.")
        if not (np.isfinite(self.delay_m) and 0 <= self.delay_m <= 2):
            raise UsageError(f"the delay search is {self.delay_m} m", "Give 0 to 2 m.")
        if self.pulse not in PULSES:
            raise UsageError(f"unknown pulse {self.pulse!r}", f"Use {', '.join(PULSES)}.")
        if self.method not in METHODS:
            raise UsageError(f"unknown imaging method {self.method!r}", f"Use {', '.join(METHODS)}.")
        if not (np.isfinite(self.focus_m) and 0 <= self.focus_m <= 0.1):
            raise UsageError(f"the focus range is {self.focus_m} m", "Give 0 to 0.1 m.")

    def preprocessing(self, matched_filter: bool) -> PreprocessSettings:
        """Preprocessing for a given axis distance, with or without the matched filter."""
        return PreprocessSettings(
            background=self.background, matched_filter=matched_filter, extent_m=self.extent_m
        )

    def preprocessing_for_focus(self, matched_filter: bool) -> PreprocessSettings:
        """As `preprocessing`, with a margin that covers the search of the axis distance."""
        plain = self.preprocessing(matched_filter)
        return replace(plain, margin_m=max(plain.margin_m, self.focus_m))


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
