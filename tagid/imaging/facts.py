"""What the settings of an image say of how it came about, as the JSON values that are stored with it."""

from __future__ import annotations

from typing import Any, NotRequired, TypedDict, cast


class HeldOutFacts(TypedDict):
    """How well an image predicts held-out views, shares of their energy; None where it is not known.

    `neighbours` is of the mean of the two neighbouring scans, without any image, and `noise` the least that
    any image can reach. Documents of earlier versions lack the neighbours.
    """

    views: int
    residual: float
    backprojection: float
    noise: float | None
    worse_than_backprojection: bool
    neighbours: NotRequired[float | None]
    worse_than_neighbours: NotRequired[bool]


class OutsideFacts(TypedDict):
    """Echoes from outside the image: their share of the energy, how many, whether they were subtracted."""

    share: float
    points: int
    subtracted: bool


class AxisFacts(TypedDict):
    """A learned distance of the axis, m."""

    distance_m: float | None
    offset_m: float
    sigma_m: float


class WobbleFacts(TypedDict):
    """A learned harmonic of the angle error over a turn."""

    harmonic: int
    amplitude_deg: float
    phase_deg: float
    sigma_deg: float
    speed_percent: float


class GainFacts(TypedDict):
    """Learned gains of the scans."""

    scans: list[float]
    sigma: list[float]
    spread: float


class StaticFacts(TypedDict):
    """A learned component that no turn changes."""

    rms: float


class CalibrationFacts(TypedDict, total=False):
    """What a fit learned of the recording beside the scene."""

    axis: AxisFacts
    wobble: list[WobbleFacts]
    gain: GainFacts
    static: StaticFacts


class ImageFacts(TypedDict, total=False):
    """The part of an image's settings that is reported; what was not asked for is absent."""

    preset: str
    axis_distance_m: float | None
    held_out: HeldOutFacts
    outside: OutsideFacts
    prior: str
    views_per_step: int
    calibration: CalibrationFacts
    warnings: list[str]


COUPLED = "coupled"
"""`prior` of an image by coupled pixels (`tagid.imaging.coupled`); those of a field do not say theirs."""


def is_coupled(facts: ImageFacts) -> bool:
    """Whether coupled pixels made an image, in the place of a field."""
    return facts.get("prior") == COUPLED


def facts_of(settings: dict[str, Any]) -> ImageFacts:
    """The settings of an image (`Image.settings`) or volume under their types."""
    return cast("ImageFacts", settings)
