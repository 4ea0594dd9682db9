"""The prior of the fit: the defaults where they explain unseen views, else coupled pixels.

The defaults are for a few reflectors that scatter to all sides. Where they leave much more than noise of
unseen views, the image is the posterior mean under a Gaussian prior whose variance neighbours share
(`tagid.imaging.coupled`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tagid.geometry import ImageGrid
from tagid.imaging.ats.fit import AtsResult, fit
from tagid.imaging.ats.problem import FirstImages
from tagid.imaging.ats.settings import (
    AUTO,
    LEAST_HELD_OUT,
    AtsSettings,
    FitSettings,
    Prior,
    StepProgress,
)
from tagid.imaging.coupled import coupled_recovery
from tagid.imaging.facts import COUPLED, ImageFacts
from tagid.imaging.heldout import backprojection_residual, left_out, residual
from tagid.imaging.preprocess import select_views
from tagid.imaging.types import BasebandScans

ENOUGH, ASKS = 0.01, 0.05
"""Shares of the energy of unseen views, over the noise, that a field may leave over: up to the first it makes
the image, beyond the second coupled pixels do, and in between what predicts more. Beyond, few views would
tell the two apart by chance: one that is left out of a dozen is predicted by nothing."""

LEAST_VIEWS = 8
"""Fewer views tell no prior from another."""


def settings_of(facts: ImageFacts, settings: AtsSettings) -> FitSettings:
    """Settings that fit as an image says (`Image.settings`) that it was fitted: the views of a step.

    All views are fitted, no other prior is tried and nothing is learned beside the scene.
    """
    prior = Prior.DEFAULT if settings.prior == AUTO else settings.prior
    same = FitSettings.of(replace(settings, prior=prior, calibrate=()))
    return replace(same, views_per_step=facts.get("views_per_step", same.views_per_step), held_out=0.0)


def fit_adapted(
    scans: BasebandScans, grid: ImageGrid, settings: AtsSettings, progress: StepProgress | None = None
) -> AtsResult:
    """Fit with the settings; where unseen views ask for it, with more views a step (`seeing_all`);
    where they still ask for another prior and none was given, with coupled pixels, which are no field.

    The image's settings then say so (`facts.is_coupled`). It keeps what the fit has learned of axis and
    wobble. Where other things are learned or weighed beside the scene the field stays.

    Args and errors as `fit`.
    """
    views = scans.aperture.views
    if settings.prior != AUTO or views < LEAST_VIEWS or not np.any(scans.samples):
        return fit(scans, grid, settings, progress)
    images = FirstImages()
    quick = FitSettings.of(settings)
    thorough = quick.seeing_all(views)
    # A dozen views are all needed for the image: then a fit without some of them is only asked.
    enough = views >= LEAST_HELD_OUT
    unseen = None if enough else left_out(views)
    for tried in dict.fromkeys((quick, thorough)):
        first = fit(scans, grid, tried, progress, unseen, images=images)
        excess = _excess(scans, grid, first)
        if excess <= ASKS:
            break
    turned = scans.with_aperture(first.calibration.aperture(scans.aperture))
    if not settings.is_plain or excess <= ENOUGH or (excess <= ASKS and not _is_coupled(turned, grid, first)):
        return first if enough else fit(scans, grid, tried, progress, images=images)
    facts = {**first.image.settings, "prior": COUPLED}
    return replace(first, image=replace(coupled_recovery(turned, grid), settings=facts), field=None)


def _excess(scans: BasebandScans, grid: ImageGrid, first: AtsResult) -> float:
    """Share of the energy of its unseen views that a fit leaves over the noise; infinite where it leaves more
    than backprojection does of the scans as they are, or correlated with the pulse."""
    if not first.losses:
        return 0.0
    unseen, seen = _apart(scans, first)
    if first.held_out > backprojection_residual(unseen, seen, grid):
        return float("inf")
    energy = float((np.abs(unseen.samples) ** 2).sum())
    return first.held_out - (unseen.noise_std**2 * unseen.samples.size / energy if energy > 0 else 1.0)


def _is_coupled(scans: BasebandScans, grid: ImageGrid, first: AtsResult) -> bool:
    """Whether coupled pixels predict more of the views that a fit has not seen."""
    unseen, seen = _apart(scans, first)
    return residual(unseen, coupled_recovery(seen, grid)) < first.held_out


def _apart(scans: BasebandScans, first: AtsResult) -> tuple[BasebandScans, BasebandScans]:
    """The scans of the views that a fit has not seen, and of the others."""
    seen = np.setdiff1d(np.arange(scans.aperture.views), first.unseen)
    return select_views(scans, first.unseen), select_views(scans, seen)
