"""The prior of the fit, chosen by views that no fit has seen.

The defaults are for a few reflectors that scatter to all sides. Where they leave much more than noise of
unseen views, the scene is something else: extended, smooth, or seen differently from different sides. Other
priors are then tried. Among them is the linear solution, whose first iteration is backprojection, so that the
method contains backprojection and returns it unless another prior is clearly better.

The views on which the image is judged in the end (`heldout.left_out`) take no part in the choice.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import MissingExtraError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.settings import AtsResult, AtsSettings, Progress
from tagid.imaging.backprojection import backproject
from tagid.imaging.heldout import left_out, misfits, residual
from tagid.imaging.linear import least_squares
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import select_views
from tagid.imaging.types import BasebandScans, Image

Floats = NDArray[np.float64]

ASKS = 0.05
"""Share of the energy of unseen views, over the noise, that the defaults may leave over before others are
tried."""

SURE = 2.0
"""A prior other than the defaults replaces backprojection where the mean of its gain per view exceeds this
many standard errors."""

LIKELY = 0.5
"""The same of the defaults. They need less: with a dozen views, a fit without some of them is much worse than
one of all, and an image of a tag is lost with them."""

KEEPS = 1.0
"""The defaults stay unless the gain of another prior over them exceeds this many standard errors."""

MOST_TRIED, NEAR = 2, 1.2
"""So many candidates at most are tried on more than one group of views, and only those that leave at most
this times what the best leaves of the first."""

LEAST_VIEWS = 8
"""Fewer views cannot be split further."""

LINEAR = "linear"
ITERATIONS = (1, 2, 4, 8, 16)
"""Iterations of conjugate gradients of the linear candidates. The first is backprojection of scans that are
correlated with the pulse; 0 stands for backprojection of the scans as they are."""

CANDIDATES: dict[str, dict[str, Any]] = {
    "sparse": {"l1": 0.1},
    "dense": {"l1": 0.003, "noise_factor": 1.0},
    "aspect": {"aspect_harmonics": 2},
    "dense, aspect": {"l1": 0.003, "noise_factor": 1.0, "aspect_harmonics": 2},
}
"""Changes of the defaults: a stronger and a weaker sparsity prior, reflectivity that depends on the aspect,
the last two together."""

SHADOWS: dict[str, dict[str, Any]] = {"occlusion": {"l1": 0.003, "noise_factor": 1.0, "occlusion": 0.3}}
"""Bright pixels dim what lies behind them. It takes many times longer, and is tried only where `dense`, which
it extends, is the best of all on the first group of views."""

_CHOSEN = ("l1", "noise_factor", "aspect_harmonics", "occlusion")


def changes_of(prior: str) -> dict[str, Any]:
    """Settings of a prior by its name; none for the defaults."""
    return {**CANDIDATES, **SHADOWS}.get(prior, {})


def linear_iterations(prior: str) -> int | None:
    """Iterations of a linear prior ("linear 4": 4), None for another prior."""
    name, _, count = prior.rpartition(" ")
    return int(count) if name == LINEAR else None


def linear_image(scans: BasebandScans, grid: ImageGrid, iterations: int) -> Image:
    """The linear solution as an image."""
    if iterations == 0:
        values = backproject(scans, grid).values
    else:
        *_, values = least_squares(ForwardOperator(scans, grid), scans.samples, (iterations,))
    facts = {"method": "ats", "axis_distance_m": scans.aperture.axis_distance}
    return Image(values.reshape(grid.pixels, grid.pixels), grid, facts)


def fit_adapted(
    scans: BasebandScans, grid: ImageGrid, settings: AtsSettings, progress: Progress | None = None
) -> AtsResult:
    """Fit with the settings; where unseen views ask for another prior and none was given, with that one.

    The image's settings say what was tried: "prior" is its name, "prior_trials" the residual of each on views
    that its fit did not see.

    Args and errors as `fit`.
    """
    first = fit(scans, grid, settings, progress)
    plain = AtsSettings()
    given = any(getattr(settings, name) != getattr(plain, name) for name in _CHOSEN)
    if given or not settings.adapt or not first.losses or scans.aperture.views < LEAST_VIEWS:
        return first
    noise = _noise_share(scans)
    if len(first.unseen) and first.held_out <= min(noise + ASKS, _plain(scans, grid, first)):
        return first
    trials = _Trials(scans, grid, settings, progress)
    trials.try_linear()
    trials.try_settings("default", {})
    # The energy of noise in so many samples varies by this much.
    spread = noise / np.sqrt(max(trials.samples, 1.0))
    if trials.residual("default") <= noise + ASKS + 2 * spread and trials.better("default"):
        return first
    trials.try_candidates()
    prior = trials.chosen(settings.calibrate == ())
    facts = {"prior": prior, "prior_trials": {name: trials.residual(name) for name in trials.found}}
    iterations = linear_iterations(prior)
    if iterations is not None:
        image = linear_image(scans, grid, iterations)
        kept = {**first.image.settings, **facts}
        return replace(first, image=replace(image, settings=kept), field=None)
    changes = changes_of(prior)
    result = first if prior == "default" else fit(scans, grid, replace(settings, **changes), progress)
    return replace(result, image=replace(result.image, settings={**result.image.settings, **facts}))


def _noise_share(scans: BasebandScans) -> float:
    energy = float((np.abs(scans.samples) ** 2).sum())
    return scans.noise_std**2 * scans.samples.size / energy


def _plain(scans: BasebandScans, grid: ImageGrid, first: AtsResult) -> float:
    """Residual of backprojection on the views that the first fit has not seen."""
    seen = np.setdiff1d(np.arange(scans.aperture.views), first.unseen)
    return residual(select_views(scans, first.unseen), backproject(select_views(scans, seen), grid))


class _Trials:
    """Residuals of priors on the same unseen views, view by view."""

    def __init__(
        self, scans: BasebandScans, grid: ImageGrid, settings: AtsSettings, progress: Progress | None
    ) -> None:
        judged = left_out(scans.aperture.views)
        rest = np.setdiff1d(np.arange(scans.aperture.views), judged)
        self.scans = select_views(scans, rest)
        self.grid, self.progress = grid, progress
        self.settings = replace(settings, calibrate=(), held_out=0.0)
        self.folds = folds(len(rest))
        self.energy = float(sum((np.abs(self.scans.samples[f]) ** 2).sum() for f in self.folds))
        judged_views = sum(map(len, self.folds))
        self.samples = scans.independent_samples * judged_views / scans.aperture.views
        self.found: dict[str, Floats] = {}

    def try_linear(self) -> None:
        """Least squares after every number of iterations, of which the first is backprojection."""
        operator = ForwardOperator(self.scans, self.grid)
        left: dict[int, list[Floats]] = {k: [] for k in ITERATIONS}
        plain: list[Floats] = []
        for fold in self.folds:
            seen = np.setdiff1d(np.arange(operator.views), fold)
            solutions = least_squares(operator.select(seen), self.scans.samples[seen], ITERATIONS)
            unseen = operator.select(fold)
            image = backproject(select_views(self.scans, seen), self.grid).values.ravel()
            plain.append(misfits(self.scans.samples[fold], unseen.forward(image)))
            for k, values in zip(ITERATIONS, solutions, strict=True):
                left[k].append(misfits(self.scans.samples[fold], unseen.forward(values)))
        self.found[f"{LINEAR} 0"] = np.concatenate(plain)
        for k, parts in left.items():
            self.found[f"{LINEAR} {k}"] = np.concatenate(parts)

    def try_candidates(self) -> None:
        """All of `CANDIDATES` on the first group of views, those near the best on the others, too."""
        for name, changes in CANDIDATES.items():
            self._try(name, changes, self.folds[:1])
        if min(self.found, key=self._on_first) == "dense":
            for name, changes in SHADOWS.items():
                self._try(name, changes, self.folds[:1])
        tried = [name for name in (*CANDIDATES, *SHADOWS) if name in self.found]
        near = sorted(tried, key=self._on_first)[:MOST_TRIED]
        best = min(map(self._on_first, self.found))
        for name in tried:
            if name in near and self._on_first(name) <= NEAR * best:
                self._try(name, changes_of(name), self.folds[1:])
            elif len(self.folds) > 1:
                self.found.pop(name, None)

    def _on_first(self, name: str) -> float:
        """Energy that a prior leaves of the first group of views."""
        return float(self.found[name][: len(self.folds[0])].sum())

    def try_settings(self, name: str, changes: dict[str, Any]) -> None:
        """The field with changed settings, on all groups of views."""
        self._try(name, changes, self.folds)

    def _try(self, name: str, changes: dict[str, Any], some: list[NDArray[np.intp]]) -> None:
        """Add groups of views to a prior's; left out where its engine or the memory for it is missing."""
        settings = replace(self.settings, **changes)
        try:
            parts = [fit(self.scans, self.grid, settings, self.progress, unseen=fold).misfit for fold in some]
        except (MissingExtraError, UsageError):
            if name == "default":
                raise
            return
        self.found[name] = np.concatenate([self.found.get(name, np.zeros(0)), *parts])

    def residual(self, name: str) -> float:
        """Share of the energy of the tried views that a prior leaves."""
        return float(self.found[name].sum()) / max(self.energy, 1e-300)

    @property
    def backprojection(self) -> str:
        """The better of the two backprojections."""
        return min((f"{LINEAR} 0", f"{LINEAR} 1"), key=self.residual)

    def better(self, name: str) -> bool:
        """Whether a prior predicts better than backprojection, by `SURE` or `LIKELY` standard errors."""
        return self._gain(name, self.backprojection) > (LIKELY if name == "default" else SURE)

    def chosen(self, may_be_linear: bool) -> str:
        """The best prior; the defaults where it is hardly better, backprojection where nothing is clearly."""
        names = [n for n in self.found if may_be_linear or linear_iterations(n) is None]
        best = min(names, key=self.residual)
        if self._gain(best, "default") < KEEPS or (may_be_linear and not self.better(best)):
            best = "default"
        return best if not may_be_linear or self.better(best) else self.backprojection

    def _gain(self, name: str, than: str) -> float:
        """Mean over its standard error of what one prior leaves less than another, over the views."""
        gain = self.found[than] - self.found[name]
        spread = float(np.sqrt((gain**2).sum()))
        return float(gain.sum()) / spread if spread > 0 else 0.0


def folds(views: int) -> list[NDArray[np.intp]]:
    """Groups of views that are held out in turn: each spread over all, together 12 or more, or most of them.

    A ninth of the views at a time leaves a fit nearly what it has in the end; the fewer they are, the more
    groups are needed to tell priors apart.
    """
    size = max(2, round(views / 9))
    count = int(np.clip(-(-12 // size), 1, min(5, views // size)))
    stride = views / size
    starts = (np.arange(count) + 0.5) * stride / count
    return [np.unique(((np.arange(size) * stride) + start).astype(np.intp) % views) for start in starts]
