"""Evidence for each layout while the views arrive: every template is evaluated once for each new view.

The sums are those of the reader's coarse search (`tagid.tags.reading`): the same patterns, range offsets and
hypotheses, so a bar shows the starting point of the final reading. The reader does the refinement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tagid.imaging.types import BasebandScans
from tagid.tags.layouts.layout import Layout
from tagid.tags.reading.aspect import Aspect, outward
from tagid.tags.reading.chance import EXPLAINED_SHARE, PLACES_PER_METRE, nats_needed
from tagid.tags.reading.coarse import CoarseDisc, CoarseImage, CoarseValues
from tagid.tags.reading.coarse_grid import CoarseGrid, SearchSettings
from tagid.tags.reading.field import RangeProfiles

FEWEST_VIEWS = 6
"""With fewer views, every layout explains the scans."""
_MARGIN_M = 0.02


@dataclass(frozen=True)
class LayoutEvidence:
    """Evidence for one layout in the scans so far, at the best position of the coarse search.

    Attributes:
        layout: its name.
        share: 0..1, part of the moving echo's energy above noise that it explains.
        needed_share: smallest share of tags without a body.
        nats: explained energy divided by the noise energy.
        needed_nats: value that noise alone, over all positions of the search, reaches with the false-accept
        probability.
    """

    layout: str
    share: float
    needed_share: float
    nats: float
    needed_nats: float

    @property
    def enough(self) -> bool:
        """Whether both thresholds are reached; an identification requires further tests."""
        return self.share >= self.needed_share and self.nats >= self.needed_nats


class GrowingEvidence:
    """Sums over the views from which the evidence for every layout is computed.

    Args:
        layouts: the enrolled ones, at least one.
        search: the reader's search; its coarse stage is used.
        false_accept: probability that noise alone reaches `needed_nats`.
    """

    def __init__(
        self,
        layouts: Sequence[Layout],
        search: SearchSettings | None = None,
        false_accept: float = 1e-3,
    ) -> None:
        self._layouts = layouts
        self._search = search or SearchSettings()
        self._false_accept = false_accept
        self._radius = max(layout.radius_m for layout in layouts) + self._search.centre_range_m * np.sqrt(2)
        self._grids = [CoarseGrid.of(layout, self._search) for layout in layouts]
        positions = (
            sum(2 * np.pi * layout.radius_m / layout.symmetry for layout in layouts) * PLACES_PER_METRE
        )
        self._places = positions * len(self._search.patterns)
        self._range: RangeProfiles | None = None
        self._sums: list[_PatternSums] = []
        self._reference = np.zeros(0, dtype=np.complex64)
        self._scan_sum = np.zeros(0, dtype=np.complex128)
        self.views = 0

    def add(self, scans: BasebandScans) -> None:
        """Add views of one recording.

        Args:
            scans: from `preprocess` without the matched filter and without background removal.

        Raises:
            DataError: the scans miss the object's range.
        """
        if self._range is None:
            self._range = RangeProfiles.of(scans, self._radius + _MARGIN_M)
            self._reference = scans.samples[0].copy()
            disc = CoarseDisc.of(self._radius)
            rank = self._range.profiles.shape[1]
            self._sums = [
                _PatternSums(disc, aspect, self._search.offsets_m, self._grids, rank)
                for aspect in self._search.aspects
            ]
            self._scan_sum = np.zeros(rank, dtype=np.complex128)
        rows = (scans.samples - self._reference)[:, self._range.keep]
        coordinates = self._range.coordinates(rows)
        for antenna, row in zip(scans.aperture.positions, coordinates, strict=True):
            for sums in self._sums:
                sums.add(self._range, antenna, row)
        self._scan_sum += coordinates.sum(axis=0, dtype=np.complex128)
        self.views += len(coordinates)

    def judged(self, scans: BasebandScans) -> tuple[LayoutEvidence, ...]:
        """The evidence for each layout, in the given order; empty with too few views.

        Args:
            scans: all views so far, from `preprocess` without the matched filter: their energy and noise.
        """
        if self._range is None or self.views < FEWEST_VIEWS:
            return ()
        z = scans.samples[:, self._range.keep]
        z = z - z.mean(axis=0)
        energy = float(np.sum(np.abs(z.astype(np.complex128)) ** 2))
        samples = scans.independent_samples * np.count_nonzero(self._range.keep) / scans.samples.shape[1]
        independent = max(samples, 1.0)
        noise = scans.noise_std**2 * z.size / independent
        signal = max(energy - noise * independent, 1e-30)
        mean = self._scan_sum / self.views
        profile_energy = np.sum(np.abs(self._range.profiles) ** 2, axis=1)
        template_energy = float(self.views * np.median(profile_energy))
        images = [sums.image(self.views, mean) for sums in self._sums]
        evidence = []
        for number, layout in enumerate(self._layouts):
            explained = max(
                float(
                    self._grids[number]
                    .energies(image, sums.grams[number], template_energy, self._search.balance)
                    .best.max()
                )
                for image, sums in zip(images, self._sums, strict=True)
            )
            evidence.append(
                LayoutEvidence(
                    layout.name,
                    float(np.clip(explained / signal, 0, 1)),
                    EXPLAINED_SHARE,
                    float(explained / noise) if noise > 0 else 0.0,
                    nats_needed(layout.size, self._places, self._false_accept),
                )
            )
        return tuple(evidence)


class _PatternSums:
    """The sums of one pattern over the views.

    With t the template of a point and c the scan, both in the basis of the range profiles:
    sum_v conj(t_v) c_v (offsets, points), sum_v t_v (offsets, points, rank), and for every rotation of every
    layout sum_v conj(t_kv) t_lv (A, K, K).
    """

    def __init__(
        self,
        disc: CoarseDisc,
        aspect: Aspect,
        offsets_m: Sequence[float],
        grids: Sequence[CoarseGrid],
        rank: int,
    ) -> None:
        self._disc, self._aspect, self._offsets = disc, aspect, offsets_m
        self._points = disc.points
        self._facing = disc.facing
        self._placed = [grid.placed for grid in grids]
        count = len(self._points)
        self._data = np.zeros((len(offsets_m), count), dtype=np.complex128)
        self._template = np.zeros((len(offsets_m), count, rank), dtype=np.complex64)
        self.grams = [np.zeros((*p.shape[:2], p.shape[1]), dtype=np.complex128) for p in self._placed]

    def add(self, profiles: RangeProfiles, antenna: NDArray[np.float64], row: NDArray[np.complex64]) -> None:
        """Add one view: the antenna at (3,), m, the scan's coordinates (rank,)."""
        distance = _distances(self._points, antenna)
        weight = self._aspect.weight(antenna[None], self._points, self._facing)
        turn = profiles.phase(distance, None if weight is None else weight[:, 0])
        for number, offset in enumerate(self._offsets):
            shifted = np.complex64(np.exp(-2j * profiles.wavenumber * offset))
            template = profiles.profiles[profiles.index(distance + offset)]
            template *= (turn * shifted)[:, None]
            self._data[number] += template.conj() @ row
            self._template[number] += template
        for gram, placed in zip(self.grams, self._placed, strict=True):
            distance = _distances(placed, antenna)
            weight = self._aspect.weight(antenna[None], placed, outward(placed, np.zeros(2)))
            turn = profiles.phase(distance, None if weight is None else weight[..., 0])
            template = profiles.profiles[profiles.index(distance)] * turn[..., None]
            gram += np.matmul(template.conj(), np.swapaxes(template, -1, -2))

    def image(self, views: int, mean: NDArray[np.complex128]) -> CoarseImage:
        """b on the disc, of the scans without their mean (rank,)."""
        b = self._data - self._template.conj() @ mean
        at_axis = int(np.argmin(np.abs(self._offsets)))
        return CoarseImage(self._disc, self._aspect, views, CoarseValues(self._template[at_axis] / views, b))


def _distances(points: NDArray[np.float64], antenna: NDArray[np.float64]) -> NDArray[np.float64]:
    """(...) distance of points (..., 2) in the plane from an antenna (3,), m."""
    x, y = points[..., 0] - antenna[0], points[..., 1] - antenna[1]
    return np.asarray(np.sqrt(x * x + y * y + antenna[2] ** 2))
