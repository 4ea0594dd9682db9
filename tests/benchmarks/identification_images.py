"""Tags read from images instead of the scans: an image, a finder of reflectors, and the pairing with layouts.

These rows show what each step of the textbook way costs against reading in the data; all share the matcher of
`constellation`, which may refuse as the product may.
"""

from __future__ import annotations

from constellation import ConstellationReading, read_constellation

from tagid.capture import Capture
from tagid.imaging.ats.fit import AtsSettings, fit
from tagid.imaging.backprojection import backproject
from tagid.tags.layouts.layout import Layout
from tagid.tags.network.planes import GRID, NetworkInput
from tagid.tags.network.second_look import shipped_detector
from train.evaluate import local_maxima
from train.images import focused_scans


def read_image(
    capture: Capture, layouts: tuple[Layout, ...], method: str, finder: str
) -> ConstellationReading:
    """A capture read by an image ("bp" or "ats") and a finder ("maxima" or "network")."""
    scans = focused_scans(capture, method)
    image = backproject(scans, GRID) if method == "bp" else fit(scans, GRID, AtsSettings()).image
    seen = NetworkInput.of(image, scans)
    found = local_maxima(seen) if finder == "maxima" else shipped_detector().detect(seen, 1.0).found
    return read_constellation(found, layouts)
