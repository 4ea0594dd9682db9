"""Settings of the reader from those of the pipeline."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tagid.pipeline.settings import ImagingSettings, TagPriors

if TYPE_CHECKING:
    from tagid.tags.matching.contest_settings import ContestSettings
    from tagid.tags.matching.matcher import ReaderSettings


def reader_settings(settings: ImagingSettings, spent: float = 0.0) -> ReaderSettings:
    """Settings of the reader.

    Args:
        settings: of imaging and reading.
        spent: share of the false-accept probability that was used before, by readings of parts of the turn.
    """
    from tagid.tags.matching.matcher import ReaderSettings
    from tagid.tags.reading.decision import DecisionSettings
    from tagid.tags.reading.hypotheses import SearchSettings

    left = settings.false_accept * (1 - spent)
    return ReaderSettings(
        search=SearchSettings().within(settings.priors.offset_range_m),
        decision=DecisionSettings(false_accept=left),
        contest=_contest_settings(settings.priors, left),
        direction_known=settings.direction_known,
    )


def _contest_settings(known: TagPriors, false_accept: float) -> ContestSettings:
    """Priors, searches and tests on bodies; one that may stand further off is sought and named there."""
    from tagid.tags.bodies.body_reading import BodySettings
    from tagid.tags.bodies.decide import BodyDecision
    from tagid.tags.bodies.reflectors_fit import Priors
    from tagid.tags.bodies.revolution import RoundBody
    from tagid.tags.matching.contest_settings import ContestSettings

    usual, decision = BodySettings(), BodyDecision()
    wider = max(known.centre_sigma_m / usual.priors.centre_m, 1.0)
    body = BodySettings(
        priors=Priors(
            known.centre_sigma_m, known.radius_sigma_m, -known.radius_inside_m, known.radius_outside_m
        ),
        body=RoundBody(reach_m=usual.body.reach_m * wider),
        centre_reach_m=usual.centre_reach_m * wider,
    )
    farther = BodyDecision(centre_m=decision.centre_m * wider)
    return ContestSettings(body=body, decision=farther, false_accept=false_accept)
