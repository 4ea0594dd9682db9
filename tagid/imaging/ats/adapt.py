"""The prior of the fit chosen by views that no fit has seen.

The defaults are for a few reflectors that scatter to all sides. Where they leave much more than noise of
unseen views, the scene is something else: extended, or seen differently from different sides. A few other
priors are then tried on the same views, and the one that predicts the others best makes the image.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from tagid.geometry import ImageGrid
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.settings import AtsResult, AtsSettings, Progress
from tagid.imaging.types import BasebandScans

ASKS = 0.1
"""Share of the energy of unseen views, over the noise, that the defaults may leave over before others are
tried."""

BETTER = 0.97
"""Part of the residual of the defaults that another prior must stay under to be taken."""

TRIAL_SHARE = 0.12
"""Views held out of the trials: enough that their residual tells priors apart."""

CANDIDATES: dict[str, dict[str, Any]] = {
    "dense": {"l1": 0.003, "noise_factor": 1.0},
    "aspect": {"aspect_harmonics": 2},
    "dense, aspect": {"l1": 0.003, "noise_factor": 1.0, "aspect_harmonics": 2},
    "occlusion": {"l1": 0.003, "noise_factor": 1.0, "occlusion": 0.3},
}
"""Changes of the defaults: a weaker sparsity prior, reflectivity that depends on the aspect, shadows."""

_CHOSEN = ("l1", "noise_factor", "aspect_harmonics", "occlusion")


def fit_adapted(
    scans: BasebandScans, grid: ImageGrid, settings: AtsSettings, progress: Progress | None = None
) -> AtsResult:
    """Fit with the settings; where unseen views ask for another prior and none was given, with that one.

    The image's settings say what was tried: "prior" is its name, "prior_trials" the held-out residual of
    each.

    Args and errors as `fit`.
    """
    first = fit(scans, grid, settings, progress)
    plain = AtsSettings()
    given = any(getattr(settings, name) != getattr(plain, name) for name in _CHOSEN)
    energy = float((abs(scans.samples) ** 2).sum())
    noise = scans.noise_std**2 * scans.samples.size / energy if energy > 0 else 1.0
    if given or not settings.adapt or not first.held_out > noise + ASKS:
        return first
    views = settings.held_out if settings.held_out > TRIAL_SHARE else TRIAL_SHARE
    trial = replace(settings, held_out=views, calibrate=())
    tried = {"default": fit(scans, grid, trial, progress).held_out}
    for name, changes in CANDIDATES.items():
        tried[name] = fit(scans, grid, replace(trial, **changes), progress).held_out
    best = min(tried, key=lambda name: tried[name])
    if not tried[best] < BETTER * tried["default"]:
        best = "default"
    result = first if best == "default" else fit(scans, grid, replace(settings, **CANDIDATES[best]), progress)
    facts = {**result.image.settings, "prior": best, "prior_trials": tried}
    return replace(result, image=replace(result.image, settings=facts))
