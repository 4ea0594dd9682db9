"""From recordings of one object to what they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import exp

import numpy as np

from tagid.counting import counted
from tagid.errors import DataError, RegistryError
from tagid.imaging.types import BasebandScans
from tagid.reading.calibration import Calibration, worth
from tagid.reading.columns import Priors
from tagid.reading.decision import SURE, Decision, Needed, has_middle
from tagid.reading.explain import Explained, explanations, kind_of, ranked, residuals
from tagid.reading.hypotheses import Contest
from tagid.reading.hypothesis import Hypothesis, best_bare
from tagid.reading.place import settled
from tagid.reading.reading import LayoutScore, Reading
from tagid.reading.several import best_of, clearest, decide_together
from tagid.reading.signature import enrolled_in
from tagid.reading.spectra import RADIUS_M, Spectra
from tagid.reading.verdict import Code
from tagid.tags.bodies.signature import Signature
from tagid.tags.layouts.layout import Layout

MOST_RECORDINGS = 100
MOST_VIEWS = 360
"""More views than these tell no more of an object, and count as so many for the calibration: those of several
antenna heights, or of a wide image."""


@dataclass(frozen=True)
class ReaderSettings:
    """What a person may set.

    Attributes:
        false_accept: probability of naming an object without an enrolled tag.
        priors: of centre and mounting.
        direction_known: whether angles rise as the object turns counter-clockwise. Where that is not known,
            a layout may be seen as its mirror image.
        calibration: None for the package's own.
    """

    false_accept: float = 5e-3
    priors: Priors = field(default_factory=Priors)
    direction_known: bool = True
    calibration: Calibration | None = None


def contest(
    scans: BasebandScans,
    layouts: Sequence[Layout],
    signatures: Sequence[Signature] = (),
    priors: Priors | None = None,
) -> Contest:
    """What competes in a recording; arguments as of `read`."""
    enrolled = enrolled_in(scans, signatures)
    radius_m = max([RADIUS_M, *(body.signature.radius_m for body in enrolled)])
    kappa = enrolled[0].signature.wavenumbers if enrolled else None
    spectra = Spectra.of(scans, radius_m, kappa=kappa)
    return Contest(spectra, layouts, enrolled=enrolled, priors=priors or Priors())


def read(
    scans: BasebandScans,
    layouts: Sequence[Layout],
    settings: ReaderSettings | None = None,
    signatures: Sequence[Signature] = (),
) -> Reading:
    """Read the tag of an object.

    Args:
        scans: made without a matched filter.
        layouts: the candidates.
        settings: None for the defaults.
        signatures: enrolled bodies and objects; those of another band than the recording's take no part.

    Raises:
        RegistryError: no layouts. DataError: the scans do not hold the object's range.
    """
    return read_together([scans], layouts, settings, signatures)[0]


def read_together(
    recordings: Sequence[BasebandScans],
    layouts: Sequence[Layout],
    settings: ReaderSettings | None = None,
    signatures: Sequence[Signature] = (),
) -> tuple[Reading, list[Reading]]:
    """Read the tag of an object of which there are several recordings, each in another pose.

    Arguments and errors are those of `read`.

    Returns:
        The joint reading, with turn, place and reflectors of the recording that shows them most clearly; and
        what each recording says alone.
    """
    if not 1 <= len(recordings) <= MOST_RECORDINGS:
        raise DataError(
            f"{counted(len(recordings), 'recording')} of one object", f"Give 1 to {MOST_RECORDINGS}."
        )
    if not layouts and not any(signature.kind == "object" for signature in signatures):
        raise RegistryError("no layout is enrolled", "Enroll one with `tagid enroll`.")
    settings = settings or ReaderSettings()
    candidates = list(layouts)
    if not settings.direction_known:
        candidates += [layout.mirrored() for layout in layouts]
    contests = [contest(recording, candidates, signatures, settings.priors) for recording in recordings]
    views = [min(len(recording.samples), MOST_VIEWS) for recording in recordings]
    alone = []
    for i, count in enumerate(views):
        needed = _needed(settings, count)
        contests[i] = settled(contests[i], needed)
        decision = decide_together([contests[i]], needed)
        alone.append(_reading(decision, contests[i], settings, count))
    if len(contests) == 1:
        return alone[0], alone
    fewest = min(views)
    decision = decide_together(contests, _needed(settings, fewest))
    shown, winner = _shown(contests, decision.winner)
    return _reading(replace(decision, winner=winner), shown, settings, fewest), alone


def _shown(contests: Sequence[Contest], winner: Hypothesis) -> tuple[Contest, Hypothesis]:
    """The recording in which a hypothesis of several is shown, and what it is there."""
    for recorded in contests:
        if winner in recorded.hypotheses:
            return recorded, winner
    recorded = clearest(contests)
    return recorded, (best_of(recorded, winner.name) if winner.name else None) or winner


def _calibration(settings: ReaderSettings) -> Calibration:
    return settings.calibration or Calibration.shipped()


def _needed(settings: ReaderSettings, views: int) -> Needed:
    return _calibration(settings).needed(views, settings.false_accept)


def _reading(decision: Decision, contest: Contest, settings: ReaderSettings, views: int) -> Reading:
    """A decision as an answer, with what a recording shows of it."""
    if not _calibration(settings).covers(views):
        # Of the hypotheses that compete some fits so few views by chance.
        reason = f"{counted(views, 'view')}, too few to tell: {decision.reason}"
        decision = replace(decision, status="unknown", reason=reason, code=Code.UNCALIBRATED)
    spectra, winner = contest.spectra, _plainest(contest, decision.winner)
    best = best_of(contest, decision.best.name) if decision.best is not None and decision.best.name else None
    every = [Explained.of(spectra, hypothesis) for hypothesis in ranked(contest.hypotheses, winner)]
    explained = every[0]
    scores = _scores(contest)
    nearest = (best.name if best is not None else None) or (scores[0].name if scores else "")
    named = decision.status == "identified"
    layout = nearest if decision.status in ("identified", "ambiguous") else None
    rotation, centre = (0.0, (winner.estimate.centre.real, winner.estimate.centre.imag))
    if best is not None and best.layout is not None and layout is not None:
        rotation, centre = _pose(best)
    bound = None
    if named:
        reached = worth(decision.lead, decision.bare)
        bound = _calibration(settings).bound(reached, views, settings.false_accept)
    share = (
        0.0 if decision.status == "no_tag" or best is None else 1 - Explained.of(spectra, best).unexplained
    )
    reflectors = explained.reflectors(spectra)
    if winner.layout is None:
        reflectors = tuple(replace(reflector, matched=False) for reflector in reflectors)
    expected = 0 if best is None or best.layout is None else best.layout.size
    if best is not None and winner.estimate.model.covers_middle:
        expected -= has_middle(best)
    count = len(winner.estimate.positions)
    differs = not named and decision.status == "unknown" and count > 0
    reading = Reading(
        decision.status,
        decision.reason,
        layout,
        nearest,
        float(decision.lead) if np.isfinite(decision.lead) else 0.0,
        _lead_needed(decision, _needed(settings, views)),
        share,
        float(np.clip(1 - exp(-max(decision.lead, 0.0)), 0, 1)),
        rotation,
        centre,
        explained.offset_m(spectra),
        reflectors,
        max(expected - count, 0) if differs else 0,
        max(count - expected, 0) if differs else 0,
        scores,
        decision.code,
        kind_of(winner),
        explanations(every),
        bound,
        winner,
        residuals(spectra, every),
    )
    return reading.moved(contest.place)


def _plainest(contest: Contest, winner: Hypothesis) -> Hypothesis:
    """The winner, or the best of its name beside no body where a body does not show."""
    bare = best_bare(contest.hypotheses, winner.name) if winner.name else None
    return bare if bare is not None and bare.log_z > winner.log_z - SURE else winner


def _lead_needed(decision: Decision, needed: Needed) -> float:
    """The lead from which this object would have its name: less where no body shows beside it."""
    return min(needed.lead, needed.bare + max(decision.lead - decision.bare, 0.0))


def _scores(contest: Contest) -> tuple[LayoutScore, ...]:
    """Every layout by its best hypothesis, best first."""
    untagged = max(hypothesis.log_z for hypothesis in contest.hypotheses if not hypothesis.tagged)
    best: dict[str, Hypothesis] = {}
    for hypothesis in sorted(contest.hypotheses, key=lambda hypothesis: -hypothesis.log_z):
        if hypothesis.layout is not None:
            best.setdefault(hypothesis.layout.name, hypothesis)
    return tuple(
        LayoutScore(
            name, untagged - hypothesis.log_z, 1 - Explained.of(contest.spectra, hypothesis).unexplained
        )
        for name, hypothesis in best.items()
    )


def _pose(best: Hypothesis) -> tuple[float, tuple[float, float]]:
    """Rotation of a layout within its symmetry, deg, and where its origin lies, m."""
    assert best.layout is not None and best.estimate.model.tag is not None
    tag, positions = best.estimate.model.tag, best.estimate.positions
    flat = tag.radius_m * np.exp(1j * tag.angle)
    nominal = best.layout.positions[:, 0] + 1j * best.layout.positions[:, 1]
    # By hand, turns are in the angles: the layout's own say by how much.
    if len(nominal) == len(flat):
        flat = nominal
    elif best.middle:
        flat = nominal[np.abs(nominal) > 5e-3]
    turn = np.vdot(flat - flat.mean(), positions - positions.mean())
    turn = turn / max(abs(turn), 1e-30)
    centre = complex(positions.mean() - turn * flat.mean())
    period = 360 / best.layout.symmetry
    return float(np.rad2deg(np.angle(turn)) % period), (centre.real, centre.imag)
