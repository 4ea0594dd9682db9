"""How well an image predicts views that it was not made from: a figure of merit that needs no ground truth.

An image of the object also predicts views that were left out. Sidelobes, ghosts and noise that was mistaken
for reflectors do not. Where views are dense, the scans beside a view predict it, too, whatever the geometry:
an image that predicts no better than they do is no evidence for its geometry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.errors import DataError
from tagid.geometry import ImageGrid
from tagid.imaging.backprojection import backproject
from tagid.imaging.facts import HeldOutFacts
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import select_views
from tagid.imaging.types import BasebandScans, Image

LEAST_VIEWS = 6
"""Fewer views are all needed for the image."""
SHARE = 1 / 12
"""Views left out, at least two: few enough that the image is nearly that of all views."""
_MOST_NOISE = 1.25
"""Estimated noise over what a prediction leaves, from which on it was clutter that was taken for noise. The
noise's own energy in two views of 40 independent samples varies by a ninth."""
_WORSE = 1e-3
"""Backprojection predicts better where it leaves less by this share of the energy."""


def held_out_facts(
    residual: float, backprojection: float, scans: BasebandScans, unseen: NDArray[np.intp]
) -> HeldOutFacts:
    """How well views that were left out are predicted, as shares of their energy.

    Args:
        residual: what the image leaves over of them: 1 for a blank image. One complex factor is fitted.
        backprojection: the same for backprojection from the same views; of scans as they are or correlated
            with the pulse, whichever predicts better.
        scans: all views, without matched filter.
        unseen: numbers of those that were left out.
    """
    samples = scans.samples[unseen]
    energy = float((np.abs(samples) ** 2).sum(dtype=np.float64))
    neighbours = neighbours_residual(scans, unseen)
    noise = scans.noise_std**2 * samples.size / energy if scans.noise_std > 0 and energy > 0 else np.nan
    least = float(np.fmin(residual, neighbours))
    noise = min(noise, least) if noise <= _MOST_NOISE * least else np.nan
    return {
        "residual": residual,
        "backprojection": backprojection,
        "neighbours": neighbours if np.isfinite(neighbours) else None,
        "noise": noise if np.isfinite(noise) else None,
        "views": len(unseen),
        "worse_than_backprojection": residual > backprojection + _WORSE,
        "worse_than_neighbours": neighbours < residual,
    }


def left_out(views: int) -> NDArray[np.intp]:
    """Numbers of the views to leave out, spread over all; empty if there are too few."""
    count = max(2, round(views * SHARE)) if views >= LEAST_VIEWS else 0
    return np.asarray((np.arange(count) + 0.5) * views / max(count, 1), dtype=np.intp)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted beside measured scans of some views, as sums over the bins; all (views,).

    Attributes:
        measured, predicted: energies.
        product: complex, of the predicted scans' conjugate and the measured ones.
    """

    measured: NDArray[np.float64]
    predicted: NDArray[np.float64]
    product: NDArray[np.complex128]

    @classmethod
    def of(cls, data: NDArray[np.complexfloating], seen: NDArray[np.complexfloating]) -> Prediction:
        """Of measured and predicted scans, both (views, bins)."""
        power = [(np.abs(samples) ** 2).sum(axis=1, dtype=np.float64) for samples in (data, seen)]
        return cls(power[0], power[1], (seen.conj() * data).sum(axis=1, dtype=np.complex128))

    @classmethod
    def none(cls) -> Prediction:
        """Of no views."""
        empty = np.zeros(0)
        return cls(empty, empty, empty.astype(np.complex128))

    @property
    def misfits(self) -> NDArray[np.float64]:
        """Energy that is left of every view; one complex factor is fitted to all of them together.

        A factor of its own for each of a few views would explain a part of them by any image.
        """
        power = float(self.predicted.sum())
        factor = self.product.sum() / power if power > 0 else 0.0
        misfit = self.measured - 2 * (np.conj(factor) * self.product).real + abs(factor) ** 2 * self.predicted
        return np.asarray(np.maximum(misfit, 0.0))

    @property
    def residual(self) -> float:
        """Share of the energy of all views that is left; nan where there is none."""
        energy = float(self.measured.sum())
        return float(self.misfits.sum()) / energy if energy > 0 else float("nan")


def residual(scans: BasebandScans, image: Image) -> float:
    """||y - A x||^2 / ||y||^2 on scans that were not used for the reconstruction: 1 for a blank image.

    The image's scale and phase are fitted, so that the normalisation of backprojection does not count. Raises
    DataError: the scans are all zero.
    """
    if not np.any(scans.samples):
        raise DataError("the held-out scans are zero")
    seen = ForwardOperator(scans, image.grid).forward(image.values.ravel())
    return Prediction.of(scans.samples.astype(np.complex128), seen.astype(np.complex128)).residual


def backprojection_residual(scans: BasebandScans, seen: BasebandScans, grid: ImageGrid) -> float:
    """`residual` on scans that were not seen of backprojection of those seen, as they are or correlated with
    the pulse, whichever predicts better. Both are without matched filter.
    """
    correlated = ForwardOperator(seen, grid).adjoint(seen.samples).reshape(grid.pixels, grid.pixels)
    return min(residual(scans, image) for image in (backproject(seen, grid), Image(correlated, grid)))


def neighbours_residual(scans: BasebandScans, unseen: NDArray[np.intp]) -> float:
    """What the mean of the two neighbouring scans leaves of the views `unseen`, over their energy; nan
    without any.

    The neighbours of a view are the nearest antenna position among the other views of the scans (without
    matched filter), and the nearest on its far side (the nearest alone at the end of a path). One complex
    factor is fitted to all views.
    """
    seen = np.setdiff1d(np.arange(scans.aperture.views), unseen)
    if not len(seen):
        return float("nan")
    positions = np.concatenate(scans.aperture.antennas, axis=1)
    predicted = np.zeros((len(unseen), scans.samples.shape[1]), dtype=np.complex128)
    for row, view in zip(predicted, unseen, strict=True):
        away = positions[seen] - positions[view]
        distance = np.linalg.norm(away, axis=1)
        first = int(np.argmin(distance))
        beyond = np.flatnonzero(away @ away[first] < 0)
        near = [first, beyond[np.argmin(distance[beyond])]] if len(beyond) else [first]
        row[:] = scans.samples[seen[near]].mean(axis=0)
    return Prediction.of(scans.samples[unseen], predicted).residual


def check(
    scans: BasebandScans,
    unfiltered: BasebandScans,
    grid: ImageGrid,
    make: Callable[[BasebandScans], Image] | None,
    predicted: Callable[[BasebandScans, NDArray[np.intp]], float] | None = None,
) -> HeldOutFacts | None:
    """Figures of an image made without some views, on those views; None if there are too few, or no data.

    `scans` are as the method takes them; all methods are compared on the `unfiltered` ones. `make` gives the
    method's image of scans, at bare pixels; None: backprojection itself. For a model that is more than its
    image, `predicted` gives its own residual on those of all views that `left_out` names.
    """
    unseen = left_out(scans.aperture.views)
    if not len(unseen):
        return None
    seen = np.setdiff1d(np.arange(scans.aperture.views), unseen)
    test = select_views(unfiltered, unseen)
    if not np.any(test.samples):
        return None
    if make is None:
        best = plain = residual(test, backproject(select_views(scans, seen), grid))
    else:
        plain = backprojection_residual(test, select_views(unfiltered, seen), grid)
        best = (
            residual(test, make(select_views(scans, seen))) if predicted is None else predicted(scans, unseen)
        )
    return held_out_facts(best, plain, unfiltered, unseen)
