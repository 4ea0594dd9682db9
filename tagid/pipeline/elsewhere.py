"""The same scans with another axis distance, or about another point of the turntable: what is read there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tagid.capture import Capture
from tagid.errors import DataError
from tagid.pipeline.identify import identify
from tagid.pipeline.prepared import PreparedCapture
from tagid.reading.reading import Reading
from tagid.tags.layouts.layout import Layout


def named_in(prepared: PreparedCapture, capture: Capture, layouts: Sequence[Layout]) -> Reading | None:
    """The reading of the same scans elsewhere if it names the object.

    Args:
        prepared: the capture of the answer, for its settings.
        capture: the scans elsewhere.
        layouts: the enrolled ones.
    """
    try:
        found = identify(prepared.elsewhere(capture), layouts)
    except DataError:
        return None
    return found.reading if found.status == "identified" else None


def recentred(capture: Capture, centre: tuple[float, float]) -> Capture:
    """The scans as they would be if the point `centre` of the turntable were its axis.

    Each view is shifted in range by the difference between the distances of that point and of the axis, and
    its angle becomes the direction of the antenna from that point. What is the same in every view before the
    shift, the room, is subtracted; so is what is the same in every view after it, a round body about the new
    axis. The two are told apart by least squares, because the mean over the views of an echo that moves
    would be left behind as one that moves the other way. The remaining error is the change of curvature,
    under 1 mm for an object of 0.1 m at 1 m.

    Args:
        capture: of a turntable, with angles and axis distance.
        centre: (x, y), m.
    """
    if capture.angles_rad is None or capture.axis_distance_m is None:
        raise DataError("only scans of a turntable can be moved to another axis")
    distance = capture.axis_distance_m
    x = distance * np.cos(capture.angles_rad) - centre[0]
    y = -distance * np.sin(capture.angles_rad) - centre[1]
    bins = capture.samples.shape[1]
    padded = 1 << int(np.ceil(np.log2(2 * bins)))
    shift = (np.hypot(x, y) - distance) / capture.range_step_m
    turned = np.exp(2j * np.pi * np.fft.fftfreq(padded) * shift[:, None])
    spectra = _without_either(np.fft.fft(capture.samples, padded), turned)
    moved = np.fft.ifft(spectra * turned)[:, :bins]
    # Not back to the integers of a P440: nothing may be rounded away.
    real = not np.iscomplexobj(capture.samples)
    samples = moved.real.astype(np.float32) if real else moved.astype(np.complex64)
    return replace(capture, samples=samples, angles_rad=-np.arctan2(y, x))


def _without_either(
    spectra: NDArray[np.complex128], turned: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """(V, F) spectra without what is the same in every view, or is so once they are turned."""
    columns = np.stack([np.ones_like(turned), turned.conj()], axis=-1).swapaxes(0, 1)
    basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    # At a wavelength far above the shift both are one.
    basis = basis * (sizes > 1e-6 * sizes[:, :1])[:, None, :]
    data = spectra.T[..., None]
    return np.asarray((data - basis @ (basis.conj().swapaxes(1, 2) @ data))[..., 0].T)
