"""The prior of the fit, chosen by views that no fit has seen.

The defaults are for a few reflectors that scatter to all sides. Where they leave much more than noise of
unseen views, the scene is something else: extended, smooth, or seen differently from different sides. Other
priors are then tried. Among them are two without a field: the linear solution, whose first iteration is
backprojection, and the sparse solution of independent pixels. So the method contains both and returns them
where no field predicts better.

The views on which the image is judged in the end (`heldout.left_out`) take no part in the choice.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tagid.errors import MissingExtraError, UsageError
from tagid.geometry import ImageGrid
from tagid.imaging.ats.fit import fit, sparsity_weight, unshrinking
from tagid.imaging.ats.settings import LEAST_HELD_OUT, AtsResult, AtsSettings, Progress
from tagid.imaging.ats.start import LARGE_PAIRS, FirstImages
from tagid.imaging.backprojection import backproject
from tagid.imaging.heldout import Prediction, left_out, residual
from tagid.imaging.operator import ForwardOperator
from tagid.imaging.preprocess import select_views
from tagid.imaging.sparse import sparse_recovery
from tagid.imaging.types import BasebandScans, Image
from tagid.types import Samples


def least_squares(operator: ForwardOperator, scans: Samples, iterations: Sequence[int]) -> Iterator[Samples]:
    """Minimise ||A x - y||^2 from zero (CGLS; Hestenes and Stiefel, J. Res. NBS 49, 1952).

    Args:
        operator: A.
        scans: y, (views, bins) complex64.
        iterations: numbers of iterations after which x is wanted, ascending.

    Yields:
        x (points,) complex64 after each number of iterations.
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

BLANK = 0.05
"""Where no prior explains this share of unseen views, the image is backprojection."""

KEEPS = 1.0
"""The defaults stay unless the gain of another prior over them exceeds this many standard errors over the
views. Sparse pixels, which the default field starts from, take its place where they leave less, unless it
leaves little but noise: it tells places more accurately."""

MOST_TRIED, NEAR = 2, 1.1
"""So many fields at most are tried on another group of views, and only those that leave at most this times
what the best leaves of the groups so far: most priors fall behind on the first."""

MOST_GROUPS, LEAST_JUDGED = 3, 4
"""Groups of views at most, unless they are fewer than so many views together. More changed no choice for the
better, and each costs a fit of every prior in the race."""

SETTLES = 2
"""A prior falls behind after so many views, not before."""

LEAST_VIEWS = 8
"""Fewer views cannot be split further."""

ISOTROPIC = {"aspect": "default", "dense, aspect": "dense"}
"""Priors that depend on the aspect, the most expensive fields, and the same without it. Of a large image
(`LARGE_PAIRS`) only that of the better of the two others is tried, and the linear solution ends where it gets
worse. Fewer views in the trials are no way out: without their neighbours, views at 24 GHz are predicted by no
prior."""

LINEAR = "linear"
ITERATIONS = (1, 2, 4, 8, 16)
"""Iterations of conjugate gradients of the linear candidates. The first is backprojection of scans that are
correlated with the pulse; 0 stands for backprojection of the scans as they are."""
BACKPROJECTIONS = (f"{LINEAR} 0", f"{LINEAR} 1")

PIXELS = "pixels"
"""The sparse solution itself (`tagid.imaging.sparse`). Of few views of extended objects it predicts more than
a field that starts from it: the encoding ties neighbours together, of which a dozen views tell nothing."""

DEFAULT = "default"

_PLAIN = AtsSettings()


@dataclass(frozen=True)
class Prior:
    """What a fit assumes of the scene: the settings of the same names (`AtsSettings`)."""

    l1: float = _PLAIN.l1
    noise_factor: float = _PLAIN.noise_factor
    aspect_harmonics: int = _PLAIN.aspect_harmonics
    occlusion: float = _PLAIN.occlusion

    @classmethod
    def of(cls, settings: AtsSettings) -> Prior:
        """That of some settings."""
        return cls(settings.l1, settings.noise_factor, settings.aspect_harmonics, settings.occlusion)


_DENSE = Prior(l1=0.003, noise_factor=1.0)

CANDIDATES: dict[str, Prior] = {
    DEFAULT: Prior(),
    "sparse": Prior(l1=0.1),
    "dense": _DENSE,
    "aspect": Prior(aspect_harmonics=2),
    "dense, aspect": replace(_DENSE, aspect_harmonics=2),
    "dense, shadows": replace(_DENSE, occlusion=1.0),
    "dense, aspect, shadows": replace(_DENSE, aspect_harmonics=2, occlusion=1.0),
}
"""The defaults, a stronger and a weaker sparsity prior, reflectivity that depends on the aspect, the last two
together, and the dense ones on a scene that hides what lies behind it. Of attenuations of 0.1 to 3 nepers 1
leaves least of unseen views in most outlines, boxes and smooth bodies that were tried (seeds from 5000)."""

SHADED = {"dense, shadows": "dense", "dense, aspect, shadows": "dense, aspect"}
"""Priors with shadows, and the same without. Only that of the best field so far is tried, where it still asks
for another (`ASKS`), and none of a large image: every view takes a sum over all pixels."""


def with_prior(settings: AtsSettings, prior: str) -> AtsSettings:
    """Settings with a prior by its name; as they are for one that has no field, or for no name."""
    return replace(settings, **asdict(CANDIDATES[prior])) if prior in CANDIDATES else settings


def settings_of(facts: dict[str, Any], settings: AtsSettings) -> AtsSettings:
    """Settings with what an image (`Image.settings`) says was changed for it: prior, and views of a step."""
    views = facts.get("views_per_step", settings.views_per_step)
    return replace(with_prior(settings, facts.get("prior", "")), views_per_step=views)


def linear_iterations(prior: str) -> int | None:
    """Iterations of a linear prior ("linear 4": 4), None for another prior."""
    name, _, count = prior.rpartition(" ")
    return int(count) if name == LINEAR else None


def has_field(prior: str) -> bool:
    """Whether an image of a prior shows a field: neither a linear solution nor sparse pixels."""
    return prior != PIXELS and linear_iterations(prior) is None


def image_without_field(scans: BasebandScans, grid: ImageGrid, prior: str) -> Image:
    """The image of a prior that has no field.

    Raises:
        ValueError: it has one.
    """
    iterations = linear_iterations(prior)
    if prior == PIXELS:
        values = _sparse_pixels(scans, grid, ForwardOperator(scans, grid))
    elif iterations is None:
        raise ValueError(f"prior {prior} has a field")
    elif iterations == 0:
        values = backproject(scans, grid).values
    else:
        *_, values = least_squares(ForwardOperator(scans, grid), scans.samples, (iterations,))
    facts = {"method": "ats", "axis_distance_m": scans.aperture.axis_distance}
    return Image(values.reshape(grid.pixels, grid.pixels), grid, facts)


def _sparse_pixels(scans: BasebandScans, grid: ImageGrid, operator: ForwardOperator) -> NDArray[np.complex64]:
    """(points,) sparse solution times the one factor that explains the scans best, as of a field."""
    values = sparse_recovery(scans, grid, operator=operator).values.ravel()
    factor = np.float32(unshrinking(operator.forward(values), scans.samples))
    return np.asarray(values * factor, dtype=np.complex64)


def fit_adapted(
    scans: BasebandScans, grid: ImageGrid, settings: AtsSettings, progress: Progress | None = None
) -> AtsResult:
    """Fit with the settings; where unseen views ask for it, with more views a step (`seeing_all`);
    where they still ask for another prior and none was given, with that one.

    The image's settings say what was tried: "prior" is its name, "prior_trials" the residual of each on views
    that its fit did not see, "prior_against_default" its residual and that of the defaults on those of these
    views that both were tried on, "priors_not_tried" what was left out because the image is large.

    Args and errors as `fit`.
    """
    if (
        Prior.of(settings) != Prior()
        or not settings.adapt
        or scans.aperture.views < LEAST_VIEWS
        or not np.any(scans.samples)
    ):
        return fit(scans, grid, settings, progress)
    first: AtsResult | None = None
    images = FirstImages()
    quick, settings = settings, settings.seeing_all(scans.aperture.views)
    if settings.held_out > 0 and scans.aperture.views >= LEAST_HELD_OUT:
        for fromkey in dict.fromkeys((quick, settings)):
            first = fit(scans, grid, fromkey, progress, images=images)
            if not first.losses or _explains(scans, grid, first):
                return first
    trials = _Trials(scans, grid, settings, progress, without_field=settings.calibrate == ())
    prior = trials.chosen()
    if first is None or (has_field(prior) and prior != DEFAULT):
        first = fit(scans, grid, with_prior(settings, prior), progress, images=images)
    facts = {**first.image.settings, "prior": prior, "prior_trials": trials.residuals()}
    facts["prior_against_default"] = trials.against_default(prior)
    if trials.skipped:
        facts["priors_not_tried"] = trials.skipped
    if has_field(prior):
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
        settings: AtsSettings,
        progress: Progress | None,
        without_field: bool,
    ) -> None:
        judged = left_out(scans.aperture.views)
        some = np.setdiff1d(np.arange(scans.aperture.views), judged)
        self.scans, self.bounded = select_views(scans, some), len(some) * grid.pixels**2 > LARGE_PAIRS
        self.skipped: list[str] = []
        self.images = FirstImages()
        self.grid, self.progress = grid, progress
        self.settings = replace(settings, calibrate=(), held_out=0.0)
        self.operator, self.without_field = ForwardOperator(self.scans, grid), without_field
        self.views = 0
        self.explained = False
        self.found: dict[str, Prediction] = {}
        self._race(folds(self.scans.aperture.views))

    def residuals(self) -> dict[str, float]:
        """Share of the energy that every prior leaves of the groups that it was tried on."""
        return {name: part.residual for name, part in self.found.items()}

    def against_default(self, name: str) -> dict[str, float]:
        """What a prior and the defaults leave of the views that both were tried on, and their number.

        The defaults may fall behind after the first group; others are then judged on more views.
        """
        parts = [self.found[prior] for prior in (name, DEFAULT)]
        views = min(len(part.measured) for part in parts)
        residual, default = (part.first(views).residual for part in parts)
        return {"residual": residual, "default": default, "views": views}

    def chosen(self) -> str:
        """The best prior of those that were tried on every group; the defaults where it is hardly better,
        backprojection where none predicts anything."""
        last = [name for name in self._last() if name != PIXELS or not self.explained]
        residuals = self.residuals()
        best = min(last, key=residuals.__getitem__)
        if DEFAULT in last and self._gain(best, DEFAULT) < KEEPS:
            best = min((name for name in (DEFAULT, PIXELS) if name in last), key=residuals.__getitem__)
        if self.without_field and residuals[best] > 1 - BLANK:
            best = min(BACKPROJECTIONS, key=residuals.__getitem__)
        return best

    def _race(self, groups: list[NDArray[np.intp]]) -> None:
        running = self._different()
        for number, group in enumerate(groups):
            self.views += len(group)
            if self.without_field:
                self._try_linear(group)
                self._try_pixels(group)
            for name in running:
                if number == 0 and self._is_skipped(name, group):
                    continue
                self._try(name, group)
                if name == DEFAULT and number == 0 and self._enough(group):
                    self.explained = True
                    return
            if self.views < SETTLES:
                continue
            residuals, last = self.residuals(), self._last()
            best = min(residuals[name] for name in last)
            near = [name for name in last if name in CANDIDATES and residuals[name] <= NEAR * best]
            running = sorted(near, key=residuals.__getitem__)[:MOST_TRIED]
            if not running:
                return

    def _different(self) -> list[str]:
        """Fields without those whose sparsity prior has the weight of another's: noise may set both."""
        peak = float(np.abs(self.operator.adjoint(self.scans.samples)).max())
        kept: dict[tuple[float, int, float], str] = {}
        for name in CANDIDATES:
            settings = with_prior(self.settings, name)
            weight = sparsity_weight(self.scans, peak, settings)
            kept.setdefault((weight, settings.aspect_harmonics, settings.occlusion), name)
        return list(kept.values())

    def _is_skipped(self, name: str, group: NDArray[np.intp]) -> bool:
        """Whether a prior is left out of the trials; noted where it is because the image is large."""
        tried = self.residuals()
        if name in SHADED:
            best = min((candidate for candidate in CANDIDATES if candidate in tried), key=tried.__getitem__)
            asks = tried[best] > _noise_share(select_views(self.scans, group)) + ASKS
            if SHADED[name] != best or not asks:
                return True
            if self.bounded:
                self.skipped.append(name)
            return self.bounded
        others = [prior for prior in ISOTROPIC.values() if prior in tried]
        if not self.bounded or name not in ISOTROPIC or not others:
            return False
        if ISOTROPIC[name] == min(others, key=tried.__getitem__):
            return False
        self.skipped.append(name)
        return True

    def _enough(self, group: NDArray[np.intp]) -> bool:
        """Whether the defaults leave little but noise of the first group, and less than backprojection."""
        residuals = self.residuals()
        part = select_views(self.scans, group)
        plain = [residuals[name] for name in BACKPROJECTIONS if name in residuals]
        return residuals[DEFAULT] <= min([_noise_share(part) + ASKS, *plain])

    def _last(self) -> list[str]:
        """Priors that were tried on every group so far."""
        return [name for name, part in self.found.items() if len(part.measured) == self.views]

    def _add(self, name: str, prediction: Prediction) -> None:
        self.found[name] = self.found.get(name, Prediction.none()).and_of(prediction)

    def _try_linear(self, group: NDArray[np.intp]) -> None:
        """Backprojection, and least squares after every number of iterations."""
        operator = self.operator
        rest = np.setdiff1d(np.arange(operator.views), group)
        seen, unseen = select_views(self.scans, rest), operator.select(group)
        plain = backproject(seen, self.grid).values.ravel()
        counts = [count for count in ITERATIONS if f"{LINEAR} {count}" not in self.skipped]
        solutions = least_squares(operator.select(rest), seen.samples, counts)
        residuals: list[float] = []
        for iterations, values in zip((0, *counts), chain([plain], solutions), strict=True):
            prediction = Prediction.of(self.scans.samples[group], unseen.forward(values))
            self._add(f"{LINEAR} {iterations}", prediction)
            residuals.append(prediction.residual)
            if self.bounded and not self.skipped and iterations > 1 and residuals[-1] > residuals[-2]:
                self.skipped = [f"{LINEAR} {more}" for more in counts if more > iterations]
                break

    def _try_pixels(self, group: NDArray[np.intp]) -> None:
        """Sparse pixels; of a large image they take as long as all fields together."""
        if self.bounded:
            if PIXELS not in self.skipped:
                self.skipped.append(PIXELS)
            return
        operator = self.operator
        rest = np.setdiff1d(np.arange(operator.views), group)
        values = _sparse_pixels(select_views(self.scans, rest), self.grid, operator.select(rest))
        predicted = operator.select(group).forward(values)
        self._add(PIXELS, Prediction.of(self.scans.samples[group], predicted))

    def _try(self, name: str, group: NDArray[np.intp]) -> None:
        """A field; left out where its engine or the memory for it is missing."""
        settings = with_prior(self.settings, name)
        try:
            fitted = fit(self.scans, self.grid, settings, self.progress, group, images=self.images)
        except (MissingExtraError, UsageError):
            if name == DEFAULT:
                raise
            return
        self._add(name, fitted.prediction)

    def _gain(self, name: str, than: str) -> float:
        """Mean over its standard error of what one prior leaves less than another, over the views."""
        gain = self.found[than].misfits - self.found[name].misfits
        spread = float(np.sqrt((gain**2).sum()))
        return float(gain.sum()) / spread if spread > 0 else 0.0


def folds(views: int) -> list[NDArray[np.intp]]:
    """Groups of views that are held out in turn: each spread over all, together 12 views if few groups do.

    A ninth of the views at a time leaves a fit nearly what it has in the end. Of a dozen views that is one:
    a fit of tags without two of them is much worse than one of all.
    """
    size = max(1, round(views / 9))
    most = max(MOST_GROUPS, LEAST_JUDGED // size)
    count = int(np.clip(-(-12 // size), 1, min(most, views // size)))
    stride = views / size
    starts = (np.arange(count) + 0.5) * stride / count
    return [np.unique(((np.arange(size) * stride) + start).astype(np.intp) % views) for start in starts]
