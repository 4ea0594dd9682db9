"""Captures of one object from several antenna heights, joined into one capture of antenna positions.

Each capture must state the true angles of the object. A table started by hand at a different angle each time
gives captures that are rotated relative to each other, from which no volume can be formed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.errors import DataError, UsageError
from tagid.imaging.preprocess import remove_background

_SAME_M = 1e-6
"""Range starts and steps that differ by less are equal."""


def join(captures: Sequence[Capture]) -> Capture:
    """One capture with the antenna positions of all, whose angles or positions are known.

    The first one gives the band, the pulse and the metadata of radar and object. Raises UsageError: fewer
    than two captures, or one of them twice. DataError: different range windows, bands or media, or no
    geometry.
    """
    if len(captures) < 2:
        raise UsageError("one capture cannot be joined", "Give two or more captures of the same object.")
    first = captures[0]
    for number, other in enumerate(captures[1:], start=2):
        _check(first, other, number)
        for earlier, before in enumerate(captures[: number - 1], start=1):
            if before.uuid == other.uuid and np.array_equal(before.samples, other.samples):
                raise UsageError(
                    f"captures {earlier} and {number} are the same recording",
                    "Give each recording once; one from every antenna height.",
                )
    apertures = [capture.aperture() for capture in captures]
    pairs = any(aperture.half_baseline is not None for aperture in apertures)
    path = np.concatenate([aperture.antennas[0] for aperture in apertures])
    other_end = np.concatenate([aperture.antennas[-1] for aperture in apertures]) if pairs else None
    kind = np.complex64 if np.iscomplexobj(first.samples) else np.float32
    same = {capture.samples.dtype for capture in captures} == {first.samples.dtype}
    parts = [capture.samples if same else capture.samples.astype(kind) for capture in captures]
    joined = Capture(
        np.concatenate(parts),
        first.range_start_m,
        first.range_step_m,
        antenna_positions_m=path,
        receive_positions_m=other_end,
        center_frequency_hz=first.center_frequency_hz,
        bandwidth_hz=first.bandwidth_hz,
        wave_speed_m_s=first.wave_speed_m_s,
        pulse=first.pulse,
        radar=first.radar,
        object=first.object,
        complete=all(capture.complete for capture in captures),
    )
    if len(heights_of(joined)) < 2:
        raise DataError(
            f"all {len(captures)} captures were recorded at the same antenna height",
            "Give captures from different heights, each recorded with its own `motion.antenna_height_m`.",
        )
    flags = [capture.flags for capture in captures]
    if all(flag is not None for flag in flags):
        joined = replace(joined, flags=np.concatenate([flag for flag in flags if flag is not None]))
    return joined


def heights_of(capture: Capture) -> list[NDArray[np.intp]]:
    """Views of each antenna height, see `tagid.geometry.Aperture.height_groups`."""
    return capture.aperture().height_groups()


def without_background_of_each_height(capture: Capture, background: str) -> Capture:
    """The capture minus the mean over the views of each height, as the room's echo depends on the height."""
    if background == "none":
        return capture
    samples = np.empty(
        capture.samples.shape, np.complex64 if np.iscomplexobj(capture.samples) else np.float32
    )
    for views in heights_of(capture):
        samples[views] = remove_background(capture.samples[views], background)  # type: ignore[arg-type]
    return replace(capture, samples=samples)


def _check(first: Capture, other: Capture, number: int) -> None:
    """Raises DataError if two captures cannot be joined."""
    if np.iscomplexobj(first.samples) != np.iscomplexobj(other.samples):
        raise DataError(f"capture {number} is real and the first is complex, or vice versa")
    same = {
        "range bins": first.bins == other.bins,
        "the range of the first bin": abs(first.range_start_m - other.range_start_m) < _SAME_M,
        "the step between bins": abs(first.range_step_m - other.range_step_m) < _SAME_M,
        "the band": (first.center_frequency_hz, first.bandwidth_hz)
        == (other.center_frequency_hz, other.bandwidth_hz),
        "the wave speed": first.wave_speed_m_s == other.wave_speed_m_s,
    }
    different = [name for name, equal in same.items() if not equal]
    if different:
        raise DataError(
            f"capture {number} differs from the first in {', '.join(different)}",
            "Record all heights with the same range window and radar.",
        )
