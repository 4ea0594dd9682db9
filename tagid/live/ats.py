"""Analysis through synthesis during the recording: the field goes on from its last state with each new piece.

A fit from scratch spends most of its steps on what the earlier views have already shown.
"""

from __future__ import annotations

from dataclasses import replace

from tagid.capture import Capture
from tagid.geometry import ImageGrid
from tagid.imaging.ats.fit import fit
from tagid.imaging.ats.problem import FieldWeights
from tagid.imaging.preprocess import preprocess
from tagid.imaging.restore import restore
from tagid.imaging.types import Image
from tagid.pipeline.settings import ImagingSettings

PIECE_VIEWS = 24
"""New views after which the fit goes on: an eighth of a turn of 180 views."""
STEPS, LAST_STEPS = 15, 60
"""Steps of each piece and of the whole turn at the end; a fit from scratch takes 100."""


class GrowingAts:
    """A field that is fitted to all views so far, piece by piece; its prior is not adapted.

    Attributes:
        views: number of views of the last fit.
        held_out: its residual on views that it did not see (`AtsResult.held_out`); nan before there is one.
    """

    def __init__(self, grid: ImageGrid, imaging: ImagingSettings) -> None:
        self.views = 0
        self.held_out = float("nan")
        self._grid = grid
        self._imaging = imaging
        self._field: FieldWeights | None = None

    def due(self, views: int) -> bool:
        """Whether there are enough new views to go on with."""
        return views >= self.views + PIECE_VIEWS

    def go_on(self, capture: Capture, last: bool = False) -> Image:
        """The image of all views so far, which have angles: the fit goes on from its last state.

        The last one is of the whole turn. Raises DataError if the scans cannot be imaged.
        """
        imaging = self._imaging
        scans = preprocess(capture, settings=imaging.preprocessing(matched_filter=False))
        settings = replace(imaging.ats, steps=LAST_STEPS if last else STEPS, seed=imaging.seed)
        result = fit(scans, self._grid, settings, start=self._field)
        self._field, self.held_out, self.views = result.field, result.held_out, capture.views
        return restore(result.image, scans.wavenumber) if imaging.restore else result.image
