"""What every layout explains of the scans so far, by the first step of the search: for bars during a scan.

The log evidences are those from which the reading starts; it goes on with odd scatterers, sheets, enrolled
bodies and arrangements that nobody enrolled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

from tagid.imaging.types import BasebandScans
from tagid.reading.columns import Model
from tagid.reading.descent import refined
from tagid.reading.hypothesis import Candidate
from tagid.reading.reader import contest
from tagid.reading.spectra import Spectra
from tagid.reading.starts import starts_about
from tagid.reading.untagged import GRID_M, likeliest, nothing, round_bodies
from tagid.tags.layouts.layout import Layout

REFINED = 2
"""Starts of every layout that are refined."""


@dataclass(frozen=True)
class LayoutEvidence:
    """Evidence for one layout in the scans so far.

    Attributes:
        layout: its name.
        log_evidence: over that of the best explanation without reflectors, nats.
        lead: over the best other layout, or no reflectors, nats; negative where it is behind.
    """

    layout: str
    log_evidence: float
    lead: float


def layout_evidence(scans: BasebandScans, layouts: Sequence[Layout]) -> tuple[LayoutEvidence, ...]:
    """The evidence for each layout, the likeliest first.

    Args:
        scans: (views, bins), made without a matched filter.
        layouts: the enrolled ones, at least one.

    Raises:
        DataError: the scans do not hold the object's range.
    """
    (first, *others), none = _log_evidences(scans, layouts), 0.0
    second = max([none, *(value for _, value in others[:1])])
    return (
        LayoutEvidence(first[0], first[1], first[1] - second),
        *(LayoutEvidence(name, value, value - max(none, first[1])) for name, value in others),
    )


def _log_evidences(scans: BasebandScans, layouts: Sequence[Layout]) -> list[tuple[str, float]]:
    """Every layout and the log evidence of its best start, over that of none, nats; the best first."""
    first = contest(scans, layouts)
    bodies = round_bodies(first.spectra, first.priors)
    body = likeliest(bodies)
    untagged = max(estimate.log_z for estimate in (body, *nothing(first.spectra, first.priors)))
    powers, shapes = [of_disc.powers for of_disc in bodies], [of_disc.shape for of_disc in bodies]
    starts: dict[str, list[Candidate]] = {}
    for transfer in first.searched:
        model = Model(transfer, None, transfer.body, 0, levels=first.spectra.levels, priors=first.priors)
        for start in starts_about(first.wanted, model, [body.centre, *GRID_M[::2]], powers, shapes):
            assert start.layout is not None
            starts.setdefault(start.layout.name, []).append(start)
    logs = {name: _refined(first.spectra, some) - untagged for name, some in starts.items()}
    return sorted(logs.items(), key=lambda entry: -entry[1])


def _refined(spectra: Spectra, starts: Sequence[Candidate]) -> float:
    """Log evidence of one layout, from the best of its starts."""
    best = sorted(starts, key=lambda start: -start.log)[:REFINED]
    logs = [refined(spectra, start.model, start.x, (1e-3, None)).log_z for start in best]
    symmetry = best[0].layout.symmetry if best[0].layout is not None else 1
    return max(logs) + log(symmetry)
