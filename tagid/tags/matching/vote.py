"""One answer from several recordings of the same object, each with the object in another turn and place.

Energies over noise add up where counted heads do not: three weak readings that lean one way are one good one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tagid.counting import counted
from tagid.errors import DataError
from tagid.imaging.types import BasebandScans
from tagid.tags.bodies.hypothesis import Enrolled, Kind
from tagid.tags.layouts.layout import Layout
from tagid.tags.matching.matcher import MatchedScan, ReaderSettings
from tagid.tags.matching.reading import Reading
from tagid.tags.reading.decision import Evidence, decide
from tagid.tags.verdicts.verdict import Code

MAX_SCANS = 100


def read_together(
    recordings: Sequence[BasebandScans],
    layouts: Sequence[Layout],
    settings: ReaderSettings | None = None,
    enrolled: Enrolled | None = None,
) -> tuple[Reading, list[Reading]]:
    """Which layout all the recordings are of.

    Args:
        recordings: 1 to MAX_SCANS recordings of one object, each as `read_tag` takes it.
        layouts: the enrolled ones.
        settings: as of a single reading.
        enrolled: enrolled bodies and objects.

    Returns:
        The joint reading, with turn, place and reflectors of the recording with the most energy over noise;
        and what each recording says alone.

    Raises:
        RegistryError: no layouts. DataError: no or too many recordings, or one without the object's range.
    """
    if not 1 <= len(recordings) <= MAX_SCANS:
        raise DataError(f"{counted(len(recordings), 'recording')} to vote", f"Give 1 to {MAX_SCANS}.")
    settings = settings or ReaderSettings()
    scans = [MatchedScan(recording, layouts, settings, enrolled) for recording in recordings]
    alone = [scan.settled(scan.own) for scan in scans]
    joint = _joint(scans, settings)
    hidden = any(one.hidden_deg for one in alone)
    walled = any(one.wall_m is not None for one in alone)
    if joint.status == "unknown" and (hidden or walled):
        # What disturbs the reading of one recording disturbs that of all.
        clear = [scan.where_seen for scan in scans] if hidden else scans
        without = _joint([scan.without_wall for scan in clear] if walled else clear, settings)
        if without.status == "identified":
            joint = without
    return agreed_on_body(_in_place(joint, alone), alone), alone


def _joint(scans: Sequence[MatchedScan], settings: ReaderSettings) -> Reading:
    """What recordings say together without a body."""
    order = np.argsort(np.sum([scan.criteria for scan in scans], axis=0))
    agreed = [
        scan.own if list(np.argsort(scan.criteria)[:2]) == list(order[:2]) else scan.read(order)
        for scan in scans
    ]
    evidence = joint_evidence([reading.evidence for reading in agreed])
    verdict = decide(evidence, settings.decision)
    status = verdict.status
    clearest = max(agreed, key=lambda reading: reading.evidence.nats)
    return replace(
        clearest,
        status=status,
        reason=verdict.reason,
        code=verdict.code,
        layout=clearest.nearest if status in ("identified", "ambiguous") else None,
        score=0.0 if status == "no_tag" else float(np.mean([reading.score for reading in agreed])),
        margin=float(np.clip(evidence.margin_share, 0, 1)),
        missing=evidence.missing,
        extra=evidence.extra,
        evidence=evidence,
    )


def _in_place(joint: Reading, alone: Sequence[Reading]) -> Reading:
    """The joint reading, its name taken back where most recordings find the reflectors in other places."""
    away = [one for one in alone if one.code is Code.DISPLACED]
    if joint.status != "identified" or 2 * len(away) <= len(alone):
        return joint
    found = max(away, key=lambda one: one.evidence.nats)
    return replace(joint, status=found.status, code=found.code, reason=found.reason, layout=None)


def agreed_on_body(joint: Reading, alone: Sequence[Reading]) -> Reading:
    """The joint reading without a body, or the name that most of the recordings give on a body.

    A recording at which a body contradicts the joint name takes it back where most of them do.
    """
    named = Counter(one.layout for one in alone if one.kind is not Kind.BARE and one.status == "identified")
    told = [one for one in alone if one.kind is not Kind.BARE]
    if 2 * len(told) <= len(alone):
        return joint
    if joint.status == "identified" and named[joint.layout] == len(told):
        return joint
    if len(named) == 1 and 2 * named.total() > len(alone):
        layout = next(iter(named))
        best = max((one for one in told if one.layout == layout), key=lambda one: one.margin)
        if joint.status != "identified" or joint.layout == layout:
            return best
    if joint.status in ("identified", "ambiguous") or len(named) > 1:
        return joint.refused(
            Code.DISAGREE,
            f"{len(told)} of {len(alone)} recordings show a body, and do not agree on a layout on it",
        )
    return max(told, key=lambda one: one.evidence.nats)


def joint_evidence(parts: Sequence[Evidence]) -> Evidence:
    """Evidence of several recordings for one layout: energies add up, shares are weighted by energy.

    A reflector counts as missing or extra where more than half of the recordings say so.
    """
    energy = np.array([part.noise_nats for part in parts])
    weight = energy / max(float(energy.sum()), 1e-30)

    def mean(values: list[float]) -> float:
        return float(np.dot(weight, values))

    return Evidence(
        size=parts[0].size,
        nats=sum(part.nats for part in parts),
        places=parts[0].places,
        share=mean([part.share for part in parts]),
        weakest=mean([part.weakest for part in parts]),
        missing=int(np.median([part.missing for part in parts])),
        extra=int(np.median([part.extra for part in parts])),
        gain_nats=sum(part.gain_nats for part in parts),
        further_nats=sum(part.further_nats for part in parts),
        odds_nats=sum(part.odds_nats for part in parts),
        outward=mean([part.outward for part in parts]),
        noise_nats=float(energy.sum()),
        displacement_m=float(np.sqrt(mean([part.displacement_m**2 for part in parts]))),
        displacement_sigma_m=float(np.sqrt(mean([part.displacement_sigma_m**2 for part in parts]))),
        margin_share=mean([part.margin_share for part in parts]),
        margin_nats=sum(part.margin_nats for part in parts),
        views=min(part.views for part in parts),
        scans=sum(part.scans for part in parts),
        uneven_nats=sum(part.uneven_nats for part in parts),
        absent=int(np.median([part.absent for part in parts])),
    )
