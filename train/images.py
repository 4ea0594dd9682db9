"""From a training scene to what the network sees, through the package's own imaging.

Nothing is shared with the answers: the autofocus, the background removal and their errors are the field's.
"""

from __future__ import annotations

from dataclasses import replace

from tagid.capture import Capture
from tagid.errors import UsageError
from tagid.imaging.autofocus import focus_axis_distance
from tagid.imaging.backprojection import backproject
from tagid.imaging.preprocess import PreprocessSettings, preprocess
from tagid.imaging.types import BasebandScans
from train.planes import GRID, NetworkInput

METHODS = ("bp", "ats")


def focused_scans(capture: Capture, method: str) -> BasebandScans:
    """Preprocessed scans under the axis distance that focuses them, as in `tagid.pipeline.reconstruct`."""
    settings = PreprocessSettings(matched_filter=False, extent_m=GRID.extent)
    focused, _ = focus_axis_distance(preprocess(capture, settings=settings), GRID)
    if method != "bp":
        return focused
    matched = preprocess(capture, settings=replace(settings, matched_filter=True))
    return matched.with_aperture(focused.aperture)


def network_input(capture: Capture, method: str, seed: int = 0) -> NetworkInput:
    """The network's input for one capture and method, "bp" or "ats"."""
    if method not in METHODS:
        raise UsageError(f"the detector is not trained on {method!r}", f"Use {' or '.join(METHODS)}.")
    scans = focused_scans(capture, method)
    if method == "bp":
        return NetworkInput.of(backproject(scans, GRID), scans)
    from tagid.imaging.ats.fit import fit
    from tagid.imaging.ats.settings import AtsSettings

    return NetworkInput.of(fit(scans, GRID, AtsSettings(seed=seed)).image, scans)
