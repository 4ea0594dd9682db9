"""The imaging methods by name, shared by commands, tests and benchmarks.

Each takes baseband scans and a grid about the origin and returns an image; its preprocessing requirements
are listed with it.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, replace

from tagid.errors import MissingExtraError
from tagid.geometry import ImageGrid
from tagid.imaging.ats.settings import AtsSettings
from tagid.imaging.types import BasebandScans, Image

Progress = Callable[[float, float, str], None]
"""Called with (done, total, remark)."""

OMP_POINTS = 32
"""Maximum number of points of matching pursuit: two to three times the number of reflectors of a tag."""
OMP_STOP = 4.5
"""Matching pursuit stops when no correlation exceeds this number of noise standard deviations: the largest
of 10^4 pixels of pure noise reaches 3.5 to 4."""


@dataclass(frozen=True)
class MethodInfo:
    """A method and its preprocessing requirements.

    Attributes:
        title: title for tables and pictures.
        matched_filter: whether it needs scans correlated with the pulse.
        sparse: whether its pixels are reflectivities, finer than the resolution of the data.
    """

    title: str
    matched_filter: bool
    sparse: bool = False


METHODS = {
    "bp": MethodInfo("matched-filter BP", True),
    "bp-raw": MethodInfo("BP", False),
    "range-doppler": MethodInfo("range-Doppler", True),
    "polar": MethodInfo("polar format", True),
    "sparse": MethodInfo("FISTA", False, True),
    "omp": MethodInfo("OMP", False, True),
    "ats": MethodInfo("ATS", False, True),
}


def make_image(
    scans: BasebandScans,
    grid: ImageGrid,
    method: str,
    seed: int = 0,
    preset: str = "field",
    progress: Progress | None = None,
    ats: AtsSettings | None = None,
) -> Image:
    """Image of scans by a method of `METHODS`.

    Args:
        scans: preprocessed as the method's `MethodInfo` requires.
        grid: image grid about the origin.
        method: a key of `METHODS`.
        seed: random seed.
        preset: "field" or "paper", for ats.
        progress: called during the slow methods.
        ats: settings of ats with the preset "field"; its seed is `seed`.
    """

    def steps(step: int, of: int, loss: float) -> None:
        if progress:
            progress(step, of, f"loss {loss:.3g}")

    if method in ("bp", "bp-raw"):
        from tagid.imaging.backprojection import backproject

        return backproject(scans, grid)
    if method == "sparse":
        from tagid.imaging.sparse import sparse_recovery

        return sparse_recovery(scans, grid)
    if method == "omp":
        from tagid.imaging.sparse import omp

        return omp(scans, grid, OMP_POINTS, OMP_STOP)
    if method in ("range-doppler", "polar"):
        from tagid.imaging.farfield import polar_format, range_doppler

        return (polar_format if method == "polar" else range_doppler)(scans, grid)
    if preset == "paper":
        if importlib.util.find_spec("torch") is None:
            raise MissingExtraError(
                "`preset=paper` needs torch",
                "Install it with `pip install 'tagid[ats]'`, or use `preset=field`.",
            )
        from tagid.imaging.ats.fit_paper import PaperSettings, fit_paper

        return fit_paper(scans, grid, PaperSettings(seed=seed), steps)
    from tagid.imaging.ats.adapt import fit_adapted

    return fit_adapted(scans, grid, replace(ats or AtsSettings(), seed=seed), steps).image
