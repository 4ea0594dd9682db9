"""What a round wall of known waves says of a reading on a round body with a free pattern."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from tagid.tags.bodies.body_reading import BodyReading, BodySettings
from tagid.tags.bodies.decide import BodyDecision, is_in_place
from tagid.tags.bodies.points import PointReading
from tagid.tags.layouts.layout import Layout
from tagid.tags.matching.contest_settings import ContestSettings
from tagid.tags.verdicts.verdict import Verdict

DOUBTED = 0.30
"""A reading beside a wall bears out one with a free pattern where it leaves up to so much: a wall of another
thickness than those tried leaves a quarter."""
HOPEFUL = 0.30
"""Walls are tried where free patterns leave no more: those of wide jars leave a quarter at 36 views,"""
DOUBT_SIGMAS = 2.0
"""beside so many standard deviations of what the noise may have."""
CLEAR_LEAD = 1.0
"""A name on an opaque round body that leads by less is held against walls. Three reflectors on a can, at
10 dB, passed for two by 0.7; beside walls three led by 2.4. Of 504 right names walls take none."""


def read_beside_wall(
    reading: BodyReading,
    points: PointReading | None,
    layouts: Sequence[Layout],
    body: BodySettings,
) -> BodyReading | None:
    """The reading beside a wall; None where that of a free pattern shows that no wall explains the echo.

    Args:
        reading: on a round body, with a free pattern.
        points: fit of points without a body, against which it must lead; None for none.
        layouts, body: as of the reading.
    """
    least, spectra = reading.least, reading.spectra
    rich = spectra.views >= body.through_views
    above = least - reading.noise - DOUBT_SIGMAS * spectra.noise_doubt
    if rich and above > HOPEFUL * max(reading.body_left - least, 0.0):
        # Five free terms hold the patterns of round walls.
        return None
    from tagid.tags.bodies.cylinder_reader import read_on_cylinder

    beside = read_on_cylinder(spectra, layouts, reading, body)
    return beside if beside is None or points is None else beside.against(points)


def is_doubted(reading: BodyReading, verdict: Verdict, hopeful: bool) -> bool:
    """Whether walls are asked about a reading with a free pattern.

    Args:
        reading, verdict: the reading, and what is said of it.
        hopeful: whether a name that walls give to a refused reading could stand.
    """
    if verdict.status != "identified":
        return hopeful and verdict.status == "unknown"
    return bool(reading.body.name) or reading.through or reading.lead < CLEAR_LEAD


def outdone(reading: BodyReading, others: Sequence[BodyReading], settings: ContestSettings) -> bool:
    """Whether reflectors on another enrolled body explain the echo clearly better than on this enrolled one.

    Args:
        reading: with a free pattern, which leaves less than any wall does.
        others: on the enrolled bodies read before.
        settings: of the contest.
    """
    least = min((other.least for other in others), default=inf)
    return bool(reading.body.name) and reading.least - least > settings.enrolled_other * reading.error


def borne_out(reading: BodyReading, beside: BodyReading | None, decision: BodyDecision) -> bool:
    """Whether a wall bears out a layout that was named with a pattern of many free terms.

    Five of them hold the echo of a helmet shell and its tag as a pair on a round body. No wall does. Nor does
    one whose reflectors do not answer from their places: neighbours on a crate passed for opposite ones.
    """
    if beside is None or beside.layouts[0].layout != reading.layouts[0].layout:
        return False
    fits = beside.lead >= decision.lead and beside.unexplained <= DOUBTED
    return fits and is_in_place(beside, decision)


def disputed(reading: BodyReading, beside: BodyReading | None) -> bool:
    """Whether another arrangement explains the echo better beside a wall.

    Where no arrangement beside a wall explains it, walls have no say: an enrolled body's own may taper.
    """
    if beside is None or beside.least - beside.noise > DOUBTED * beside.tag:
        return False
    return beside.layouts[0].layout != reading.layouts[0].layout or beside.lead < 0
