"""Relative rotation of captures of one object that were recorded one after another on a turntable.

The angles of a recording start at its first scan. A table that turns on, or is started again by hand, gives
each recording another zero, which has to be known before several recordings become one.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.errors import DataError
from tagid.geometry import ImageGrid, VolumeGrid
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from tagid.imaging.volume import backproject_volume
from tagid.pipeline.join import join, without_background_of_each_height

_EXTENT_M = 0.4
"""Diameter of the object, m."""
STEPS = 720
"""Angles of the polar images, half a degree: 1.3 mm at a radius of 0.15 m, between which a parabola is
put."""
RADIUS_STEP_M = 0.008
LEAST_LIKENESS = 0.35
"""Correlation coefficient of two captures' images at the best rotation. 300 pairs of noise reach 0.20; 120
captures of three points at 10 and 20 dB, 0.1 and 0.2 m higher than the first, have 0.52 or more."""
RIVAL_SHARE, RIVAL_APART_DEG, MOST_RIVALS = 0.7, 8.0, 4
"""Further peaks of this share of the highest, so far from it, are compared in three dimensions: reflectors at
the corners of a regular polygon look alike from above after a rotation, even at different heights."""
_VOLUME_PIXELS, _VOLUME_LEVELS, _VOLUME_HEIGHT_M = 60, 18, 0.24
_VOLUME_VIEWS = 60
_EQUAL = 0.02
"""Volumes whose sharpness differs by less than this share are equally sharp."""


@dataclass(frozen=True)
class Alignment:
    """The rotation of one capture relative to the first.

    Attributes:
        rotation_rad: the object of this capture is rotated by so much, counter-clockwise from above, at the
            same stated angle.
        likeness: correlation coefficient of the two images at this rotation, see `LEAST_LIKENESS`.
    """

    rotation_rad: float
    likeness: float

    @property
    def rotation_deg(self) -> float:
        """The rotation from -180 to 180 degrees."""
        return float(np.rad2deg(np.angle(np.exp(1j * self.rotation_rad))))


def aligned(captures: Sequence[Capture]) -> tuple[list[Capture], list[Alignment]]:
    """The captures, prepared: each with angles and its own antenna height, with their angles referred to the
    first one's pose.

    The rotation is the peak of the circular correlation of the captures' backprojections |f(r, phi)|^2. These
    are images of the plane z = 0; a reflector at another height appears there as a small ring about its
    place, which does not move the peak. Reflectors that look symmetric from above but have different heights
    are told apart by the sharpness of the joint volume, which takes three heights, 0.15 m apart at 1 m, and
    none of them at the object's own level, from where heights hardly show.

    Raises DataError: a capture without angles, one that cannot be imaged, or two that do not show the same
    rotating object clearly enough.
    """
    for number, capture in enumerate(captures, start=1):
        if capture.angles_rad is None:
            raise DataError(
                f"capture {number} has antenna positions instead of angles, so it cannot be rotated",
                "Join it without `align`.",
            )
    images = [_polar(capture) for capture in captures]
    rivals, likeness = [[0.0]], [1.0]
    for number in range(1, len(captures)):
        # The one before is nearest in height, so that its image is the most alike.
        correlation = _correlation(images[number - 1], images[number])
        likeness.append(float(correlation.max()))
        if likeness[-1] < LEAST_LIKENESS:
            raise DataError(
                f"the rotation of capture {number + 1} relative to the one before cannot be determined from "
                f"the scans (correlation {likeness[-1]:.2f}, {LEAST_LIKENESS:.2f} needed)",
                "If every capture states the same angle for the same pose, join them without `align`.",
            )
        rivals.append(_peaks(correlation))
    turns = [0.0]
    while len(turns) < len(captures):
        # Two heights fit any rotation of a symmetric tag at some height of its reflectors; three do not.
        more = rivals[len(turns) : len(turns) + (2 if len(turns) == 1 else 1)]
        turns = _sharpest(captures, turns, more)
    done = [rotated(capture, turn) for capture, turn in zip(captures, turns, strict=True)]
    return done, [Alignment(*pair) for pair in zip(turns, likeness, strict=True)]


def rotated(capture: Capture, rotation_rad: float) -> Capture:
    """The capture with every angle increased by the rotation, rad."""
    if capture.angles_rad is None:
        raise DataError("a capture without angles cannot be rotated")
    return replace(capture, angles_rad=capture.angles_rad + rotation_rad)


def _polar(capture: Capture) -> NDArray[np.float64]:
    """(radii, STEPS) |f|^2 of the backprojection in the plane z = 0, weighted by the radius."""
    scans = preprocess(capture, settings=PreprocessSettings(extent_m=_EXTENT_M))
    radii = np.arange(0.5, _EXTENT_M / 2 / RADIUS_STEP_M) * RADIUS_STEP_M
    angle = np.arange(STEPS) * 2 * np.pi / STEPS
    points = radii[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    image = ForwardOperator(scans, points.reshape(-1, 2)).adjoint(scans.samples)
    power = np.abs(image.reshape(len(radii), STEPS)).astype(np.float64) ** 2
    return np.asarray(power * radii[:, None])


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """(STEPS,) correlation coefficient of a(r, phi) and b(r, phi + d), without their means over phi, for
    every d."""
    a, b = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    product = np.fft.rfft(a, axis=1).conj() * np.fft.rfft(b, axis=1)
    return np.asarray(np.fft.irfft(product.sum(axis=0), STEPS) / max(size, 1e-300), dtype=np.float64)


def _peaks(correlation: NDArray[np.float64]) -> list[float]:
    """Rotations, rad, that undo the peaks of a correlation, the highest first."""
    remaining, turns = correlation.copy(), list[float]()
    top, apart = float(correlation.max()), round(RIVAL_APART_DEG / 360 * STEPS)
    for _ in range(MOST_RIVALS):
        at = int(np.argmax(remaining))
        if remaining[at] < RIVAL_SHARE * top:
            break
        before, here, after = (correlation[(at + step) % STEPS] for step in (-1, 0, 1))
        bend = 2 * here - before - after
        part = 0.5 * (after - before) / bend if bend > 0 else 0.0
        turns.append(2 * np.pi * (at + float(np.clip(part, -0.5, 0.5))) / STEPS)
        remaining[(at + np.arange(-apart, apart + 1)) % STEPS] = -np.inf
    return turns


def _sharpest(captures: Sequence[Capture], turns: list[float], rivals: Sequence[list[float]]) -> list[float]:
    """The rotations so far, rad, and one of each list of rivals, relative to the capture before, with which
    the volume is sharpest. Of several that are equally sharp (a symmetric object) those with the smallest
    rotations.
    """
    tried = [turns + list(np.cumsum([turns[-1], *steps])[1:]) for steps in itertools.product(*rivals)]
    if len(tried) == 1:
        return tried[0]
    volumes = [[rotated(*turned) for turned in zip(captures, turns, strict=False)] for turns in tried]
    sharp = [_sharpness(volume) for volume in volumes]
    equal = [
        turns for turns, sharpness in zip(tried, sharp, strict=True) if sharpness > (1 - _EQUAL) * max(sharp)
    ]
    return min(equal, key=lambda turns: float(np.abs(np.angle(np.exp(1j * np.array(turns)))).sum()))


def _sharpness(captures: Sequence[Capture]) -> float:
    """sum |f|^4 / (sum |f|^2)^2 of a coarse volume."""
    some = [capture.select(slice(None, None, max(1, capture.views // _VOLUME_VIEWS))) for capture in captures]
    heights = (-_VOLUME_HEIGHT_M / 2, _VOLUME_HEIGHT_M / 2)
    clean = without_background_of_each_height(join(some), "mean")
    settings = PreprocessSettings("none", extent_m=_EXTENT_M, heights_m=heights)
    scans: BasebandScans = preprocess(clean, settings=settings)
    grid = VolumeGrid(ImageGrid(_EXTENT_M, _VOLUME_PIXELS), *heights, _VOLUME_LEVELS)
    power = np.abs(backproject_volume(scans, grid).values).astype(np.float64) ** 2
    return float((power**2).sum() / max(float(power.sum()) ** 2, 1e-300))
