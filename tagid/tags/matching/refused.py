"""Which hypothesis explains an echo of which nothing is named, for the answer and for its picture.

The decision refuses a layout by the test that it fails first, often one without a body: points on a can's
wall explain most of its echo as well. What stands there is then said by the hypothesis that leaves least.
"""

from __future__ import annotations

from dataclasses import replace

from tagid.tags.bodies.body_reading import BodyReading
from tagid.tags.bodies.hypothesis import Kind
from tagid.tags.matching.contest import stands_alone
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.matching.reading import Reading
from tagid.tags.matching.won import kind_on, measured


def attributed(settled: Reading, settings: ContestSettings) -> Reading:
    """The same refusal as one on the body that explains the echo, with the reflectors measured beside it.

    Args:
        settled: what all hypotheses come to.
        settings: of the contest.
    """
    body = settled.body
    if settled.status != "unknown" or body is None:
        return settled
    if settled.kind is Kind.BARE and _stands(settled, body, settings):
        settled = replace(settled, kind=kind_on(body))
    if settled.kind not in (Kind.ROUND, Kind.BODY):
        return settled
    beside = measured(body, matched=False)
    return replace(settled, reflectors=beside) if beside else settled


def _stands(settled: Reading, body: BodyReading, settings: ContestSettings) -> bool:
    """Whether the body alone explains most of the echo, and reflectors on it leave less than ones without."""
    bare = min((one.left for one in settled.hypotheses if one.kind is Kind.BARE), default=1.0)
    return stands_alone(body, settings) and (body.least - body.noise) / body.signal < bare
