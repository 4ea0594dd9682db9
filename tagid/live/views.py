"""Views of the first turn, formed during the recording, with their image and evidence."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tagid.angles.views import average_into_views
from tagid.capture import Capture
from tagid.constants import RANGE_STEP_M
from tagid.geometry import ImageGrid
from tagid.imaging.preprocess import preprocess
from tagid.imaging.types import Image
from tagid.live.image import GrowingImage
from tagid.metadata import RadarInfo
from tagid.pipeline.settings import ImagingSettings
from tagid.reading.preview import LayoutEvidence, layout_evidence
from tagid.reading.reader import contest
from tagid.tags.layouts.layout import Layout

if TYPE_CHECKING:
    from tagid.radar.assembler import Scan
    from tagid.recording.session import Session

MAX_VIEWS = 180
"""Views per turn during the recording, 2 degrees each: a reflector at 0.15 m is smeared over 5 mm, which
reduces it by 0.1 dB. The last frame has all views of the stored capture."""
EVIDENCE_VIEWS = MAX_VIEWS // 2
"""Views per turn from which the evidence is computed, whose time rises with them: pairs of the image's."""
TOLERANCE_RAD = float(np.deg2rad(0.3))
"""Smallest change of an angle for which the views are recomputed: 0.3 degrees move a reflector at 0.25 m by
1.3 mm."""
_EVIDENCE_SHARE = 0.3
"""Largest share of time for computing evidence: with many enrolled layouts the bars update less often."""
FEWEST_VIEWS = 6
"""With fewer views, every layout explains the scans."""
_CHUNK = 8


class GrowingViews:
    """The views so far (`capture`; None before the first one); each is added to the image once."""

    def __init__(self, grid: ImageGrid, layouts: Sequence[Layout], imaging: ImagingSettings) -> None:
        self._grid, self._layouts, self._imaging = grid, layouts, imaging
        self._judged: tuple[LayoutEvidence, ...] = ()
        self._judge_at = 0.0
        self._judged_views = 0
        self._clear()

    def _clear(self) -> None:
        self._image = GrowingImage(self._grid)
        self._taken = 0
        self._scan_angles = np.zeros(0)
        self._open: list[int] = []
        self._samples: list[NDArray[np.float32]] = []
        self._angles: list[float] = []
        self.capture: Capture | None = None

    @property
    def count(self) -> int:
        return self._image.views

    def update(
        self, scans: Capture, angles_rad: NDArray[np.float64], hurry: Callable[[], bool] = lambda: False
    ) -> None:
        """Add new scans.

        Args:
            scans: all scans so far, without angles.
            angles_rad: (scans,) their current angles; if they differ from those used for the views, all
                views are recomputed.
            hurry: called between views; True postpones the remaining ones.

        Raises:
            DataError: the scans cannot be imaged.
        """
        before = angles_rad[: self._taken]
        if self._taken and float(np.abs(before - self._scan_angles).max()) > TOLERANCE_RAD:
            self._clear()
        sector_rad = 2 * np.pi / MAX_VIEWS
        sector = np.rint(np.abs(angles_rad) / sector_rad).astype(np.int64)
        new: list[list[int]] = []
        for number in range(self._taken, len(angles_rad)):
            if sector[number] >= MAX_VIEWS:
                if self._open:
                    new.append(self._open)
                self._open = []
            elif self._open and sector[number] != sector[self._open[-1]]:
                new.append(self._open)
                self._open = [number]
            else:
                self._open.append(number)
        self._taken = len(angles_rad)
        self._scan_angles = angles_rad.copy()
        for at in range(0, len(new), _CHUNK):
            if hurry():
                return
            self._add(scans, angles_rad, new[at : at + _CHUNK])

    def _add(self, scans: Capture, angles_rad: NDArray[np.float64], groups: list[list[int]]) -> None:
        self._samples += [scans.samples[group].mean(axis=0).astype(np.float32) for group in groups]
        self._angles += [float(angles_rad[group].mean()) for group in groups]
        self.capture = replace(
            scans,
            samples=np.stack(self._samples),
            angles_rad=np.array(self._angles, dtype=np.float64),
            angle_sigma_rad=None,
            host_time_ns=None,
            radar_time_ms=None,
            scan_id=None,
            flags=None,
        )
        newest = self.capture.select(slice(-len(groups), None))
        settings = replace(self._imaging.preprocessing(matched_filter=True), background="none")
        self._image.add(preprocess(newest, settings=settings))

    def image(self) -> Image | None:
        """The image of the views; None before two of them."""
        return self._image.image() if self._image.views > 1 else None

    def evidence(self) -> tuple[LayoutEvidence, ...]:
        """The evidence for each layout, recomputed within its share of the time."""
        now = time.monotonic()
        if self.capture is None or self.capture.views == self._judged_views or now < self._judge_at:
            return self._judged
        self._judged_views = self.capture.views
        part = average_into_views(self.capture, EVIDENCE_VIEWS)
        self._judged = evidence_of(part, self._layouts, self._imaging)
        done = time.monotonic()
        self._judge_at = done + (done - now) * (1 / _EVIDENCE_SHARE - 1)
        return self._judged


def capture_so_far(session: Session, scans: Sequence[Scan]) -> Capture:
    """The scans of a recording so far as a capture without angles; at least one scan."""
    plan = session.plan
    return Capture(
        np.stack([scan.samples for scan in scans]),
        session.config.range_start_m(plan.cable_delay_ps),
        RANGE_STEP_M,
        axis_distance_m=plan.axis_distance_m,
        antenna_height_m=plan.antenna_height_m,
        antenna_separation_m=plan.antenna_separation_m,
        radar=RadarInfo(config=session.config.stored()),
    )


def whole_image(capture: Capture, grid: ImageGrid, imaging: ImagingSettings) -> Image:
    """The image of a prepared capture, as `GrowingViews` makes it: backprojection of every view.

    Raises DataError if it cannot be imaged.
    """
    image = GrowingImage(grid)
    settings = replace(imaging.preprocessing(matched_filter=True), background="none")
    image.add(preprocess(capture, settings=settings))
    return image.image()


def evidence_of(
    capture: Capture, layouts: Sequence[Layout], imaging: ImagingSettings
) -> tuple[LayoutEvidence, ...]:
    """The evidence for each layout in a capture with angles, of one turn or a part of it; empty with too few.

    Raises DataError if the scans miss the object's range.
    """
    if not layouts or capture.views < FEWEST_VIEWS:
        return ()
    plain = replace(imaging.preprocessing(matched_filter=False), background="mean")
    return layout_evidence(contest(preprocess(capture, settings=plain), layouts))
