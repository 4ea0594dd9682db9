"""Scores of images against known points, defined once so that figures of different methods are comparable.

Published figures often cannot be compared because normalisation, ground truth and data range are not given.
Here magnitudes are normalised to their peak, points are Gaussians of 1 cm, and the data range is 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError, StorageError
from tagid.geometry import ImageGrid
from tagid.imaging.types import Image
from tagid.models_store import load_onnxruntime

POINT_SIGMA_M = 0.01
"""Standard deviation of the Gaussian that represents a true point, m."""

MATCH_RADIUS_M = 0.02
"""An estimated point farther from every true one is a false detection, m (half a wavelength of the P440 is
38 mm, the full-circle resolution 13 mm)."""


@dataclass(frozen=True)
class Localisation:
    """Estimated points against true ones, matched one to one at the least total distance.

    Attributes:
        rmse_m: root mean square distance of the matched pairs, m; nan if none matched.
        detected: number of true points that were matched.
        missed: number of true points that were not.
        false: number of estimated points that match no true one.
    """

    rmse_m: float
    detected: int
    missed: int
    false: int


def normalised_magnitude(values: NDArray[np.generic]) -> NDArray[np.float64]:
    """|values| / max |values|, any shape; a blank image stays zero."""
    magnitude: NDArray[np.float64] = np.abs(values).astype(np.float64)
    peak = float(magnitude.max()) if magnitude.size else 0.0
    return magnitude / peak if peak > 0 else magnitude


def truth_image(
    points: NDArray[np.floating],
    grid: ImageGrid,
    amplitudes: NDArray[np.floating] | None = None,
    sigma_m: float = POINT_SIGMA_M,
) -> NDArray[np.float64]:
    """(pixels, pixels) ground truth: the maximum over points (n, 2), m, of amplitude * Gaussian."""
    truth = np.zeros((grid.pixels, grid.pixels))
    heights = np.ones(len(points)) if amplitudes is None else np.abs(amplitudes)
    for (x, y), height in zip(np.asarray(points, dtype=np.float64), heights, strict=True):
        across = np.exp(-((grid.axis - x) ** 2) / (2 * sigma_m**2))
        along = np.exp(-((grid.axis - y) ** 2) / (2 * sigma_m**2))
        truth = np.maximum(truth, height * along[:, None] * across)
    return truth


def mse(image: NDArray[np.generic], truth: NDArray[np.generic]) -> float:
    """Mean square difference of the peak-normalised magnitudes. Raises DataError if shapes differ."""
    if image.shape != truth.shape:
        raise DataError(f"image has shape {image.shape}, truth {truth.shape}")
    return float(((normalised_magnitude(image) - normalised_magnitude(truth)) ** 2).mean())


def psnr(image: NDArray[np.generic], truth: NDArray[np.generic]) -> float:
    """-10 log10 MSE, dB: the data range is 1. Infinite for equal images."""
    error = mse(image, truth)
    return float(-10 * np.log10(error)) if error > 0 else float("inf")


def localise(
    estimated: NDArray[np.floating], true: NDArray[np.floating], radius_m: float = MATCH_RADIUS_M
) -> Localisation:
    """Compare points (n, 2) and (m, 2), m; pairs farther apart than the radius do not count."""
    from scipy.optimize import linear_sum_assignment

    points = np.asarray(estimated, dtype=np.float64).reshape(-1, 2)
    truth = np.asarray(true, dtype=np.float64).reshape(-1, 2)
    if len(points) == 0 or len(truth) == 0:
        return Localisation(float("nan"), 0, len(truth), len(points))
    distance = np.linalg.norm(points[:, None] - truth[None], axis=2)
    # A pair beyond the radius costs more than all pairs within it, so the number of matches is maximised
    # first.
    cost = np.where(distance <= radius_m, distance, 1e3 * radius_m * max(distance.shape))
    rows, columns = linear_sum_assignment(cost)
    pairs = distance[rows, columns]
    pairs = pairs[pairs <= radius_m]
    rmse = float(np.sqrt((pairs**2).mean())) if len(pairs) else float("nan")
    return Localisation(rmse, len(pairs), len(truth) - len(pairs), len(points) - len(pairs))


def pick_peaks(image: Image, count: int, separation_m: float = MATCH_RADIUS_M) -> NDArray[np.float64]:
    """The strongest pixels (n <= count, 2), m, none closer to a stronger one than `separation_m`.

    A plain peak picker for scoring images of any method. Pixels below 0.3 of the maximum are not peaks. The
    position is the power-weighted mean of the 3 x 3 pixels around the maximum.
    """
    power = np.abs(image.values).astype(np.float64) ** 2
    least = 0.3**2 * float(power.max())
    remaining = power.copy()
    x, y = np.meshgrid(image.grid.axis, image.grid.axis)
    peaks: list[tuple[float, float]] = []
    while len(peaks) < count:
        row, column = np.unravel_index(int(np.argmax(remaining)), remaining.shape)
        if remaining[row, column] <= 0 or remaining[row, column] < least:
            break
        near = (slice(max(0, row - 1), row + 2), slice(max(0, column - 1), column + 2))
        share = power[near] / power[near].sum()
        peaks.append((float((x[near] * share).sum()), float((y[near] * share).sum())))
        remaining[np.hypot(x - x[row, column], y - y[row, column]) < separation_m] = 0
    return np.array(peaks, dtype=np.float64).reshape(-1, 2)


def blank(grid: ImageGrid) -> Image:
    """A blank image, the baseline of every comparison."""
    return Image(np.zeros((grid.pixels, grid.pixels), dtype=np.complex64), grid, {"method": "blank"})


def lpips(image: NDArray[np.generic], truth: NDArray[np.generic], model: Path) -> float:
    """Learned perceptual distance (Zhang et al., CVPR 2018), SqueezeNet v0.1, of two (H, W) images.

    Peak-normalised magnitudes in 0..1, repeated on three channels and normalised as ImageNet; `model` is an
    ONNX file with two inputs (1, 3, H, W) float32 and one number out.

    Raises StorageError if the model file does not exist.
    """
    if not model.is_file():
        raise StorageError(f"the LPIPS model {model} does not exist", "Give the path of lpips_sq.onnx.")
    session = load_onnxruntime().InferenceSession(str(model), providers=["CPUExecutionProvider"])
    names = [entry.name for entry in session.get_inputs()]
    feed = dict(zip(names, (_for_network(image), _for_network(truth)), strict=True))
    return float(np.asarray(session.run(None, feed)[0]).ravel()[0])


def _for_network(values: NDArray[np.generic]) -> NDArray[np.float32]:
    mean = np.array([0.485, 0.456, 0.406])[:, None, None]
    std = np.array([0.229, 0.224, 0.225])[:, None, None]
    magnitude = np.repeat(normalised_magnitude(values)[None], 3, axis=0)
    return np.asarray(((magnitude - mean) / std)[None], dtype=np.float32)
