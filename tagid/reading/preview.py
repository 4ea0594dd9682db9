"""What every layout explains of the scans so far, by the first step of the search: for bars during a scan.

The log evidences are those from which the reading starts; it goes on with odd scatterers, sheets, enrolled
bodies and arrangements that nobody enrolled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

from tagid.reading.descent import refined
from tagid.reading.hypotheses import Contest
from tagid.reading.hypothesis import Candidate
from tagid.reading.spectra import Spectra
from tagid.reading.starts import GRID_M, nothing, round_bodies, starts_about
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


def layout_evidence(contest: Contest) -> tuple[LayoutEvidence, ...]:
    """The evidence for each layout, the likeliest first.

    Args:
        contest: of the scans so far, of at least one layout; it is not changed.
    """
    spectra, priors = contest.spectra, contest.priors
    bodies = round_bodies(spectra, priors)
    untagged = max(estimate.log_z for estimate in (bodies.best, *nothing(spectra, priors)))
    centres = [bodies.best.centre, *GRID_M[::2]]
    starts = [
        start
        for transfer in contest.searched
        for start in starts_about(
            contest.wanted, contest.behind(transfer), centres, bodies.powers, bodies.shapes
        )
    ]
    logs = [
        _log_evidence(spectra, layout, [start for start in starts if start.layout is layout]) - untagged
        for layout in contest.layouts
    ]
    ranked = sorted(zip(contest.layouts, logs, strict=True), key=lambda entry: -entry[1])
    return tuple(
        LayoutEvidence(
            layout.name, value, value - max([0.0, *(other for of, other in ranked if of is not layout)])
        )
        for layout, value in ranked
    )


def _log_evidence(spectra: Spectra, layout: Layout, starts: Sequence[Candidate]) -> float:
    """Of a layout, from the best of its starts, nats."""
    best = sorted(starts, key=lambda start: -start.log)[:REFINED]
    estimates = [refined(spectra, start.model, start.x, (1e-3, None)) for start in best]
    return max(estimate.log_z for estimate in estimates) + log(layout.symmetry)
