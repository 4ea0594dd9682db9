"""The prior of the fit: the defaults where they explain unseen views, else one that suits the scene.

The defaults are for a few reflectors that scatter to all sides. Where they leave much more than noise of
unseen views, few views get the mean of the dense field and the sparse pixels, as they do not tell which of
the two is right; of many, other priors are tried on views that no fit has seen. Among them are two without a
field: the linear solution, whose first iteration is backprojection, and sparse pixels. The views on which the
image is judged in the end (`heldout.left_out`) take no part in the choice.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import MissingExtraError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.ats.fit import AtsResult, fit, sparsity_weight, unshrinking
from tagid.imaging.ats.problem import LARGE_PAIRS, FirstImages
from tagid.imaging.ats.settings import (
    AUTO,
    LEAST_HELD_OUT,
    AtsSettings,
    FitSettings,
    Prior,
    StepProgress,
)
from tagid.imaging.backprojection import backproject
from tagid.imaging.heldout import Prediction, left_out, residual
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import select_views
from tagid.imaging.sparse import sparse_recovery
from tagid.imaging.types import BasebandScans, Image
from tagid.types import Samples


def least_squares(operator: ForwardOperator, scans: Samples, iterations: Sequence[int]) -> Iterator[Samples]:
    """Minimise ||A x - y||^2 from zero for scans y (views, bins) (CGLS; Hestenes and Stiefel, J. Res. NBS 49,
    1952).

    Yields x (points,) complex64 after each of the ascending numbers of iterations.
    """
    x = np.zeros(operator.points, dtype=np.complex64)
    rest = np.asarray(scans, dtype=np.complex64).copy()
    slope = operator.adjoint(rest)
    direction, power = slope.copy(), float(np.vdot(slope, slope).real)
    for done in range(1, max(iterations) + 1):
        if power > 0:
            seen = operator.forward(direction)
            energy = float(np.vdot(seen, seen).real)
            length = np.float32(power / energy if energy > 0 else 0.0)
            x = x + length * direction
            rest -= length * seen
            slope = operator.adjoint(rest)
            before, power = power, float(np.vdot(slope, slope).real)
            direction = slope + np.float32(power / before) * direction
        if done in iterations:
            yield x


ASKS = 0.05
"""Share of the energy of unseen views, over the noise, that the defaults may leave over before others are
tried."""

KEEPS = 1.0
"""The defaults stay unless the gain of another prior over them exceeds this many standard errors over the
views. Sparse pixels, which the default field starts from, take its place where they leave less, unless it
leaves little but noise: it tells places more accurately."""

MOST_TRIED, NEAR = 2, 1.1
"""So many fields at most are tried on another group of views, and only those that leave at most this times
what the best leaves of the groups so far: most priors fall behind on the first."""

LEAST_VIEWS = 8
"""Fewer views tell no prior from another."""

FEW_VIEWS = 90
"""From so many views on, priors are tried. On a turn about an object of 0.4 m at 4 GHz fewer are not tied to
their neighbours: one that is left out is predicted by no prior, and trials choose by chance."""

BACKPROJECTIONS = (Prior.LINEAR_0, Prior.LINEAR_1)
LINEAR = [prior for prior in Prior if prior.iterations]
"""Linear priors by rising iterations, backprojection of the scans as they are left out."""

ISOTROPIC = {Prior.ASPECT: Prior.DEFAULT, Prior.DENSE_ASPECT: Prior.DENSE}
"""Priors that depend on the aspect, the most expensive fields, and the same without it. Of a large image
(`LARGE_PAIRS`) only that of the better of the two others is tried, and the linear solution ends where it gets
worse. Fewer views in the trials are no way out: without their neighbours, views at 24 GHz are predicted by no
prior."""

SHADED = {Prior.DENSE_SHADOWS: Prior.DENSE, Prior.DENSE_ASPECT_SHADOWS: Prior.DENSE_ASPECT}
"""Priors with shadows, and the same without. Only that of the best field so far is tried, where it still asks
for another (`ASKS`), and none of a large image: every view takes a sum over all pixels."""


def settings_of(facts: dict[str, Any], settings: AtsSettings) -> FitSettings:
    """Settings that fit as an image says (`Image.settings`) that it was fitted: prior, and views of a step.

    All views are fitted, no other prior is tried and nothing is learned beside the scene.
    """
    prior = Prior.DEFAULT if settings.prior == AUTO else settings.prior
    same = FitSettings.of(replace(settings, prior=prior, calibrate=()))
    views = facts.get("views_per_step", same.views_per_step)
    chosen = same.with_prior(Prior.of(facts)) if "prior" in facts else same
    return replace(chosen, views_per_step=views, held_out=0.0)


def image_without_field(
    scans: BasebandScans,
    grid: ImageGrid,
    prior: Prior,
    settings: AtsSettings | None = None,
    progress: StepProgress | None = None,
    images: FirstImages | None = None,
) -> Image:
    """The image of a prior that is no field. `settings` are those of the field whose mean with sparse pixels
    is the image; the others are as of `fit`.
    """
    if prior is Prior.MEAN:
        quick = FitSettings.of(settings or AtsSettings())
        dense = quick.seeing_all(scans.aperture.views).with_prior(Prior.DENSE)
        field = fit(scans, grid, dense, progress, images=images).image
        pixels = image_without_field(scans, grid, Prior.PIXELS)
        return replace(field, values=(field.values + pixels.values) / 2)
    if prior is Prior.PIXELS:
        values = _sparse_pixels(scans, grid, ForwardOperator(scans, grid))
    elif not prior.iterations:
        values = backproject(scans, grid).values
    else:
        *_, values = least_squares(ForwardOperator(scans, grid), scans.samples, (prior.iterations,))
    facts = {"method": "ats", "axis_distance_m": scans.aperture.axis_distance}
    return Image(values.reshape(grid.pixels, grid.pixels), grid, facts)


def _sparse_pixels(scans: BasebandScans, grid: ImageGrid, operator: ForwardOperator) -> NDArray[np.complex64]:
    """(points,) sparse solution times the one factor that explains the scans best, as of a field."""
    values = sparse_recovery(scans, grid, operator=operator).values.ravel()
    factor = np.float32(unshrinking(operator.forward(values), scans.samples))
    return np.asarray(values * factor, dtype=np.complex64)


def fit_adapted(
    scans: BasebandScans, grid: ImageGrid, settings: AtsSettings, progress: StepProgress | None = None
) -> AtsResult:
    """Fit with the settings; where unseen views ask for it, with more views a step (`seeing_all`);
    where they still ask for another prior and none was given, with that one: `Prior.MEAN` of fewer views than
    `FEW_VIEWS`, else the best of the trials.

    The image's settings say what was tried: "prior" is its name, "prior_trials" the residual of each on views
    that its fit did not see, "prior_against_default" its residual and that of the defaults on those of these
    views that both were tried on, "priors_not_tried" what was left out because the image is large.

    Args and errors as `fit`.
    """
    views = scans.aperture.views
    if not settings.adapts or views < LEAST_VIEWS or not np.any(scans.samples):
        return fit(scans, grid, settings, progress)
    images = FirstImages()
    quick = FitSettings.of(settings)
    thorough = quick.seeing_all(views)
    # A dozen views are all needed for the image: then a fit without some of them is only asked.
    enough = views >= LEAST_HELD_OUT
    unseen = None if enough else left_out(views)
    for tried in dict.fromkeys((quick, thorough)):
        first = fit(scans, grid, tried, progress, unseen, images=images)
        if not first.losses or _explains(scans, grid, first):
            return first if enough else fit(scans, grid, tried, progress, images=images)
    if views < FEW_VIEWS:
        image = image_without_field(scans, grid, Prior.MEAN, quick, progress, images)
        facts = {**image.settings, "prior": Prior.MEAN.value}
        return replace(first, image=replace(image, settings=facts), field=None)
    trials = _Trials(scans, grid, thorough, progress, without_field=settings.calibrate == ())
    prior = trials.chosen()
    if prior.field is not None and prior is not Prior.DEFAULT:
        first = fit(scans, grid, thorough.with_prior(prior), progress, images=images)
    facts = {**first.image.settings, "prior": prior.value, "prior_trials": trials.residuals()}
    facts["prior_against_default"] = trials.against_default(prior)
    if trials.skipped:
        facts["priors_not_tried"] = [skipped.value for skipped in trials.skipped]
    if prior.field is not None:
        return replace(first, image=replace(first.image, settings=facts))
    image = image_without_field(scans, grid, prior)
    return replace(first, image=replace(image, settings=facts), field=None)


def _noise_share(scans: BasebandScans) -> float:
    energy = float((np.abs(scans.samples) ** 2).sum())
    return scans.noise_std**2 * scans.samples.size / energy if energy > 0 else 1.0


def _explains(scans: BasebandScans, grid: ImageGrid, first: AtsResult) -> bool:
    """Whether a fit leaves little but noise of its unseen views, and less than both backprojections."""
    unseen = select_views(scans, first.unseen)
    if first.held_out > _noise_share(unseen) + ASKS:
        return False
    seen = select_views(scans, np.setdiff1d(np.arange(scans.aperture.views), first.unseen))
    plain = (residual(unseen, image_without_field(seen, grid, name)) for name in BACKPROJECTIONS)
    return all(first.held_out <= value for value in plain)


class _Trials:
    """Residuals of priors on groups of views that their fits have not seen, view by view.

    All fields are tried on the first group, some of a large image (`LARGE_PAIRS`); those near the best go on
    to the next.
    """

    def __init__(
        self,
        scans: BasebandScans,
        grid: ImageGrid,
        settings: FitSettings,
        progress: StepProgress | None,
        without_field: bool,
    ) -> None:
        judged = left_out(scans.aperture.views)
        some = np.setdiff1d(np.arange(scans.aperture.views), judged)
        self.scans, self.bounded = select_views(scans, some), len(some) * grid.pixels**2 > LARGE_PAIRS
        self.skipped: list[Prior] = []
        self.images = FirstImages()
        self.grid, self.progress = grid, progress
        self.settings = replace(settings, calibrate=(), held_out=0.0)
        self.operator, self.without_field = ForwardOperator(self.scans, grid), without_field
        self.views = 0
        self.explained = False
        self.found: dict[Prior, Prediction] = {}
        self._race(folds(self.scans.aperture.views))

    def residuals(self) -> dict[str, float]:
        """Share of the energy that every prior leaves of the groups that it was tried on."""
        return {prior.value: part.residual for prior, part in self.found.items()}

    def against_default(self, prior: Prior) -> dict[str, float]:
        """What a prior and the defaults leave of the views that both were tried on, and their number.

        The defaults may fall behind after the first group; others are then judged on more views.
        """
        parts = [self.found[tried] for tried in (prior, Prior.DEFAULT)]
        views = min(len(part.measured) for part in parts)
        residual, default = (part.first(views).residual for part in parts)
        return {"residual": residual, "default": default, "views": views}

    def chosen(self) -> Prior:
        """The best prior of those that were tried on every group; the defaults where it is hardly better."""
        last = [prior for prior in self._last() if prior is not Prior.PIXELS or not self.explained]
        best = min(last, key=self._residual)
        if Prior.DEFAULT in last and self._gain(best, Prior.DEFAULT) < KEEPS:
            best = min((p for p in (Prior.DEFAULT, Prior.PIXELS) if p in last), key=self._residual)
        return best

    def _race(self, groups: list[NDArray[np.intp]]) -> None:
        running = self._different()
        for number, group in enumerate(groups):
            self.views += len(group)
            if self.without_field:
                self._try_linear(group)
                self._try_pixels(group)
            for prior in running:
                if number == 0 and self._is_skipped(prior, group):
                    continue
                self._try(prior, group)
                if prior is Prior.DEFAULT and number == 0 and self._enough(group):
                    self.explained = True
                    return
            last = self._last()
            best = min(map(self._residual, last))
            near = [prior for prior in last if prior.field and self._residual(prior) <= NEAR * best]
            running = sorted(near, key=self._residual)[:MOST_TRIED]
            if not running:
                return

    def _residual(self, prior: Prior) -> float:
        return self.found[prior].residual

    def _different(self) -> list[Prior]:
        """Fields without those whose sparsity prior has the weight of another's: noise may set both."""
        peak = float(np.abs(self.operator.adjoint(self.scans.samples)).max())
        kept: dict[tuple[float, int, float], Prior] = {}
        for prior in Prior:
            if prior.field is not None:
                weight = sparsity_weight(self.scans, peak, prior.field)
                kept.setdefault((weight, prior.field.aspect_harmonics, prior.field.occlusion), prior)
        return list(kept.values())

    def _is_skipped(self, prior: Prior, group: NDArray[np.intp]) -> bool:
        """Whether a prior is left out of the trials; noted where it is because the image is large."""
        if prior in SHADED:
            best = min((tried for tried in self.found if tried.field), key=self._residual)
            asks = self._residual(best) > _noise_share(select_views(self.scans, group)) + ASKS
            if SHADED[prior] != best or not asks:
                return True
            if self.bounded:
                self.skipped.append(prior)
            return self.bounded
        others = [tried for tried in ISOTROPIC.values() if tried in self.found]
        if not self.bounded or prior not in ISOTROPIC or not others:
            return False
        if ISOTROPIC[prior] == min(others, key=self._residual):
            return False
        self.skipped.append(prior)
        return True

    def _enough(self, group: NDArray[np.intp]) -> bool:
        """Whether the defaults leave little but noise of the first group, and less than backprojection."""
        part = select_views(self.scans, group)
        plain = [self._residual(prior) for prior in BACKPROJECTIONS if prior in self.found]
        return self._residual(Prior.DEFAULT) <= min([_noise_share(part) + ASKS, *plain])

    def _last(self) -> list[Prior]:
        """Priors that were tried on every group so far."""
        return [prior for prior, part in self.found.items() if len(part.measured) == self.views]

    def _add(self, prior: Prior, prediction: Prediction) -> None:
        self.found[prior] = self.found.get(prior, Prediction.none()).and_of(prediction)

    def _try_linear(self, group: NDArray[np.intp]) -> None:
        """Backprojection, and least squares after every number of iterations."""
        operator = self.operator
        rest = np.setdiff1d(np.arange(operator.views), group)
        seen, unseen = select_views(self.scans, rest), operator.select(group)
        plain = backproject(seen, self.grid).values.ravel()
        priors = [prior for prior in LINEAR if prior not in self.skipped]
        counts = [prior.iterations for prior in priors if prior.iterations]
        solutions = least_squares(operator.select(rest), seen.samples, counts)
        residuals: list[float] = []
        for prior, values in zip((Prior.LINEAR_0, *priors), chain([plain], solutions), strict=True):
            prediction = Prediction.of(self.scans.samples[group], unseen.forward(values))
            self._add(prior, prediction)
            residuals.append(prediction.residual)
            worse = len(residuals) > 2 and residuals[-1] > residuals[-2]
            if self.bounded and not self.skipped and worse:
                self.skipped = priors[priors.index(prior) + 1 :]
                break

    def _try_pixels(self, group: NDArray[np.intp]) -> None:
        """Sparse pixels; of a large image they take as long as all fields together."""
        if self.bounded:
            if Prior.PIXELS not in self.skipped:
                self.skipped.append(Prior.PIXELS)
            return
        operator = self.operator
        rest = np.setdiff1d(np.arange(operator.views), group)
        values = _sparse_pixels(select_views(self.scans, rest), self.grid, operator.select(rest))
        predicted = operator.select(group).forward(values)
        self._add(Prior.PIXELS, Prediction.of(self.scans.samples[group], predicted))

    def _try(self, prior: Prior, group: NDArray[np.intp]) -> None:
        """A field; left out where its engine or the memory for it is missing."""
        settings = self.settings.with_prior(prior)
        try:
            fitted = fit(self.scans, self.grid, settings, self.progress, group, images=self.images)
        except (MissingExtraError, UsageError):
            if prior is Prior.DEFAULT:
                raise
            return
        self._add(prior, fitted.prediction)

    def _gain(self, prior: Prior, than: Prior) -> float:
        """Mean over its standard error of what one prior leaves less than another, over the views."""
        gain = self.found[than].misfits - self.found[prior].misfits
        spread = float(np.sqrt((gain**2).sum()))
        return float(gain.sum()) / spread if spread > 0 else 0.0


def folds(views: int) -> list[NDArray[np.intp]]:
    """Groups of views that are held out in turn: each spread over all, together 12 views or more.

    A ninth of the views at a time leaves a fit nearly what it has in the end.
    """
    size = max(1, round(views / 9))
    count = min(-(-12 // size), views // size)
    stride = views / size
    starts = (np.arange(count) + 0.5) * stride / count
    return [np.unique(((np.arange(size) * stride) + start).astype(np.intp) % views) for start in starts]
